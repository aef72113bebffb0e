"""Tracking the electrodes over the cycle in one view, on the phantom's motion with given pixels."""

from __future__ import annotations

import functools
from dataclasses import astuple, replace

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE, follows_tip
from fluoromap.contracts import (
    Array,
    MonoplaneView,
    NamedChain,
    Observation,
    Refusal,
    Silent,
    SiteCycle,
    StudyVariation,
    Track,
)
from fluoromap.monoplane.expected_motion import expected_motion
from fluoromap.monoplane.motion_covariance import FIXED, MotionCovariance, MotionParams
from fluoromap.monoplane.motion_prior import MotionPrior
from fluoromap.monoplane.track_samples import in_study
from fluoromap.monoplane.view_electrodes import gather_electrodes
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.phantom.ideal_matching import matched_sites
from fluoromap.reasons import Reason
from fluoromap.triangulator.linear import Linear
from fluoromap.triangulator.self_calibration import any_study_belief
from fluoromap.triangulator.uncertainty import UncertaintyParams

EXACT = {
    "gantry_angle_sd_deg": 0.0, "isocentre_sd_mm": 0.0, "magnification_sd": 0.0,
    "respiration_head_feet_sd_mm": 0.0, "respiration_other_sd_mm": 0.0,
}  # fmt: skip
SITES = 12


@functools.cache
def _study(
    seed: int, rate_hz: float = 30.0
) -> tuple[tuple[MonoplaneView, ...], tuple[Array, ...], tuple[SiteCycle, ...]]:
    """Return views, true points (n, m, 3) and cycles; breath held.

    They are views a and b of the first site with its cycle, and the other sites' cycles.
    """
    frames = int(1.6 * rate_hz)
    study = simulate_study(
        StudySpec(seed, sites=SITES, frames=frames, frame_rate_hz=rate_hz, heart="dog", breathing_mm=0.0)
    )
    matched = matched_sites(study)
    located = Linear(UncertaintyParams.model_validate(EXACT)).triangulate(matched, DEFAULT_CATALOGUE, Silent()).sites
    site, runs = located[0], matched[0].runs
    views = (
        MonoplaneView(
            "S01", "a", site.camera_a, DEFAULT_CATALOGUE, runs.frame_times_a_ms, runs.track_a, site.points, site.frame_a,
            site.cycle, (),
        ),
        MonoplaneView(
            "S01", "b", site.camera_b, DEFAULT_CATALOGUE, runs.frame_times_b_ms, runs.track_b, site.points, site.frame_b,
            site.cycle, (),
        ),
    )  # fmt: skip
    truth = tuple(
        np.stack([run.truth.points_mm[point.catheter][:, point.electrode - 1] for point in site.points], axis=1)
        for run in study.sites[0].runs
    )
    return views, truth, tuple(other.cycle for other in located[1:] if other.cycle is not None)


def _track(view: MonoplaneView, **parameters: float) -> Track:
    return MotionPrior(MotionPrior.Params.model_validate({**EXACT, **parameters})).track(view, Silent())


def _rms(track: Track, truth: Array, positions: Array | None = None) -> float:
    error = (track.positions_mm if positions is None else positions) - truth
    return float(np.sqrt((error[track.located] ** 2).sum(axis=-1).mean()))


def _whole(track: Track) -> None:
    """Assert that each covariance of a located sample is symmetric and positive definite."""
    assert track.relative_covariance_mm2 is not None
    for covariances in (track.covariance_mm2, track.relative_covariance_mm2):
        visible = covariances[track.located]
        np.testing.assert_allclose(visible, np.swapaxes(visible, -1, -2), atol=1e-12)
    assert np.linalg.eigvalsh(track.covariance_mm2[track.located]).min() > 0


def _without(observation: Observation, *catheters: str) -> Observation:
    return replace(observation, chains=tuple(c for c in observation.chains if c.catheter not in catheters))


def _at_other_pixels(view: MonoplaneView, catheter: str, shift: Array) -> MonoplaneView:
    """Return the view with one catheter displaced in the image.

    It is displaced frame by frame by (n, 2) pixels.
    """
    changed = tuple(
        replace(visible, chains=tuple(
            replace(chain, pixels_uv=chain.pixels_uv + shift[row]) if chain.catheter == catheter else chain
            for chain in visible.chains
        ))
        for row, visible in enumerate(view.observations)
    )  # fmt: skip
    return replace(view, observations=changed)


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_sites_own_cycle_gives_depth_in_every_frame(seed: int, number: int) -> None:
    views, truth, _ = _study(seed)
    track = _track(views[number])
    assert track.located.all()
    assert _rms(track, truth[number]) <= 0.9
    assert np.sqrt(((track.positions_mm - truth[number]) ** 2).sum(axis=-1).mean(axis=1)).max() < 2.0
    assert _rms(track, truth[number]) <= 1.05 * _rms(track, truth[number], track.baseline_mm)
    assert all(reasons == () for reasons in track.reasons)
    _whole(track)


