"""Faults that only the whole study shows: a wrong gantry, a wrong catalogue, a moved table."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue
from fluoromap.contracts import (
    CHI2_95_3D,
    Array,
    Grade,
    MatchedRuns,
    MatchedSite,
    NamedChain,
    Observation,
    PhasePair,
    Silent,
    Triangulation,
    grade_of,
)
from fluoromap.geometry import Camera, camera_from_gantry
from fluoromap.phantom import FRONTAL, LATERAL, StudySpec, simulate_study
from fluoromap.reasons import Reason
from fluoromap.triangulator.error_sources import study_covariance, study_sources
from fluoromap.triangulator.estimate import JointLeastSquares
from fluoromap.triangulator.maximum_likelihood import MaximumLikelihood
from fluoromap.triangulator.reference_origin import ReferenceOrigin
from fluoromap.triangulator.self_calibration import any_study_belief, header_belief
from fluoromap.triangulator.site_locator import SiteLocator
from fluoromap.triangulator.site_moment import Moment, errors_in_study
from fluoromap.triangulator.study_equations import (
    HEART_SCALES,
    CalibrationSite,
    Information,
    SiteEquations,
    gap_labels,
    information,
    site_equations,
)
from fluoromap.triangulator.two_view_pixels import pixels_in_both_views
from fluoromap.triangulator.uncertainty import UncertaintyParams

NOISE_PX = 0.5
ANOTHER_BEAT_MS = 800.0
"""Time of the frame of view b: the two runs of a site show different beats."""
CAMERAS = camera_from_gantry(LATERAL), camera_from_gantry(FRONTAL)
Points = dict[str, Array]


def turn(angle_deg: float, offset_mm: float, seed: int) -> Array:
    """Return the displacement (4, 4) of the world by a wrong header.

    It has the given size and a random direction.
    """
    rng = np.random.default_rng(seed)
    axis, along = rng.normal(size=3), rng.normal(size=3)
    displaced = np.eye(4)
    displaced[:3, :3] = Rotation.from_rotvec(angle_deg * axis / np.linalg.norm(axis), degrees=True).as_matrix()
    displaced[:3, 3] = offset_mm * along / np.linalg.norm(along)
    return displaced


def electrodes(seed: int, sites: int = 12) -> list[Points]:
    """Return the electrodes of a simulated heart at diastole, site by site."""
    study = simulate_study(StudySpec(seed, sites=sites, frames=1, breathing_mm=0.0))
    return [dict(site.truth.diastole_mm) for site in study.sites]


def matched_sites(
    by_site: list[Points],
    rng: np.random.Generator,
    displaced: Array | None = None,
    shifts: dict[int, Array] | None = None,
    noise_px: float = NOISE_PX,
) -> tuple[MatchedSite, ...]:
    """Return all sites as both views show them.

    ``displaced`` (4, 4) displaces view b against its header; ``shifts`` moves the heart in view b at some sites.
    """
    true_b = CAMERAS[1] if displaced is None else Camera(CAMERAS[1].matrix @ displaced, 512, 512)
    sites = []
    for index, points in enumerate(by_site):
        moved = {name: at + (shifts or {}).get(index, np.zeros(3)) for name, at in points.items()}
        a, b = observation(CAMERAS[0], points, rng, noise_px), observation(true_b, moved, rng, noise_px)
        pair = PhasePair(0.8, a, b)
        runs = MatchedRuns(*CAMERAS, pair, (), (a,), (b,), np.zeros(1), np.full(1, ANOTHER_BEAT_MS))
        sites.append(MatchedSite(f"S{index + 1:02d}", runs))
    return tuple(sites)


def with_diastole(site: MatchedSite, diastole: PhasePair) -> MatchedSite:
    return replace(site, runs=replace(site.runs, diastole=diastole))


def observation(by: Camera, points: Points, rng: np.random.Generator, noise_px: float = NOISE_PX) -> Observation:
    chains = []
    for name, at in points.items():
        noise = np.broadcast_to(noise_px**2 * np.eye(2), (len(at), 2, 2))
        pixels = by.project(at) + rng.normal(0, noise_px, (len(at), 2))
        chains.append(NamedChain(name, tuple(range(1, len(at) + 1)), pixels, noise))
    return Observation(0, 0.8, tuple(chains))


def located(sites: tuple[MatchedSite, ...], catalogue: Catalogue = DEFAULT_CATALOGUE) -> Triangulation:
    return MaximumLikelihood(UncertaintyParams()).triangulate(sites, catalogue, Silent())


def errors(answer: Triangulation, by_site: list[Points]) -> tuple[Array, Array]:
    """Return located and true points, both (n, 3), mm."""
    found = [point.position_mm for site in answer.sites for point in site.points]
    true = [points[name][k] for points in by_site for name in points for k in range(len(points[name]))]
    return np.array(found), np.array(true)


def rms(apart: Array) -> float:
    return float(np.sqrt((apart**2).sum(axis=1).mean()))


def aligned(found: Array, true: Array) -> Array:
    middle, centre = found.mean(axis=0), true.mean(axis=0)
    rotation, _ = Rotation.align_vectors(true - centre, found - middle)
    return np.asarray(rotation.apply(found - middle) + centre)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_right_header_is_kept(seed: int) -> None:
    by_site = electrodes(seed)
    sites = matched_sites(by_site, np.random.default_rng(seed))
    answer = located(sites)
    assert answer.calibration is not None
    assert not answer.calibration.applied
    assert (answer.calibration.rotation_deg == 0).all()
    assert (answer.calibration.offset_mm == 0).all()
    assert answer.calibration.epipolar_after_px == answer.calibration.epipolar_before_px < 0.6
    assert all((site.camera_b.matrix == CAMERAS[1].matrix).all() for site in answer.sites)
    assert rms(np.subtract(*errors(answer, by_site))) < 0.15
    assert answer.notes == ()


def test_a_gantry_wrong_by_one_degree_and_two_millimetres_is_found_and_reported() -> None:
    left = []
    for seed in (1, 2, 3):
        by_site = electrodes(seed, sites=20)
        displaced = turn(1.0, 2.0, seed)
        answer = located(matched_sites(by_site, np.random.default_rng(seed), displaced))
        found = answer.calibration
        assert found is not None
        assert found.applied
        assert found.epipolar_before_px > 1.3 * NOISE_PX
        assert found.epipolar_after_px <= 0.55
        true_turn = Rotation.from_matrix(displaced[:3, :3]).as_rotvec(degrees=True)
        assert found.rotation_deg == pytest.approx(true_turn, abs=0.6)
        points, true = errors(answer, by_site)
        # The catalogue's gaps are not exact, so that no gap shows an offset along a ray.
        assert rms(points - true) <= 1.5
        left.append(rms(aligned(points, true) - true))
        true_b = Camera(CAMERAS[1].matrix @ displaced, 512, 512)
        # Nothing shows which view is wrong, so the world may be displaced.
        apart = answer.sites[0].camera_b.project(aligned(true, points)) - true_b.project(true)
        before = np.abs(CAMERAS[1].project(true) - true_b.project(true))
        # View b's camera is right along the axis that both views show. Nothing shows an offset across it.
        assert np.abs(apart)[:, 1].mean() < before[:, 1].mean() / 4
        (note,) = answer.notes
        assert "degrees" in note
        assert "mm" in note
    assert np.mean(left) <= 0.16


def test_a_wrong_gantry_is_shared_by_both_views() -> None:
    """Whichever view is wrong, the answer is half as far from the truth as if view b were always the wrong one."""
    for wrong in (0, 1):
        by_site = electrodes(1, sites=20)
        rng = np.random.default_rng(1)
        cameras = [Camera(camera.matrix @ turn(1.5, 0.0, 1), 512, 512) if view == wrong else camera
                   for view, camera in enumerate(CAMERAS)]  # fmt: skip
        sites = []
        for index, points in enumerate(by_site):
            a, b = (observation(camera, points, rng) for camera in cameras)
            pair = PhasePair(0.8, a, b)
            runs = MatchedRuns(*CAMERAS, pair, (), (a,), (b,), np.zeros(1), np.full(1, ANOTHER_BEAT_MS))
            sites.append(MatchedSite(f"S{index:02d}", runs))
        answer = located(tuple(sites))
        assert answer.calibration is not None
        assert answer.calibration.applied
        found, true = errors(answer, by_site)
        rotation, _ = Rotation.align_vectors(true - true.mean(axis=0), found - found.mean(axis=0))
        assert np.degrees(rotation.magnitude()) == pytest.approx(0.75, abs=0.2)


def test_breathing_between_the_runs_is_not_taken_for_a_wrong_gantry() -> None:
    rng = np.random.default_rng(5)
    by_site = electrodes(5)
    shifts = {index: rng.normal(0, [1.4, 1.4, 5.0]) for index in range(len(by_site))}
    answer = located(matched_sites(by_site, rng, shifts=shifts))
    assert answer.calibration is not None
    assert not answer.calibration.applied
    assert not any(Reason.TABLE_MOVED in site.reasons for site in answer.sites)


def unequal_pixels(sites: tuple[MatchedSite, ...], rng: np.random.Generator) -> tuple[MatchedSite, ...]:
    """Return the sites with pixels that are known unequally well.

    Some are known to 0.06 px, some to 0.8 px.
    """
    found = []
    for site in sites:
        views = []
        for view in (site.runs.diastole.a, site.runs.diastole.b):
            chains = []
            for chain in view.chains:
                sd_px = rng.choice([0.06, 0.15, 0.8], len(chain.electrodes), p=[0.7, 0.2, 0.1])
                pixels = chain.pixels_uv + rng.normal(size=(len(sd_px), 2)) * sd_px[:, None]
                covariances = sd_px[:, None, None] ** 2 * np.eye(2)
                chains.append(replace(chain, pixels_uv=pixels, covariance_px2=covariances))
            views.append(replace(view, chains=tuple(chains)))
        found.append(with_diastole(site, replace(site.runs.diastole, a=views[0], b=views[1])))
    return tuple(found)


@pytest.mark.parametrize("seed", [51, 52, 53, 54, 55, 56])
def test_breathing_is_no_fault_of_the_study_where_pixels_are_known_unequally_well(seed: int) -> None:
    """The heart moves by several millimetres between the runs, as in every study without held breath."""
    rng = np.random.default_rng(seed)
    by_site = electrodes(seed, sites=8)
    breaths = {index: rng.normal(0, [1.4, 1.4, 4.0]) for index in range(len(by_site))}
    sites = matched_sites(by_site, rng, shifts=breaths, noise_px=0.02)
    answer = located(unequal_pixels(sites, rng))
    assert answer.calibration is not None
    assert not answer.calibration.applied
    assert not any(
        reason in (Reason.TABLE_MOVED, Reason.GEOMETRY_DOUBTFUL, Reason.SPACING_MISMATCH)
        for site in answer.sites
        for point in site.points
        for reason in (*site.reasons, *point.reasons)
    )
    for site, points in zip(answer.sites, by_site, strict=True):
        origin = points["reference"].mean(axis=0)
        for point in site.points:
            assert point.relative_mm is not None
            assert point.relative_covariance_mm2 is not None
            assert np.linalg.norm(point.relative_mm - (points[point.catheter][point.electrode - 1] - origin)) < 1.0
            assert grade_of(point.relative_covariance_mm2, point.reasons) in (Grade.A, Grade.B)


@pytest.mark.parametrize("seed", [61, 62, 63])
def test_a_site_with_wrong_electrodes_leaves_the_uncertainty_of_the_others(seed: int) -> None:
    by_site = electrodes(seed, sites=8)
    sites = list(matched_sites(by_site, np.random.default_rng(seed)))
    before = located(tuple(sites))
    view = sites[2].runs.diastole.b
    chains = [
        replace(chain, pixels_uv=chain.pixels_uv + np.array([[0, 20], [0, 0], [0, 0], [0, -20]]))
        for chain in view.chains
    ]
    wrong = replace(view, chains=tuple(chains))
    sites[2] = with_diastole(sites[2], replace(sites[2].runs.diastole, b=wrong))
    answer = located(tuple(sites))
    assert Reason.GEOMETRY_DOUBTFUL in answer.sites[2].reasons
    for index in (0, 1, 3, 4, 5, 6, 7):
        assert Reason.GEOMETRY_DOUBTFUL not in answer.sites[index].reasons
        ratios = [
            np.trace(point.covariance_mm2) / np.trace(known.covariance_mm2)
            for point, known in zip(answer.sites[index].points, before.sites[index].points, strict=True)
        ]
        assert max(ratios) < 1.3


def test_a_difference_that_no_gantry_explains_is_not_corrected_but_doubted() -> None:
    by_site = electrodes(6)
    upside_down = np.diag([1.0, 1.0, -1.0, 1.0])
    answer = located(matched_sites(by_site, np.random.default_rng(6), upside_down))
    assert answer.calibration is None or not answer.calibration.applied
    assert all(Reason.GEOMETRY_DOUBTFUL in site.reasons for site in (*answer.sites, *answer.rejected))


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_beats_that_displace_catheters_are_no_doubt_where_pixels_are_known_unequally_well(seed: int) -> None:
    rng = np.random.default_rng(seed)
    by_site, sites = electrodes(seed), []
    for points, site in zip(by_site, matched_sites(by_site, rng), strict=True):
        views = []
        for camera, view in zip(CAMERAS, (site.runs.diastole.a, site.runs.diastole.b), strict=True):
            chains = []
            for chain in view.chains:
                sd_px = rng.choice([0.05, 0.1, 0.6], len(chain.electrodes))
                beat_px = rng.normal(0, 0.25 * camera.px_per_mm, 2)
                pixels = camera.project(points[chain.catheter]) + beat_px + rng.normal(size=(4, 2)) * sd_px[:, None]
                chains.append(replace(chain, pixels_uv=pixels, covariance_px2=sd_px[:, None, None] ** 2 * np.eye(2)))
            views.append(replace(view, chains=tuple(chains)))
        sites.append(with_diastole(site, replace(site.runs.diastole, a=views[0], b=views[1])))
    answer = located(tuple(sites))
    assert len(answer.sites) == len(sites)
    assert not any(Reason.GEOMETRY_DOUBTFUL in site.reasons for site in answer.sites)


@pytest.mark.parametrize("seed", [71, 72, 73])
def test_pixels_known_well_do_not_hide_how_far_whole_catheters_move(seed: int) -> None:
    rng = np.random.default_rng(seed)
    follows = np.linspace(1.0, 0.5, 4)[:, None]
    by_site, sites = electrodes(seed), []
    for site in matched_sites(by_site, rng, noise_px=0.05):
        views = []
        for camera, view in zip(CAMERAS, (site.runs.diastole.a, site.runs.diastole.b), strict=True):
            chains = [
                replace(chain, pixels_uv=chain.pixels_uv + follows * rng.normal(0, 0.25 * camera.px_per_mm, 2))
                for chain in view.chains
            ]
            views.append(replace(view, chains=tuple(chains)))
        sites.append(with_diastole(site, replace(site.runs.diastole, a=views[0], b=views[1])))
    assert located(tuple(sites)).sites[0].variation.beats > 0.75


def test_an_electrodes_own_bend_is_no_beat() -> None:
    """It does not grow with the beats, else precise pixels would show calm beats where whole catheters move."""
    (site,) = matched_sites(electrodes(74, sites=1), np.random.default_rng(74))
    params = UncertaintyParams(beat_sd_mm=0.0)
    pixels = pixels_in_both_views(site.runs.diastole)
    equations = site_equations(CalibrationSite(CAMERAS, pixels), CAMERAS, DEFAULT_CATALOGUE, (), params)
    assert (equations.beats == 0).all()
    assert np.linalg.eigvalsh(equations.fixed - np.diag(equations.pixel_variance)).min() > 0
    assert params.scaled(1.0, 2.0).bend_sd_mm == params.bend_sd_mm


def test_a_study_whose_catheters_are_all_described_wrongly_is_refused_with_the_cause() -> None:
    by_site = electrodes(7, sites=6)
    wider = tuple(
        replace(catheter, spacing_mm=tuple(gap + 2.0 for gap in catheter.spacing_mm))
        for catheter in DEFAULT_CATALOGUE.catheters
    )
    answer = located(
        matched_sites(by_site, np.random.default_rng(7), np.eye(4)), replace(DEFAULT_CATALOGUE, catheters=wider)
    )
    assert answer.sites == ()
    assert {site.reasons for site in answer.rejected} == {(Reason.SPACING_MISMATCH, Reason.GEOMETRY_DOUBTFUL)}
    assert any("differ from its description" in note for note in answer.notes)


@pytest.mark.parametrize("error", [0.0, 1.0])
def test_a_catalogue_two_millimetres_off_is_reported_and_not_believed(error: float) -> None:
    by_site = electrodes(7, sites=20)
    sites = matched_sites(by_site, np.random.default_rng(7), turn(error, 2 * error, 7))
    mapping = DEFAULT_CATALOGUE["mapping"]
    first, second, third = mapping.spacing_mm
    wrong = replace(mapping, spacing_mm=(first, second + 2.0, third))
    catalogue = replace(DEFAULT_CATALOGUE, catheters=(*DEFAULT_CATALOGUE.catheters[:2], wrong))
    answer = located(sites, catalogue)
    assert answer.calibration is not None
    assert answer.calibration.applied == (error > 0)
    points, true = errors(answer, by_site)
    assert rms(aligned(points, true) - true) <= 0.2
    for site in answer.sites:
        for point in site.points:
            assert (Reason.SPACING_MISMATCH in point.reasons) == (point.catheter == "mapping")
    assert "'mapping'" in answer.notes[0]
    assert "2 to 3: 6.3 mm instead of 8.3" in answer.notes[0]


@pytest.mark.parametrize(
    ("shift", "at", "words"),
    [
        ((12.0, 0.0, 0.0), [4], "At S05"),
        ((0.0, 0.0, 30.0), [4], "At S05"),
        ((12.0, 0.0, 0.0), [7, 8, 9], "From S08 on"),
    ],
)
def test_a_table_that_moved_between_the_views_is_found(
    shift: tuple[float, float, float], at: list[int], words: str
) -> None:
    by_site = electrodes(8, sites=10)
    sites = matched_sites(by_site, np.random.default_rng(8), shifts=dict.fromkeys(at, np.array(shift)))
    answer = located(sites)
    assert [index for index, site in enumerate(answer.sites) if Reason.TABLE_MOVED in site.reasons] == at
    assert answer.notes[0].startswith(words)
    assert answer.calibration is not None
    assert not answer.calibration.applied
    for index, site in enumerate(answer.sites):
        tip = site.point("mapping", 1)
        assert tip is not None
        apart = tip.position_mm - by_site[index]["mapping"][0] - np.array(shift) / 2 * (index in at)
        assert apart @ np.linalg.solve(tip.covariance_mm2, apart) < 7.8
        if index in at:
            assert grade_of(tip.covariance_mm2) is Grade.C


def test_a_heart_displaced_in_both_views_is_no_moved_table() -> None:
    by_site = electrodes(9, sites=8)
    by_site[3] = {name: at + np.array([12.0, -12.0, 5.0]) for name, at in by_site[3].items()}
    answer = located(matched_sites(by_site, np.random.default_rng(9)))
    assert not any(Reason.TABLE_MOVED in site.reasons for site in answer.sites)


@pytest.mark.parametrize(("error_mm", "contradicted"), [(0.0, False), (0.3, False), (0.5, True)])
def test_a_tip_off_the_catalogue_by_more_than_its_error_is_a_contradiction(error_mm: float, contradicted: bool) -> None:
    by_site = electrodes(14, sites=8)
    for points in by_site:
        at = points["mapping"] = points["mapping"].copy()
        at[0] += error_mm * (at[0] - at[1]) / np.linalg.norm(at[0] - at[1])
    answer = located(matched_sites(by_site, np.random.default_rng(14)))
    for site in answer.sites:
        for point in site.points:
            expected = contradicted and point.catheter == "mapping"
            assert (Reason.CATALOGUE_CONTRADICTED in point.reasons) == expected
            assert Reason.SPACING_MISMATCH not in point.reasons
    assert any("contradict the description" in note for note in answer.notes) == contradicted


@pytest.mark.parametrize("seed", [21, 22, 23])
def test_gaps_wrong_alike_at_all_sites_do_not_correct_a_right_header(seed: int) -> None:
    """Every catheter is bent: its last chord is 0.3 mm shorter than the catalogue's arc."""
    by_site = electrodes(seed)
    for points in by_site:
        for name, at in points.items():
            points[name] = at = at.copy()
            at[3] += 0.3 * (at[2] - at[3]) / np.linalg.norm(at[2] - at[3])
    answer = located(matched_sites(by_site, np.random.default_rng(seed)))
    assert answer.calibration is not None
    assert not answer.calibration.applied


