"""The plugin rigid-pose: stated errors hold; unobservable depth and bodies that are not rigid are refused with the cause."""

import contextlib

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap.contracts import (
    CHI2_95_3D,
    Array,
    BoolArray,
    ElectrodePoint,
    MonoplaneView,
    NamedChain,
    Observation,
    Refusal,
    Silent,
    SiteCycle,
    Track,
)
from fluoromap.geometry import Camera, camera_from_gantry
from fluoromap.monoplane.rigid_pose import RigidPose
from fluoromap.phantom import FRONTAL, StudySpec, simulate_study
from fluoromap.reasons import Reason

BODY = Catalogue(
    (Catheter("mapping", 20, (5.0,) * 19, 4, 1.3), Catheter("reference", 10, (5.0,) * 9, 4, 1.3)),
    "reference",
    "mapping",
)
LABELS = (*(("mapping", k) for k in range(1, 21)), *(("reference", k) for k in range(1, 11)))


def view_of(  # type: ignore[no-untyped-def]
    camera: Camera,
    a_priori: Array,
    pixels: Array,
    *,
    sd_mm: float = 1e-3,
    shared_sd_mm: float | None = None,
    visible: BoolArray | None = None,
    labels=LABELS,
    catalogue: Catalogue = BODY,
    **more,
) -> MonoplaneView:
    """Return a view with half a pixel of noise in its pixels (n, m, 2).

    The points are known in frame 0 to ``sd_mm``, and together to ``shared_sd_mm``.
    """
    n, m = pixels.shape[:2]
    labels = labels[:m]
    visible = np.ones((n, m), dtype=bool) if visible is None else visible
    shape = sd_mm**2 * np.eye(3)
    relative = None if shared_sd_mm is None else shape
    absolute = shape + (shared_sd_mm or 0.0) ** 2 * np.eye(3)
    known = tuple(
        ElectrodePoint(name, electrode, at, absolute, None if relative is None else at, relative, (0.1, 0.1), 90.0)
        for (name, electrode), at in zip(labels, a_priori, strict=True)
    )
    observations = []
    for frame in range(n):
        chains = []
        for name in sorted({name for name, _ in labels}):
            columns = [k for k in range(m) if labels[k][0] == name and visible[frame, k]]
            if columns:
                noise = np.broadcast_to(0.25 * np.eye(2), (len(columns), 2, 2))
                chains.append(NamedChain(name, tuple(labels[k][1] for k in columns), pixels[frame, columns], noise))
        observations.append(Observation(frame, None, tuple(chains)))
    start = more.pop("start", 0)
    cycle, others = more.pop("cycle", None), more.pop("others", ())
    times = np.arange(n) * 16.7
    return MonoplaneView("S01", "a", camera, catalogue, times, tuple(observations), known, start, cycle, others)


def solve(view: MonoplaneView, **params: object) -> Track:
    known = {"gantry_angle_sd_deg": 0, "isocentre_sd_mm": 0, "known_rigid": True}
    return RigidPose(RigidPose.Params.model_validate(known | params)).track(view, Silent())


def refusal_of(view: MonoplaneView, **params: object) -> Refusal:
    with pytest.raises(Refusal) as refusal:
        solve(view, **params)
    return refusal.value


def inside(error: Array, covariance: Array) -> float:
    squared = np.einsum("...i,...ij,...j->...", error, np.linalg.inv(covariance), error)
    return float((squared <= CHI2_95_3D).mean())


@pytest.mark.parametrize("depth_step_mm", [0.0, 5.0])
@pytest.mark.parametrize("start", [0, 4])
def test_without_noise_the_track_is_the_truth(simulate, depth_step_mm: float, start: int) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 8)
    view = view_of(simulation.camera, simulation.points_mm[start], simulation.pixels_uv, start=start)
    track = solve(view, depth_step_mm=depth_step_mm)
    assert np.abs(track.positions_mm - simulation.points_mm).max() <= 1e-8
    assert track.located.all()
    assert track.reasons == ((),) * 30


