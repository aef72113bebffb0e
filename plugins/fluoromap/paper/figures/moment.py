"""One moment of the cycle in one view of a simulated study: exact and single-view positions.

The electrodes' pixels are the true ones with noise, so that the figures show depth alone. Names and the gantry are correct.
Everything else is as in a study: the two runs of a site are taken one after the other, frames are matched by cardiac phase,
and the triangulator computes positions at diastole and the site's cycle from two views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import (
    Array,
    ChamberMap,
    Context,
    LocatedSite,
    MappedSite,
    MatchedSite,
    MonoplaneView,
    Silent,
    SiteCycle,
    Track,
)
from fluoromap.geometry import Camera
from fluoromap.monoplane.track_samples import in_study
from fluoromap.phantom import SimulatedRun, SimulatedSite, SimulatedStudy
from fluoromap.phantom.ideal_matching import matched_sites
from fluoromap.phantom.simulated_study import ACTIVATION_NOISE_MS, origin_mm
from fluoromap.registry import DEFAULTS, build_fuser, build_monoplane, build_triangulator

PhantomView = Literal["LAT", "PA"]

NOISE_PX = 0.5
_PHASES = 15


@dataclass(frozen=True, eq=False)
class SiteAtMoment:
    """A site in the frame of one run that is nearest to the moment.

    frame : from 0. exact, single_view : true and single-view position of the mapping tip minus the reference catheter's
    mean in that frame. other_cycles_mm : (3,) single-view position with only the cycles of other sites, as at a site with
    one usable view. exact_origin_mm, single_view_origin_mm : (3,) the reference's mean, from the isocentre. ray : (3,)
    unit vector from the source to the true tip. tip_uv : (2,) pixel of the tip. moved_mm : distance of the true tip from
    its place at diastole, both minus the reference.
    """

    frame: int
    exact: MappedSite
    single_view: MappedSite
    other_cycles_mm: Array
    exact_origin_mm: Array
    single_view_origin_mm: Array
    camera: Camera
    ray: Array
    tip_uv: Array
    moved_mm: float


@dataclass(frozen=True, eq=False)
class MomentInView:
    """One moment in runs of one view: all located sites, and the maps of exact and single-view depth."""

    view: PhantomView
    sites: tuple[SiteAtMoment, ...]
    exact: ChamberMap
    single_view: ChamberMap

    def site(self, name: str) -> SiteAtMoment:
        """Return the site of this name."""
        return next(site for site in self.sites if site.exact.site == name)


def farthest_phase(study: SimulatedStudy) -> float:
    """Return the phase at which the tips are farthest from diastole.

    The distances from the diastolic places are averaged over sites and runs.
    """
    phases = np.concatenate([run.truth.phases for site in study.sites for run in site.runs])
    moved = np.concatenate([_moved_mm(study.catalogue, site, run) for site in study.sites for run in site.runs])
    part = np.minimum((phases * _PHASES).astype(np.int64), _PHASES - 1)
    count = np.bincount(part, minlength=_PHASES)
    mean = np.bincount(part, moved, minlength=_PHASES) / np.maximum(count, 1)
    return float((np.argmax(mean) + 0.5) / _PHASES)


def moment_in_views(study: SimulatedStudy, phase: float, context: Context) -> dict[PhantomView, MomentInView]:
    """Return both views at a phase of the cycle.

    The default solver tracks every site in one view at a time.

    Raises
    ------
    Refusal
        Where a view cannot be tracked or the sites make no map.
    """
    matched = {site.site: site for site in matched_sites(study, NOISE_PX, study.spec.seed)}
    triangulator = build_triangulator(DEFAULTS["triangulator"], {})
    located = triangulator.triangulate(tuple(matched.values()), study.catalogue, Silent()).sites
    context.progress(0.3)
    simulated = {site.name: site for site in study.sites}
    cycles = {site.site: site.cycle for site in located if site.cycle is not None}
    views: dict[PhantomView, MomentInView] = {}
    names: tuple[PhantomView, ...] = ("LAT", "PA")
    for number, view in enumerate(names):
        sites = []
        for done, place in enumerate(located, start=1):
            others = tuple(cycle for site, cycle in cycles.items() if site != place.site)
            sites.append(
                _site_at(study.catalogue, simulated[place.site], number, matched[place.site], place, others, phase)
            )
            context.progress(0.3 + 0.35 * (number + 0.8 * done / len(located)))
        fuser = build_fuser(DEFAULTS["fuser"], {})
        exact = fuser.fuse(tuple(site.exact for site in sites), Silent())
        views[view] = MomentInView(
            view, tuple(sites), exact, fuser.fuse(tuple(site.single_view for site in sites), Silent())
        )
    return views


def _site_at(
    catalogue: Catalogue, site: SimulatedSite, view: int, matched: MatchedSite, located: LocatedSite,
    others: tuple[SiteCycle, ...], phase: float,
) -> SiteAtMoment:  # fmt: skip
    run = site.runs[view]
    monoplane_view = MonoplaneView(
        site=site.name,
        view=run.view,
        camera=(located.camera_a, located.camera_b)[view],
        catalogue=catalogue,
        frame_times_ms=run.frame_times_ms,
        observations=(matched.runs.track_a, matched.runs.track_b)[view],
        a_priori=located.a_priori_points,
        a_priori_frame=(located.frame_a, located.frame_b)[view],
        cycle=located.cycle,
        others=() if located.cycle is not None else others,
    )
    solver = build_monoplane(DEFAULTS["monoplane"], {})
    track = in_study(
        solver.track(monoplane_view, Silent()), monoplane_view.camera, catalogue.reference, located.variation
    )
    frame = int(np.argmin(np.abs((run.truth.phases - phase + 0.5) % 1.0 - 0.5)))
    truth = {name: points[frame] for name, points in run.truth.points_mm.items()}
    single_view = _electrodes_mm(catalogue, track, frame)
    without_own_cycle = solver.track(replace(monoplane_view, cycle=None, others=others), Silent())
    tip = track.labels.index((catalogue.mapping, 1))
    covariance = track.covariance_mm2 if track.relative_covariance_mm2 is None else track.relative_covariance_mm2
    ray = truth[catalogue.mapping][0] - monoplane_view.camera.source_world_mm
    return SiteAtMoment(
        frame=frame,
        exact=_mapped_site(catalogue, site, truth, np.zeros((3, 3))),
        single_view=_mapped_site(catalogue, site, single_view, covariance[frame, tip]),
        other_cycles_mm=_tip_mm(catalogue, _electrodes_mm(catalogue, without_own_cycle, frame)),
        exact_origin_mm=origin_mm(truth, catalogue),
        single_view_origin_mm=origin_mm(single_view, catalogue),
        camera=monoplane_view.camera,
        ray=ray / np.linalg.norm(ray),
        tip_uv=track.pixels_uv[frame, tip],
        moved_mm=float(_moved_mm(catalogue, site, run)[frame]),
    )


def _electrodes_mm(catalogue: Catalogue, track: Track, frame: int) -> dict[str, Array]:
    """Return the positions in one frame, catheter -> (electrodes, 3), tip first."""
    at = dict(zip(track.labels, track.positions_mm[frame], strict=True))
    return {name: np.array([at[label] for label in sorted(at) if label[0] == name]) for name in catalogue.names}


def _tip_mm(catalogue: Catalogue, electrodes_mm: dict[str, Array]) -> Array:
    """Return the mapping tip (3,) minus the reference catheter's mean."""
    tip: Array = electrodes_mm[catalogue.mapping][0] - origin_mm(electrodes_mm, catalogue)
    return tip


def _mapped_site(
    catalogue: Catalogue, site: SimulatedSite, electrodes_mm: dict[str, Array], covariance_mm2: Array
) -> MappedSite:
    mapping = electrodes_mm[catalogue.mapping]
    axis = mapping[0] - mapping[1]
    return MappedSite(
        site=site.name,
        tip_mm=_tip_mm(catalogue, electrodes_mm),
        covariance_mm2=covariance_mm2,
        axis=axis / np.linalg.norm(axis),
        tip_length_mm=catalogue[catalogue.mapping].tip_mm,
        lat_ms=site.lat_ms,
        lat_sd_ms=ACTIVATION_NOISE_MS,
    )


def _moved_mm(catalogue: Catalogue, site: SimulatedSite, run: SimulatedRun) -> Array:
    """Return the distance (n,) of the true tip from diastole.

    Both positions are minus the reference catheter's mean.
    """
    points = run.truth.points_mm
    tip = points[catalogue.mapping][:, 0] - origin_mm(points, catalogue)
    moved: Array = np.linalg.norm(tip - site.truth.relative_mm[catalogue.mapping][0], axis=1)
    return moved