def test_a_gantry_that_no_electrode_shows_is_in_the_ellipsoids() -> None:
    """A header wrong by 1 degree and 2 mm in both views: the common displacement stays, and the ellipsoids contain it."""
    inside = []
    for seed in range(31, 43):
        by_site = electrodes(seed)
        rng = np.random.default_rng(seed)
        turns = [turn(1.0, 2.0, 10 * seed + view) for view in (0, 1)]
        sites = []
        for index, points in enumerate(by_site):
            a, b = (
                observation(Camera(camera.matrix @ of_view, 512, 512), points, rng)
                for camera, of_view in zip(CAMERAS, turns, strict=True)
            )
            pair = PhasePair(0.8, a, b)
            runs = MatchedRuns(*CAMERAS, pair, (), (a,), (b,), np.zeros(1), np.full(1, ANOTHER_BEAT_MS))
            sites.append(MatchedSite(f"S{index:02d}", runs))
        answer = located(tuple(sites))
        found, true = errors(answer, by_site)
        covariances = np.array([point.covariance_mm2 for site in answer.sites for point in site.points])
        apart = found - true
        distance = np.einsum("ni,ni->n", apart, np.linalg.solve(covariances, apart[..., None])[..., 0])
        inside.append((distance <= CHI2_95_3D).mean())
        assert rms(aligned(found, true) - true) <= 0.3
    # With the stated gantry alone, 0 to 43 % were inside.
    assert np.mean(inside) > 0.8