def test_the_other_sites_motion_replaces_an_unknown_cycle() -> None:
    errors = []
    for seed in (1, 2, 3):
        views, truths, others = _study(seed)
        for view, truth in zip(views, truths, strict=True):
            track = _track(replace(view, cycle=None, others=others))
            assert set(track.reasons) == {(Reason.MOTION_FROM_OTHERS,)}
            still = _track(replace(view, cycle=None))
            assert set(still.reasons) == {(Reason.DEPTH_ASSUMED,)}
            errors.append((_rms(track, truth), _rms(track, truth, track.baseline_mm), _rms(still, truth)))
    field, baseline, constant = np.sqrt(np.mean(np.square(errors), axis=0))
    assert field <= 1.0
    assert field <= 1.05 * baseline
    assert field < 0.7 * constant


def test_the_baseline_lies_on_the_rays_and_positions_within_the_pixels() -> None:
    (view, _), _, _ = _study(1)
    track = _track(view)
    np.testing.assert_allclose(view.camera.project(track.baseline_mm), track.pixels_uv, atol=1e-9)
    assert np.abs(view.camera.project(track.positions_mm) - track.pixels_uv).max() < 4 * 0.5


def test_without_phases_the_last_known_depth_is_kept_and_said() -> None:
    (view, _), truth, others = _study(1)
    blind = replace(
        view,
        observations=tuple(replace(visible, phase=None) for visible in view.observations),
        cycle=None,
        others=others,
    )
    track = _track(blind)
    assert all(set(reasons) == {Reason.DEPTH_ASSUMED, Reason.PHASE_UNKNOWN} for reasons in track.reasons)
    assert _rms(track, truth[0]) < 3.5
    _whole(track)


def test_a_catheter_is_located_only_where_it_is_seen() -> None:
    (view, _), truth, _ = _study(1)
    gaps = {3, 4, 20}
    gone = tuple(_without(s, "mapping") if row in gaps else s for row, s in enumerate(view.observations))
    track = _track(replace(view, observations=gone))
    mapping = np.array([name == "mapping" for name, _ in track.labels])
    expected = np.ones_like(track.located)
    expected[np.ix_(np.array(sorted(gaps)), np.flatnonzero(mapping))] = False
    np.testing.assert_array_equal(track.located, expected)
    assert not track.positions_mm[~track.located].any()
    assert [Reason.TRACK_INTERRUPTED in reasons for reasons in track.reasons] == mapping.tolist()
    assert _rms(track, truth[0]) <= 0.9


def test_one_electrode_in_view_stays_at_the_cycles_depth() -> None:
    (view, _), truth, _ = _study(1)
    alone = tuple(
        replace(visible, chains=tuple(
            NamedChain("mapping", (1,), chain.pixels_uv[:1], chain.covariance_px2[:1])
            for chain in visible.chains if chain.catheter == "mapping"
        ))
        for visible in view.observations
    )  # fmt: skip
    track = _track(replace(view, observations=alone))
    assert track.located.sum() == len(view.observations)
    assert _rms(track, truth[0]) <= 1.2
    _whole(track)
    # There is no reference to subtract, so that both covariances are equal.
    assert track.relative_covariance_mm2 is not None
    np.testing.assert_array_equal(track.relative_covariance_mm2, track.covariance_mm2)


def test_a_mirrored_view_is_refused() -> None:
    (view, _), _, _ = _study(1)
    middle = 2 * view.camera.principal_point_uv[0]
    mirrored = tuple(
        replace(visible, chains=tuple(
            replace(chain, pixels_uv=np.stack([middle - chain.pixels_uv[:, 0], chain.pixels_uv[:, 1]], axis=1))
            for chain in visible.chains
        ))
        for visible in view.observations
    )  # fmt: skip
    with pytest.raises(Refusal) as refused:
        _track(replace(view, observations=mirrored))
    assert refused.value.reason == Reason.VIEW_MIRRORED


def test_a_catheter_that_jumps_away_does_not_move_the_others() -> None:
    (view, _), truth, _ = _study(1)
    shift = np.zeros((len(view.observations), 2))
    shift[10:13] = (60.0, -35.0)
    track = _track(_at_other_pixels(view, "pacing", shift))
    pacing = np.array([name == "pacing" for name, _ in track.labels])
    assert [Reason.PRIOR_GATE in reasons for reasons in track.reasons] == pacing.tolist()
    np.testing.assert_array_equal(track.positions_mm[10:13, pacing], track.baseline_mm[10:13, pacing])
    # Pixels and cycle contradict each other: the uncertainty contains both.
    off = (track.positions_mm - truth[0])[10:13, pacing]
    distance = np.einsum(
        "nmi,nmi->nm", off, np.linalg.solve(track.covariance_mm2[10:13, pacing], off[..., None])[..., 0]
    )
    assert distance.max() <= 7.815
    error = (track.positions_mm - truth[0])[:, ~pacing]
    assert np.sqrt((error**2).sum(axis=-1).mean()) <= 0.9


