"""Phase matching of a site's two runs, and comparison of their motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, BoolArray, NamedChain, Observation, PhasePair
from fluoromap.geometry import Camera
from fluoromap.matching.phase import phase_distance
from fluoromap.matching.run_catheters import RunCatheter
from fluoromap.matching.two_view import signed_epipolar_px

NEAREST_PHASE = 0.03
"""Frames of the two views show the same moment of the cycle when their phases differ by no more than this."""
WIDEST_GAP = 0.15
"""Frames with a larger difference in phase are not interpolated: that would cut systole short."""
MOMENTS = 50
"""Number of phases at which the motion of two runs is compared."""
_BLUR = 0.025
_LEAST_MOTION_PX = 0.5
_MOTION_SD_PX = 1.5
_MOTION_SD_SHARE = 0.12
_INDEPENDENT_MOMENTS = 4.0


@dataclass(frozen=True, eq=False)
class FoldedRun:
    """The motion of a run's catheters over one cycle, from all beats together.

    paths : for each catheter electrode number -> pixels (MOMENTS, 2) at phases evenly from 0 on.
    phase_uncertainty : the largest possible distance of phase 0 from the R wave, in cycles; 0.5 without R waves.
    """

    paths: tuple[dict[int, Array], ...]
    phase_uncertainty: float


def fold(catheters: Sequence[RunCatheter], phases: Array, phase_uncertainty: float) -> FoldedRun:
    """Combine all beats of a run into one cycle.

    phases : (n,) of its frames.
    """
    paths: list[dict[int, Array]] = []
    for catheter in catheters:
        frames, electrodes, pixels = catheter.electrode_paths
        if len(frames) < 4:
            paths.append({})
            continue
        at = phases[frames]
        blur = max(_BLUR, 0.5 * float(np.diff(np.sort(at), append=np.sort(at)[:1] + 1).max()))
        apart = phase_distance(np.arange(MOMENTS)[:, None] / MOMENTS, at[None, :])
        weights = np.exp(-0.5 * (apart / blur) ** 2)
        weights /= weights.sum(axis=1, keepdims=True)
        smooth = np.einsum("kn,nei->kei", weights, pixels)
        paths.append({number: smooth[:, row] for row, number in enumerate(electrodes)})
    return FoldedRun(tuple(paths), phase_uncertainty)


def _variations(
    cameras: tuple[Camera, Camera], folded: tuple[FoldedRun, FoldedRun], pairs: Sequence[tuple[int, int]]
) -> tuple[Array, Array]:
    """Return the variation of each pair's epipolar distance over the cycle, px^2.

    Both views show the same motion across the epipolar lines: at equal phases the distance does not change.

    Returns
    -------
    (p, MOMENTS)
        For each shift of view b's phases by k / MOMENTS. NaN where no electrode is tracked in both runs.
    (p,)
        The variation if the two chains were different catheters.
    """
    known, first, second = [], [], []
    for row, (i, j) in enumerate(pairs):
        path_a, path_b = folded[0].paths[i], folded[1].paths[j]
        common = sorted(set(path_a) & set(path_b))
        if common:
            known.append(row)
            first.append(np.mean([path_a[number] for number in common], axis=0))
            second.append(np.mean([path_b[number] for number in common], axis=0))
    variation, unlike = np.full((len(pairs), MOMENTS), np.nan), np.full(len(pairs), np.nan)
    if known:
        distance = signed_epipolar_px(*cameras, np.array(first)[:, :, None], np.array(second)[:, None, :])
        moments = np.arange(MOMENTS)
        # With view b's phases shifted by s, its image at phase p was recorded at p - s.
        recorded = (moments[None, :] - moments[:, None]) % MOMENTS
        variation[known] = distance[:, moments[None, :], recorded].var(axis=2)
        unlike[known] = distance.var(axis=1).mean(axis=1) + distance.var(axis=2).mean(axis=1)
    return variation, unlike


def motion_misfit(cameras: tuple[Camera, Camera], folded: tuple[FoldedRun, FoldedRun] | None, n: int, m: int) -> Array:
    """Return the cost of each pair's different motion in the two views, nats.

    Returns
    -------
    ndarray, shape (n, m, k)
        For n and m catheters and k possible shifts of view b's phases, 0 among them; k is 0 without phases.
    """
    if folded is None:
        return np.zeros((n, m, 0))
    pairs = [(i, j) for i in range(n) for j in range(m)]
    variation, unlike = _variations(cameras, folded, pairs)
    variation = variation[:, _allowed_shifts(folded)]
    usual = _MOTION_SD_PX**2 + _MOTION_SD_SHARE**2 * unlike[:, None]
    cost = _INDEPENDENT_MOMENTS / 2 * np.log1p(np.nan_to_num(variation / usual, nan=1.0))
    misfit: Array = cost.reshape(n, m, -1)
    return misfit


def phase_shift(
    cameras: tuple[Camera, Camera], folded: tuple[FoldedRun, FoldedRun], pairs: Sequence[tuple[int, int]]
) -> float:
    """Return the shift of view b's phases for which both views count alike.

    It lies between -0.5 and 0.5. It is the shift for which the paired catheters' epipolar distances vary least, within
    the limits of the R waves. It is 0 where hardly anything moves across the epipolar lines.
    """
    allowed = _allowed_shifts(folded)
    variation = np.nansum(_variations(cameras, folded, pairs)[0], axis=0) / max(len(pairs), 1)
    best = int(np.flatnonzero(allowed)[np.argmin(variation[allowed])])
    if np.sqrt(variation.max()) - np.sqrt(variation[best]) < _LEAST_MOTION_PX:
        return 0.0
    left, middle, right = variation[(best + np.array([-1, 0, 1])) % MOMENTS]
    bend = left - 2 * middle + right
    between = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend > 0 else 0.0
    shift = float(((best + between) / MOMENTS + 0.5) % 1.0 - 0.5)
    farthest = folded[0].phase_uncertainty + folded[1].phase_uncertainty
    return float(np.clip(shift, -farthest, farthest))


def _allowed_shifts(folded: tuple[FoldedRun, FoldedRun]) -> BoolArray:
    """Return which of the MOMENTS shifts (MOMENTS,) of view b's phases are possible."""
    farthest = folded[0].phase_uncertainty + folded[1].phase_uncertainty
    within: BoolArray = phase_distance(np.arange(MOMENTS) / MOMENTS, np.array(0.0)) <= farthest
    return within


