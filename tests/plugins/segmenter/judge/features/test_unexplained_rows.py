"""Electrodes in the line of a row, and what explains them."""

import numpy as np
import pytest

from fluoromap.contracts import Chain
from fluoromap.segmenter.judge.features.unexplained_rows import onwards

PX = 3.0
ROW_MM = np.array([[0.0, 0.0], [3.0, 0.0], [9.0, 0.0], [12.0, 0.0]])
PAIR_MM = np.array([[18.0, 0.0], [21.0, 0.0]])


def beyond(points_mm, row_mm=ROW_MM, as_sure=None):
    points_mm = np.reshape(points_mm, (-1, 2))
    sure = np.zeros(len(points_mm), np.bool_) if as_sure is None else np.array(as_sure)
    return onwards(4, row_mm * PX + 100, points_mm * PX + 100, sure, PX)


def chain_at(points_mm):
    count = len(points_mm)
    return Chain(
        tuple(range(1, count + 1)),
        points_mm * PX + 100,
        np.tile(np.eye(2), (count, 1, 1)),
        np.ones(count),
        (("other", 1.0),),
    )


def test_a_pair_goes_on_in_the_line_of_the_row_in_its_order():
    found = beyond([*PAIR_MM[::-1], *ROW_MM, [18.0, 9.0], [-6.0, 0.0]])
    assert found.frame == 4
    assert np.allclose(found.points_uv, PAIR_MM * PX + 100)
    assert found.unexplained_by([])


@pytest.mark.parametrize("turn_rad", [0.0, 0.4, -1.1])
def test_the_line_has_any_direction(turn_rad):
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    turned = np.array([[cos, sin], [-sin, cos]])
    assert len(beyond(PAIR_MM @ turned, ROW_MM @ turned).points_uv) == 2


@pytest.mark.parametrize(
    "points_mm",
    [
        [],
        # Parts of a long tip.
        [[14.0, 0.0]],
        # Farther apart than electrodes of the row are.
        [[20.0, 0.0], [23.0, 0.0]],
        # Aside.
        [[12.0, 6.0], [15.0, 9.0]],
    ],
)
def test_other_points_are_no_electrodes_of_the_row(points_mm):
    found = beyond(points_mm)
    assert len(found.points_uv) == 0
    assert not found.unexplained_by([])


def test_one_electrode_more_counts_where_it_is_as_sure_as_the_row():
    assert not beyond([[18.0, 0.0]]).unexplained_by([])
    assert beyond([[18.0, 0.0]], as_sure=[True]).unexplained_by([])
    # Another catheter explains what lies next to the row.
    two = beyond(PAIR_MM, as_sure=[True, True])
    assert not two.unexplained_by([chain_at(np.array([[18.0, 0.5], [18.0, 6.0]]))])


def test_electrodes_of_other_catheters_are_explained():
    pair = beyond(PAIR_MM)
    assert not pair.unexplained_by([chain_at(PAIR_MM + 0.5)])
    assert pair.unexplained_by([chain_at(PAIR_MM + 2.0)])