def test_a_catheter_longer_than_its_maker_says_is_not_pulled_in_depth() -> None:
    (view, _), truth, _ = _study(1)
    mapping = DEFAULT_CATALOGUE["mapping"]
    wrong = replace(mapping, spacing_mm=(6.65, 6.3, 3.3))
    catheters = tuple(wrong if one is mapping else one for one in DEFAULT_CATALOGUE.catheters)
    track = _track(replace(view, catalogue=replace(DEFAULT_CATALOGUE, catheters=catheters)))
    assert _rms(track, truth[0]) <= 1.0


def test_less_than_one_beat_is_enough() -> None:
    (view, _), truth, _ = _study(1)
    short = slice(view.a_priori_frame, view.a_priori_frame + 5)
    track = _track(
        replace(
            view, observations=view.observations[short], frame_times_ms=view.frame_times_ms[short], a_priori_frame=0
        )
    )
    assert _rms(track, truth[0][short]) <= 1.2
    one = slice(view.a_priori_frame, view.a_priori_frame + 1)
    still = replace(
        view, observations=view.observations[one], frame_times_ms=view.frame_times_ms[one], a_priori_frame=0
    )
    _whole(_track(still))


def test_an_irregular_rhythm_is_reported_and_widens_the_depth() -> None:
    (view, _), _, _ = _study(1)
    n = len(view.observations)
    uneven = np.concatenate([np.arange(0, 2, 2 / 12), np.arange(0, 1, 1 / 22), np.arange(0, 1, 1 / 22)])[:n]
    phases = np.concatenate([uneven, np.linspace(0, 0.5, n)])[:n] % 1.0
    changed = tuple(replace(visible, phase=float(p)) for visible, p in zip(view.observations, phases, strict=True))
    track = _track(replace(view, observations=changed))
    assert all(Reason.IRREGULAR_RHYTHM in reasons for reasons in track.reasons)
    _whole(track)


def test_nothing_known_from_two_views_is_refused() -> None:
    (view, _), _, _ = _study(1)
    with pytest.raises(Refusal) as refused:
        _track(replace(view, a_priori=()))
    assert refused.value.reason == Reason.NO_A_PRIORI


def test_an_electrode_that_the_cycle_lacks_moves_with_its_catheter() -> None:
    (view, _), truth, _ = _study(1)
    assert view.cycle is not None
    lost = view.cycle.labels.index(("mapping", 2))
    keep = [i for i in range(len(view.cycle.labels)) if i != lost]
    fewer = SiteCycle(
        view.cycle.phases, tuple(view.cycle.labels[i] for i in keep), view.cycle.positions_mm[:, keep],
        view.cycle.covariance_mm2[:, keep],
    )  # fmt: skip
    track = _track(replace(view, cycle=fewer))
    at = track.labels.index(("mapping", 2))
    assert np.sqrt(((track.positions_mm - truth[0])[:, at] ** 2).sum(axis=-1).mean()) <= 1.5


def test_breathing_makes_the_depth_uncertain_but_not_what_is_relative_to_the_reference() -> None:
    (view, _), _, _ = _study(1)
    held, breathing = _track(view), _track(view, respiration_other_sd_mm=1.0, respiration_head_feet_sd_mm=4.0)
    ray = view.camera.axis_world

    def depth_sd(covariance: Array | None) -> float:
        assert covariance is not None
        return float(np.sqrt(np.einsum("i,nmij,j->nm", ray, covariance, ray).mean()))

    assert depth_sd(breathing.covariance_mm2) > depth_sd(held.covariance_mm2) + 0.2
    relative = [depth_sd(track.relative_covariance_mm2) for track in (held, breathing)]
    assert relative[1] == pytest.approx(relative[0], rel=0.1)


