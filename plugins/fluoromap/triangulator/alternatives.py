"""Uncertainty of electrodes whose catheters could be paired another way across the views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fluoromap.contracts import Array, ElectrodePoint
from fluoromap.reasons import Reason


def add_alternative(
    points: tuple[ElectrodePoint, ...],
    others: tuple[ElectrodePoint, ...],
    reference_shift_mm: Array | None,
    probability: float,
) -> tuple[ElectrodePoint, ...]:
    """Widen the covariances of points by another pairing of the site's catheters.

    With probability p the true position is the alternative one. It lies at distance d from the reported position and has
    its own covariance C'. The second moment about the reported position is ``(1 - p) C + p (C' + d d')``. This is the
    covariance of the mixture, which contains p (1 - p) d d', plus p^2 d d' because the mixture's mean is not reported.
    If the reference catheter is paired differently, every relative position changes with it.

    Parameters
    ----------
    points : tuple of ElectrodePoint
        Electrodes under the most probable pairing.
    others : tuple of ElectrodePoint
        Electrodes under the alternative pairing.
    reference_shift_mm : ndarray (3,) or None
        Displacement of the reference's mean from this pairing to the alternative one, world; None where the reference is
        not located in both pairings.
    probability : float
        Probability of the alternative.
    """
    by_label = {(point.catheter, point.electrode): point for point in others}
    return tuple(
        _mix(point, by_label.get((point.catheter, point.electrode)), reference_shift_mm, probability)
        for point in points
    )


_SAME_MM = 0.01


def _mix(
    point: ElectrodePoint, other: ElectrodePoint | None, reference_shift_mm: Array | None, p: float
) -> ElectrodePoint:
    if other is None:
        return point
    apart = other.position_mm - point.position_mm
    if np.linalg.norm(apart) > _SAME_MM:
        doubts = (
            point.reasons if Reason.IDENTITY_UNCERTAIN in point.reasons else (*point.reasons, Reason.IDENTITY_UNCERTAIN)
        )
        point = replace(
            point,
            covariance_mm2=_second_moment(point.covariance_mm2, other.covariance_mm2, apart, p),
            reasons=doubts,
            alternative_mm=other.position_mm,
            alternative_probability=p,
        )
    if (
        point.relative_covariance_mm2 is None or other.relative_covariance_mm2 is None or reference_shift_mm is None
    ):  # fmt: skip
        return point
    relative_apart = apart - reference_shift_mm
    if np.linalg.norm(relative_apart) <= _SAME_MM:
        return point
    moment = _second_moment(point.relative_covariance_mm2, other.relative_covariance_mm2, relative_apart, p)
    return replace(point, relative_covariance_mm2=moment)


def _second_moment(own: Array, other: Array, apart_mm: Array, p: float) -> Array:
    moment: Array = (1 - p) * own + p * (other + np.outer(apart_mm, apart_mm))
    return moment
