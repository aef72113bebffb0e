"""Table motion between the two runs of a site that the headers do not state."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from fluoromap.contracts import Array, BoolArray, IntArray, View
from fluoromap.geometry import Camera
from fluoromap.triangulator.error_sources import ErrorSource, effect_px, jacobians
from fluoromap.triangulator.study_equations import HeartScale
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels
from fluoromap.triangulator.uncertainty import UncertaintyParams

FEWEST_SITES = 3
"""Fewest sites from which the heart's usual place can be estimated."""
_BEYOND_SD = 4.5
_LEAST_MM = 3.0
_SLIP_MM = 4.0
_JUMP_SHARE, _JUMP_SD_MM = 0.02, 15.0
"""Share of the sites between whose runs the table moves, and how far along one axis."""
CERTAIN, _POSSIBLE = 0.95, 0.05
"""Probabilities of a jump above which it is reported, and above which it counts in the ellipsoids."""
_BREATHING_SHARES = np.geomspace(0.05, 2.0, 20)
"""Breathing of a heart as multiples of the assumed one."""


@dataclass(frozen=True, eq=False)
class Jump:
    """A displacement of the heart in one view of a site.

    displacement_mm : (3,) world, across that view's rays. probability : that it is no breath. A certain jump is reported; a
    possible one widens the ellipsoids of its site.
    """

    view: View
    displacement_mm: Array
    probability: float = 1.0

    @property
    def is_certain(self) -> bool:
        return self.probability >= CERTAIN


def table_jumps(
    sites: Sequence[tuple[Cameras, TwoViewPixels, Array]], resting: frozenset[str], params: UncertaintyParams
) -> list[Jump | None]:
    """Return each site's jump in one view, or None.

    The resting catheters of a site are compared with their usual places over the study. A jump exceeds breathing, is
    visible in one view only and is common to all resting catheters: if one catheter alone moved, it slipped. A
    displacement that both views show alike belongs to both runs and does no harm.

    Parameters
    ----------
    sites : sequence of (cameras, pixels, points (N, 3) in mm)
        Sites in the order they were taken.
    resting : frozenset of str
        Catheters that stay at their place from site to site.
    """
    if len(sites) < FEWEST_SITES:
        return [None] * len(sites)
    moved = _displacements(sites, _usual_places(sites, resting))
    scale, probabilities = _views_apart(moved, params)
    # Only the head-feet direction shows how far this heart breathes.
    own = params.model_copy(update={"respiration_head_feet_sd_mm": scale * params.respiration_head_feet_sd_mm})
    found: list[Jump | None] = [None] * len(sites)
    for row in np.flatnonzero(moved.is_far() | (probabilities > _POSSIBLE)):
        site = int(moved.sites[row])
        found[site] = _site_jump(
            sites[site][0], moved.shared[row], moved.of_views[row], float(probabilities[row]), own, params
        )
    return _with_boundary(found)


def _with_boundary(jumps: list[Jump | None]) -> list[Jump | None]:
    """Return the jumps with the sites at which a lasting move may have happened.

    The table may move between the two runs of a site and stay there. If view b differs at the first sites, the move may have
    happened at the next site; if view a differs at the last sites, at the site before them.
    """
    found = list(jumps)
    views = [jump.view if jump is not None and jump.is_certain else None for jump in jumps]
    first = next((k for k, view in enumerate(views) if view != "b"), len(jumps))
    if 0 < first < len(jumps) and views[first] is None:
        found[first] = jumps[first - 1]
    last = next((k for k, view in enumerate(reversed(views)) if view != "a"), len(jumps))
    before = len(jumps) - last - 1
    if 0 < last < len(jumps) and views[before] is None:
        found[before] = jumps[before + 1]
    return found


def table_notes(names: Sequence[str], jumps: Sequence[Jump | None]) -> list[str]:
    """Return a sentence for each view that certainly jumped.

    It says at which sites, and how far.
    """
    notes = []
    jumps = [jump if jump is not None and jump.is_certain else None for jump in jumps]
    for view in ("a", "b"):
        at = [index for index, jump in enumerate(jumps) if jump is not None and jump.view == view]
        if not at:
            continue
        apart = float(np.median([np.linalg.norm(jump.displacement_mm) for jump in jumps if jump and jump.view == view]))
        later = len(at) > 1 and at == list(range(at[0], len(jumps)))
        where = f"From {names[at[0]]} on" if later else "At " + ", ".join(names[index] for index in at)
        notes.append(
            f"{where} the heart is displaced by {apart:.0f} mm in view {view} but not in the other view: the table moved "
            "between the two runs. Repeat one of them."
        )
    return notes


