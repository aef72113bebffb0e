"""Content of a simulated study, and motion of its heart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap.phantom import FRONTAL, LATERAL, SimulatedStudy, StudySpec, simulate_study


@pytest.fixture(scope="module", params=["dog", "human"])
def hearts(request: pytest.FixtureRequest) -> list[SimulatedStudy]:
    return [
        simulate_study(StudySpec(seed, sites=6, frames=120, frame_rate_hz=60.0, heart=request.param))
        for seed in range(4)
    ]


def _runs(study: SimulatedStudy) -> list:  # type: ignore[type-arg]
    return [run for site in study.sites for run in site.runs]


def test_heart_rates_are_those_of_the_animal(hearts: list[SimulatedStudy]) -> None:
    low, high = {"dog": (1.6, 2.2), "human": (1.0, 1.6)}[hearts[0].spec.heart]
    assert all(low <= study.heart_rate_hz <= high for study in hearts)
    for study in hearts:
        times = np.flatnonzero(np.diff(study.sites[0].runs[0].truth.phases) < 0) / 60
        if len(times) > 1:
            assert np.allclose(np.diff(times), 1 / study.heart_rate_hz, atol=1.1 / 60)


def test_no_electrode_moves_more_than_nine_pixels_between_frames(hearts: list[SimulatedStudy]) -> None:
    fastest = []
    for study in hearts:
        steps = [np.diff(uv, axis=0) for run in _runs(study) for uv in run.truth.pixels_uv.values()]
        fastest.append(max(np.linalg.norm(step, axis=2).max() for step in steps))
    assert max(fastest) <= 9.0
    assert min(fastest) >= 5.0


def test_tips_move_four_to_six_millimetres_an_axis(hearts: list[SimulatedStudy]) -> None:
    means = [np.mean([np.ptp(run.truth.points_mm["mapping"][:, 0], axis=0) for run in _runs(s)]) for s in hearts]
    assert min(means) >= 3.5
    assert max(means) <= 6.5
    assert 3.8 <= np.mean(means) <= 6.0


def test_diastole_is_quiet_and_systole_sharp(hearts: list[SimulatedStudy]) -> None:
    still = []
    for study in hearts:
        for run in _runs(study):
            tip = run.truth.pixels_uv["mapping"][:, 0]
            speed = np.linalg.norm(np.diff(tip, axis=0), axis=1)
            phase = run.truth.phases[1:]
            diastole = speed[(phase > 0.74) & (phase < 0.92)]
            assert np.median(diastole) < 0.1 * speed.max()
            assert np.median(diastole) < 0.3
            still.append((speed < 0.1 * speed.max()).mean())
    assert np.mean(still) > 0.27


def test_beats_differ_a_little(hearts: list[SimulatedStudy]) -> None:
    study = hearts[0]
    tip = study.sites[0].runs[0].truth.points_mm["reference"].mean(axis=1)
    phase = study.sites[0].runs[0].truth.phases
    beat = np.cumsum(np.diff(phase, prepend=phase[0]) < 0)
    rest = [tip[(beat == b) & (phase > 0.75) & (phase < 0.9)] for b in np.unique(beat)]
    rest = np.array([r.mean(axis=0) for r in rest if len(r) > 2])
    if len(rest) > 1:
        between = np.linalg.norm(np.diff(rest, axis=0), axis=1)
        assert (between > 0.01).all()
        assert (between < 2.5).all()


def test_electrodes_keep_their_distances_along_the_shaft_all_through_the_cycle(hearts: list[SimulatedStudy]) -> None:
    for run in _runs(hearts[0]):
        for name, points in run.truth.points_mm.items():
            chords = np.linalg.norm(np.diff(points, axis=1), axis=2)
            spacing = np.array(DEFAULT_CATALOGUE[name].spacing_mm)
            # A chord is a little shorter than its arc, never longer.
            assert (chords <= spacing + 1e-3).all()
            assert (chords >= 0.97 * spacing).all()


def test_proximal_electrodes_move_less_than_the_tip(hearts: list[SimulatedStudy]) -> None:
    excursion = np.mean(
        [np.ptp(run.truth.points_mm["mapping"], axis=0).mean(axis=1) for s in hearts for run in _runs(s)], axis=0
    )
    assert (np.diff(excursion) < 0).all()
    assert 0.6 < excursion[3] / excursion[0] < 0.9


def test_mapping_tips_touch_the_wall_of_a_plausible_chamber(hearts: list[SimulatedStudy]) -> None:
    for study in hearts:
        contacts = np.array([site.truth.contact_mm for site in study.sites])
        assert np.allclose(study.chamber.level(contacts), 1.0, atol=1e-9)
        for site in study.sites:
            relative = site.truth.relative_mm["mapping"] + study.reference_mm
            # Electrode 1's centre lies half a tip behind the contact, all electrodes in the blood.
            assert np.linalg.norm(relative[0] - site.truth.contact_mm) == pytest.approx(2.0, abs=0.2)
            assert (study.chamber.level(relative) < 1.0).all()
        gaps = np.linalg.norm(contacts[:, None] - contacts[None], axis=2) + 1e9 * np.eye(len(contacts))
        assert gaps.min() > 15
        assert study.chamber.volume_ml == pytest.approx(81.1, abs=0.1)


def test_reference_stays_pacing_slips_and_mapping_roves(hearts: list[SimulatedStudy]) -> None:
    reference = np.array([site.truth.relative_mm["reference"] for study in hearts for site in study.sites])
    assert np.allclose(reference.mean(axis=1), 0)
    slips = [np.std([site.truth.relative_mm["pacing"][0] for site in study.sites], axis=0) for study in hearts]
    assert 0.8 < np.mean(slips) < 2.0
    study = hearts[0]
    tips = np.array([site.truth.relative_mm["mapping"][0] for site in study.sites])
    assert np.ptp(tips, axis=0).min() > 20


def test_runs_are_taken_at_different_times_and_breaths(hearts: list[SimulatedStudy]) -> None:
    study = hearts[0]
    starts = np.array([[run.start_seconds for run in site.runs] for site in study.sites])
    assert (starts[:, 1] - starts[:, 0] >= 20).all()
    assert (starts[1:, 0] - starts[:-1, 1] >= 90).all()
    means = np.array([run.truth.points_mm["reference"].mean(axis=(0, 1)) for run in _runs(study)])
    assert 2.0 < np.ptp(means[:, 2]) < 12.0
    assert means[:, 2].std() > means[:, 0].std()


def test_truth_is_the_mean_over_beats_and_breaths() -> None:
    long = simulate_study(StudySpec(3, sites=2, frames=900, frame_rate_hz=15.0))
    for site in long.sites:
        for name, truth in site.truth.diastole_mm.items():
            seen, relative = [], []
            for run in site.runs:
                quiet = (run.truth.phases > 0.76) & (run.truth.phases < 0.84)
                points = run.truth.points_mm[name][quiet]
                seen.append(points.mean(axis=0))
                relative.append(
                    (points - run.truth.points_mm["reference"][quiet].mean(axis=1, keepdims=True)).mean(axis=0)
                )
            assert np.allclose(np.mean(seen, axis=0), truth, atol=0.25)
            assert np.allclose(np.mean(relative, axis=0), site.truth.relative_mm[name], atol=0.25)


def test_activation_spreads_along_the_wall() -> None:
    study = simulate_study(StudySpec(4, sites=60))
    chamber = study.chamber
    contacts = np.array([site.truth.contact_mm for site in study.sites])
    along = chamber.wall_distance_mm(contacts)
    straight = np.linalg.norm(contacts - chamber.focus_mm, axis=1)
    assert (along >= straight - 1e-6).all()
    assert (along <= np.pi / 2 * 1.35 * straight).all()
    assert 0.6 <= chamber.conduction_mm_per_ms <= 1.0
    noise = np.array([site.lat_ms - site.truth.lat_ms for site in study.sites])
    assert 0.6 < noise.std() < 1.5
    assert np.allclose([site.truth.lat_ms for site in study.sites], chamber.activation_ms(contacts))


def test_wall_distance_on_a_sphere_is_the_great_circle() -> None:
    rng = np.random.default_rng(0)
    study = simulate_study(StudySpec(0, sites=1))
    focus = np.array([0.0, 30.0, 0.0])
    sphere = dataclasses.replace(study.chamber, centre_mm=np.zeros(3), semi_axes_mm=np.full(3, 30.0), focus_mm=focus)
    points = sphere.on_wall(rng.normal(size=(50, 3)))
    angles = np.arccos(np.clip(points @ focus / 900, -1, 1))
    assert np.allclose(sphere.wall_distance_mm(points), 30 * angles, rtol=2e-3)


def test_wall_distance_along_a_meridian_is_its_length() -> None:
    chamber = simulate_study(StudySpec(0, sites=1)).chamber
    angle = np.linspace(0.2, 1.4, 20001)
    path = (np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1) * chamber.semi_axes_mm) @ chamber.axes
    path = path + chamber.centre_mm
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    from_start = dataclasses.replace(chamber, focus_mm=path[0])
    assert from_start.wall_distance_mm(path[-1]) == pytest.approx(length, rel=2e-3)


def test_electrodes_stay_in_the_field(hearts: list[SimulatedStudy]) -> None:
    for study in hearts:
        for run in _runs(study):
            pixels = np.concatenate([uv.reshape(-1, 2) for uv in run.truth.pixels_uv.values()])
            assert pixels.min() > 10
            assert pixels.max() < 501


def test_truth_pixels_are_the_cameras_projection() -> None:
    wide = Gantry(-30.0, 20.0, 1100.0, 720.0, (250 / 512, 250 / 512), 512, 512)
    study = simulate_study(StudySpec(5, sites=2, frames=4, gantries=(LATERAL, wide)))
    for site in study.sites:
        for run in site.runs:
            camera = camera_from_gantry(run.gantry)
            for name, points in run.truth.points_mm.items():
                assert np.allclose(camera.project(points), run.truth.pixels_uv[name])


def test_gantry_error_moves_the_true_camera_but_not_the_header() -> None:
    spec = StudySpec(6, sites=2, frames=2, gantry_error_deg=1.0, isocentre_error_mm=2.0)
    study = simulate_study(spec)
    for view in (0, 1):
        runs = [site.runs[view] for site in study.sites]
        assert all(run.gantry == spec.gantries[view] for run in runs)
        header = camera_from_gantry(runs[0].gantry)
        points = runs[0].truth.points_mm["mapping"][0]
        error = np.linalg.norm(header.project(points) - runs[0].truth.camera.project(points), axis=1)
        assert 0.5 < error.mean() < 60
        assert np.allclose(runs[0].truth.camera.matrix, runs[1].truth.camera.matrix)


def test_r_wave_frames_lie_at_phase_zero(hearts: list[SimulatedStudy]) -> None:
    for study in hearts:
        tolerance = 0.6 * study.heart_rate_hz / 60
        for run in _runs(study):
            assert run.r_wave_frames
            for frame in run.r_wave_frames:
                phase = run.truth.phases[frame]
                assert min(phase, 1 - phase) < tolerance


@pytest.mark.parametrize(
    "wrong",
    [
        {"seed": -1}, {"sites": 0}, {"frames": 0}, {"frame_rate_hz": 0.0}, {"heart": "cat"}, {"dose": 0.0},
        {"contrast": ("LAT", "AP")}, {"gantries": (LATERAL,)}, {"breathing_mm": float("nan")}, {"gantry_error_deg": -1},
    ],
)  # fmt: skip
def test_a_wrong_spec_is_refused_by_name(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        StudySpec(**({"seed": 0} | wrong))  # type: ignore[arg-type]


def test_a_field_smaller_than_the_heart_is_refused() -> None:
    small = dataclasses.replace(FRONTAL, pixel_spacing_mm=(100 / 512, 100 / 512))
    with pytest.raises(ValueError, match="does not fit"):
        simulate_study(StudySpec(0, sites=3, gantries=(LATERAL, small)))
