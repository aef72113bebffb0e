"""A site at diastole, and the errors of its electrodes in one study."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from scipy.special import chdtrc

from fluoromap.contracts import Array
from fluoromap.triangulator.error_sources import Share, study_covariance
from fluoromap.triangulator.self_calibration import StudyBelief

DOUBTFUL_BELOW = 1e-5
"""Probability of a site's misfit by chance below which its geometry is doubted."""


@dataclass(frozen=True, eq=False)
class MomentErrors:
    """The errors of a moment in one study.

    inflation : misfit over its expected value where chance does not explain it, else 1. joint_mm2 : (N, 3, N, 3) covariance of all
    electrodes. squares_mm2 : sum of the electrodes' variances from each source, in the order of the error budget.
    """

    inflation: float
    joint_mm2: Array
    squares_mm2: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Moment:
    """A site at diastole: N electrodes in 3D, and how errors displace them.

    The k study errors are those of :func:`~fluoromap.triangulator.error_sources.study_sources`: only their size depends on the
    study. So a correction at another site changes no moment unless it changes the cameras.

    labels : (catheter, electrode) of each electrode. points_mm : (N, 3) world. residuals_px : (N, 2 views, 2), without the
    displacement of the heart between the runs. ray_angles_deg : (N,). breathing_mm : half of that displacement, as far as the
    views show it.
    own_mm2 : (3 N, 3 N) covariance of the points from pixels and from errors whose size no study shows. study_mm : (3 N, k)
    effect of one unit of each study error. shares : (k,) their entries of the error budget. squares_mm2 : the budget of
    ``own_mm2``.
    apart_px : (e,) epipolar distances; empty where the method does not compare them. own_px2 : (e, e), study_px : (e, k), as above.
    """

    labels: tuple[tuple[str, int], ...]
    points_mm: Array
    residuals_px: Array
    ray_angles_deg: Array
    breathing_mm: float
    own_mm2: Array
    study_mm: Array
    shares: tuple[str, ...]
    squares_mm2: tuple[float, ...]
    apart_px: Array
    own_px2: Array
    study_px: Array


@dataclass(frozen=True, eq=False)
class Diastole:
    """A site at diastole under the chosen pairing of its catheters, and under the alternative one.

    chosen, alternative : None where no plausible position agrees with both views, or where there is no such pairing. probability :
    of the alternative pairing. frame_a, frame_b : the diastolic frames, from 0. phase_known : whether both have a phase.
    """

    chosen: Moment | None
    alternative: Moment | None
    probability: float
    frame_a: int
    frame_b: int
    phase_known: bool


BUDGET = get_args(Share)
"""Entries of the :class:`~fluoromap.contracts.ErrorBudget`, in its order."""


@functools.lru_cache(maxsize=16)
def _study_errors(belief: StudyBelief, catheters: int) -> Array:
    """Return the covariance of the study errors.

    It is the same for all sites with as many catheters.
    """
    return study_covariance(belief.params, belief.gantry.covariance, catheters)


@functools.lru_cache(maxsize=16)
def _members(shares: tuple[str, ...]) -> tuple[tuple[str, ...], Array]:
    """Return the different shares (m,), and which errors belong to each, (m, k), 0 or 1."""
    names = tuple(dict.fromkeys(shares))
    return names, np.array([[own == share for own in shares] for share in names], dtype=np.float64)


def errors_in_study(moments: Sequence[Moment], belief: StudyBelief) -> list[MomentErrors]:
    """Return the errors of each moment in a study of this belief.

    Moments of the same shape are computed together.
    """
    alike: dict[tuple[object, ...], list[int]] = {}
    for index, moment in enumerate(moments):
        catheters = len({catheter for catheter, _ in moment.labels})
        alike.setdefault((catheters, moment.shares, moment.study_mm.shape, len(moment.apart_px)), []).append(index)
    found: dict[int, MomentErrors] = {}
    for members in alike.values():
        found |= zip(members, _errors_of_shape([moments[index] for index in members], belief), strict=True)
    return [found[index] for index in range(len(moments))]


def _errors_of_shape(moments: Sequence[Moment], belief: StudyBelief) -> list[MomentErrors]:
    first = moments[0]
    n, own = len(first.labels), np.array([moment.own_mm2 for moment in moments])
    study = np.array([moment.study_mm for moment in moments])
    errors = _study_errors(belief, len({catheter for catheter, _ in first.labels}))
    inflation = _inflations(moments, errors)
    transposed = np.swapaxes(study, -1, -2)
    joint = own + study @ errors @ transposed
    joint = (inflation[:, None, None] * (joint + np.swapaxes(joint, -1, -2)) / 2).reshape(len(moments), n, 3, n, 3)
    # The electrodes' variances from each pair of study errors.
    of_pairs = errors * (transposed @ study)
    names, of = _members(first.shares)
    squares = ((of @ of_pairs) * of).sum(axis=2).tolist()
    return [
        MomentErrors(float(inflated), of_all, _added(moment.squares_mm2, names, added))
        for moment, inflated, of_all, added in zip(moments, inflation, joint, squares, strict=True)
    ]


def _inflations(moments: Sequence[Moment], study_errors: Array) -> Array:
    """Return the inflation of each moment's covariance; see :class:`MomentErrors`."""
    count = len(moments[0].apart_px)
    if not count:
        return np.ones(len(moments))
    study = np.array([moment.study_px for moment in moments])
    expected = np.array([moment.own_px2 for moment in moments]) + study @ study_errors @ np.swapaxes(study, -1, -2)
    apart = np.array([moment.apart_px for moment in moments])
    weighed = np.linalg.solve(expected, apart[..., None])[..., 0]
    misfits = np.array([own @ other for own, other in zip(apart, weighed, strict=True)])
    return np.where(chdtrc(count, misfits) < DOUBTFUL_BELOW, misfits / count, 1.0)


def _added(squares_mm2: tuple[float, ...], shares: Sequence[str], added: Sequence[float]) -> tuple[float, ...]:
    """Add the squares of some shares to the error budget."""
    squares = dict(zip(BUDGET, squares_mm2, strict=True))
    for share, square in zip(shares, added, strict=True):
        squares[share] += square
    return tuple(squares.values())