@pytest.mark.parametrize("sd_mm", [1e-3, 0.5])
def test_covariances_hold_the_truth_from_the_isocentre_and_from_the_reference(simulate, sd_mm: float) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 12)
    rng = np.random.default_rng(13)
    absolute, relative = [], []
    for _ in range(25):
        pixels = simulation.pixels_uv + rng.normal(0, 0.5, simulation.pixels_uv.shape)
        a_priori = simulation.points_mm[0] + rng.normal(0, sd_mm, (30, 3))
        track = solve(view_of(simulation.camera, a_priori, pixels, sd_mm=sd_mm))
        error = track.positions_mm - simulation.points_mm
        absolute.append(inside(error, track.covariance_mm2))
        assert track.relative_covariance_mm2 is not None
        relative.append(inside(error - error[:, 20:].mean(axis=1, keepdims=True), track.relative_covariance_mm2))
        along = simulation.camera.axis_world
        assert (along @ track.relative_covariance_mm2[1:] @ along < along @ track.covariance_mm2[1:] @ along).all()
    assert 0.92 <= np.mean(absolute) <= 0.98
    assert 0.92 <= np.mean(relative) <= 0.98


def test_an_isocentre_error_counts_across_the_view_and_not_between_electrodes(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 5)
    visible = view_of(simulation.camera, simulation.points_mm[0], simulation.pixels_uv)
    known, unknown = (solve(visible, isocentre_sd_mm=sd) for sd in (0.0, 0.7))
    assert unknown.covariance_mm2[4, 0] - known.covariance_mm2[4, 0] == pytest.approx(
        np.diag([0.49, 0.49, 0.0]), abs=1e-9
    )
    assert known.relative_covariance_mm2 is not None
    assert unknown.relative_covariance_mm2 == pytest.approx(known.relative_covariance_mm2)


def test_without_the_reference_in_the_body_nothing_is_relative_to_it(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 3)
    track = solve(view_of(simulation.camera, simulation.points_mm[0, :20], simulation.pixels_uv[:, :20]))
    assert track.relative_covariance_mm2 is None


def test_a_shift_of_the_whole_body_since_the_a_priori_does_not_spoil_its_shape(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 6)
    breath = np.array([1.0, -2.0, 4.0])
    view = view_of(
        simulation.camera, simulation.points_mm[0] + breath, simulation.pixels_uv, sd_mm=0.05, shared_sd_mm=4.0
    )
    track = solve(view)
    assert np.abs(track.positions_mm - simulation.points_mm).max() < 0.2


def test_hidden_electrodes_are_not_located_and_hidden_frames_do_not_end_the_track(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 6)
    visible = np.ones((6, 30), dtype=bool)
    visible[2, 5] = False
    visible[3, 2:] = False
    visible[4, 20:] = False
    track = solve(view_of(simulation.camera, simulation.points_mm[0], simulation.pixels_uv, visible=visible))
    expected = visible.copy()
    expected[3] = False
    assert (track.located == expected).all()
    assert np.abs((track.positions_mm - simulation.points_mm)[expected]).max() < 1e-6
    assert track.reasons[5] == (Reason.TRACK_INTERRUPTED,)
    assert track.relative_covariance_mm2 is not None
    eigenvalues = np.linalg.eigvalsh(track.relative_covariance_mm2[expected])
    assert np.isfinite(eigenvalues).all()
    assert eigenvalues.min() > -1e-9


def test_a_frame_whose_few_electrodes_do_not_show_depth_holds_no_position(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 6)
    visible = np.ones((6, 30), dtype=bool)
    visible[3, 4:] = False
    track = solve(view_of(simulation.camera, simulation.points_mm[0], simulation.pixels_uv, visible=visible))
    assert not track.located[3].any()
    assert track.located[[0, 1, 2, 4, 5]].all()
    assert track.reasons[0] == (Reason.DEPTH_UNOBSERVABLE, Reason.TRACK_INTERRUPTED)
    assert track.reasons[9] == (Reason.TRACK_INTERRUPTED,)


def test_a_c_arm_view_is_tracked_without_a_mirror_world(simulate) -> None:  # type: ignore[no-untyped-def]
    points = simulate("H18", "AP", 6).points_mm
    camera = camera_from_gantry(FRONTAL)
    assert np.linalg.det(camera.matrix[:, :3]) < 0
    track = solve(view_of(camera, points[0], camera.project(points)))
    assert np.abs(track.positions_mm - points).max() <= 1e-8


@pytest.mark.parametrize(("axis", "side"), [(0, "left to right"), (1, "top to bottom")])
def test_a_mirrored_image_is_refused_as_such(simulate, axis: int, side: str) -> None:  # type: ignore[no-untyped-def]
    points = simulate("H18", "AP", 4).points_mm
    camera = camera_from_gantry(FRONTAL)
    pixels = camera.project(points) + np.random.default_rng(3).normal(0, 0.5, (4, 30, 2))
    pixels[..., axis] = 511 - pixels[..., axis]
    refusal = refusal_of(view_of(camera, points[0], pixels, sd_mm=0.3))
    assert refusal.reason is Reason.VIEW_MIRRORED
    assert side in str(refusal)