def jump_source(cameras: Cameras, points_mm: Array, jump: Jump) -> ErrorSource:
    """Return the error source of a jump.

    Either view may show the true place, and a view does not show the jump along its rays. So each view may be displaced in
    any direction by as much as the jump. The variance of a possible jump is its expected value.
    """
    in_a, in_b = np.eye(3, 6), np.eye(3, 6, 3)
    variance = jump.probability * float(jump.displacement_mm @ jump.displacement_mm) / 2
    return ErrorSource(effect_px(jacobians(cameras, points_mm), in_a, in_b), variance * np.eye(6), ("breathing",) * 6)


def _usual_places(
    sites: Sequence[tuple[Cameras, TwoViewPixels, Array]], resting: frozenset[str]
) -> dict[tuple[str, int], Array]:
    by_label: dict[tuple[str, int], list[Array]] = {}
    for _, pixels, points in sites:
        for label, point in zip(pixels.labels, points, strict=True):
            if label[0] in resting:
                by_label.setdefault(label, []).append(point)
    return {label: np.median(places, axis=0) for label, places in by_label.items() if len(places) >= FEWEST_SITES}


@dataclass(frozen=True, eq=False)
class _Displacements:
    """Displacements of the resting catheters at the r sites that show one.

    sites : (r,) indices. shared : (r, 3) unit directions along which both views show a displacement. of_views : (r, 2, 3) in view a
    and b, world, mm, from the usual places and across the view's rays.
    """

    sites: IntArray
    shared: Array
    of_views: Array

    def is_far(self) -> BoolArray:
        """Return where a view is displaced farther than any breath across the shared direction, (r,)."""
        return np.asarray((np.linalg.norm(self._across(), axis=2) > _LEAST_MM).any(axis=1))

    def _across(self) -> Array:
        along = self.of_views @ self.shared[..., None]
        across: Array = self.of_views - along * self.shared[:, None]
        return across


def _displacements(
    sites: Sequence[tuple[Cameras, TwoViewPixels, Array]], usual: dict[tuple[str, int], Array]
) -> _Displacements:
    """Return the displacements of the resting catheters of all sites.

    Sites that show the same electrodes are computed together.
    """
    alike: dict[tuple[tuple[str, int], ...], list[int]] = {}
    for index, (_, pixels, _) in enumerate(sites):
        alike.setdefault(pixels.labels, []).append(index)
    known, of_views = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 2, 3))]
    for labels, members in alike.items():
        rows, places, first = _resting_rows(labels, usual)
        if not len(rows):
            continue
        catheters = [slice(start, stop) for start, stop in itertools.pairwise([*first.tolist(), len(rows)])]
        views = []
        for view in (0, 1):
            matrices = np.array([sites[index][0][view].matrix for index in members])
            uv = np.array([sites[index][1].pixels[view] for index in members])[:, rows]
            moved = _across_rays(matrices, places, uv)
            views.append(_common_displacements(np.stack([moved[:, own].mean(axis=1) for own in catheters], axis=1)))
        known.append(np.array(members))
        of_views.append(np.stack(views, axis=1))
    indices = np.concatenate(known)
    order = np.argsort(indices)
    axes = np.array([[camera.axis_world for camera in sites[index][0]] for index in indices[order]]).reshape(-1, 2, 3)
    shared = np.cross(axes[:, 0], axes[:, 1])
    return _Displacements(
        indices[order], shared / np.sqrt(_dot(shared, shared))[:, None], np.concatenate(of_views)[order]
    )


def _log_normal(x: Array, variance: Array) -> Array:
    """Return the log density of normal deviations with this variance."""
    log_density: Array = -0.5 * (x * x / variance + np.log(2.0 * np.pi * variance))
    return log_density


def _dot(first: Array, second: Array) -> Array:
    """Return the products (r,) of vectors (r, 3)."""
    products: Array = (first[:, None] @ second[..., None])[:, 0, 0]
    return products


def _resting_rows(
    labels: tuple[tuple[str, int], ...], usual: dict[tuple[str, int], Array]
) -> tuple[IntArray, Array, IntArray]:
    """Return the electrodes with a usual place, catheter by catheter.

    They are given by rows (n,) and places (n, 3). The third value are the indices of each catheter's first one.
    """
    names = list(dict.fromkeys(catheter for catheter, _ in labels))
    rows = sorted(
        (row for row, label in enumerate(labels) if label in usual), key=lambda row: names.index(labels[row][0])
    )
    of = [labels[row][0] for row in rows]
    first = [index for index, name in enumerate(of) if not index or of[index - 1] != name]
    places = np.array([usual[labels[row]] for row in rows]).reshape(-1, 3)
    return np.array(rows, dtype=np.int64), places, np.array(first, dtype=np.int64)


