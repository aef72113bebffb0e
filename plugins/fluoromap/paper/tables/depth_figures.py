"""The four figures of the paper's tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array


@dataclass(frozen=True, slots=True)
class DepthFigures:
    """One row of the paper's tables, mm.

    mean_mm, min_mm, max_mm : |dz found - dz true| over points and displacements from image to image, dz along the central
    ray. rms_mm : "3D RMS", of the accumulated position error over points and all images but the first.
    """

    mean_mm: float
    min_mm: float
    max_mm: float
    rms_mm: float


def depth_figures(errors_mm: Sequence[Array], axes: Sequence[Array]) -> DepthFigures:
    """Return the figures over several sequences.

    Parameters
    ----------
    errors_mm : sequence of ndarray, each shape (images, m, 3)
        Found position minus true position, world.
    axes : sequence of ndarray, each shape (3,)
        Central ray of the view of each sequence.
    """
    steps = np.concatenate(
        [np.abs(np.diff(error @ axis, axis=0)).ravel() for error, axis in zip(errors_mm, axes, strict=True)]
    )
    squares = np.concatenate([(error[1:] ** 2).sum(axis=2).ravel() for error in errors_mm])
    return DepthFigures(float(steps.mean()), float(steps.min()), float(steps.max()), float(np.sqrt(squares.mean())))
