"""The position of a C-arm's gantry, and the camera that belongs to it."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from fluoromap.geometry.camera import Array, Camera

ImageAxes = tuple[tuple[int, int], tuple[int, int]]
UPRIGHT: ImageAxes = ((1, 0), (0, 1))

LEAST_SOURCE_MM = 200.0
"""Shortest distance of the X-ray source from isocentre and detector that a C-arm can have."""


@dataclass(frozen=True, slots=True)
class Gantry:
    """Position of source and detector during a run.

    Parameters
    ----------
    primary_deg : float
        PositionerPrimaryAngle (0018,1510): LAO positive, RAO negative.
    secondary_deg : float
        PositionerSecondaryAngle (0018,1511): cranial positive, caudal negative.
    source_detector_mm : float
        DistanceSourceToDetector (0018,1110), SID.
    source_isocentre_mm : float
        DistanceSourceToPatient (0018,1111), SOD: source to isocentre.
    pixel_spacing_mm : tuple of float
        ImagerPixelSpacing (0018,1164): row spacing, column spacing, at the DETECTOR.
    rows, columns : int
        Size of the stored image.
    image_axes : tuple
        Integer matrix that takes (u, v) offsets of the upright image, seen from the detector, to offsets of the stored
        image. It follows from FieldOfViewRotation, FieldOfViewHorizontalFlip or PatientOrientation. The identity by
        default.

    Raises
    ------
    ValueError
        When a number is outside the range of a C-arm.
    """

    primary_deg: float
    secondary_deg: float
    source_detector_mm: float
    source_isocentre_mm: float
    pixel_spacing_mm: tuple[float, float]
    rows: int
    columns: int
    image_axes: ImageAxes = UPRIGHT

    def __post_init__(self) -> None:
        numbers = (
            self.primary_deg, self.secondary_deg, self.source_detector_mm, self.source_isocentre_mm,
            *self.pixel_spacing_mm,
        )  # fmt: skip
        if not all(math.isfinite(number) for number in numbers):
            raise ValueError("gantry values must be finite numbers")
        if abs(self.primary_deg) > 180 or abs(self.secondary_deg) > 90:
            raise ValueError("PositionerPrimaryAngle lies within 180 degrees, PositionerSecondaryAngle within 90")
        if not LEAST_SOURCE_MM <= self.source_isocentre_mm < self.source_detector_mm <= 3000:
            raise ValueError(
                f"the source distances are {self.source_isocentre_mm:g} mm to the isocentre and {self.source_detector_mm:g} mm "
                f"to the detector; both must be {LEAST_SOURCE_MM:g} to 3000 mm, the detector being farther"
            )
        if not all(0.01 <= spacing <= 5 for spacing in self.pixel_spacing_mm):
            raise ValueError("ImagerPixelSpacing must be between 0.01 and 5 mm")
        if self.rows < 1 or self.columns < 1:
            raise ValueError("an image has at least one row and one column")
        lines = (*self.image_axes, *zip(*self.image_axes, strict=True))
        if any(sorted(map(abs, line)) != [0, 1] for line in lines):
            raise ValueError(
                f"image_axes is {self.image_axes}; it must be a turn by 0, 90, 180 or 270 degrees, with or without a flip: "
                "each row and each column has one 0 and one 1 or -1"
            )


def view_axes(primary_deg: float, secondary_deg: float) -> Array:
    """Return the axes e_u, e_v and n of a view, (3, 3).

    The rows are unit vectors in the world (LPS). e_u and e_v are the directions of +u and +v in the upright image, n points
    from the isocentre to the detector. The displayed image looks at the patient from the detector: a frontal view shows the
    patient's left on the image's right. With a the primary and b the secondary angle::

        e_u = (cos a, sin a, 0)
        e_v = (sin a sin b, -cos a sin b, -cos b)
        n = (sin a cos b, -cos a cos b, sin b)

    (e_u, e_v, n) is left-handed. DICOM PS3.3 C.8.7.5.1.2.

    Parameters
    ----------
    primary_deg, secondary_deg : float
        See :class:`Gantry`.
    """
    a, b = math.radians(primary_deg), math.radians(secondary_deg)
    return np.array(
        [
            [math.cos(a), math.sin(a), 0.0],
            [math.sin(a) * math.sin(b), -math.cos(a) * math.sin(b), -math.cos(b)],
            [math.sin(a) * math.cos(b), -math.cos(a) * math.cos(b), math.sin(b)],
        ]
    )


@functools.lru_cache(maxsize=256)
def camera_from_gantry(gantry: Gantry) -> Camera:
    """Return the perspective camera of a gantry position, for stored pixels.

    The same position returns the same object. The axes are those of :func:`view_axes`; the isocentre projects to the
    middle of the field (DICOM PS3.17 FFF.2.1.5.2).
    """
    axes = view_axes(gantry.primary_deg, gantry.secondary_deg)
    # Millimetres on the detector are turned like the image, then converted to stored pixels.
    across: Array = np.array(gantry.image_axes, dtype=np.float64) @ axes[:2]
    row_spacing, column_spacing = gantry.pixel_spacing_mm
    focal = gantry.source_detector_mm / np.array([column_spacing, row_spacing])
    centre = np.array([(gantry.columns - 1) / 2, (gantry.rows - 1) / 2])
    matrix = np.empty((3, 4))
    matrix[2] = [*axes[2], gantry.source_isocentre_mm]
    matrix[:2, :3] = focal[:, None] * across
    matrix[:2, 3] = 0.0
    matrix[:2] += centre[:, None] * matrix[2]
    return Camera(matrix, gantry.rows, gantry.columns)
