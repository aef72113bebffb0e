"""Tip electrodes of which both ends were proposed, and chains from their middles."""

import numpy as np
import pytest

from fluoromap.catheters import catheter_type
from fluoromap.segmenter.chain_candidates import Candidates
from fluoromap.segmenter.linking import CatheterFamily, PossibleChains, ShaftImage
from fluoromap.segmenter.long_tips import are_ends_of_tip, tip_middles, with_long_tip
from fluoromap.segmenter.proposals import NO_PROPOSALS, Proposals

PX = 4.0
LONG, SHORT = catheter_type("ablation-8", "ablation"), catheter_type("quadripolar-2-5-2", "rv")
ENDS = np.array([[30.0, 50.0], [50.0, 50.0]])


def proposals(points):
    return Proposals(points, np.full(len(points), 0.8), np.tile(np.eye(2), (len(points), 1, 1)))


def shown(between):
    """Return an image with two dark spots.

    The way between them has ``between`` of their depth.
    """
    v, u = np.mgrid[:100, :100].astype(np.float64)
    image = np.full((100, 100), 6.0) - between * ((np.abs(v - 50) < 3) & (u > 30) & (u < 50))
    for end in ENDS:
        image[np.hypot(u - end[0], v - end[1]) < 3.0] = 5.0
    return ShaftImage(image.astype(np.float32), 1, 0.05, PX)


def test_the_middle_between_the_ends_of_a_long_tip_is_a_candidate():
    middles = tip_middles(proposals(ENDS), [SHORT, LONG], shown(1.0))
    np.testing.assert_allclose(middles.proposals.points_uv, [[40.0, 50.0]])
    assert middles.ends.tolist() == [[0, 1]]
    assert middles.proposals.probability[0] > 0.8


@pytest.mark.parametrize(
    ("catheters", "points", "between"),
    [([SHORT], ENDS, 1.0), ([LONG], ENDS, 0.3), ([LONG], ENDS + np.array([[0.0, 0.0], [10.0, 0.0]]), 1.0)],
)
def test_two_rings_on_a_shaft_and_places_too_far_apart_have_no_middle(catheters, points, between):
    assert len(tip_middles(proposals(points), catheters, shown(between))) == 0


def test_a_long_tip_has_the_value_of_its_weaker_end():
    chain = np.stack([40.0 + PX * LONG.arc_lengths_mm, np.full(4, 50.0)], axis=1)

    def values_at(points):
        return np.where(np.abs(points[:, 0] - 50.0) < 1.0, 0.9, np.where(np.abs(points[:, 0] - 30.0) < 1.0, 0.7, 0.1))

    np.testing.assert_allclose(with_long_tip(values_at, chain, LONG), [0.7, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(with_long_tip(values_at, chain, SHORT), 0.1)


def test_the_ends_of_a_tip_lie_as_the_next_electrode_demands():
    gap = np.array([[LONG.spacing_mm[0] * PX, 0.0]])
    apart = np.array([[5.0 * PX, 0.0]])
    assert are_ends_of_tip(apart, gap, LONG)
    assert are_ends_of_tip(-0.6 * apart, 0.6 * gap, LONG)
    assert not are_ends_of_tip(0.6 * apart, gap, LONG)
    assert not are_ends_of_tip(apart[:, ::-1], gap, LONG)


def test_a_middle_is_the_first_electrode_only_and_its_ends_are_none():
    rows_uv = np.stack([40.0 + PX * LONG.arc_lengths_mm[1:], np.full(3, 50.0)], axis=1)
    proposed = proposals(np.concatenate([ENDS, rows_uv]))
    middles = tip_middles(proposed, [LONG], shown(1.0))
    candidates = Candidates(proposed, NO_PROPOSALS, middles)
    family = CatheterFamily(("ablation",), LONG)
    rows = np.array([[5, 2, 3, 4], [2, 5, 3, 4], [5, 1, 3, 4], [1, 2, 3, 4]])
    found = candidates.possible(PossibleChains((rows,), (np.zeros(4),)), candidates.together.points_uv, (family,))
    assert found.rows[0].tolist() == [[5, 2, 3, 4], [1, 2, 3, 4]]
