"""Table motion between the two runs of a site that the headers do not state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluoromap.contracts import Array, View
from fluoromap.geometry import Camera
from fluoromap.triangulator.two_view_pixels import Cameras, TwoViewPixels
from fluoromap.triangulator.uncertainty import UncertaintyParams

FEWEST_SITES = 3
"""Fewest sites from which the heart's usual place can be estimated."""
_BEYOND_SD = 4.5
_LEAST_MM = 4.0
_SLIP_MM = 4.0


@dataclass(frozen=True, eq=False)
class Jump:
    """A displacement of the heart in one view of a site: ``displacement_mm`` (3,), world, across that view's rays."""

    view: View
    displacement_mm: Array


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
    return [_site_jump(cameras, pixels, usual, params) for cameras, pixels, _ in sites]


def table_notes(names: Sequence[str], jumps: Sequence[Jump | None]) -> list[str]:
    """Return a sentence for each view that jumped.

    It says at which sites, and how far.
    """
    notes = []
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


def _usual_places(
    sites: Sequence[tuple[Cameras, TwoViewPixels, Array]], resting: frozenset[str]
) -> dict[tuple[str, int], Array]:
    by_label: dict[tuple[str, int], list[Array]] = {}
    for _, pixels, points in sites:
        for label, point in zip(pixels.labels, points, strict=True):
            if label[0] in resting:
                by_label.setdefault(label, []).append(point)
    return {label: np.median(places, axis=0) for label, places in by_label.items() if len(places) >= FEWEST_SITES}


def _site_jump(
    cameras: Cameras, pixels: TwoViewPixels, usual: dict[tuple[str, int], Array], params: UncertaintyParams
) -> Jump | None:
    found: list[Array] = []
    strange: list[bool] = []
    for camera, uv in zip(cameras, pixels.pixels, strict=True):
        moved: dict[str, list[Array]] = {}
        for label, pixel in zip(pixels.labels, uv, strict=True):
            if label in usual:
                inverse = np.linalg.pinv(camera.jacobian(usual[label]))
                moved.setdefault(label[0], []).append(inverse @ (pixel - camera.project(usual[label])))
        if not moved:
            return None
        common = _common_displacement(np.array([np.mean(own, axis=0) for own in moved.values()]))
        found.append(common)
        strange.append(_exceeds_breathing(common, camera, params))
    # Only a displacement along this direction is visible in both views.
    shared = np.cross(cameras[0].axis_world, cameras[1].axis_world)
    shared /= np.linalg.norm(shared)
    apart = shared * float(shared @ (found[0] - found[1]))
    if all(strange) and not _exceeds_breathing(apart / np.sqrt(2), None, params):
        return None
    if not any(strange):
        return None
    view = int(np.linalg.norm(found[1]) > np.linalg.norm(found[0])) if all(strange) else strange.index(True)
    return Jump("b" if view else "a", found[view])


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
    # The usual place is a median over sites, so that its breathing is smaller: 1.25 instead of 2 variances.
    spread = 1.25 * params.respiration_covariance_mm2() + params.beat_sd_mm**2 * np.eye(3)
    if camera is not None:
        basis = np.linalg.svd(camera.axis_world[None])[2][1:]
        inverse = basis.T @ np.linalg.inv(basis @ spread @ basis.T) @ basis
    else:
        inverse = np.linalg.inv(spread)
    sds = float(np.sqrt(displacement_mm @ inverse @ displacement_mm))
    return sds > _BEYOND_SD and float(np.linalg.norm(displacement_mm)) > _LEAST_MM