def test_a_body_that_bends_is_refused(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 8)
    bent = simulation.points_mm.copy()
    bent[:, :10] += np.linspace(0, 4, 8)[:, None, None] * np.array([1.0, -1, 0])
    refusal = refusal_of(view_of(simulation.camera, bent[0], simulation.camera.project(bent)))
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    assert "rigid body" in str(refusal)


@pytest.mark.parametrize("source", ["cycle", "others"])
def test_a_contraction_that_looks_like_depth_is_refused_where_two_views_have_shown_it(simulate, source: str) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 8)
    centre = simulation.points_mm[0].mean(axis=0)
    shares = 1 - 0.02 * np.sin(np.linspace(0, np.pi, 8))
    beating = centre + shares[:, None, None] * (simulation.points_mm[0] - centre)
    pixels = simulation.camera.project(beating)
    blind = view_of(simulation.camera, beating[0], pixels)
    assert np.abs(solve(blind).positions_mm - beating).max() > 5
    unknown = refusal_of(blind, known_rigid=False)
    assert unknown.reason is Reason.DEPTH_UNOBSERVABLE
    assert "contracts by one percent looks like a heart that moves 5 mm away" in str(unknown)
    cycle = SiteCycle(np.linspace(0, 0.9, 8), LABELS, beating, np.broadcast_to(0.01 * np.eye(3), (8, 30, 3, 3)))
    known = {"cycle": cycle} if source == "cycle" else {"others": (cycle, cycle, cycle)}
    refusal = refusal_of(view_of(simulation.camera, beating[0], pixels, **known))
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    assert 5 < float(str(refusal).split("would be ")[1].split(" mm")[0]) < 15
    rigid = SiteCycle(
        np.linspace(0, 0.9, 8), LABELS, simulation.points_mm, np.broadcast_to(0.01 * np.eye(3), (8, 30, 3, 3))
    )
    shown = view_of(simulation.camera, simulation.points_mm[0], simulation.pixels_uv, cycle=rigid)
    solve(shown, known_rigid=False)


@pytest.mark.parametrize("source", ["cycle", "others"])
@pytest.mark.parametrize("shown_part", ["of one catheter at rest", "of all in diastole", "of three electrodes"])
def test_a_cycle_that_shows_too_little_does_not_pass_for_proof_of_a_rigid_body(
    simulate, shown_part: str, source: str
) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 8)
    centre = simulation.points_mm[0].mean(axis=0)
    shares = 1 - 0.02 * np.sin(np.linspace(0, np.pi, 8))
    beating = centre + shares[:, None, None] * (simulation.points_mm[0] - centre)
    phases, rows = np.linspace(0, 0.9, 8), slice(None)
    if shown_part == "of all in diastole":
        phases = np.linspace(0, 0.06, 4)
    else:
        rows = slice(20, 30) if shown_part == "of one catheter at rest" else slice(0, 3)
    n, labels = len(phases), LABELS[rows]
    still = np.repeat(beating[:1, rows], n, axis=0)
    cycle = SiteCycle(phases, labels, still, np.broadcast_to(0.01 * np.eye(3), (n, len(labels), 3, 3)))
    known = {"cycle": cycle} if source == "cycle" else {"others": (cycle, cycle, cycle)}
    view = view_of(simulation.camera, beating[0], simulation.camera.project(beating), **known)
    refusal = refusal_of(view, known_rigid=False)
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    assert "no whole cycle of all of them" in str(refusal)


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_three_catheters_in_a_beating_heart_are_refused_by_the_cycles_of_other_sites(seed: int, share: float) -> None:
    study = simulate_study(StudySpec(seed, sites=3, frames=20, breathing_mm=0.0))
    labels = tuple((name, k) for name in study.catalogue.names for k in range(1, 5))
    moving = []
    for site in study.sites:
        points = np.concatenate([site.runs[0].truth.points_mm[name] for name in study.catalogue.names], axis=1)
        moving.append(points[:1] + share * (points - points[:1]))
    certain = np.broadcast_to(0.01 * np.eye(3), (15, 12, 3, 3))
    others = tuple(SiteCycle(np.linspace(0, 0.9, 15), labels, points[:15], certain) for points in moving[1:])
    for run in study.sites[0].runs:
        pixels = run.truth.camera.project(moving[0]) + np.random.default_rng(seed).normal(0, 0.5, (20, 12, 2))
        view = view_of(
            run.truth.camera, moving[0][0], pixels, sd_mm=0.3, labels=labels, catalogue=study.catalogue, others=others
        )
        assert refusal_of(view).reason is Reason.DEPTH_UNOBSERVABLE


