"""What the triangulators share: from a matched site to a located one, given how to find points from two views."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Array,
    Context,
    ElectrodePoint,
    LocatedSite,
    MatchedSite,
    NamedChain,
    PhasePair,
    RejectedSite,
    SiteCycle,
    Triangulation,
)
from fluoromap.geometry import Camera, ray_angle_deg
from fluoromap.matching.two_view import PARALLEL_BELOW_DEG
from fluoromap.reasons import Reason
from fluoromap.triangulator.uncertainty import UncertaintyParams, joint_covariance, relative_covariance_mm2

IN_MOST_PAIRS = 0.8
"""An electrode belongs to the site's cycle when both views show it at this share of the moments."""
FEWEST_MOMENTS = 4


@dataclass(frozen=True, eq=False)
class TwoViewPixels:
    """The N electrodes that both views show at one moment.

    labels : (catheter, electrode). pixels : (N, 2) in view a, view b. covariances : (N, 2, 2) in view a, view b.
    """

    labels: tuple[tuple[str, int], ...]
    pixels: tuple[Array, Array]
    covariances: tuple[Array, Array]

    def only(self, labels: Sequence[tuple[str, int]]) -> TwoViewPixels:
        """The same moment with these electrodes, in this order."""
        rows = [self.labels.index(label) for label in labels]
        (pa, pb), (ca, cb) = self.pixels, self.covariances
        return TwoViewPixels(tuple(labels), (pa[rows], pb[rows]), (ca[rows], cb[rows]))


Cameras = tuple[Camera, Camera]
Locate = Callable[[Cameras, TwoViewPixels], Array]
"""Cameras and pixels of N electrodes -> their points (N, 3) in the world, mm."""
EstimateShift = Callable[[Cameras, TwoViewPixels], Array]
"""Cameras and pixels -> the displacement (2, 3), in the world in mm, that all electrodes share in view a and in view b."""


def seen_in_both(pair: PhasePair) -> TwoViewPixels:
    """The electrodes that both views of a pair show, paired by catheter and number."""
    first, second = _by_label(pair.a.chains), _by_label(pair.b.chains)
    labels = tuple(label for label in first if label in second)

    def stack(of: dict[tuple[str, int], tuple[Array, Array]], part: int, shape: tuple[int, ...]) -> Array:
        return np.array([of[label][part] for label in labels]).reshape(len(labels), *shape)

    return TwoViewPixels(
        labels,
        (stack(first, 0, (2,)), stack(second, 0, (2,))),
        (stack(first, 1, (2, 2)), stack(second, 1, (2, 2))),
    )


def _by_label(chains: Sequence[NamedChain]) -> dict[tuple[str, int], tuple[Array, Array]]:
    return {
        (chain.catheter, electrode): (pixel, covariance)
        for chain in chains
        for electrode, pixel, covariance in zip(chain.electrodes, chain.pixels_uv, chain.covariance_px2, strict=True)
    }


def locate_study(
    sites: Sequence[MatchedSite],
    catalogue: Catalogue,
    context: Context,
    params: UncertaintyParams,
    locate: Locate,
    estimate_shift: EstimateShift | None,
) -> Triangulation:
    """Locate every site; those whose views are too close or whose mapping catheter is missing are rejected."""
    located, rejected, notes = [], [], []
    for index, site in enumerate(sites):
        context.check()
        angle = ray_angle_deg(site.camera_a, site.camera_b)
        pixels = seen_in_both(site.diastole)
        if angle < PARALLEL_BELOW_DEG:
            rejected.append(RejectedSite(site.site, (Reason.VIEWS_PARALLEL,)))
            notes.append(f"{site.site}: the views are {angle:.0f} degrees apart; at least 20 are needed.")
        elif catalogue.mapping not in {catheter for catheter, _ in pixels.labels}:
            rejected.append(RejectedSite(site.site, (Reason.CATHETER_NOT_FOUND,)))
        else:
            answer, note = _locate_site(site, pixels, catalogue, params, locate, estimate_shift)
            located.append(answer)
            notes.extend(note)
        context.progress((index + 1) / len(sites))
    return Triangulation(tuple(located), tuple(rejected), tuple(notes))


