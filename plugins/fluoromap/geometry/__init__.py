"""From gantry angles to cameras; perspective, weak-perspective and parallel projection."""

from fluoromap.geometry.camera import Camera, direction_angle_deg, ray_angle_deg
from fluoromap.geometry.gantry import LEAST_SOURCE_MM, Gantry, camera_from_gantry, view_axes

__all__ = [
    "LEAST_SOURCE_MM",
    "Camera",
    "Gantry",
    "camera_from_gantry",
    "direction_angle_deg",
    "ray_angle_deg",
    "view_axes",
]
