"""Other scales of a run in which catheters lack: one counts where it shows others."""

from collections.abc import Sequence

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.runs.hypotheses.other_scales import useful_scales

TYPES = {"a": "quadripolar-2-5-2", "b": "quadripolar-5-5-5", "c": "hexapolar-2-5-2"}
CATALOGUE = Catalogue(tuple(catheter_type(type_, name) for name, type_ in TYPES.items()), "a", "b")
EXTRA = Reason.EXTRA_CATHETER


def chain(name: str, v: float, px_per_mm: float, seen: float = 1.0, probable: float = 0.8) -> Chain:
    along = CATALOGUE[name].arc_lengths_mm * px_per_mm * seen
    count = len(along)
    points = np.stack([along, np.full(count, v)], axis=1)
    numbers = tuple(range(1, count + 1))
    return Chain(numbers, points, np.tile(np.eye(2), (count, 1, 1)), np.full(count, probable), ((name, 1.0),))


def showing(*chains: Chain, reason: Reason | None = None) -> Segmentation:
    numbered = tuple(shown.on_track(number) for number, shown in enumerate(chains))
    frames = tuple(FrameChains(frame, numbered) for frame in range(3))
    return Segmentation(frames, FrameChains(0, numbered, reason), (0,), np.zeros(3), np.arange(3.0), ())


def useful(by_scale: dict[float, Segmentation], asked: list[float] | None = None) -> list[float]:
    asked = [] if asked is None else asked

    def segment(px_per_mm: float) -> Segmentation:
        return by_scale[round(px_per_mm, 2)]

    def promising(scales: Sequence[float], least: float) -> Sequence[float]:
        asked.append(least)
        return [scale for scale in scales if round(scale, 2) in by_scale]

    return [round(scale, 2) for scale in useful_scales(3.0, CATALOGUE, segment, promising).px_per_mm]


def test_no_other_scale_is_tried_where_the_stated_one_shows_all():
    assert useful({3.0: showing(chain("a", 10.0, 3.0), chain("b", 90.0, 3.0), chain("c", 150.0, 3.0))}) == [3.0]


@pytest.mark.parametrize(
    ("probable", "reason", "scales"), [(0.99, None, [3.54]), (0.82, None, [3.0]), (0.99, EXTRA, [3.0])]
)
def test_another_scale_explains_what_the_stated_one_calls_an_unlisted_catheter(probable, reason, scales):
    """At 0.8 of the scale some electrodes were displaced and three catheters had wrong names."""
    places = {"a": 10.0, "b": 90.0, "c": 150.0}
    stated = showing(*(chain(name, v, 3.0) for name, v in places.items()), reason=EXTRA)
    other = showing(*(chain(name, v, 3.54, probable=probable) for name, v in places.items()), reason=reason)
    asked: list[float] = []
    assert useful({3.0: stated, 3.54: other}, asked) == scales
    # All are there, so a scale is tried only if a few frames show that it explains more.
    assert asked == [1.05]


def test_two_catheters_are_not_enough_where_the_stated_scale_shows_an_unlisted_one():
    stated = showing(chain("a", 10.0, 3.0), reason=EXTRA)
    two = showing(chain("a", 10.0, 3.0), chain("b", 90.0, 2.55))
    three = showing(chain("a", 10.0, 3.0), chain("b", 90.0, 2.55), chain("c", 150.0, 2.55))
    assert useful({3.0: stated, 3.54: stated, 2.55: two}) == [3.0]
    assert useful({3.0: stated, 3.54: stated, 2.55: three}) == [3.0, 2.55]


def test_six_more_electrodes_are_enough_where_the_stated_scale_shows_an_unlisted_catheter():
    """A hexapolar catheter that does not fit the stated scale is reported as unlisted there."""
    stated = showing(chain("a", 10.0, 3.0), reason=EXTRA)
    six_more = showing(chain("a", 10.0, 3.0), chain("c", 90.0, 2.55))
    assert useful({3.0: stated, 3.54: stated, 2.55: six_more}) == [3.0, 2.55]


@pytest.mark.parametrize("scale", [3.54, 4.17, 2.55])
@pytest.mark.parametrize("seen", [0.95, 0.5])
def test_another_scale_counts_where_it_shows_more(scale, seen):
    """Some of the labelled real frames, mirrored or with more noise, show the third catheter only at a larger scale."""
    few, more = showing(chain("a", 10.0, 3.0)), showing(chain("a", 10.0, 3.0), chain("b", 90.0, scale, seen))
    assert useful({3.0: few, 3.54: few, 2.55: few} | {scale: more}) == [3.0, scale]


def test_a_scale_that_loses_one_catheter_may_show_another():
    """In changed copies of the labelled real frames the third catheter appears only where another one is displaced."""
    stated, other = showing(chain("a", 10.0, 3.0)), showing(chain("b", 90.0, 2.55))
    assert useful({3.0: stated, 3.54: stated, 2.55: other}) == [3.0, 2.55]


def test_each_scale_may_show_another_catheter():
    larger, smaller = showing(chain("b", 90.0, 3.54)), showing(chain("c", 150.0, 2.55))
    assert useful({3.0: showing(chain("a", 10.0, 3.0)), 3.54: larger, 2.55: smaller}) == [3.0, 3.54, 2.55]


@pytest.mark.parametrize(("probable", "scales"), [(0.82, [3.0, 3.54]), (0.99, [3.54, 3.0])])
def test_a_wrong_scale_adds_to_one_at_which_all_is_clearly_more_probable(probable, scales):
    """The labelled real frames have 3.1 px/mm: at 2.4 all catheters are found, but some are displaced and named wrongly."""
    other = showing(chain("a", 10.0, 3.54, probable=probable), chain("b", 90.0, 3.54, probable=probable))
    stated = showing(chain("a", 10.0, 3.0), chain("c", 150.0, 3.0))
    assert useful({3.0: stated, 3.54: other, 2.55: showing()}) == scales


def test_another_scale_does_not_count_for_what_the_stated_one_shows():
    clearer = showing(chain("a", 10.0, 3.54, probable=0.99))
    assert useful({3.0: showing(chain("a", 10.0, 3.0)), 3.54: clearer, 2.55: showing()}) == [3.0]


@pytest.mark.parametrize(("shown", "scales"), [(1, [3.0]), (2, [2.55])])
def test_one_catheter_is_not_enough_where_the_stated_scale_shows_none(shown, scales):
    both = chain("a", 10.0, 2.55), chain("b", 90.0, 2.55)
    assert useful({3.0: showing(), 3.54: showing(), 2.55: showing(*both[:shown])}) == scales
