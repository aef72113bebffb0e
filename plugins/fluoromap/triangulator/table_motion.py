"""Table motion between the two runs of a site that the headers do not state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm

from fluoromap.contracts import Array, View
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
    usual = _usual_places(sites, resting)
    found = [_displacements(cameras, pixels, usual) for cameras, pixels, _ in sites]
    scale, probabilities = _views_apart(sites, found, params)
    # Only the head-feet direction shows how far this heart breathes.
    own = params.model_copy(update={"respiration_head_feet_sd_mm": scale * params.respiration_head_feet_sd_mm})
    return _with_boundary([
        None if moved is None else _site_jump(cameras, moved, probability, own, params)
        for (cameras, *_), moved, probability in zip(sites, found, probabilities, strict=True)
    ])  # fmt: skip


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


def _displacements(
    cameras: Cameras, pixels: TwoViewPixels, usual: dict[tuple[str, int], Array]
) -> tuple[Array, Array] | None:
    """Return the displacements of the resting catheters in view a and b.

    Each is (3,), from their usual places and across the view's rays. None where the site shows no resting catheter.
    """
    rows = [row for row, label in enumerate(pixels.labels) if label in usual]
    if not rows:
        return None
    places = np.array([usual[pixels.labels[row]] for row in rows])
    catheters = [pixels.labels[row][0] for row in rows]
    found: list[Array] = []
    for camera, uv in zip(cameras, pixels.pixels, strict=True):
        jacobian = camera.jacobian(places)
        transposed = np.swapaxes(jacobian, -1, -2)
        inverse = transposed @ np.linalg.inv(jacobian @ transposed)
        moved = (inverse @ (uv[rows] - camera.project(places))[..., None])[..., 0]
        own = [[name == catheter for name in catheters] for catheter in dict.fromkeys(catheters)]
        found.append(_common_displacement(np.array([moved[of].mean(axis=0) for of in own])))
    return found[0], found[1]


def _shared_axis(cameras: Cameras) -> Array:
    """Return the unit direction (3,) along which both views show a displacement."""
    shared = np.cross(cameras[0].axis_world, cameras[1].axis_world)
    unit: Array = shared / np.linalg.norm(shared)
    return unit


def _views_apart(
    sites: Sequence[tuple[Cameras, TwoViewPixels, Array]],
    found: Sequence[tuple[Array, Array] | None],
    params: UncertaintyParams,
) -> tuple[float, list[float]]:
    """Return this heart's breathing, and each site's probability of a jump.

    A jump displaces the two views of a site farther than a breath does. The breathing is a multiple of the assumed one. Breathing
    displaces the views of every site against each other; a moved table displaces those of a few sites. A few sites show the
    breathing inaccurately, so every breathing counts with its probability.
    """
    known = [index for index, moved in enumerate(found) if moved is not None]
    probabilities = [0.0] * len(sites)
    if not known:
        return 1.0, probabilities
    apart, variance = [], []
    for index in known:
        (cameras, *_), moved = sites[index], found[index]
        assert moved is not None
        shared = _shared_axis(cameras)
        apart.append(float(shared @ (moved[0] - moved[1])))
        variance.append(2 * float(shared @ params.respiration_covariance_mm2() @ shared))
    from_usual = np.array(apart) - np.median(apart)
    spread = np.square(_BREATHING_SHARES)[:, None] * np.array(variance) + 2 * params.beat_sd_mm**2
    breath = np.log(1 - _JUMP_SHARE) + norm.logpdf(from_usual, 0, np.sqrt(spread))
    jump = np.log(_JUMP_SHARE) + norm.logpdf(from_usual, 0, np.sqrt(spread + _JUMP_SD_MM**2))
    either = np.logaddexp(breath, jump)
    evidence = either.sum(axis=1) + [HeartScale(share, 1.0).log_prior for share in _BREATHING_SHARES]
    weights = np.exp(evidence - logsumexp(evidence))
    far = np.abs(from_usual) / np.sqrt(2) > _LEAST_MM
    for index, probability in zip(known, far * (weights @ np.exp(jump - either)), strict=True):
        probabilities[index] = float(probability)
    return float(np.sqrt(weights @ np.square(_BREATHING_SHARES))), probabilities


def _site_jump(
    cameras: Cameras, moved: tuple[Array, Array], probability: float, own: UncertaintyParams, params: UncertaintyParams
) -> Jump | None:
    """Return the jump of a site, or None.

    ``moved`` are its displacements in both views; they jumped against each other with this ``probability``. ``own`` has this
    heart's breathing, ``params`` the assumed one.
    """
    shared = _shared_axis(cameras)
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


def _common_displacement(displacements_mm: Array) -> Array:
    """Return the displacement (3,) common to k catheters (k, 3).

    It is their mean, or the smallest where one of them slipped.
    """
    mean = displacements_mm.mean(axis=0)
    if np.linalg.norm(displacements_mm - mean, axis=1).max() <= _SLIP_MM:
        return np.asarray(mean)
    return np.asarray(displacements_mm[np.argmin(np.linalg.norm(displacements_mm, axis=1))])


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