def test_depth_from_another_run_is_off_by_both_runs_breaths() -> None:
    (view, _), _, _ = _study(1)
    assert view.cycle is not None
    breath = np.diag([1.0, 1.0, 16.0])
    follows = follows_tip(view.cycle.positions_mm, view.cycle.labels, view.catalogue)
    still = 0.25**2 * follows @ np.swapaxes(follows, -1, -2)

    def depth_variance(covariance: Array, **breathing: float) -> Array:
        assert view.cycle is not None
        changed = replace(view, cycle=replace(view.cycle, covariance_mm2=covariance))
        p = MotionParams.model_validate({**EXACT, "respiration_drift_sd_mm": 0.0, **breathing})
        electrodes = gather_electrodes(changed)
        sds = p.mapping_motion_sd_mm, p.other_motion_sd_mm, p.beat_sd_mm, p.gantry_angle_sd_deg
        expected = expected_motion(changed, electrodes, *sds)
        prior = MotionCovariance(changed, electrodes.labels, expected, electrodes.phases, p).window(slice(0, 10))
        return prior.variance_mm2(np.ones(4), (FIXED,), np.broadcast_to(view.camera.axis_world, prior.mean_mm.shape))

    # The cycle is valid for the middle of two breathing positions: half of one position's variance.
    middle = depth_variance(still + breath / 2, respiration_other_sd_mm=1.0, respiration_head_feet_sd_mm=4.0)
    np.testing.assert_allclose(
        middle - depth_variance(still), 2 * view.camera.axis_world @ breath @ view.camera.axis_world, rtol=1e-6
    )
    # A cycle recorded with the breath held has the depth of that breath; only this run's breath remains.
    held = depth_variance(still, respiration_other_sd_mm=1.0, respiration_head_feet_sd_mm=4.0)
    np.testing.assert_allclose(
        held - depth_variance(still), view.camera.axis_world @ breath @ view.camera.axis_world, rtol=1e-6
    )


def test_ellipsoids_hold_the_truth_about_as_often_as_they_say() -> None:
    """Check a coarse limit over few hearts; the benchmark measures the figure."""
    inside = []
    for seed in (1, 2, 3):
        views, truths, _ = _study(seed)
        for view, truth in zip(views, truths, strict=True):
            track = _track(view)
            error = track.positions_mm - truth
            distance = np.einsum("nmi,nmi->nm", error, np.linalg.solve(track.covariance_mm2, error[..., None])[..., 0])
            inside.append((distance <= 7.815).mean())
    assert 0.85 <= np.mean(inside) <= 0.998


def test_cost_is_linear_in_frames_because_beats_are_solved_one_by_one() -> None:
    (view, _), _, _ = _study(1)
    phases = np.array([visible.phase or 0.0 for visible in view.observations])
    cut = int(np.flatnonzero(np.diff(phases) < -0.5)[-1]) + 1
    # The same moment of an earlier beat, so that it stays in the part.
    at_rest = int(np.abs(phases[:cut] - phases[view.a_priori_frame]).argmin())
    view = replace(view, a_priori_frame=at_rest)
    whole = _track(view)
    part = _track(replace(view, observations=view.observations[:cut], frame_times_ms=view.frame_times_ms[:cut]))
    # The pixels of later beats do not enter; only the number of beats that were averaged differs.
    assert np.abs(part.positions_mm - whole.positions_mm[:cut]).max() < 0.3


def test_a_track_belongs_to_its_study_only_when_it_is_read() -> None:
    """The study's variation changes the covariances, not the positions, and each cause changes its own share."""
    views, _, _ = _study(3)
    track, camera = _track(views[0], isocentre_sd_mm=0.5, respiration_other_sd_mm=1.0), views[0].camera
    same = in_study(track, camera, "reference", StudyVariation())
    np.testing.assert_allclose(same.covariance_mm2, track.covariance_mm2, atol=1e-12)
    calm = in_study(track, camera, "reference", StudyVariation(0.1, 0.3, 0.5, 1.0))
    wild = in_study(track, camera, "reference", StudyVariation(1.6, 2.4, 4.0, 4.0))
    np.testing.assert_array_equal(calm.positions_mm, track.positions_mm)
    for narrow, wide in ((calm, track), (track, wild)):
        _whole(narrow)
        for before, after in (
            (narrow.covariance_mm2, wide.covariance_mm2),
            (narrow.relative_covariance_mm2, wide.relative_covariance_mm2),
        ):
            assert before is not None
            assert after is not None
            sizes = [np.trace(of, axis1=-2, axis2=-1)[track.located] for of in (before, after)]
            assert (sizes[0] <= sizes[1] + 1e-9).all()
    breath = in_study(track, camera, "reference", replace(StudyVariation(), breathing=2.0))
    assert np.trace(breath.covariance_mm2, axis1=-2, axis2=-1)[track.located].min() > 0
    assert (breath.covariance_mm2 - track.covariance_mm2)[track.located].max() > 0.5
    # Breathing displaces all catheters alike: it cancels in positions from the reference catheter.
    assert breath.relative_covariance_mm2 is not None
    assert track.relative_covariance_mm2 is not None
    np.testing.assert_allclose(breath.relative_covariance_mm2, track.relative_covariance_mm2, atol=0.05)


def test_without_a_study_the_variation_is_that_of_any_study() -> None:
    belief = any_study_belief(UncertaintyParams())
    assert astuple(belief.variation) == pytest.approx(astuple(StudyVariation()), abs=1e-3)