def test_a_table_displaced_between_all_runs_of_the_two_views_is_suspected() -> None:
    by_site = electrodes(16, sites=8)
    shifts = dict.fromkeys(range(8), np.array([8.0, 0.0, 25.0]))
    answer = located(matched_sites(by_site, np.random.default_rng(16), shifts=shifts))
    for site in answer.sites:
        assert {Reason.TABLE_MOVED, Reason.GEOMETRY_DOUBTFUL} & set(site.reasons)
        assert all(grade_of(point.covariance_mm2, point.reasons) is Grade.C for point in site.points)


def without(site: MatchedSite, catheter: str, hidden: tuple[int, ...]) -> MatchedSite:
    """Return the site without some electrodes of a catheter in view a."""

    def visible(chain: NamedChain) -> NamedChain:
        kept = [k for k, number in enumerate(chain.electrodes) if chain.catheter != catheter or number not in hidden]
        numbers = tuple(chain.electrodes[k] for k in kept)
        return replace(
            chain, electrodes=numbers, pixels_uv=chain.pixels_uv[kept], covariance_px2=chain.covariance_px2[kept]
        )

    seen = site.runs.diastole.a
    seen = replace(seen, chains=tuple(chain for old in seen.chains if (chain := visible(old)).electrodes))
    return with_diastole(site, replace(site.runs.diastole, a=seen))


