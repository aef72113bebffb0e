from dataclasses import replace

import numpy as np
import pytest

from fluoromap.contracts import Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.judge.acceptance import UNSEEN
from fluoromap.segmenter.judge.features.unexplained_rows import Onwards
from fluoromap.segmenter.judge.verdict import Verdict
from fluoromap.segmenter.tracks.tracking import track_chains

POINTS = np.array([[0.0, 0], [20, 0], [50, 5], [70, 10]])


def chain(points, name="reference", scores=None, **more):
    n = len(points)
    likely = np.ones(n) if scores is None else scores
    return Chain(tuple(range(1, n + 1)), points, np.tile(np.eye(2), (n, 1, 1)), likely, ((name, 1.0),), **more)


def run(chains_of_frame, unsure=()):
    return [
        FrameChains(frame, tuple(chains), Reason.MANUAL_NEEDED if frame in unsure or not chains else None)
        for frame, chains in enumerate(chains_of_frame)
    ]


def two_beating(frame):
    shift = np.array([15 * np.sin(frame / 5), 10 * np.sin(frame / 5)])
    return [chain(POINTS + 100 + shift), chain(POINTS[:, ::-1] + 180 - shift)]


def times(count):
    return np.arange(count) * 16.7


def test_two_beating_catheters_keep_their_numbers_through_a_gap():
    found = []
    for frame in range(40):
        chains = two_beating(frame)
        if frame in range(12, 16):
            chains = chains[1:]
        found.append(chains[::-1] if frame % 2 else chains)
    entries = track_chains(run(found), times(40), 3)
    seen = {(float(np.ptp(one.pixels_uv[:, 0])) > 50, one.track) for entry in entries for one in entry.chains}
    assert len(seen) == 2
    assert [entry.manual_needed for entry in entries[11:17]] == [None, *[Reason.TRACK_INTERRUPTED] * 4, None]


def test_a_missing_catheter_is_carried_from_where_it_was():
    asked = []

    def search(frame, known, shift, reach_px, taken, confirmed=False):
        asked.append(frame)
        assert len(taken) == 1
        expected = two_beating(frame)[0]
        assert np.linalg.norm(known.pixels_uv + shift - expected.pixels_uv, axis=1).max() <= reach_px
        return expected if frame != 13 else None

    found = [two_beating(frame)[1 if frame in range(12, 16) else 0 :] for frame in range(40)]
    entries = track_chains(run(found), times(40), 3, search)
    assert sorted(asked) == [12, 13, 14, 15]
    assert [len(entry.chains) for entry in entries[11:17]] == [2, 2, 1, 2, 2, 2]


def test_sure_frames_decide_where_the_tip_of_a_track_is():
    odds = [2.0 if frame < 4 else 0.1 for frame in range(9)]
    found = run([[chain(POINTS if frame < 4 else POINTS[::-1], tip_odds=odds[frame])] for frame in range(9)])
    for entry in track_chains(found, times(9), 1):
        np.testing.assert_allclose(entry.chains[0].pixels_uv, POINTS)


def test_a_seed_with_its_tip_at_the_other_end_is_turned_before_frames_are_searched_with_it():
    searched = []

    def search(frame, known, shift, reach_px, taken, same_shape=False, confirmed=False):
        searched.append(known.pixels_uv)

    found = run([[chain(POINTS, tip_odds=1.0)] if frame != 5 else [] for frame in range(9)])
    seed = FrameChains(4, (chain(POINTS[::-1], tip_odds=0.2),))
    for entry in track_chains(found, times(9), 1, search, seed, says(lambda chains: True)):
        assert all(np.array_equal(each.pixels_uv, POINTS) for each in entry.chains)
    # The frame without a chain, and none in which a chain had to be turned and fitted again.
    assert searched
    assert all(np.array_equal(points, POINTS) for points in searched)


def test_another_kind_is_another_track():
    entries = track_chains(run([[chain(POINTS)], [chain(POINTS + 1, "mapping")]]), times(2), 3)
    assert entries[0].chains[0].track != entries[1].chains[0].track


