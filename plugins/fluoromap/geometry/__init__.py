"""From gantry angles to cameras; perspective, weak-perspective and parallel projection."""

from fluoromap.geometry.camera import Camera, ray_angle_deg
from fluoromap.geometry.gantry import Gantry, camera_from_gantry

__all__ = ["Camera", "Gantry", "camera_from_gantry", "ray_angle_deg"]