@pytest.mark.parametrize("hidden", [(1, 2), (3, 4), (4,)])
def test_a_site_that_hides_some_of_the_reference_has_the_same_origin_as_the_others(hidden: tuple[int, ...]) -> None:
    by_site = electrodes(33, sites=6)
    sites = list(matched_sites(by_site, np.random.default_rng(0)))
    sites[2] = without(sites[2], "reference", hidden)
    for index, site in enumerate(located(tuple(sites)).sites):
        reference = by_site[index]["reference"].mean(axis=0)
        tip = site.point("mapping", 1)
        assert tip is not None
        assert tip.relative_mm is not None
        assert np.linalg.norm(tip.relative_mm - (by_site[index]["mapping"][0] - reference)) < 1.0
        assert site.reference_mm is not None
        assert np.linalg.norm(site.reference_mm - reference) < 1.0


def test_a_site_that_hides_most_of_the_reference_moves_the_origin_of_no_other_site() -> None:
    by_site = electrodes(33, sites=5)
    sites = list(matched_sites(by_site, np.random.default_rng(0)))
    plain = located(tuple(sites))
    sites[4] = without(sites[4], "reference", (1, 2, 3))
    found = located(tuple(sites))
    for before, after in zip(plain.sites[:4], found.sites[:4], strict=True):
        first, second = before.point("mapping", 1), after.point("mapping", 1)
        assert first is not None
        assert second is not None
        np.testing.assert_allclose(first.relative_mm, second.relative_mm, atol=0.3)