def test_what_is_not_sure_continues_a_track_but_begins_none():
    found = [two_beating(frame) for frame in range(10)]
    entries = track_chains(run(found, unsure=range(4, 10)), times(10), 3)
    assert all(len(entry.chains) == 2 for entry in entries)
    nothing = track_chains(run(found, unsure=range(10)), times(10), 3)
    assert all(entry.chains == () and entry.manual_needed == Reason.MANUAL_NEEDED for entry in nothing)


def test_a_track_of_single_frames_is_dropped():
    found = [two_beating(frame) for frame in range(30)]
    found[7].append(chain(POINTS + np.array([250, 30])))
    assert all(len(entry.chains) == 2 for entry in track_chains(run(found), times(30), 3))


def test_tracks_start_from_a_mark():
    found = [two_beating(frame)[:1] for frame in range(12)]
    found[5] = [chain(POINTS[:, ::-1] + 180, "mapping", manual=True)]
    entries = track_chains(run(found), times(12), 3)
    assert entries[5].chains[0].manual
    assert entries[5].chains[0].track != entries[6].chains[0].track


def test_never_more_chains_than_catheters():
    found = [[*two_beating(frame), chain(POINTS + np.array([250, 30]))] for frame in range(10)]
    assert all(len(entry.chains) == 2 for entry in track_chains(run(found), times(10), 2))


def test_an_empty_run():
    assert track_chains([], np.zeros(0), 3) == ()


def test_a_rejected_track_leaves_its_place_to_the_catheter_that_it_kept_out():
    right, false = chain(POINTS + 100), chain(POINTS[:, ::-1] + 300)

    def search(frame, known, shift, reach_px, taken, confirmed=False):
        return None if any(np.allclose(known.pixels_uv, other.pixels_uv) for other in taken) else known

    found = run([[false] if frame < 8 else [right] for frame in range(20)])
    assert len({one.track for entry in track_chains(found, times(20), 1, search) for one in entry.chains}) <= 2
    entries = track_chains(
        found, times(20), 1, search, judge=says(lambda chains: chains[max(chains)].pixels_uv[0, 0] < 200)
    )
    assert all(np.allclose(entry.chains[0].pixels_uv, right.pixels_uv) for entry in entries)


def test_an_accepted_track_is_there_in_most_frames():
    found = run([[chain(POINTS + 100)] if frame < 8 else [] for frame in range(20)])
    assert track_chains(found, times(20), 1)[0].chains
    assert not track_chains(found, times(20), 1, judge=says(lambda chains: True))[0].chains


def test_a_part_of_a_longer_catheter_does_not_keep_it_out():
    long = np.stack([np.arange(10) * 12.0, np.arange(10) * 3.0], axis=1) + 60
    found = run([[chain(long + frame, "cs")] for frame in range(6)])
    # The mean of the frames shows four of its electrodes only, and they are found again in every frame.
    seed = FrameChains(2, (chain(long[3:7] + 2, "rv"),))

    def search(frame, known, shift, reach_px, taken, confirmed=False):
        return chain(long[3:7] + frame, "rv") if len(known.electrodes) == 4 else chain(long + frame, "cs")

    entries = track_chains(found, np.arange(6) * 100.0, 2, search, seed)
    assert [[len(one.electrodes) for one in entry.chains] for entry in entries] == [[10]] * 6


def test_a_mark_keeps_its_name_in_a_track():
    kinds = [(("cs", 0.9), ("rv", 0.1)), (("cs", 0.3), ("rv", 0.7)), (("cs", 0.9), ("rv", 0.1)), (("cs", 1.0),)]
    found = run([[replace(chain(POINTS + frame), kinds=said)] for frame, said in enumerate(kinds)])
    by_hand = FrameChains(1, (chain(POINTS + 1, "rv", manual=True),))
    entries = track_chains([found[0], by_hand, *found[2:]], times(4), 1)
    assert [one.probability("rv") for one in entries[1].chains] == [1.0]


@pytest.mark.parametrize(("frame_ms", "tracks"), [(16.7, 2), (80.0, 1)])
def test_a_catheter_may_bend_farther_between_frames_that_lie_farther_apart(frame_ms, tracks):
    bent = POINTS + np.array([[0.0, 14.0], [0, 0], [0, 0], [0, 0]])
    entries = track_chains(run([[chain(POINTS + 100)]] * 3 + [[chain(bent + 100)]] * 3), np.arange(6) * frame_ms, 2)
    assert len({one.track for entry in entries for one in entry.chains}) == tracks