def _locate_site(
    site: MatchedSite,
    pixels: TwoViewPixels,
    catalogue: Catalogue,
    params: UncertaintyParams,
    locate: Locate,
    estimate_shift: EstimateShift | None,
) -> tuple[LocatedSite, list[str]]:
    nominal = (site.camera_a, site.camera_b)
    cameras, notes = nominal, []
    if estimate_shift is not None:
        shift_a, shift_b = estimate_shift(nominal, pixels)
        cameras = (site.camera_a.translated(shift_a), site.camera_b.translated(shift_b))
        apart_mm = float(np.linalg.norm(shift_b - shift_a))
        if apart_mm > 2.0:
            notes.append(
                f"{site.site}: between its two runs the whole heart stands {apart_mm:.0f} mm apart (breathing, a moved "
                "table or the gantry's angles); positions relative to the reference catheter hardly suffer from it."
            )
    points = locate(cameras, pixels)
    catheters = tuple(catheter for catheter, _ in pixels.labels)
    joint = joint_covariance(
        cameras, points, pixels.covariances, catheters, params, params.catheter_sd_mm(), estimate_shift is not None
    )
    residuals = [
        np.linalg.norm(camera.project(points) - seen, axis=1)
        for camera, seen in zip(cameras, pixels.pixels, strict=True)
    ]
    angles = _ray_angles_deg(nominal, pixels)
    reference = [index for index, catheter in enumerate(catheters) if catheter == catalogue.reference]
    reference_mm = points[reference].mean(axis=0) if reference else None
    mismatched = _spacing_mismatches(points, pixels.labels, catalogue, params.spacing_limit_mm)
    doubts: dict[str, list[Reason]] = {}
    for catheter, reason in site.notes:
        doubts.setdefault(catheter, []).append(reason)
    electrode_points = tuple(
        ElectrodePoint(
            catheter=catheter,
            electrode=electrode,
            position_mm=points[i],
            covariance_mm2=joint[i, :, i],
            relative_mm=None if reference_mm is None else points[i] - reference_mm,
            relative_covariance_mm2=relative_covariance_mm2(joint, i, reference) if reference else None,
            residual_px=(float(residuals[0][i]), float(residuals[1][i])),
            ray_angle_deg=float(angles[i]),
            reasons=(*doubts.get(catheter, []), *([Reason.SPACING_MISMATCH] if i in mismatched else [])),
        )
        for i, (catheter, electrode) in enumerate(pixels.labels)
    )
    reasons = [reason for reason, holds in (
        (Reason.NO_REFERENCE, reference_mm is None),
        (Reason.PHASE_UNKNOWN, site.diastole.a.phase is None or site.diastole.b.phase is None),
    ) if holds]  # fmt: skip
    answer = LocatedSite(
        site=site.site,
        camera_a=site.camera_a,
        camera_b=site.camera_b,
        frame_a=site.diastole.a.frame,
        frame_b=site.diastole.b.frame,
        points=electrode_points,
        reference_mm=reference_mm,
        cycle=locate_cycle(site.cycle, cameras, params, locate, estimate_shift is not None),
        reasons=tuple(reasons),
    )
    return answer, notes


def _ray_angles_deg(cameras: Cameras, pixels: TwoViewPixels) -> Array:
    """Angle between each electrode's two rays, folded to 0..90 degrees, shape (N,)."""
    ray_a, ray_b = (camera.rays(seen) for camera, seen in zip(cameras, pixels.pixels, strict=True))
    cosine = np.abs((ray_a * ray_b).sum(axis=1))
    angles: Array = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
    return angles


def _spacing_mismatches(
    points: Array, labels: Sequence[tuple[str, int]], catalogue: Catalogue, limit_mm: float
) -> set[int]:
    """Indices of electrodes whose distance from the next one located on the catheter is not the catalogue's."""
    found: set[int] = set()
    for name in catalogue.names:
        along = catalogue[name].arc_lengths_mm
        own = sorted(
            (electrode, i) for i, (catheter, electrode) in enumerate(labels)
            if catheter == name and electrode <= len(along)
        )  # fmt: skip
        for (first, i), (second, j) in itertools.pairwise(own):
            distance = float(np.linalg.norm(points[i] - points[j]))
            if abs(distance - (along[second - 1] - along[first - 1])) > limit_mm:
                found |= {i, j}
    return found


def locate_cycle(
    pairs: Sequence[PhasePair], cameras: Cameras, params: UncertaintyParams, locate: Locate, shift_estimated: bool
) -> SiteCycle | None:
    """The site's electrodes at every matched phase; None where too few moments show them.

    ``cameras`` have the shift between the runs taken out already: it is the same at all phases.
    """
    moments = [(pair.phase, seen_in_both(pair)) for pair in pairs if pair.phase is not None]
    counts: dict[tuple[str, int], int] = {}
    for _, pixels in moments:
        for label in pixels.labels:
            counts[label] = counts.get(label, 0) + 1
    labels = tuple(label for label, count in counts.items() if count >= IN_MOST_PAIRS * len(moments))
    whole: dict[float, TwoViewPixels] = {}
    for phase, pixels in moments:
        # Beats told by R waves repeat phase 0; one moment of each phase is enough.
        if phase not in whole and set(labels) <= set(pixels.labels):
            whole[phase] = pixels.only(labels)
    if not labels or len(whole) < FEWEST_MOMENTS:
        return None
    catheters = tuple(catheter for catheter, _ in labels)
    phases = np.array(sorted(whole))
    positions = np.array([locate(cameras, whole[phase]) for phase in phases])
    # The geometry hardly changes over the cycle: what is unsure at its mean place is so throughout, but for the pixels.
    mean_pixels = tuple(np.mean([pixels.covariances[v] for pixels in whole.values()], axis=0) for v in (0, 1))
    joint = joint_covariance(
        cameras, positions.mean(axis=0), (mean_pixels[0], mean_pixels[1]), catheters, params,
        params.cycle_beat_sd_mm, shift_estimated,
    )  # fmt: skip
    own = np.einsum("iaib->iab", joint)
    return SiteCycle(phases, labels, positions, np.broadcast_to(own, (len(phases), *own.shape)))
