"""The paper's figures on a small simulated heart: their numbers agree with the positions."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from fluoromap.contracts import Silent
from fluoromap.drawing.colours import scale_of
from fluoromap.paper.figures import PaperFigures, paper_figures
from fluoromap.paper.figures.differences import map_difference, site_differences, time_differences_ms
from fluoromap.paper.figures.moment import MomentInView, PhantomView, farthest_phase, moment_in_views
from fluoromap.paper.figures.pictures import figure, in_space, on_frame, shared_scale
from fluoromap.phantom import SimulatedStudy, StudySpec, simulate_study


@pytest.fixture(scope="module")
def study() -> SimulatedStudy:
    return simulate_study(StudySpec(5, 6, 30, 30.0, heart="dog"))


@pytest.fixture(scope="module")
def moments(study: SimulatedStudy) -> dict[PhantomView, MomentInView]:
    return moment_in_views(study, farthest_phase(study), Silent())


@pytest.fixture(scope="module")
def made() -> PaperFigures:
    return paper_figures(6, Silent(), sites=4)


def _without_depth_error(moment: MomentInView) -> MomentInView:
    sites = tuple(replace(site, single_view=site.exact) for site in moment.sites)
    return replace(moment, sites=sites, single_view=moment.exact)


def test_the_moment_is_when_the_tips_are_farthest_from_diastole(study: SimulatedStudy) -> None:
    phase = farthest_phase(study)
    # Systole; the heart is at rest around 0.8.
    assert 0.15 < phase < 0.5
    catalogue = study.catalogue

    def moved(at: float) -> float:
        found = []
        for site in study.sites:
            for run in site.runs:
                frame = np.argmin(np.abs((run.truth.phases - at + 0.5) % 1 - 0.5))
                points = run.truth.points_mm
                tip = points[catalogue.mapping][frame, 0] - points[catalogue.reference][frame].mean(axis=0)
                found.append(np.linalg.norm(tip - site.truth.relative_mm[catalogue.mapping][0]))
        return float(np.mean(found))

    assert moved(phase) >= 0.9 * max(moved(at) for at in np.arange(20) / 20)


def test_exact_positions_project_to_the_pixel_of_the_tip(moments: dict[PhantomView, MomentInView]) -> None:
    for moment in moments.values():
        for site in moment.sites:
            at = site.camera.project(site.exact.tip_mm + site.exact_origin_mm)
            assert np.abs(at - site.tip_uv).max() < 5 * 0.5
            assert np.linalg.norm(site.ray) == pytest.approx(1)


def test_one_view_errs_along_its_rays(moments: dict[PhantomView, MomentInView]) -> None:
    for moment in moments.values():
        of = map_difference(moment, site_differences(moment.sites))
        assert 0 < of.rms_lateral_mm < 0.4
        assert of.rms_lateral_mm < of.rms_along_ray_mm < 3
        assert of.rms_mm < of.other_cycles_rms_mm < 5


def test_equal_maps_differ_by_nothing(moments: dict[PhantomView, MomentInView]) -> None:
    moment = _without_depth_error(moments["LAT"])
    of = map_difference(moment, site_differences(moment.sites))
    assert (of.rms_mm, of.largest_mm) == (0, 0)
    assert of.largest_ms == pytest.approx(0, abs=1e-9)
    assert of.compared_points == of.covered_points > 0
    above, below = in_space(moment)
    assert np.array_equal(above, below)


def test_times_shifted_everywhere_differ_by_the_shift(moments: dict[PhantomView, MomentInView]) -> None:
    chamber = moments["LAT"].exact
    later = replace(chamber, lat_ms=np.where(chamber.covered, chamber.lat_ms + 7.0, 0.0))
    assert time_differences_ms(chamber, later) == pytest.approx(7.0)


def test_parts_of_the_wall_that_one_map_leaves_open_are_not_compared(moments: dict[PhantomView, MomentInView]) -> None:
    chamber = moments["LAT"].exact
    first = chamber.vertices_mm[:, 2] > np.median(chamber.vertices_mm[:, 2])
    half = replace(chamber, covered=chamber.covered & first)
    compared = time_differences_ms(chamber, half)
    assert 0 < len(compared) <= half.covered.sum()
    assert compared == pytest.approx(0, abs=1e-9)


def test_both_maps_share_their_colours(moments: dict[PhantomView, MomentInView]) -> None:
    moment = moments["PA"]
    later = replace(moment.exact, lat_ms=moment.exact.lat_ms + 63.0)
    scale = shared_scale(moment.exact, later)
    for chamber in (moment.exact, later):
        own = scale_of(chamber)
        assert scale.start_ms <= own.start_ms
        assert scale.stop_ms >= own.stop_ms
        assert scale.step_ms >= own.step_ms


def test_overlays_differ_only_where_something_is_drawn(
    study: SimulatedStudy, moments: dict[PhantomView, MomentInView]
) -> None:
    moment = _without_depth_error(moments["LAT"])
    shown = moment.sites[0]
    moment = replace(moment, sites=(replace(shown, single_view_origin_mm=shown.exact_origin_mm), *moment.sites[1:]))
    stored = np.random.default_rng(1).integers(400, 2400, (512, 512)).astype(np.uint16)
    above, below = on_frame(moment, shown.exact.site, stored)
    assert above.shape == (1024, 1024, 3)
    assert np.array_equal(above, below)


def test_long_captions_stay_on_the_page() -> None:
    part = np.zeros((50, 300, 3), np.uint8)
    short, long = (figure("Title", [("Above", part)], ["word " * words]) for words in (1, 100))
    assert long.shape[0] > short.shape[0]
    # Nothing is written on the border.
    assert (long[:, -8:] == long[0, 0]).all()


def test_the_file_agrees_with_its_positions(made: PaperFigures) -> None:
    content = json.loads(made.files()["figures.json"])
    assert (content["simulated"], content["seed"], content["simulated_sites"]) == (True, 6, 4)
    assert [(view["view"], view["figures"]) for view in content["views"]] == [("LAT", [3, 4]), ("PA", [5])]
    for view in content["views"]:
        sites, of = view["sites"], view["difference"]
        exact, single, ray, other = (
            np.array([site[name] for site in sites])
            for name in ("exact_mm", "single_view_mm", "ray", "other_cycles_mm")
        )
        distance = np.linalg.norm(single - exact, axis=1)
        along = ((single - exact) * ray).sum(axis=1)
        lateral = np.linalg.norm(np.cross(single - exact, ray), axis=1)
        assert [site["distance_mm"] for site in sites] == pytest.approx(distance)
        assert [site["along_ray_mm"] for site in sites] == pytest.approx(along)
        assert [site["lateral_mm"] for site in sites] == pytest.approx(lateral)
        for name, values in (("rms_mm", distance), ("rms_along_ray_mm", along), ("rms_lateral_mm", lateral)):
            assert of[name] == pytest.approx(np.sqrt(np.mean(values**2)))
        assert of["largest_mm"] == pytest.approx(distance.max())
        assert of["farthest_site"] == sites[int(distance.argmax())]["site"]
        assert of["other_cycles_largest_mm"] == pytest.approx(np.linalg.norm(other - exact, axis=1).max())
        assert 0 <= of["median_ms"] <= of["largest_ms"]


def test_every_figure_is_a_picture(made: PaperFigures) -> None:
    files = made.files()
    assert set(files) == {"figure3.png", "figure4.png", "figure5.png", "figures.json"}
    for number in (3, 4, 5):
        picture = Image.open(io.BytesIO(files[f"figure{number}.png"]))
        assert min(picture.size) > 900
