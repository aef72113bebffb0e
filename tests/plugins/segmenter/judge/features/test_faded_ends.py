"""Ends of chains at which no electrodes are."""

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.segmenter.chains.families import catheter_families
from fluoromap.segmenter.chains.linking import PossibleChains
from fluoromap.segmenter.judge.features.faded_ends import count_faded, without_shorter_catheters

CLEAR, NOTHING = (20.0, 2.0), (2.0, -2.0)


def chain_of(*electrodes):
    contrast, odds = np.array(electrodes).T
    return contrast[None], odds[None]


@pytest.mark.parametrize(("first", "last"), [(0, 0), (2, 0), (0, 3), (2, 2)])
def test_places_without_an_electrode_are_counted_at_both_ends(first, last):
    places = [NOTHING] * first + [CLEAR] * (10 - first - last) + [NOTHING] * last
    assert count_faded(*chain_of(*places)) == [first + last]


@pytest.mark.parametrize(
    "end",
    [
        pytest.param([CLEAR, NOTHING], id="one may be hidden"),
        pytest.param([(2.0, 1.0), (2.0, 1.0)], id="probable"),
        pytest.param([(12.0, -2.0), (12.0, -2.0)], id="as much contrast as others"),
    ],
)
def test_weak_electrodes_are_not_counted(end):
    assert count_faded(*chain_of(*[CLEAR] * 8, *end)) == [0]


def test_noise_may_hide_electrodes():
    assert count_faded(*chain_of(*[(7.0, 1.0)] * 8, *[(0.0, -2.0)] * 2)) == [0]


@pytest.mark.parametrize(("shown", "kept"), [(6, False), (7, True)])
def test_a_chain_is_left_out_where_a_shorter_catheter_has_its_electrodes(shown, kept):
    catalogue = Catalogue(
        (catheter_type("decapolar-2-5-2", "cs"), catheter_type("hexapolar-2-5-2", "his")), "cs", "his"
    )
    contrast, odds = np.array([CLEAR] * shown + [NOTHING] * (10 - shown)).T
    possible = PossibleChains((np.arange(10)[None], np.arange(6)[None]), (np.array([5.0]), np.array([4.0])))
    long, short = without_shorter_catheters(possible, catheter_families(catalogue), contrast, odds, 0.75).scores
    assert short == [4.0]
    assert len(long) == kept
    assert (long == 5.0 - 0.75 * (10 - shown)).all()


def test_no_place_may_be_empty_at_an_infinite_price():
    families = catheter_families(Catalogue((catheter_type("decapolar-2-5-2", "cs"),), None, "cs"))
    possible = PossibleChains((np.array([np.arange(10), np.arange(9, -1, -1)]),), (np.array([5.0, 4.0]),))
    for shown, scores in ((10, [5.0, 4.0]), (8, [-np.inf, -np.inf])):
        contrast, odds = np.array([CLEAR] * shown + [NOTHING] * (10 - shown)).T
        found = without_shorter_catheters(possible, families, contrast, odds, np.inf)
        np.testing.assert_array_equal(found.scores[0], scores)


def test_unlikely_chains_are_left_out():
    families = catheter_families(Catalogue((catheter_type("quadripolar-2-5-2", "cs"),), None, "cs"))
    possible = PossibleChains((np.arange(4)[None],), (np.array([-np.inf]),))
    (scores,) = without_shorter_catheters(possible, families, np.ones(4), np.ones(4), 0.75).scores
    assert not len(scores)


def test_a_short_catheter_may_have_hidden_electrodes():
    families = catheter_families(Catalogue((catheter_type("quadripolar-2-5-2", "cs"),), None, "cs"))
    possible = PossibleChains((np.arange(4)[None],), (np.array([3.0]),))
    contrast, odds = np.array([CLEAR, CLEAR, NOTHING, NOTHING]).T
    assert without_shorter_catheters(possible, families, contrast, odds, 0.75).scores[0] == [3.0]