def test_offsets_of_some_electrodes_add_their_own_error_and_those_of_all_add_none() -> None:
    offsets = {number: np.array([3.0 * number - 6.0, 0.0, 0.0]) for number in (1, 2, 3)}
    origin = ReferenceOrigin(offsets, 0.25 * np.eye(3))
    at = np.array([[10.0, 1.0, 1.0], [13.0, 1.0, 1.0], [16.0, 1.0, 1.0]])
    place, added = origin.from_electrodes((1, 2, 3), at) or (None, None)
    np.testing.assert_allclose(place, [13.0, 1.0, 1.0])
    np.testing.assert_allclose(added, 0.0, atol=1e-12)
    place, added = origin.from_electrodes((3,), at[2:]) or (None, None)
    np.testing.assert_allclose(place, [13.0, 1.0, 1.0])
    np.testing.assert_allclose(added, 0.25 * 2 / 3 * np.eye(3))
    assert origin.from_electrodes((7,), at[:1]) is None


class _Remembering(Silent):
    """A context with a memory: ``computed`` are the kinds of the partial results that it had to compute."""

    def __init__(self) -> None:
        self.computed: list[str] = []
        self._known: dict[str, Any] = {}

    def recall(self, kind, inputs, compute):  # type: ignore[no-untyped-def]
        with np.printoptions(threshold=100_000, precision=17):
            key = repr((kind, inputs))
        if key not in self._known:
            self._known[key] = compute()
            self.computed.append(kind.__name__)
        return self._known[key]


