from dataclasses import replace

import numpy as np
import pytest

from fluoromap.contracts import Chain, FrameChains
from fluoromap.segmenter.tracks.track_agreement import with_common_kinds, with_common_shape, with_shape_of_track
from fluoromap.segmenter.tracks.tracking import track_chains

ROW = np.stack([np.arange(10) * 9.0, np.arange(10) * 3.0], axis=1) + 60
FRAMES = 12


def chain(points, electrodes=None, **more):
    count = len(points)
    numbers = tuple(range(1, count + 1)) if electrodes is None else electrodes
    return Chain(numbers, points, np.tile(np.eye(2), (count, 1, 1)), np.ones(count), (("cs", 1.0),), **more)


def beating(frame):
    """Return the points of a moving catheter that bends by up to 5 px."""
    phase = np.sin(frame / 2)
    return ROW + [12 * phase, 8 * phase] + np.linspace(0, 5 * phase, 10)[:, None] * [-0.3, 0.95]


def displaced(points, by=8.0):
    moved = points.copy()
    moved[9] = moved[8] + (moved[8] - moved[9]) / np.linalg.norm(moved[8] - moved[9]) * (by - 9.0)
    return moved


def search_of(truth):
    asked = []

    def search(frame, known, shift, reach_px):
        asked.append(frame)
        assert np.median(np.linalg.norm(known.pixels_uv + shift - truth(frame), axis=1)) <= reach_px
        return chain(truth(frame))

    return search, asked


def test_displaced_electrodes_are_searched_where_most_frames_show_them():
    chains = {frame: chain(displaced(beating(frame)) if frame % 3 == 1 else beating(frame)) for frame in range(FRAMES)}
    search, asked = search_of(beating)
    agreed = with_common_shape(chains, search)
    assert asked == [frame for frame in range(FRAMES) if frame % 3 == 1]
    for frame, found in agreed.items():
        np.testing.assert_allclose(found.pixels_uv, beating(frame))
    assert all(agreed[frame] is chains[frame] for frame in range(FRAMES) if frame % 3 != 1)


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_of_three_frames_two_that_agree_show_the_shape(wrong):
    chains = {frame: chain(displaced(beating(frame)) if frame == wrong else beating(frame)) for frame in range(3)}
    search, asked = search_of(beating)
    agreed = with_common_shape(chains, search)
    assert asked == [wrong]
    np.testing.assert_allclose(agreed[wrong].pixels_uv, beating(wrong))


def test_a_catheter_that_bends_is_not_searched_again():
    chains = {frame: chain(beating(frame)) for frame in range(2 * FRAMES)}
    search, asked = search_of(beating)
    assert with_common_shape(chains, search) == chains
    assert not asked


def test_a_catheter_whose_tip_bends_far_without_a_jump_is_not_searched_again():
    def bent(frame):
        return ROW + np.clip(np.arange(10) - 6, 0, None)[:, None] * [0.0, 0.55 * max(frame - 14, 0)]

    chains = {frame: chain(bent(frame)) for frame in range(2 * FRAMES)}
    # Most frames show another shape than the last ones, six pixels away.
    assert np.abs(bent(2 * FRAMES - 1) - ROW).max() > 6.0
    search, asked = search_of(bent)
    assert with_common_shape(chains, search) == chains
    assert not asked
    # The same shapes as displaced places of single frames: they come and go.
    jumping = {frame: chain(bent(23 if frame % 4 == 1 else 0)) for frame in range(2 * FRAMES)}
    search, asked = search_of(lambda frame: bent(0))
    with_common_shape(jumping, search)
    assert asked == [frame for frame in range(2 * FRAMES) if frame % 4 == 1]


def test_chains_remain_where_the_search_finds_nothing_or_another_shape():
    chains = {frame: chain(displaced(ROW) if frame == 4 else ROW) for frame in range(FRAMES)}
    for answer in (None, chain(displaced(ROW)), chain(ROW[:9])):
        agreed = with_common_shape(chains, lambda *_, answer=answer: answer)
        assert agreed[4] is chains[4]


