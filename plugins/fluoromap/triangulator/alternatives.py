"""Points whose catheter could be paired otherwise across the views: the other place belongs to what is told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fluoromap.contracts import Array, ElectrodePoint
from fluoromap.reasons import Reason


def with_alternative(
    points: tuple[ElectrodePoint, ...],
    other: Mapping[tuple[str, int], ElectrodePoint],
    reference_shift_mm: Array | None,
    probability: float,
) -> tuple[ElectrodePoint, ...]:
    """The points with the places they would have under another pairing of the site's catheters.

    With probability p the truth lies at the other place, d away and known there with its own covariance C': the second
    moment about the told place is ``(1 - p) C + p (C' + d d')``. That is the mixture's covariance, with p (1 - p) d d',
    and p^2 d d' for its mean, which is not told. Where the reference catheter is paired otherwise, every relative
    position hangs on it.

    Parameters
    ----------
    other : mapping
        (catheter, electrode) -> the same electrode under the alternative pairing.
    reference_shift_mm : ndarray (3,) or None
        Where the reference's mean would be, less where it is; None where it is not located in both pairings.
    probability : float
        Of the alternative.
    """
    return tuple(
        _mixed(point, other.get((point.catheter, point.electrode)), reference_shift_mm, probability) for point in points
    )


_SAME_MM = 0.01


def _mixed(
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
    moved = apart - reference_shift_mm
    if np.linalg.norm(moved) <= _SAME_MM:
        return point
    mixed = _second_moment(point.relative_covariance_mm2, other.relative_covariance_mm2, moved, p)
    return replace(point, relative_covariance_mm2=mixed)


def _second_moment(own: Array, other: Array, apart_mm: Array, p: float) -> Array:
    moment: Array = (1 - p) * own + p * (other + np.outer(apart_mm, apart_mm))
    return moment
