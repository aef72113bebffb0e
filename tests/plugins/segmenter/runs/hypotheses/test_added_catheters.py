"""Catheters of one segmentation of a run, added to those of another: free places, free names, reasons, diastole."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.runs.hypotheses.added_catheters import add_catheters

TYPES = {"a": "quadripolar-2-5-2", "b": "quadripolar-2-5-2", "c": "hexapolar-2-5-2", "d": "quadripolar-5-5-5"}
CATALOGUE = Catalogue(tuple(catheter_type(type_, name) for name, type_ in TYPES.items()), "a", "b")
PX_PER_MM = 3.0
FRAMES = 4


def chain(names: str, u: float, v: float, track: int = 0) -> Chain:
    """Return a catheter from left to right whose names are equally probable."""
    along = CATALOGUE[names[0]].arc_lengths_mm * PX_PER_MM
    count = len(along)
    points = np.stack([u + along, np.full(count, v)], axis=1)
    kinds = tuple((name, 1.0 / len(names)) for name in names)
    return Chain(tuple(range(1, count + 1)), points, np.tile(np.eye(2), (count, 1, 1)), np.ones(count), kinds, track)


def segmented(
    *chains: Chain, in_frames: range = range(FRAMES), reason: Reason | None = None, averaged=(1, 2)
) -> Segmentation:
    frames = tuple(
        FrameChains(frame, chains if frame in in_frames else (), None if frame in in_frames else Reason.MANUAL_NEEDED)
        for frame in range(FRAMES)
    )
    times = np.arange(float(FRAMES))
    return Segmentation(
        frames, FrameChains(averaged[len(averaged) // 2], chains, reason), averaged, np.zeros(FRAMES), times
    )


def together(found: Segmentation, other: Segmentation) -> Segmentation:
    return add_catheters(found, other, CATALOGUE, PX_PER_MM)


def shown(found: Segmentation) -> list[list[float]]:
    """Return the row of each chain of each frame."""
    return [[float(one.pixels_uv[0, 1]) for one in entry.chains] for entry in found.frames]


def test_a_catheter_elsewhere_is_added_with_a_track_of_its_own():
    joined = together(segmented(chain("ab", 10.0, 10.0)), segmented(chain("ab", 10.0, 10.0), chain("c", 10.0, 90.0, 1)))
    assert shown(joined) == [[10.0, 90.0]] * FRAMES
    assert {tuple(one.track for one in entry.chains) for entry in joined.frames} == {(0, 1)}
    assert [one.track for one in joined.diastole.chains] == [0, 1]
    assert {entry.manual_needed for entry in joined.frames} == {None}


@pytest.mark.parametrize("away_px", [(0.0, 3.0), (7.0, 0.0), (-7.0, 0.0)])
def test_a_catheter_on_another_one_is_not_added(away_px):
    """A displaced copy of a catheter lies in its line, between its electrodes."""
    displaced = chain("ab", 10.0 + away_px[0], 10.0 + away_px[1])
    found = segmented(chain("ab", 10.0, 10.0))
    assert together(found, segmented(displaced)) is found


def test_a_crossing_catheter_is_added():
    crossing = chain("c", 0.0, 0.0)
    turned = crossing.pixels_uv[:, ::-1] + (20.0, -20.0)
    joined = together(segmented(chain("ab", 10.0, 10.0)), segmented(replace(crossing, pixels_uv=turned)))
    assert [len(entry.chains) for entry in joined.frames] == [2] * FRAMES


def test_a_catheter_needs_a_name_of_its_own():
    two = segmented(chain("ab", 10.0, 10.0), chain("ab", 10.0, 50.0, 1))
    assert together(two, segmented(chain("ab", 10.0, 90.0))) is two
    assert shown(together(two, segmented(chain("d", 10.0, 90.0)))) == [[10.0, 50.0, 90.0]] * FRAMES


def test_a_catheter_of_few_frames_is_not_added():
    found = segmented(chain("ab", 10.0, 10.0))
    assert together(found, segmented(chain("c", 10.0, 90.0), in_frames=range(1))) is found


def test_frames_without_an_added_catheter_say_so():
    joined = together(segmented(chain("ab", 10.0, 10.0)), segmented(chain("c", 10.0, 90.0), in_frames=range(1, FRAMES)))
    assert shown(joined) == [[10.0], *[[10.0, 90.0]] * (FRAMES - 1)]
    assert [entry.manual_needed for entry in joined.frames] == [Reason.TRACK_INTERRUPTED, None, None, None]


def test_frames_that_have_only_an_added_catheter_say_so():
    joined = together(segmented(chain("ab", 10.0, 10.0), in_frames=range(1, FRAMES)), segmented(chain("c", 10.0, 90.0)))
    assert [entry.manual_needed for entry in joined.frames] == [Reason.TRACK_INTERRUPTED, None, None, None]


def test_all_counts_where_nothing_was_found():
    other = segmented(chain("ab", 10.0, 10.0))
    assert together(segmented(), other) is other


@pytest.mark.parametrize("averaged", [(1, 2), (0, 1)])
def test_the_added_catheter_is_there_at_diastole(averaged):
    other = segmented(chain("c", 10.0, 90.0), averaged=averaged)
    joined = together(segmented(chain("ab", 10.0, 10.0)), other)
    assert joined.diastole_frames == (1, 2)
    assert [float(one.pixels_uv[0, 1]) for one in joined.diastole.chains] == [10.0, 90.0]


@pytest.mark.parametrize("of_other", [None, Reason.EXTRA_CATHETER])
def test_an_unlisted_catheter_is_one_that_neither_explains(of_other):
    found = segmented(chain("ab", 10.0, 10.0), reason=Reason.EXTRA_CATHETER)
    assert together(found, segmented(chain("c", 10.0, 90.0), reason=of_other)).diastole.manual_needed is of_other


def test_electrodes_set_by_hand_keep_their_place_and_name():
    by_hand = replace(chain("c", 10.0, 10.0), kinds=(("c", 1.0),), manual=True)
    found = segmented(by_hand)
    assert together(found, segmented(chain("c", 10.0, 90.0))) is found
    assert shown(together(found, segmented(chain("ab", 10.0, 90.0)))) == [[10.0, 90.0]] * FRAMES
