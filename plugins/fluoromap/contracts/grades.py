"""Grades: the trust in a position."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from fluoromap.reasons import AT_BEST_B, AT_BEST_C, Reason

CHI2_95_3D = 7.814727903251179
"""95th percentile of the chi-squared distribution with 3 degrees of freedom: a 95 % ellipsoid's squared radius."""


class Grade(StrEnum):
    """Trust in a position: by the largest semi-axis of its 95 % ellipsoid, and by the doubts about it."""

    A = "A"
    B = "B"
    C = "C"
    REJECTED = "rejected"


def grade_of(covariance_mm2: ArrayLike, reasons: Iterable[Reason] = ()) -> Grade:
    """Return the grade of a 3x3 position covariance with the reasons of the position.

    A up to 2 mm, B up to 4 mm, C beyond (largest semi-axis of the 95 % ellipsoid). Reasons that no covariance contains limit
    the grade: see ``AT_BEST_C`` and ``AT_BEST_B``.
    """
    return grades_of(np.asarray(covariance_mm2)[None], reasons)[0]


def grades_of(covariances_mm2: ArrayLike, reasons: Iterable[Reason] = ()) -> list[Grade]:
    """Return the grades of covariances (n, 3, 3) that have the same reasons; see :func:`grade_of`."""
    own = tuple(reasons)
    return [grade_of_axis(axis, own) for axis in largest_semi_axes_mm(covariances_mm2)]


def largest_semi_axes_mm(covariances_mm2: ArrayLike) -> list[float]:
    """Return the largest semi-axis of the 95 % ellipsoid of each covariance (n, 3, 3)."""
    largest = np.maximum(np.linalg.eigvalsh(np.asarray(covariances_mm2, dtype=np.float64))[:, -1], 0.0)
    semi_axes_mm: list[float] = np.sqrt(CHI2_95_3D * largest).tolist()
    return semi_axes_mm


def grade_of_axis(semi_axis_mm: float, reasons: Iterable[Reason]) -> Grade:
    """Return the grade for a largest semi-axis and reasons.

    See :func:`grade_of`.
    """
    doubts = set(reasons)
    if semi_axis_mm > 4.0 or doubts & AT_BEST_C:
        return Grade.C
    return Grade.B if semi_axis_mm > 2.0 or doubts & AT_BEST_B else Grade.A