def test_misplaced_electrodes_of_a_long_catheter_do_not_interrupt_its_track():
    row = np.stack([np.arange(10) * 12.0, np.arange(10) * 3.0], axis=1) + 60
    places = [row + frame for frame in range(6)]
    for frame, electrode in ((2, 7), (3, 8), (4, 7)):
        places[frame][electrode] += 10.0
    entries = track_chains(run([[chain(points, "cs")] for points in places]), np.arange(6) * 60.0, 1)
    assert [[one.track for one in entry.chains] for entry in entries] == [[0]] * 6
    for points in places[2:5]:
        points[:4] += 24.0
    entries = track_chains(run([[chain(points, "cs")] for points in places]), np.arange(6) * 60.0, 1)
    assert len({one.track for entry in entries for one in entry.chains}) > 1


def test_a_chain_a_pair_too_far_along_its_catheter_does_not_keep_it_out():
    row = np.stack([np.arange(12) * 12.0, np.arange(12) * 3.0], axis=1) + 60
    found = run([[chain(row[:10] + frame, "cs")] for frame in range(6)])
    seed = FrameChains(2, (chain(row[2:] + 2, "cs"),))

    def search(frame, known, shift, reach_px, taken, confirmed=False):
        return chain(row[2:] + frame, "cs")

    entries = track_chains(found, times(6), 1, search, seed)
    for entry in entries:
        np.testing.assert_allclose(entry.chains[0].pixels_uv, row[:10] + entry.frame)


@pytest.mark.parametrize("bent_px", [0.0, -8.0])
@pytest.mark.parametrize(("clearness", "shown_px"), [(0.5, 0.0), (0.9, 3.0)])
def test_a_clear_chain_stays_where_the_search_finds_the_wrong_shape_of_the_frame_before(bent_px, clearness, shown_px):
    """What a search found replaces the frame's own chain only where it is about as clear."""
    row = np.stack([np.arange(10) * 14.0, np.zeros(10)], axis=1)
    at_end = np.where(np.arange(10)[:, None] >= 7, [0.0, 1.0], 0.0)

    def search(frame, known, shift, reach_px, taken, same_shape=False, confirmed=False):
        if same_shape or frame == 3:
            return None
        return chain(row + 8.0 * at_end + [0.0, 3.0], scores=np.full(10, clearness))

    displaced_px = [0.0, 0.0, 0.0, 8.0, bent_px, 0.0, 0.0, 0.0]
    found = run([[chain(row + displaced * at_end)] for displaced in displaced_px])
    after = track_chains(found, times(8), 1, search)[4]
    assert after.chains[0].pixels_uv[0].tolist() == [0.0, shown_px]


def test_a_clear_chain_farther_away_than_the_track_moves_is_not_taken():
    """It has two of the searched electrodes, and two of another catheter."""

    def search(frame, known, shift, reach_px, taken, same_shape=False, confirmed=False):
        return None if same_shape else chain(POINTS, scores=np.full(4, 0.3))

    wrong = POINTS + np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 50.0], [0.0, 70.0]])
    found = run([[chain(wrong if frame == 4 else POINTS)] for frame in range(8)])
    assert np.array_equal(track_chains(found, times(8), 1, search)[4].chains[0].pixels_uv, POINTS)


def test_the_tip_end_of_a_longer_catheter_does_not_keep_it_out():
    long = np.stack([np.arange(6) * 12.0, np.arange(6) * 3.0], axis=1) + 60
    found = run([[chain(long + frame, "cs")] for frame in range(6)])
    seed = FrameChains(2, (chain(long[:4] + 2, "rv"),))

    def search(frame, known, shift, reach_px, taken, confirmed=False):
        return chain(long[:4] + frame, "rv") if len(known.electrodes) == 4 else chain(long + frame, "cs")

    entries = track_chains(found, np.arange(6) * 100.0, 2, search, seed)
    assert [[len(one.electrodes) for one in entry.chains] for entry in entries] == [[6]] * 6