def test_marks_and_short_tracks_keep_their_shape():
    search, asked = search_of(lambda frame: ROW)
    by_hand = {frame: chain(displaced(ROW), manual=True) if frame == 4 else chain(ROW) for frame in range(FRAMES)}
    short = {frame: chain(displaced(ROW) if frame == 1 else ROW) for frame in range(2)}
    for chains in (by_hand, short):
        assert with_common_shape(chains, search) == chains
    assert not asked


def test_chains_that_lack_electrodes_are_compared_by_the_others():
    chains = {frame: chain(ROW) for frame in range(FRAMES)}
    chains[2] = chain(ROW[[0, 1, 2, 3, 4, 5, 6, 7, 9]], (1, 2, 3, 4, 5, 6, 7, 8, 10))
    chains[3] = chain(ROW[:2], (1, 2))
    chains[5] = chain(displaced(ROW)[1:], tuple(range(2, 11)))
    search, asked = search_of(lambda frame: ROW)
    agreed = with_common_shape(chains, search)
    assert asked == [5]
    np.testing.assert_allclose(agreed[5].pixels_uv, ROW)


def test_a_long_track_is_compared_with_some_of_its_frames():
    chains = {frame: chain(displaced(ROW) if frame % 50 == 7 else ROW) for frame in range(400)}
    search, asked = search_of(lambda frame: ROW)
    with_common_shape(chains, search)
    assert asked == list(range(7, 400, 50))


def test_the_frames_of_a_track_agree_on_its_name():
    kinds = [(("cs", 0.9), ("rv", 0.1)), (("cs", 0.3), ("rv", 0.7)), (("cs", 0.9), ("rv", 0.1)), (("cs", 1.0),)]
    agreed = with_common_kinds({frame: replace(chain(ROW), kinds=said) for frame, said in enumerate(kinds)}, track=2)
    assert {found.track for found in agreed.values()} == {2}
    assert [found.probability("cs") for found in agreed.values()] == pytest.approx([0.775] * 4)


def test_tracking_searches_displaced_electrodes_beside_the_other_chains():
    other = chain(ROW[:, ::-1] + 150)
    places = [displaced(beating(frame)) if frame in (3, 4) else beating(frame) for frame in range(FRAMES)]
    found = [FrameChains(frame, (chain(points), other), None) for frame, points in enumerate(places)]
    taken_there = []

    def search(frame, known, shift, reach_px, taken, same_shape=False):
        assert same_shape
        taken_there.append((frame, len(taken)))
        return chain(beating(frame))

    entries = track_chains(found, np.arange(FRAMES) * 60.0, 2, search)
    assert taken_there == [(3, 1), (4, 1)]
    for entry in entries:
        (followed,) = (one for one in entry.chains if one.pixels_uv[0, 0] < 130)
        np.testing.assert_allclose(followed.pixels_uv, beating(entry.frame))


def test_a_mean_is_searched_again_where_its_track_shows_another_shape():
    track = {frame: chain(beating(frame)) for frame in range(FRAMES)}
    search, asked = search_of(beating)
    wrong = chain(displaced(beating(4)))
    found = with_shape_of_track(wrong, 4, track, lambda *known: search(4, *known))
    np.testing.assert_allclose(found.pixels_uv, beating(4))
    assert asked == [4]
    right = chain(beating(4) + 0.2)
    assert with_shape_of_track(right, 4, track, lambda *known: search(4, *known)) is right
    assert asked == [4]


def test_displaced_frames_of_a_track_do_not_change_its_mean():
    track = {frame: chain(displaced(beating(frame)) if frame == 7 else beating(frame)) for frame in range(FRAMES)}
    search, asked = search_of(beating)
    right = chain(beating(4))
    assert with_shape_of_track(right, 4, track, lambda *known: search(4, *known)) is right
    assert not asked


def test_a_mean_without_a_track_remains():
    wrong = chain(displaced(beating(4)))
    assert with_shape_of_track(wrong, 4, {}, lambda *_: None) is wrong