def test_a_corrected_diastole_locates_its_own_site_again() -> None:
    first, *others = matched_sites(electrodes(3), np.random.default_rng(3))
    triangulator, context = MaximumLikelihood(UncertaintyParams()), _Remembering()
    triangulator.triangulate((first, *others), DEFAULT_CATALOGUE, context)
    each = ["SiteLook", "Diastole", "SiteCycle", "APriori"]
    assert sorted(context.computed) == sorted((1 + len(others)) * each + ["StudyChecks"])

    context.computed.clear()
    chains = first.runs.diastole.a.chains
    moved = replace(chains[0], pixels_uv=chains[0].pixels_uv + 0.5)
    pair = replace(first.runs.diastole, a=replace(first.runs.diastole.a, chains=(moved, *chains[1:])))
    corrected = (with_diastole(first, pair), *others)
    again = triangulator.triangulate(corrected, DEFAULT_CATALOGUE, context)
    assert sorted(context.computed) == sorted([*each, "StudyChecks"])
    assert repr(again) == repr(located(corrected))


def test_a_note_at_all_sites_locates_none_of_them_again() -> None:
    sites = matched_sites(electrodes(3), np.random.default_rng(3))
    triangulator, context = MaximumLikelihood(UncertaintyParams()), _Remembering()
    triangulator.triangulate(sites, DEFAULT_CATALOGUE, context)

    context.computed.clear()
    noted = tuple(replace(site, notes=(("reference", Reason.IDENTITY_BY_MOTION),)) for site in sites)
    again = triangulator.triangulate(noted, DEFAULT_CATALOGUE, context)
    # The reasons are part of the a-priori points, which follow quickly.
    assert context.computed == ["APriori"] * len(sites)
    assert repr(again) == repr(located(noted))
    for site in again.sites:
        assert all((Reason.IDENTITY_BY_MOTION in at.reasons) == (at.catheter == "reference") for at in site.points)