def test_a_short_catheter_stays_where_one_frame_shows_a_longer_one_at_its_place():
    long = np.stack([np.arange(10) * 12.0, np.arange(10) * 3.0], axis=1) + 60
    found = run([[chain(long, "cs")] if frame == 3 else [chain(long[3:7], "rv")] for frame in range(6)])
    entries = track_chains(found, np.arange(6) * 100.0, 2, lambda *asked, confirmed=False: asked[1])
    assert all(len(entry.chains[0].electrodes) == 4 for entry in entries)


def says(is_there):
    """Return the judge that is sure of a catheter where ``is_there`` says so."""
    return lambda chains: Verdict(is_there(chains))


def only_confirmed(frame, known, shift, reach_px, taken, confirmed=False):
    return known if confirmed else None


@pytest.mark.parametrize("frame_ms", [16.7, 66.7, 133.3])
def test_an_accepted_track_is_searched_by_contrast_in_the_frames_that_lack_it(frame_ms):
    right, at_ms = chain(POINTS + 100), np.arange(12) * frame_ms
    found = run([[right] if frame not in (0, 5, 6) else [] for frame in range(12)])
    entries = track_chains(found, at_ms, 1, only_confirmed, judge=says(lambda chains: True))
    assert all(np.allclose(entry.chains[0].pixels_uv, right.pixels_uv) for entry in entries)
    entries = track_chains(found, at_ms, 1, only_confirmed)
    assert [entry.frame for entry in entries if not entry.chains] == [0, 5, 6]


def test_a_catheter_of_moved_means_is_followed_where_no_frame_shows_it_and_a_false_track_has_its_place():
    right, false = chain(POINTS + 100), chain(POINTS[:, ::-1] + 300)
    found = run([[false]] * 8)
    seed = FrameChains(3, (right,))

    def accepts(chains):
        return chains[min(chains)].pixels_uv[0, 0] < 200

    entries = track_chains(found, times(8), 1, only_confirmed, seed, says(accepts), marks_first=False)
    assert all(np.allclose(entry.chains[0].pixels_uv, right.pixels_uv) for entry in entries)
    assert not any(entry.chains for entry in track_chains(found, times(8), 1, only_confirmed, seed, says(accepts)))


@pytest.mark.parametrize(("displaced", "kept"), [(3, True), (6, False)])
def test_a_few_displaced_chains_do_not_outvote_a_catheter_of_moved_means(displaced, kept):
    row = np.stack([np.arange(12) * 12.0, np.arange(12) * 3.0], axis=1) + 60
    found = run([[chain(row[2:], "cs")] if frame < displaced else [] for frame in range(16)])
    seed = FrameChains(10, (chain(row[:10], "cs"),))
    entries = track_chains(found, times(16), 1, only_confirmed, seed, says(lambda chains: True), marks_first=False)
    assert [np.allclose(one.pixels_uv, row[:10]) for entry in entries for one in entry.chains].count(True) == 16 * kept


def test_a_long_catheter_that_few_frames_show_replaces_its_parts():
    long = np.stack([np.arange(10) * 12.0, np.arange(10) * 3.0], axis=1) + 60
    whole, part = chain(long, "cs"), chain(long[3:7], "rv")
    found = run([[whole] if frame < 5 else [part] for frame in range(16)])
    accepted = {10}

    def accepts(chains):
        return len(chains[min(chains)].electrodes) in accepted

    def tracked():
        entries = track_chains(found, times(16), 2, only_confirmed, FrameChains(0, (whole,)), says(accepts))
        return [[len(one.electrodes) for one in entry.chains] for entry in entries]

    assert tracked() == [[10]] * 16
    accepted.add(4)
    assert tracked() == [[10]] * 16

    # Not where the judge doubts it in the frames that were added.
    def doubts(chains):
        return len(chains) < 15 or len(chains[min(chains)].electrodes) == 4

    entries = track_chains(found, times(16), 2, only_confirmed, FrameChains(0, (whole,)), says(doubts))
    assert [len(one.electrodes) for one in entries[-1].chains] == [4]