def pair_by_phase(track_a: Sequence[Observation], track_b: Sequence[Observation]) -> tuple[PhasePair, ...]:
    """Pair each frame of view a with view b at the same phase.

    The pairs have rising phases, and only frames with catheters are used. The partner is view b's frame nearest in
    phase, of any beat. At low frame rates there may be none near enough. Then the positions are interpolated between
    the frames before and after in phase. A moment between frames that differ too much is left out.
    """
    shown_a = [seen for seen in track_a if seen.chains and seen.phase is not None]
    shown_b = sorted((seen for seen in track_b if seen.chains and seen.phase is not None), key=_phase_of)
    if not shown_a or not shown_b:
        return ()
    phases_b = np.array([_phase_of(seen) for seen in shown_b])
    pairs = []
    for seen in sorted(shown_a, key=lambda entry: (_phase_of(entry), entry.frame)):
        apart = phase_distance(np.array(seen.phase), phases_b)
        nearest = int(np.argmin(apart))
        partner: Observation | None = shown_b[nearest]
        if apart[nearest] > NEAREST_PHASE:
            after = int(np.searchsorted(phases_b, _phase_of(seen))) % len(shown_b)
            partner = _interpolate(shown_b[after - 1], shown_b[after], _phase_of(seen))
        if partner is not None:
            pairs.append(PhasePair(seen.phase, seen, partner))
    return tuple(pairs)


def _phase_of(seen: Observation) -> float:
    assert seen.phase is not None
    return seen.phase


def _interpolate(before: Observation, after: Observation, phase: float) -> Observation | None:
    """Return the interpolated observation at ``phase``.

    None where the two moments are too far apart or have no electrode in common.
    """
    gap = (_phase_of(after) - _phase_of(before)) % 1.0
    if not 0 < gap <= WIDEST_GAP:
        return None
    share = ((phase - _phase_of(before)) % 1.0) / gap
    later = {chain.catheter: chain for chain in after.chains}
    chains = []
    for early in before.chains:
        late = later.get(early.catheter)
        common = tuple(number for number in early.electrodes if late is not None and number in late.electrodes)
        if late is None or not common:
            continue
        first = [early.electrodes.index(number) for number in common]
        second = [late.electrodes.index(number) for number in common]
        chains.append(
            NamedChain(
                early.catheter,
                common,
                (1 - share) * early.pixels_uv[first] + share * late.pixels_uv[second],
                (1 - share) ** 2 * early.covariance_px2[first] + share**2 * late.covariance_px2[second],
            )
        )
    frame = before.frame if share <= 0.5 else after.frame
    return Observation(frame, phase, tuple(chains)) if chains else None