@pytest.mark.parametrize(("breathing", "beats"), [(1.0, 1.0), (0.3, 1.6)])
def test_the_size_of_the_study_errors_is_that_of_their_sources(breathing: float, beats: float) -> None:
    points = electrodes(4)[0]
    (site, *_) = matched_sites([points], np.random.default_rng(4))
    labels = pixels_in_both_views(site.runs.diastole).labels
    params = UncertaintyParams().scaled(breathing, beats)
    gantry = np.cov(np.random.default_rng(0).normal(size=(14, 40)))
    sources = study_sources(CAMERAS, np.concatenate(list(points.values())), labels, DEFAULT_CATALOGUE, params, gantry)
    whole = study_covariance(params, gantry, len(points))
    np.testing.assert_allclose(whole, block_diag(*(source.covariance for source in sources)), rtol=1e-15)


def _without_tip(pair: PhasePair) -> PhasePair:
    """Return the pair without the first electrode of each chain."""

    def shorter(chain: NamedChain) -> NamedChain:
        return replace(
            chain,
            electrodes=chain.electrodes[1:],
            pixels_uv=chain.pixels_uv[1:],
            covariance_px2=chain.covariance_px2[1:],
        )

    a, b = (replace(view, chains=tuple(map(shorter, view.chains))) for view in (pair.a, pair.b))
    return replace(pair, a=a, b=b)