@pytest.mark.parametrize(("seen", "kept"), [(12, True), (8, False)])
def test_a_track_that_many_frames_are_added_to_is_judged_again(seen, kept):
    found = run([[chain(POINTS + 100)] if frame < seen else [] for frame in range(14)])
    entries = track_chains(found, times(14), 1, only_confirmed, judge=says(lambda chains: len(chains) < 14))
    assert [bool(entry.chains) for entry in entries] == [kept] * 14


def test_parts_do_not_take_the_frames_of_a_long_catheter_where_the_run_is_followed_again():
    long = np.stack([np.arange(10) * 12.0, np.arange(10) * 3.0], axis=1) + 60
    whole, part, other = chain(long, "cs"), chain(long[3:7], "rv"), chain(POINTS + 250, "map")
    false = chain(POINTS[:, ::-1] + 400, "map")
    found = run([[whole, false] if frame < 5 else [part, other, false] for frame in range(16)])

    def search(frame, known, shift, reach_px, taken, confirmed=False):
        return known if confirmed or len(known.electrodes) == 4 else None

    def accepts(chains):
        return chains[min(chains)].pixels_uv[0, 0] < 390

    entries = track_chains(found, times(16), 3, search, FrameChains(0, (whole, false)), says(accepts))
    assert [sorted(len(one.electrodes) for one in entry.chains) for entry in entries] == [[4, 10]] * 16


def test_a_short_catheter_that_few_frames_show_may_be_anatomy():
    found = run([[chain(POINTS + 100)] if frame < 5 else [] for frame in range(16)])
    assert not any(
        entry.chains for entry in track_chains(found, times(16), 1, only_confirmed, None, says(lambda chains: True))
    )


@pytest.mark.parametrize(
    ("name", "believed", "kept"), [("map", True, True), ("map", False, False), ("reference", True, False)]
)
def test_a_short_catheter_that_few_frames_show_is_believed_beside_another_one(name, believed, kept):
    """Not where the judge doubts it, nor where the study has no catheter left for it."""
    other, rare = chain(POINTS + 100), chain(POINTS + 250, name)
    found = run([[other, rare] if frame in (3, 4, 5, 6) else [other] for frame in range(16)])

    def accepts(chains):
        return believed or chains[min(chains)].pixels_uv[0, 0] < 200

    entries = track_chains(found, times(16), 2, only_confirmed, None, says(accepts))
    assert [len(entry.chains) for entry in entries] == [1 + kept] * 16


def test_a_faint_catheter_is_accepted_only_beside_a_clear_one():
    clear, faint = chain(POINTS + 100, "map"), chain(POINTS + 250, "rv")

    def tracked(found, clear_odds=0.5):
        def judge(chains):
            is_faint = chains[min(chains)].pixels_uv[0, 0] > 200
            return Verdict(False, -1.0, may_be_hidden=True) if is_faint else Verdict(True, clear_odds)

        entries = track_chains(run(found), times(10), 2, only_confirmed, judge=judge)
        return [len(entry.chains) for entry in entries]

    assert tracked([[clear, faint]] * 10) == [2] * 10
    # Noise that hides one catheter hides all.
    assert tracked([[clear, faint]] * 10, clear_odds=3.0) == [1] * 10
    assert tracked([[faint]] * 10) == [0] * 10
    # A catheter that is there for a moment does not vouch for another one.
    assert tracked([[clear, faint]] * 4 + [[faint]] * 6) == [0] * 10


def test_an_unclear_catheter_is_accepted_only_beside_a_clear_one():
    """A contrast-filled coronary tree looked like two unclear catheters in each frame."""
    clear, unclear = chain(POINTS + 100, "map"), chain(POINTS + 250, "rv")

    def judge(chains):
        return Verdict(True, 0.5, is_clear=chains[min(chains)].pixels_uv[0, 0] < 200)

    def tracked(found, search=only_confirmed):
        entries = track_chains(run(found), times(10), 2, search, judge=judge)
        return [(len(entry.chains), entry.manual_needed) for entry in entries]

    assert tracked([[clear, unclear]] * 10) == [(2, None)] * 10
    assert tracked([[unclear, chain(POINTS + np.array([400, 250]), "cs")]] * 10) == [(0, Reason.MANUAL_NEEDED)] * 10
    # A chain that was set by hand is clear.
    assert tracked([[unclear, chain(POINTS + 100, "map", manual=True)]] * 10) == [(2, None)] * 10
    # One that is there for a moment is none, unless the search finds it again in the other frames.
    for_a_moment = [[clear, unclear]] * 4 + [[unclear]] * 6
    assert tracked(for_a_moment, search=None) == [(0, Reason.MANUAL_NEEDED)] * 10
    assert tracked(for_a_moment) == [(2, None)] * 10