def _across_rays(matrices: Array, places_mm: Array, uv: Array) -> Array:
    """Return the smallest displacements (s, n, 3) that move places (n, 3) to pixels (s, n, 2).

    ``matrices`` (s, 3, 4) are those of the cameras.
    """
    homogeneous = places_mm @ np.swapaxes(matrices[:, :, :3], -1, -2) + matrices[:, None, :, 3]
    projected = homogeneous[..., :2] / homogeneous[..., 2:]
    depth = places_mm @ matrices[:, 2, :3, None] + matrices[:, None, 2, 3:]
    jacobian = (matrices[:, None, :2, :3] - projected[..., None] * matrices[:, None, 2:, :3]) / depth[..., None]
    transposed = np.swapaxes(jacobian, -1, -2)
    inverse = transposed @ np.linalg.inv(jacobian @ transposed)
    moved: Array = (inverse @ (uv - projected)[..., None])[..., 0]
    return moved


def _views_apart(moved: _Displacements, params: UncertaintyParams) -> tuple[float, Array]:
    """Return this heart's breathing, and the probability (r,) of a jump at each site.

    A jump displaces the two views of a site farther than a breath does. The breathing is a multiple of the assumed one. Breathing
    displaces the views of every site against each other; a moved table displaces those of a few sites. A few sites show the
    breathing inaccurately, so every breathing counts with its probability.
    """
    if not len(moved.sites):
        return 1.0, np.zeros(0)
    apart = _dot(moved.shared, moved.of_views[:, 0] - moved.of_views[:, 1])
    variance = 2 * _dot((moved.shared[:, None] @ params.respiration_covariance_mm2())[:, 0], moved.shared)
    from_usual = apart - np.median(apart)
    spread = np.square(_BREATHING_SHARES)[:, None] * variance + 2 * params.beat_sd_mm**2
    breath = np.log(1 - _JUMP_SHARE) + _log_normal(from_usual, spread)
    jump = np.log(_JUMP_SHARE) + _log_normal(from_usual, spread + _JUMP_SD_MM**2)
    either = np.logaddexp(breath, jump)
    evidence = either.sum(axis=1) + [HeartScale(share, 1.0).log_prior for share in _BREATHING_SHARES]
    weights = np.exp(evidence - logsumexp(evidence))
    far = np.abs(from_usual) / np.sqrt(2) > _LEAST_MM
    probabilities: Array = far * (weights @ np.exp(jump - either))
    return float(np.sqrt(weights @ np.square(_BREATHING_SHARES))), probabilities


def _site_jump(
    cameras: Cameras, shared: Array, moved: Array, probability: float, own: UncertaintyParams, params: UncertaintyParams
) -> Jump | None:
    """Return the jump of a site, or None.

    ``moved`` (2, 3) are its displacements in both views; they jumped against each other with this ``probability`` along ``shared``
    (3,). ``own`` has this heart's breathing, ``params`` the assumed one.
    """
    strange = [
        _exceeds_breathing(one - shared * (shared @ one), camera, params)
        for one, camera in zip(moved, cameras, strict=True)
    ]
    farther = int(np.linalg.norm(moved[1]) > np.linalg.norm(moved[0]))
    if probability < CERTAIN:
        # Displaced alike in both views: the table moved before both runs, or the heart lies elsewhere. That does no harm.
        alike = all(_exceeds_breathing(shared * float(shared @ one), None, own) for one in moved)
        if alike or all(strange) or not any(strange):
            return Jump("b" if farther else "a", moved[farther], probability) if probability > _POSSIBLE else None
    view = farther if strange[0] == strange[1] else strange.index(True)
    return Jump("b" if view else "a", moved[view])


def _common_displacements(displacements_mm: Array) -> Array:
    """Return the displacement (s, 3) common to the catheters (s, c, 3) of each site.

    It is their mean, or the smallest where one of them slipped.
    """
    mean = displacements_mm.mean(axis=1)
    away = np.linalg.norm(displacements_mm - mean[:, None], axis=2).max(axis=1)
    for site in np.flatnonzero(away > _SLIP_MM):
        own = displacements_mm[site]
        mean[site] = own[np.argmin(np.linalg.norm(own, axis=1))]
    return np.asarray(mean)


def _exceeds_breathing(displacement_mm: Array, camera: Camera | None, params: UncertaintyParams) -> bool:
    """Return True where breathing and a beat do not explain a displacement.

    With a camera, only the part across its central ray counts.
    """
    if float(np.linalg.norm(displacement_mm)) <= _LEAST_MM:
        return False
    # The usual place is a median over sites, so that its breathing is smaller: 1.25 instead of 2 variances.
    spread = 1.25 * params.respiration_covariance_mm2() + params.beat_sd_mm**2 * np.eye(3)
    if camera is not None:
        basis = np.linalg.svd(camera.axis_world[None])[2][1:]
        inverse = basis.T @ np.linalg.inv(basis @ spread @ basis.T) @ basis
    else:
        inverse = np.linalg.inv(spread)
    sds = float(np.sqrt(displacement_mm @ inverse @ displacement_mm))
    return sds > _BEYOND_SD