def test_one_catheter_alone_is_refused_with_the_bound(simulate) -> None:  # type: ignore[no-untyped-def]
    camera = simulate("H18", "AP", 1).camera
    arc = DEFAULT_CATALOGUE["mapping"].arc_lengths_mm / 30
    points = np.stack([30 * np.sin(arc), 30 * (1 - np.cos(arc)), np.zeros(4)], axis=1) + np.array([10.0, 5.0, 0.0])
    moved = points + np.arange(4)[:, None, None] * np.array([0.5, 0.5, 0.5])
    refusal = refusal_of(view_of(camera, points, camera.project(moved)))
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    bound = float(str(refusal).split("better than ")[1].split(" mm")[0])
    assert 5 < bound < 200


@pytest.mark.parametrize(("count", "accuracy"), [(1, "at all"), (3, "mm"), (8, "mm")])
def test_too_few_electrodes_or_electrodes_on_a_line_are_refused_with_their_bound(
    simulate, count: int, accuracy: str
) -> None:  # type: ignore[no-untyped-def]
    camera = simulate("H18", "AP", 1).camera
    points = np.arange(count)[:, None] * np.array([3.0, 1.0, 2.0])
    if count == 3:
        points = points + np.eye(3) * 5
    pixels = np.broadcast_to(camera.project(points), (3, count, 2))
    refusal = refusal_of(view_of(camera, points, pixels))
    assert refusal.reason is Reason.DEPTH_UNOBSERVABLE
    assert "four electrodes" in str(refusal)
    assert accuracy in str(refusal).split("cannot be known")[1]


def test_a_run_that_shows_nothing_is_refused(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 3)
    view = view_of(
        simulation.camera, simulation.points_mm[0], simulation.pixels_uv, visible=np.zeros((3, 30), dtype=bool)
    )
    assert refusal_of(view).reason is Reason.DEPTH_UNOBSERVABLE


@pytest.mark.parametrize("seed", range(8))
def test_any_pixels_give_an_answer_that_is_finite_or_a_refusal(simulate, seed: int) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "LAT", 5)
    rng = np.random.default_rng(seed)
    pixels = simulation.pixels_uv + rng.normal(0, 0.5, simulation.pixels_uv.shape)
    pixels[rng.integers(5)] = rng.uniform(0, 511, (30, 2))
    visible = rng.uniform(size=(5, 30)) < rng.uniform(0.05, 1)
    with contextlib.suppress(Refusal):
        track = solve(view_of(simulation.camera, simulation.points_mm[0], pixels, visible=visible, sd_mm=0.2))
        assert np.abs((track.positions_mm - simulation.points_mm)[track.located]).max() < 20


def test_an_uncertain_shape_counts_against_the_bound(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 4)
    exact, vague = (
        solve(view_of(simulation.camera, simulation.points_mm[0], simulation.pixels_uv, sd_mm=sd)) for sd in (1e-3, 1.0)
    )
    assert vague.covariance_mm2[3, 0, 2, 2] > 4 * exact.covariance_mm2[3, 0, 2, 2]


def test_a_smooth_path_gives_smaller_covariances(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 8)
    view = view_of(simulation.camera, simulation.points_mm[0], simulation.pixels_uv)
    free, smooth = solve(view), solve(view, acceleration_sd_mm=0.05)
    assert np.abs(smooth.positions_mm - simulation.points_mm).max() < 0.01
    assert np.trace(smooth.covariance_mm2[4, 0]) < 0.5 * np.trace(free.covariance_mm2[4, 0])


def test_without_a_biplane_position_it_refuses(simulate) -> None:  # type: ignore[no-untyped-def]
    simulation = simulate("H18", "AP", 3)
    full = view_of(simulation.camera, simulation.points_mm[0], simulation.pixels_uv)
    empty = MonoplaneView("S01", "a", full.camera, BODY, full.frame_times_ms, full.observations, (), 0, None, ())
    assert refusal_of(empty).reason is Reason.NO_A_PRIORI