def _moments() -> list[Moment]:
    sites = matched_sites(electrodes(5), np.random.default_rng(5))
    sites = (with_diastole(sites[0], _without_tip(sites[0].runs.diastole)), *sites[1:])
    params = UncertaintyParams()
    locator = SiteLocator(JointLeastSquares(), DEFAULT_CATALOGUE, header_belief(params), any_study_belief(params), 1.5)
    found = [locator.diastole(site.runs, CAMERAS, None, None).chosen for site in sites]
    assert all(moment is not None for moment in found)
    return [moment for moment in found if moment is not None]


def test_the_errors_of_a_site_do_not_depend_on_the_others() -> None:
    moments, belief = _moments(), header_belief(UncertaintyParams())
    together = errors_in_study(moments, belief)
    assert len({moment.study_mm.shape for moment in moments}) == 2
    for moment, found in zip(moments, together, strict=True):
        (alone,) = errors_in_study([moment], belief)
        assert found.inflation == alone.inflation
        assert found.squares_mm2 == alone.squares_mm2
        assert np.array_equal(found.joint_mm2, alone.joint_mm2)


def test_equations_say_the_same_when_their_products_are_known() -> None:
    gaps = gap_labels(DEFAULT_CATALOGUE, frozenset(DEFAULT_CATALOGUE.names))
    sites = [
        CalibrationSite(CAMERAS, pixels_in_both_views(site.runs.diastole))
        for site in matched_sites(electrodes(6), np.random.default_rng(6))
    ]

    def equations() -> list[SiteEquations]:
        return [site_equations(site, site.cameras, DEFAULT_CATALOGUE, gaps, UncertaintyParams()) for site in sites]

    def content(hearts: list[Information]) -> list[object]:
        return [(heart.matrix.tolist(), heart.vector.tolist(), heart.constant) for heart in hearts]

    header, others = np.zeros(14 + len(gaps)), np.zeros(len(HEART_SCALES))
    known = equations()
    first = information(known, header, others)
    # One site is corrected; then the products of the others are known.
    again = [*known[:-1], equations()[-1]]
    assert content(information(again, header, others)) == content(first)
    assert content(information(known[1:], header, others)) == content(information(equations()[1:], header, others))
