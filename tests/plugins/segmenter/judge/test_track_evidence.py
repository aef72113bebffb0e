"""Tracks judged by pictures averaged along them, in noise and where nothing is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fluoromap.contracts import Chain, PixelFacts
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, read_weights
from fluoromap.segmenter.judge.acceptance import UNSEEN
from fluoromap.segmenter.judge.features.track_means import SectionOdds, TrackMeans
from fluoromap.segmenter.judge.track_evidence import TrackEvidence
from fluoromap.segmenter.picture.field_mask import find_field
from fluoromap.segmenter.picture.log_image import LogTransform

FRAMES = 8
PX_PER_MM = 512 / 178 * 2
FACTS = PixelFacts(False, 12, False)
TIMES_MS = np.arange(4 * FRAMES) * 1000.0 / 60.0


@pytest.fixture(scope="module")
def noisy():
    spec = StudySpec(313, sites=1, frames=FRAMES, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA"), dose=0.25)
    return simulate_study(spec).sites[0].runs[1]


@pytest.fixture(scope="module")
def images(noisy):
    frames = [noisy.frames[k] for k in range(FRAMES)]
    field = find_field(noisy.frames, FACTS)
    transform = LogTransform.of_run(FACTS, field.mean_level)
    return [field.fill(transform(frame)) for frame in frames]


def chains(path_uv):
    count = path_uv.shape[1]
    numbers = tuple(range(1, count + 1))
    covariance = np.tile(np.eye(2), (count, 1, 1))
    return {
        frame: Chain(numbers, points, covariance, np.ones(count), (("reference", 1.0),))
        for frame, points in enumerate(path_uv)
    }


def accepts(judge, track, log_image):
    return judge(track, log_image).is_catheter


def evidence(odds, shafts=(0.0, 0.0), gaps=0.0, beyond=(0.0, 0.0), tips=(0.0, 0.0)):
    """Return evidence for electrodes with nothing beside them.

    ``odds`` : their log-odds, (n,). ``shafts``, ``tips`` : at both ends. ``gaps`` and ``beyond`` both ends: how dark it is there,
    as a share of the electrodes' depth.
    """
    beside, across = np.zeros((2, 6, len(odds), 3)), np.zeros((2, 9, len(odds), 3))
    depths = np.zeros((2 * len(odds) - 1, 2))
    depths[::2, 0], depths[1::2, 0] = 1.0, gaps
    return SectionOdds(
        odds, beside, across, depths, np.array(shafts), np.array(beyond), np.array(tips), np.zeros((0, 2)), np.zeros(0)
    )


@pytest.mark.parametrize(
    ("shafts", "tips", "says"),
    [
        ((0.1, 0.9), (0.0, 0.0), 1),
        ((0.9, 0.1), (0.0, 0.0), -1),
        ((0.5, 0.5), (0.0, 0.0), 0),
        ((0.5, 0.5), (2.0, -1.0), 1),
        ((0.5, 0.5), (-1.0, 2.0), -1),
        ((0.4, 0.6), (-2.0, 2.0), -1),
        # However sure the network is, a clear shaft says more.
        ((0.0, 1.0), (-20.0, 20.0), 1),
    ],
)
def test_shaft_and_network_in_the_means_say_which_end_of_a_track_is_the_tip(monkeypatch, shafts, tips, says):
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    track = chains(np.repeat(row[None], FRAMES, axis=0))
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda *_: evidence(np.full(4, 2.0), shafts, tips=tips))
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    assert np.sign(judge(track, lambda frame: None).tip_odds) == says
    # Single frames show a long tip itself.
    knows = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES], frozenset({"reference"}))
    assert knows(track, lambda frame: None).tip_odds is None


def test_a_catheter_in_noise_is_clear_in_the_mean_along_its_track(noisy, images):
    trained = read_weights(Path(SHIPPED))
    judge = TrackEvidence(trained, PX_PER_MM, TIMES_MS[:FRAMES])
    alone = [NetworkResponse.of_image(image, trained, PX_PER_MM) for image in images]
    for path_uv in noisy.truth.pixels_uv.values():
        assert accepts(judge, chains(path_uv), lambda frame: images[frame])
        odds = (
            TrackMeans(trained, PX_PER_MM)
            .evidence_along(list(range(FRAMES)), path_uv, lambda frame: images[frame])
            .log_odds
        )
        single = [np.median(seen.probability_at(points)) for seen, points in zip(alone, path_uv, strict=True)]
        assert 1.0 / (1.0 + np.exp(-np.median(odds))) > np.median(single)


def test_a_track_beside_the_catheters_is_rejected(noisy, images):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    path_uv = noisy.truth.pixels_uv["reference"]
    for shift in ([0.0, 60.0], [70.0, 0.0], [-55.0, -40.0]):
        beside = path_uv + np.array(shift)
        assert not accepts(judge, chains(beside), lambda frame: images[frame])


def test_a_long_catheter_is_judged_in_sections(images):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    row = np.stack([np.linspace(100.0, 400.0, 20), np.full(20, 200.0)], axis=1)
    path_uv = np.repeat(row[None], FRAMES, axis=0)
    assert not accepts(judge, chains(path_uv), lambda frame: images[frame])


def test_chains_of_fewer_electrodes_than_usual_do_not_count(noisy, images):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    track = chains(noisy.truth.pixels_uv["reference"])
    track[2] = next(iter(chains(noisy.truth.pixels_uv["reference"][2:3, :3]).values()))
    assert accepts(judge, track, lambda frame: images[frame])


@pytest.mark.parametrize(
    ("electrodes", "odds", "hidden", "accepted"),
    [
        (4, 0.5, 0, True),
        (4, 0.5, 1, False),
        (4, 2.5, 1, True),
        (4, 2.5, 2, False),
        (6, 0.5, 1, True),
        (10, 0.1, 2, True),
        (10, -2.4, 2, True),
        (10, -2.8, 0, False),
    ],
)
def test_some_electrodes_of_a_long_catheter_and_one_of_a_clear_short_one_may_be_doubted(
    monkeypatch, electrodes, odds, hidden, accepted
):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])

    def along(self, frames, path_uv, log_image):
        return evidence(np.where(path_uv[0, :, 0] > 100.0 + 20.0 * hidden - 1.0, odds, -2.5))

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(electrodes), np.full(electrodes, 200.0)], axis=1)
    assert accepts(judge, chains(np.repeat(row[None], FRAMES, axis=0)), lambda frame: None) == accepted


def test_a_place_that_is_clearly_no_electrode_has_no_excuse_in_a_short_catheter(monkeypatch):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    track = chains(np.repeat(row[None], FRAMES, axis=0))
    for worst, accepted in ((-2.9, True), (-3.1, False)):
        odds = np.array([3.0, 3.0, 3.0, worst])
        monkeypatch.setattr(TrackMeans, "evidence_along", lambda *_, odds=odds: evidence(odds))
        assert accepts(judge, track, lambda frame: None) == accepted


def test_a_lead_with_two_electrodes_can_be_accepted(monkeypatch):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    row = np.array([[100.0, 200.0], [150.0, 200.0]])
    track = chains(np.repeat(row[None], FRAMES, axis=0))
    for odds, accepted in ((0.9, True), (0.7, False)):
        monkeypatch.setattr(TrackMeans, "evidence_along", lambda *_, odds=odds: evidence(np.full(2, odds)))
        assert accepts(judge, track, lambda frame: None) == accepted


def test_what_lies_beside_a_loop_is_its_other_side(monkeypatch):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    angles = np.linspace(0.0, 5.5, 10)
    loop = 200.0 + 40.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    row = np.stack([100.0 + 20.0 * np.arange(10), np.full(10, 200.0)], axis=1)

    def along(self, frames, path_uv, log_image):
        count = path_uv.shape[1]
        wall = np.broadcast_to(np.array([0.6, 1.0, 1.0]), (2, 9, count, 3))
        return replace(evidence(np.full(count, 3.0)), across=wall)

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    assert accepts(judge, chains(np.repeat(loop[None], FRAMES, axis=0)), lambda frame: None)
    assert not accepts(judge, chains(np.repeat(row[None], FRAMES, axis=0)), lambda frame: None)


def test_electrodes_outside_the_field_do_not_count(monkeypatch):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    row = np.stack([-10.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    known = chains(np.repeat(row[None], FRAMES, axis=0))

    def along(self, frames, path_uv, log_image):
        return evidence(np.where(path_uv[0, :, 0] > 0, 1, -9))

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    for outside, accepted in ((1, True), (2, False)):
        scores = np.where(np.arange(4) < outside, UNSEEN, 0.3)
        track = {frame: replace(chain, scores=scores) for frame, chain in known.items()}
        assert accepts(judge, track, lambda frame: None) == accepted
    assert not accepts(judge, known, lambda frame: None)


@pytest.mark.parametrize(("all_along", "accepted"), [(0.5, True), (-2.8, False)])
@pytest.mark.parametrize("electrodes", [4, 10])
def test_a_catheter_at_rest_over_anatomy_or_in_noise_is_judged_by_frames_all_along_its_track(
    monkeypatch, electrodes, all_along, accepted
):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[: 2 * FRAMES])

    def along(self, frames, path_uv, log_image):
        return evidence(np.full(path_uv.shape[1], all_along if np.ptp(frames) > FRAMES else -2.8))

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(electrodes), np.full(electrodes, 200.0)], axis=1)
    assert accepts(judge, chains(np.repeat(row[None], 2 * FRAMES, axis=0)), lambda frame: None) == accepted


@pytest.mark.parametrize("lines", ["beside", "across"])
def test_a_track_along_the_bars_of_a_probe_is_no_catheter(monkeypatch, lines):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    known = chains(np.repeat(row[None], FRAMES, axis=0))
    nothing = evidence(np.full(4, 3.0))
    bars = np.zeros(getattr(nothing, lines).shape)
    bars[0] = 0.6, 1.0, 1.0
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda *_: replace(nothing, **{lines: bars}))
    assert not accepts(judge, known, lambda frame: None)
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda *_: nothing)
    assert accepts(judge, known, lambda frame: None)


@pytest.mark.parametrize(
    ("electrodes", "odds", "found", "moves", "accepted"),
    [
        (4, -0.2, 24, True, True),
        (4, -0.6, 24, True, False),
        (4, 0.3, 12, True, False),
        (4, 0.7, 12, True, True),
        (4, 1.0, 24, False, False),
        (4, 1.3, 24, False, True),
        (10, -0.2, 12, True, False),
        (10, 0.9, 24, False, True),
        (10, 0.7, 24, False, False),
    ],
)
def test_clutter_is_rarely_the_same_catheter_in_every_frame_and_rarely_moves(
    monkeypatch, electrodes, odds, found, moves, accepted
):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(24) * 66.7)
    monkeypatch.setattr(
        TrackMeans,
        "evidence_along",
        lambda self, frames, path_uv, log_image: evidence(np.full(path_uv.shape[1], odds)),
    )
    row = np.stack([100.0 + 20.0 * np.arange(electrodes), np.full(electrodes, 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(found))[:, None, None] * np.array([0.0, float(moves)])
    assert accepts(judge, chains(row + beat), lambda frame: None) == accepted


@pytest.mark.parametrize(
    ("odds", "tips", "gaps", "moves", "name", "accepted"),
    [
        ([-0.5] * 4, (0.5, -1.0), 0.0, True, "ablation", True),
        ([-0.5] * 4, (0.5, -1.0), 0.0, True, "cs", False),
        ([-0.5] * 4, (0.5, -1.0), 0.0, False, "ablation", False),
        ([-0.5] * 4, (0.3, -1.0), 0.0, True, "ablation", False),
        ([-0.5] * 4, (0.5, -0.4), 0.0, True, "ablation", False),
        ([-0.7] * 4, (0.5, -1.0), 0.0, True, "ablation", False),
        ([-0.3, -0.3, -0.3, -2.6], (0.5, -1.0), 0.0, True, "ablation", False),
        ([0.1] * 4, (0.5, -1.0), 0.7, True, "ablation", True),
        ([-0.1] * 4, (0.5, -1.0), 0.7, True, "ablation", False),
    ],
)
def test_a_sure_long_tip_is_rarely_clutter_that_moves(monkeypatch, odds, tips, gaps, moves, name, accepted):
    """A long tip and the rings near it merge to a dark bar, in which the network doubts each."""
    assert judged_with_tip(monkeypatch, odds, tips, gaps, moves, name).is_catheter == accepted


def judged_with_tip(monkeypatch, odds, tips, gaps, moves=True, name="ablation"):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(24) * 66.7, frozenset({"ablation"}))

    def along(self, frames, path_uv, log_image):
        return evidence(np.resize(odds, path_uv.shape[1]), gaps=gaps, tips=tips)

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(len(odds)), np.full(len(odds), 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(24))[:, None, None] * np.array([0.0, float(moves)])
    track = {frame: replace(chain, kinds=((name, 1.0),)) for frame, chain in chains(row + beat).items()}
    return judge(track, lambda frame: None)


@pytest.mark.parametrize(
    ("odds", "tips", "name", "is_clear"),
    [
        (0.6, (0.5, -1.0), "ablation", True),
        (0.6, (0.5, -0.4), "ablation", False),
        (0.6, (0.5, -1.0), "cs", False),
        (0.1, (0.5, -1.0), "ablation", False),
        (1.1, (0.0, 0.0), "cs", True),
    ],
)
def test_a_catheter_with_a_sure_long_tip_is_clear_enough_alone(monkeypatch, odds, tips, name, is_clear):
    """Clutter rarely has a tip: such a catheter may be all that a run shows clearly. One that needs its tip is not clear."""
    verdict = judged_with_tip(monkeypatch, [odds] * 4, tips, 0.0, name=name)
    assert (verdict.is_catheter, verdict.is_clear) == (odds > 0.0, is_clear)


@pytest.mark.parametrize(("electrodes", "gaps"), [(2, 0.0), (10, 0.7)])
def test_a_tip_speaks_for_no_pair_and_no_row(monkeypatch, electrodes, gaps):
    assert not judged_with_tip(monkeypatch, [0.4] * electrodes, (0.5, -1.0), gaps).is_catheter


def test_noise_hides_no_catheter_with_a_tip_on_a_dark_line(monkeypatch):
    odds = [0.48, 0.48, 0.48, -1.6]
    assert not judged_with_tip(monkeypatch, odds, (0.5, -1.0), 0.7).may_be_hidden
    assert judged_with_tip(monkeypatch, odds, (0.5, -1.0), 0.0).may_be_hidden


@pytest.mark.parametrize(
    ("odds", "gaps", "step_px", "accepted"),
    [(-0.2, 0.2, 0.0, True), (1.0, 0.6, 0.0, False), (1.3, 0.6, 0.0, True), (1.0, 0.6, 1.0, True)],
)
def test_a_moment_is_too_short_to_see_separate_spots_move(monkeypatch, odds, gaps, step_px, accepted):
    """Parts of a dark line at rest need as much as in a longer run."""
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[: 2 * FRAMES])
    monkeypatch.setattr(
        TrackMeans, "evidence_along", lambda self, frames, path_uv, log_image: evidence(np.full(4, odds), gaps=gaps)
    )
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    moved = step_px * np.arange(2 * FRAMES)[:, None, None] * np.array([0.0, 1.0])
    assert accepts(judge, chains(row + moved), lambda frame: None) == accepted


@pytest.mark.parametrize(
    ("odds", "gaps", "frame_ms", "accepted"),
    [
        ([0.4, 0.4, 0.4, -1.4], 0.2, 66.7, True),
        ([0.4, 0.4, 0.4, -1.6], 0.2, 66.7, False),
        ([0.2, 0.2, 0.2, 0.2], 0.2, 66.7, False),
        ([1.0, 1.0, 1.0, 1.0], 0.6, 66.7, False),
        ([1.3, 1.3, 1.3, -0.9], 0.6, 66.7, False),
        ([2.0, 2.0, 2.0, -1.4], 0.6, 66.7, True),
        ([2.0, 2.0, 2.0, -1.6], 0.6, 66.7, False),
        ([2.0, -1.4, 2.0, 2.0], 0.6, 66.7, False),
        ([-1.4, 2.0, 2.0, -1.4], 0.6, 66.7, False),
        ([2.0, 2.0, 2.0, -1.4], 0.6, 250.0, False),
        ([0.4, 0.4, 0.4, 0.4], 0.2, 250.0, False),
        ([0.4] * 6, 0.2, 66.7, True),
        ([0.7] * 6, 0.6, 66.7, False),
    ],
)
def test_in_less_than_a_beat_separate_spots_may_not_have_moved_yet(monkeypatch, odds, gaps, frame_ms, accepted):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(6) * frame_ms)

    def along(self, frames, path_uv, log_image):
        return evidence(np.array(odds)[: path_uv.shape[1]], gaps=gaps)

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(len(odds)), np.full(len(odds), 200.0)], axis=1)
    assert accepts(judge, chains(np.repeat(row[None], 6, axis=0)), lambda frame: None) == accepted


@pytest.mark.parametrize(("worst", "accepted"), [(-3.0, True), (-5.5, False)])
def test_a_chain_that_is_displaced_along_its_catheter_has_places_that_are_clearly_none(monkeypatch, worst, accepted):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    odds = {7: worst, 8: 3.0, 9: 3.0}

    def along(self, frames, path_uv, log_image):
        place = np.rint((path_uv[0, :, 0] - 100.0) / 20.0).astype(int)
        return evidence(np.array([odds.get(index, -0.5) for index in place.tolist()]))

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(10), np.full(10, 200.0)], axis=1)
    assert accepts(judge, chains(np.repeat(row[None], FRAMES, axis=0)), lambda frame: None) == accepted


@pytest.mark.parametrize(("step_px", "accepted"), [(0.0, False), (3.0, True)])
def test_a_short_track_that_does_not_move_needs_every_electrode(monkeypatch, step_px, accepted):
    frames = 6
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, 66.7 * np.arange(frames))
    odds = np.array([2.0, 2.0, 2.0, -1.6])
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda self, frames, path_uv, log_image: evidence(odds))
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    places = row + np.array([0.0, step_px]) * np.arange(frames)[:, None, None]
    assert accepts(judge, chains(places), lambda frame: None) == accepted


@pytest.mark.parametrize(
    ("odds", "found", "moves", "shown"),
    [
        ([-0.6, -0.6, -1.2, -2.9], 24, True, True),
        ([-0.6, -0.6, -1.2, -3.1], 24, True, False),
        ([-2.0, -2.0, -2.0, -2.0], 24, True, True),
        ([-2.2, -2.2, -2.2, -2.2], 24, True, False),
        ([-0.6, -0.6, -0.6, -0.6], 18, True, False),
        ([0.8, 0.8, 0.8, -0.6], 24, False, True),
        ([0.8, 0.8, 0.8, -0.8], 24, False, False),
        ([0.5, 0.5, 0.5, 0.5], 24, False, False),
    ],
)
def test_noise_is_an_excuse_in_a_run_that_shows_another_catheter(monkeypatch, odds, found, moves, shown):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(24) * 66.7)
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda self, frames, path_uv, log_image: evidence(np.array(odds)))
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(found))[:, None, None] * np.array([0.0, float(moves)])
    assert judge(chains(row + beat), lambda frame: None).may_be_hidden == shown


@pytest.mark.parametrize(
    ("odds", "is_catheter"),
    [
        ([2.5, 2.5, -1.2, 2.5, 2.5, 2.5], False),
        ([2.5, 2.5, -0.8, 2.5, 2.5, 2.5], True),
        ([1.0, 1.0, -2.2, 1.0, 1.0, 1.0], True),
        ([1.0, 1.0, -2.7, 1.0, 1.0, 1.0], False),
        ([2.5] * 4 + [-1.2] + [2.5] * 5, True),
        ([2.5] * 4 + [-4.5] + [2.5] * 5, True),
        ([2.5] * 4 + [-4.5] * 2 + [2.5] * 4, True),
        ([2.5] * 8 + [-4.5] * 2, True),
        ([2.5] * 7 + [-4.5] * 3, False),
        ([2.5, 2.5, -4.5, 2.5, 2.5, 2.5, -4.5, 2.5, 2.5, 2.5], False),
        ([2.5] * 4 + [-4.5] * 2, False),
    ],
)
def test_a_row_with_places_of_nothing_may_lie_on_a_shorter_catheter(monkeypatch, odds, is_catheter):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])

    def along(self, frames, path_uv, log_image):
        place = np.rint((path_uv[0, :, 0] - 100.0) / 20.0).astype(int)
        return evidence(np.array(odds)[place])

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(len(odds)), np.full(len(odds), 200.0)], axis=1)
    assert judge(chains(np.repeat(row[None], FRAMES, axis=0)), lambda frame: None).is_catheter == is_catheter


def test_the_places_that_something_hides_are_known(monkeypatch):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    odds = np.array([2.5] * 8 + [-2.9, -3.1])

    def along(self, frames, path_uv, log_image):
        return evidence(odds[np.rint((path_uv[0, :, 0] - 100.0) / 20.0).astype(int)])

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(10), np.full(10, 200.0)], axis=1)
    assert judge(chains(np.repeat(row[None], FRAMES, axis=0)), lambda frame: None).hidden == (False,) * 9 + (True,)
    for unhidden in (2.5, [0.9] * 9 + [-3.1]):
        odds[:] = unhidden
        assert judge(chains(np.repeat(row[None], FRAMES, axis=0)), lambda frame: None).hidden == ()


@pytest.mark.parametrize(
    ("electrodes", "odds", "gaps", "accepted"),
    [
        (10, -2.4, 0.2, True),
        (10, -2.8, 0.2, False),
        (10, -1.2, 0.4, True),
        (10, -1.4, 0.4, False),
        (10, 0.1, 0.55, True),
        (10, -0.1, 0.55, False),
        (4, -0.3, 0.2, True),
        (4, -0.3, 0.55, False),
        (4, 0.5, 0.55, True),
    ],
)
def test_a_row_of_separate_spots_is_a_catheter_in_more_noise_than_parts_of_a_line(
    monkeypatch, electrodes, odds, gaps, accepted
):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(24) * 66.7)
    monkeypatch.setattr(
        TrackMeans,
        "evidence_along",
        lambda self, frames, path_uv, log_image: evidence(np.full(path_uv.shape[1], odds), gaps=gaps),
    )
    row = np.stack([100.0 + 20.0 * np.arange(electrodes), np.full(electrodes, 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(24))[:, None, None] * np.array([0.0, 1.0])
    assert accepts(judge, chains(row + beat), lambda frame: None) == accepted


def test_what_is_not_dark_is_no_row_of_spots(monkeypatch):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(24) * 66.7)
    flat = replace(evidence(np.full(5, -0.5)), depths=np.zeros((9, 2)))
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda self, frames, path_uv, log_image: flat)
    row = np.stack([100.0 + 20.0 * np.arange(10), np.full(10, 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(24))[:, None, None] * np.array([0.0, 1.0])
    assert not accepts(judge, chains(row + beat), lambda frame: None)


@pytest.mark.parametrize(("doubted", "accepted"), [(0.0, False), (1.0, True)])
def test_the_ends_of_a_lead_and_places_on_its_coil_are_no_catheter(monkeypatch, doubted, accepted):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(24) * 66.7)
    lead = evidence(np.array([doubted, doubted, 2.5, 2.5]))
    lead.depths[1::2, 0] = 1.5, 0.5, 0.3
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda self, frames, path_uv, log_image: lead)
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(24))[:, None, None] * np.array([0.0, 1.0])
    assert accepts(judge, chains(row + beat), lambda frame: None) == accepted


@pytest.mark.parametrize(
    ("odds", "gaps", "accepted"),
    [((2.1, 1.9, -0.8, -0.4), 1.0, False), ((2.1, 1.9, -0.8, -0.4), 0.6, True), ((2.1, 1.9, -0.8, 0.4), 1.0, True)],
)
def test_two_electrodes_of_a_lead_and_two_places_of_its_shaft_are_no_catheter(monkeypatch, odds, gaps, accepted):
    """Nor is a long row between other electrodes."""
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, np.arange(24) * 66.7)
    beat = 10.0 * np.sin(np.arange(24))[:, None, None] * np.array([0.0, 1.0])
    for sections in (1, 2):
        shown = (*odds[:2], *(4 * sections - 4) * (2.5,), *odds[2:])
        row = np.stack([100.0 + 20.0 * np.arange(len(shown)), np.full(len(shown), 200.0)], axis=1)
        of_section = (evidence(part, gaps=gaps) for part in 3 * np.array_split(np.array(shown), sections))
        monkeypatch.setattr(TrackMeans, "evidence_along", lambda *_, of=of_section: next(of))
        assert accepts(judge, chains(row + beat), lambda frame: None) == accepted


@pytest.mark.parametrize(("between", "odds", "accepted"), [(0.5, 1.9, True), (0.7, 1.9, False), (0.7, 2.1, True)])
def test_a_track_on_a_dark_line_is_no_catheter_but_a_loop_may_be(monkeypatch, between, odds, accepted):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])

    def along(self, frames, path_uv, log_image):
        return evidence(np.full(path_uv.shape[1], odds), gaps=between)

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    angles = np.linspace(0.0, 5.5, 10)
    loop = 200.0 + 40.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    row = np.stack([100.0 + 20.0 * np.arange(10), np.full(10, 200.0)], axis=1)
    assert accepts(judge, chains(np.repeat(row[None], FRAMES, axis=0)), lambda frame: None) == accepted
    assert accepts(judge, chains(np.repeat(loop[None], FRAMES, axis=0)), lambda frame: None)


@pytest.mark.parametrize(
    ("beyond", "tips", "accepted"),
    [
        ((0.6, 0.6), (-2.0, -4.0), False),
        ((0.6, 0.6), (0.5, 0.5), False),
        ((0.1, 0.6), (-2.0, -4.0), True),
        ((0.6, 0.1), (-2.0, -4.0), True),
        ((0.6, 0.6), (0.3, -2.0), True),
        ((0.6, 0.6), (-2.0, 0.3), True),
    ],
)
def test_a_track_on_a_line_that_goes_on_beyond_both_ends_is_no_catheter_unless_it_is_circular_or_has_a_tip(
    monkeypatch, beyond, tips, accepted
):
    seen = evidence(np.full(5, 3.0), beyond=beyond, tips=tips)
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda self, frames, path_uv, log_image: seen)
    weights, none = read_weights(Path(SHIPPED)), frozenset()
    row = np.stack([100.0 + 20.0 * np.arange(5), np.full(5, 200.0)], axis=1)
    track = chains(np.repeat(row[None], FRAMES, axis=0))
    for circular, expected in ((none, accepted), (frozenset({"reference"}), True)):
        judge = TrackEvidence(weights, PX_PER_MM, TIMES_MS[:FRAMES], none, circular)
        assert accepts(judge, track, lambda frame: None) == expected


@pytest.mark.parametrize(
    ("blank", "doubt", "accepted"), [([1, 2], -1.5, False), ([1], -1.5, True), ([1, 2], -0.5, True), ([], -1.5, True)]
)
def test_two_places_where_nothing_shows_are_no_electrodes_whatever_the_mean_of_all_frames_says(
    monkeypatch, blank, doubt, accepted
):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[: 2 * FRAMES])

    def along(self, frames, path_uv, log_image):
        seen = evidence(np.full(4, 1.5))
        if np.ptp(frames) < FRAMES:
            seen.log_odds[[1, 2]] = doubt
        seen.depths[2 * np.array(blank, np.int64), 0] = 0.1
        return seen

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(2 * FRAMES))[:, None, None] * np.array([0.0, 1.0])
    assert accepts(judge, chains(row + beat), lambda frame: None) == accepted


def test_a_short_chain_that_turns_back_is_no_loop(monkeypatch):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[:FRAMES])
    dark = evidence(np.full(4, 0.4), gaps=0.9)
    monkeypatch.setattr(TrackMeans, "evidence_along", lambda self, frames, path_uv, log_image: dark)
    turned = np.array([[100.0, 200.0], [110.0, 205.0], [112.0, 213.0], [102.0, 208.0]])
    assert not accepts(judge, chains(np.repeat(turned[None], FRAMES, axis=0)), lambda frame: None)


@pytest.mark.parametrize(("odds", "onwards"), [((3.0, 3.0), 2), ((1.8, 3.0), 2), ((0.9, 3.0), 0), ((2.5, 0.9), 1)])
def test_electrodes_in_the_line_of_a_track_are_those_as_probable_as_its_own(monkeypatch, odds, onwards):
    judge = TrackEvidence(read_weights(Path(SHIPPED)), PX_PER_MM, TIMES_MS[: 2 * FRAMES])
    own = np.array([2.0, 2.2, 2.4, 2.2])
    row = np.stack([100.0 + 20.0 * np.arange(4), np.full(4, 200.0)], axis=1)
    beat = 10.0 * np.sin(np.arange(2 * FRAMES))[:, None, None] * np.array([0.0, 1.0])
    track = chains(row + beat)

    def along(self, frames, path_uv, log_image):
        middle = path_uv[len(frames) // 2]
        pair = middle[-1] + np.array([[20.0, 0.0], [40.0, 0.0]])
        return replace(evidence(own), near_uv=np.concatenate([middle, pair]), near_odds=np.concatenate([own, odds]))

    monkeypatch.setattr(TrackMeans, "evidence_along", along)
    verdict = judge(track, lambda frame: None)
    assert verdict.is_catheter
    for before, behind in verdict.onwards:
        last = track[behind.frame].pixels_uv[-1]
        assert len(before.points_uv) == 0
        assert np.allclose(behind.points_uv, last + np.array([[20.0, 0.0], [40.0, 0.0]])[:onwards])
    assert len(verdict.onwards) == 2
