"""Figures 3, 4 and 5 of the paper with their numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from fluoromap.contracts import Context
from fluoromap.drawing.overlay import Picture
from fluoromap.drawing.png import encode_png
from fluoromap.paper.figures.differences import MapDifference, SiteDifference, map_difference, site_differences
from fluoromap.paper.figures.moment import NOISE_PX, MomentInView, PhantomView, farthest_phase, moment_in_views
from fluoromap.paper.figures.pictures import figure, in_space, on_frame
from fluoromap.phantom import SimulatedRun, SimulatedStudy, StudySpec, simulate_study
from fluoromap.registry import DEFAULTS

SITES = 20
"""Mapping sites, as in the paper."""
# A run of about two seconds, as in the paper, with about 15 images a cycle.
_FRAMES, _FRAME_RATE_HZ = 60, 30.0


@dataclass(frozen=True, slots=True)
class ViewNumbers:
    """Results of one view. figures : the figures' numbers in the paper."""

    view: PhantomView
    figures: tuple[int, ...]
    difference: MapDifference
    sites: tuple[SiteDifference, ...]


@dataclass(frozen=True, slots=True)
class FigureNumbers:
    """Results of all figures.

    phase : of the cardiac cycle at the shown moment, 0 at an R wave. moved_mm : mean distance of the tips from their
    places at diastole at that moment. shown_site : the site of the frames in Figures 4 and 5. simulated_sites : number of
    sites before any were rejected.
    """

    simulated: bool
    seed: int
    simulated_sites: int
    noise_px: float
    breathing_mm: float
    monoplane: str
    fuser: str
    phase: float
    moved_mm: float
    shown_site: str
    views: tuple[ViewNumbers, ...]


@dataclass(frozen=True, eq=False)
class PaperFigures:
    """The pictures, RGB, by their number in the paper, and their results."""

    pictures: Mapping[int, Picture]
    numbers: FigureNumbers

    def files(self) -> dict[str, bytes]:
        """Return the content of every file by its name.

        The files are a PNG for each figure, and ``figures.json``.
        """
        content = {f"figure{number}.png": encode_png(picture) for number, picture in self.pictures.items()}
        text = json.dumps(asdict(self.numbers), indent=2, allow_nan=False)
        return {**content, "figures.json": f"{text}\n".encode()}


def paper_figures(seed: int, context: Context, sites: int = SITES) -> PaperFigures:
    """Make the figures; the same arguments give the same pictures.

    Parameters
    ----------
    seed : int
        Seed of the simulated heart.
    sites : int
        Mapping sites, 4 or more.

    Raises
    ------
    ValueError
        Where the heart does not fit into the views' fields.
    Refusal
        Where a view cannot be tracked or the sites make no map.
    """
    study = simulate_study(StudySpec(seed, sites, _FRAMES, _FRAME_RATE_HZ, heart="dog", contrast=("LAT", "PA")))
    phase = farthest_phase(study)
    context.progress(0.05)
    views = moment_in_views(study, phase, context)
    lateral, frontal = views["LAT"], views["PA"]
    # Single-view depth is hardest where the tip moves most.
    shown = max(lateral.sites, key=lambda site: site.moved_mm).exact.site
    numbers = FigureNumbers(
        simulated=True,
        seed=seed,
        simulated_sites=sites,
        noise_px=NOISE_PX,
        breathing_mm=study.spec.breathing_mm,
        monoplane=DEFAULTS["monoplane"],
        fuser=DEFAULTS["fuser"],
        phase=phase,
        moved_mm=float(np.mean([site.moved_mm for site in lateral.sites])),
        shown_site=shown,
        views=(_numbers(lateral, (3, 4)), _numbers(frontal, (5,))),
    )
    of_lateral, of_frontal = numbers.views
    lateral_run, frontal_run = _runs(study, shown)
    pictures = {
        3: _figure("Figure 3. Isochronal map in 3D", in_space(lateral), of_lateral, numbers),
        4: _figure(
            f"Figure 4. Map fused on the lateral frame, site {shown}",
            on_frame(lateral, shown, lateral_run.frames[lateral.site(shown).frame]),
            of_lateral,
            numbers,
        ),
        5: _figure(
            f"Figure 5. Map fused on the postero-anterior frame, site {shown}",
            on_frame(frontal, shown, frontal_run.frames[frontal.site(shown).frame]),
            of_frontal,
            numbers,
        ),
    }
    context.progress(1.0)
    return PaperFigures(pictures, numbers)


def _runs(study: SimulatedStudy, name: str) -> tuple[SimulatedRun, SimulatedRun]:
    return next(site.runs for site in study.sites if site.name == name)


def _numbers(moment: MomentInView, figures: tuple[int, ...]) -> ViewNumbers:
    sites = site_differences(moment.sites)
    return ViewNumbers(moment.view, figures, map_difference(moment, sites), sites)


def _figure(title: str, maps: tuple[Picture, Picture], shown: ViewNumbers, numbers: FigureNumbers) -> Picture:
    exact, single_view = maps
    parts = (
        ("Exact depth: the phantom's true tips", exact),
        (f"Single-view depth: from the {shown.view} view alone ({numbers.monoplane})", single_view),
    )
    return figure(f"{title} (simulated, seed {numbers.seed})", parts, _caption(shown, numbers))


def _caption(shown: ViewNumbers, numbers: FigureNumbers) -> tuple[str, ...]:
    of = shown.difference
    farthest = next(site for site in shown.sites if site.site == of.farthest_site)
    compared = 100 * of.compared_points / of.covered_points
    return (
        f"Sites, single view against exact: RMS {of.rms_mm:.2f} mm (along the ray {of.rms_along_ray_mm:.2f}, lateral "
        f"{of.rms_lateral_mm:.2f}); largest {of.largest_mm:.2f} mm at {farthest.site} (along the ray "
        f"{abs(farthest.along_ray_mm):.2f}, lateral {farthest.lateral_mm:.2f}). "
        f"Times of the two maps over the covered wall: median difference {of.median_ms:.1f} ms, largest "
        f"{of.largest_ms:.1f} ms ({compared:.0f} % of its points are covered in both).",
        f"Moment: phase {numbers.phase:.2f} of the cycle, when the tips are farthest from their places at diastole "
        f"({numbers.moved_mm:.1f} mm on average). Positions are relative to the reference catheter; same colours above and "
        f"below; wall by {numbers.fuser}.",
        f"The single-view solver knows the positions at diastole and the cycle from the site's own two runs (the tracked run "
        f"is one of them), taken one after the other with up to {numbers.breathing_mm:g} mm of breathing. With the cycles of "
        f"other sites instead, as for a site with one usable view: RMS {of.other_cycles_rms_mm:.2f} mm, largest "
        f"{of.other_cycles_largest_mm:.2f} mm.",
        f"Simulated dog's heart, seed {numbers.seed}; {len(shown.sites)} of {numbers.simulated_sites} sites; electrodes at "
        f"their true pixels with {numbers.noise_px:g} px noise per axis (not segmented).",
    )