@pytest.mark.parametrize(("electrodes", "odds", "kept"), [(6, 0.5, 2), (6, 0.7, 3), (6, 1.5, 3), (4, 0.0, 3)])
def test_a_long_row_that_is_far_less_clear_than_two_other_catheters_is_none(electrodes, odds, kept):
    row = chain(np.stack([np.arange(electrodes) * 12.0, np.arange(electrodes) * 3.0], axis=1) + 250, "cs")
    clear = [chain(POINTS + 100, "map"), chain(POINTS + np.array([400, 100]), "rv")]

    def judge(chains):
        return Verdict(True, odds if np.allclose(chains[min(chains)].pixels_uv[0], row.pixels_uv[0]) else 3.0)

    def tracked(found):
        return [len(entry.chains) for entry in track_chains(run(found), times(10), 3, only_confirmed, judge=judge)]

    assert tracked([[*clear, row]] * 10) == [kept] * 10
    assert tracked([[clear[0], row]] * 10) == [2] * 10


@pytest.mark.parametrize(("pictures", "explained", "kept"), [(2, False, 0), (1, False, 1), (0, False, 1), (2, True, 2)])
def test_a_part_of_a_catheter_that_the_catalogue_does_not_list_is_no_other_catheter(pictures, explained, kept):
    row, pair = chain(POINTS + 100, "map"), chain(np.array([[90.0, 14.0], [110.0, 18.0]]) + 100, "lead")
    shown = [row, pair] if explained else [row]

    def judge(chains):
        if len(next(iter(chains.values())).electrodes) == 2:
            return Verdict(True, 2.0)
        ends = (
            tuple(
                Onwards(frame, pair.pixels_uv if index < pictures else np.zeros((0, 2)), np.ones(2, np.bool_), 4.0)
                for _ in range(2)
            )
            for index, frame in enumerate((2, 6))
        )
        return Verdict(True, 2.0, onwards=tuple(ends))

    entries = track_chains(run([shown] * 8), times(8), 2, only_confirmed, judge=judge)
    assert [len(entry.chains) for entry in entries] == [kept] * 8


@pytest.mark.parametrize(("of_frames", "of_judge", "first", "odds"), [
    (1.0, None, 0, 1.0),
    (1.0, -2.0, 1, 1.25),
    (1.0, 0.5, 0, 1.25),
    (3.0, -2.0, 0, 0.25),
    (3.0, 9.0, 0, 4.0),
])  # fmt: skip
def test_the_judge_and_the_frames_say_together_which_end_is_the_tip(of_frames, of_judge, first, odds):
    found = run([[chain(POINTS + frame, tip_odds=of_frames)] for frame in range(8)])
    entries = track_chains(found, times(8), 1, only_confirmed, judge=lambda _: Verdict(True, 2.0, tip_odds=of_judge))
    for frame, entry in enumerate(entries):
        assert entry.chains[0].pixels_uv[0].tolist() == (POINTS + frame)[-first].tolist()
        assert entry.chains[0].tip_odds == pytest.approx(odds)


@pytest.mark.parametrize("tip_odds", [3.0, -3.0])
def test_places_that_something_hides_are_unseen(tip_odds):
    row = np.stack([np.arange(6) * 12.0, np.arange(6) * 3.0], axis=1) + 100
    found = run([[chain(row + frame)] for frame in range(8)])
    hidden = (False,) * 4 + (True, True)
    entries = track_chains(
        found, times(8), 1, only_confirmed, judge=lambda _: Verdict(True, 2.0, tip_odds=tip_odds, hidden=hidden)
    )
    for frame, entry in enumerate(entries):
        (one,) = entry.chains
        unseen = one.pixels_uv[one.scores <= UNSEEN]
        assert sorted(unseen.tolist()) == (row[4:] + frame).tolist()
