"""Two runs of a site brought to the same cardiac phase."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fluoromap.contracts import Array, NamedChain, Observation, PhasePair
from fluoromap.geometry import Camera
from fluoromap.matching.phase import phase_distance
from fluoromap.matching.two_view import signed_epipolar_px

NEAREST_PHASE = 0.03
"""Frames of the two views are the same moment of the cycle when their phases differ by no more than this."""
_SHIFTS = np.linspace(-0.5, 0.5, 101)
_LEAST_MOTION_PX = 0.5


def pair_by_phase(track_a: Sequence[Observation], track_b: Sequence[Observation]) -> tuple[PhasePair, ...]:
    """Each frame of view a with the frame of view b nearest in phase, by rising phase; only frames that show catheters."""
    shown_a = [seen for seen in track_a if seen.chains and seen.phase is not None]
    shown_b = [seen for seen in track_b if seen.chains and seen.phase is not None]
    if not shown_a or not shown_b:
        return ()
    phases_b = np.array([seen.phase for seen in shown_b])
    pairs = []
    for seen in sorted(shown_a, key=lambda entry: (entry.phase, entry.frame)):
        apart = phase_distance(np.array(seen.phase), phases_b)
        nearest = int(np.argmin(apart))
        if apart[nearest] <= NEAREST_PHASE:
            pairs.append(PhasePair(seen.phase, seen, shown_b[nearest]))
    return tuple(pairs)


def align_phases(
    camera_a: Camera, camera_b: Camera, track_a: Sequence[Observation], track_b: Sequence[Observation]
) -> Array:
    """Phases of view b's frames, shifted so that both views count from the same moment of the cycle.

    What moves across the epipolar lines is seen by both views: at equal phases the epipolar distance of an electrode
    stays what it is, at unequal ones it follows the heart. The shift is the one that leaves the least variation. Where
    hardly anything moves in that direction the phases stay as they are.

    Returns
    -------
    ndarray, shape (n_b,)
        For the observations of ``track_b``, which must all have a phase.
    """
    phases_a = np.array([seen.phase for seen in track_a], dtype=np.float64)
    phases_b = np.array([seen.phase for seen in track_b], dtype=np.float64)
    labels = _electrodes_in_most(track_a) & _electrodes_in_most(track_b)
    if not labels:
        return phases_b
    pixels_a, pixels_b = _pixels(track_a, sorted(labels)), _pixels(track_b, sorted(labels))
    good_a, good_b = np.isfinite(pixels_a).all(axis=(1, 2)), np.isfinite(pixels_b).all(axis=(1, 2))
    if good_a.sum() < 4 or good_b.sum() < 4:
        return phases_b
    pixels_a, times_a = pixels_a[good_a], phases_a[good_a]
    order = np.argsort(phases_b[good_b])
    pixels_b, times_b = pixels_b[good_b][order], phases_b[good_b][order]
    variation = np.array(
        [
            signed_epipolar_px(camera_a, camera_b, pixels_a, _at_phases(times_b + shift, pixels_b, times_a))
            .var(axis=0)
            .mean()
            for shift in _SHIFTS
        ]
    )
    best = int(np.argmin(variation))
    if np.sqrt(variation.max()) - np.sqrt(variation[best]) < _LEAST_MOTION_PX:
        return phases_b
    shifted: Array = (phases_b + _SHIFTS[best]) % 1.0
    return shifted


def _electrodes_in_most(track: Sequence[Observation]) -> set[tuple[str, int]]:
    counts: dict[tuple[str, int], int] = {}
    for seen in track:
        for chain in seen.chains:
            for electrode in chain.electrodes:
                counts[chain.catheter, electrode] = counts.get((chain.catheter, electrode), 0) + 1
    return {label for label, count in counts.items() if count >= 0.8 * len(track)}


def _pixels(track: Sequence[Observation], labels: Sequence[tuple[str, int]]) -> Array:
    """Pixels (n, m, 2) of these electrodes, NaN where not seen."""
    pixels = np.full((len(track), len(labels), 2), np.nan)
    place = {label: index for index, label in enumerate(labels)}
    for row, seen in enumerate(track):
        for chain in seen.chains:
            _put(pixels[row], chain, place)
    return pixels


def _put(row: Array, chain: NamedChain, place: dict[tuple[str, int], int]) -> None:
    for electrode, pixel in zip(chain.electrodes, chain.pixels_uv, strict=True):
        if (chain.catheter, electrode) in place:
            row[place[chain.catheter, electrode]] = pixel


def _at_phases(phases: Array, pixels: Array, wanted: Array) -> Array:
    """Pixels (n, m, 2), known at ``phases`` (n,), interpolated round the cycle at ``wanted`` (k,): (k, m, 2)."""
    flat = pixels.reshape(len(pixels), -1)
    columns = [np.interp(wanted, phases, flat[:, column], period=1.0) for column in range(flat.shape[1])]
    interpolated: Array = np.stack(columns, axis=1).reshape(len(wanted), *pixels.shape[1:])
    return interpolated
