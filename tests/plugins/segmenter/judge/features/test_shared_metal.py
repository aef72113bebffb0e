"""Chains on the metal of another catheter."""

import numpy as np
import pytest

from fluoromap.catheters import catheter_type
from fluoromap.contracts import Chain
from fluoromap.segmenter.judge.features.shared_metal import lies_on_metal

PX_PER_MM = 5.0
ABLATION = catheter_type("ablation-8", "ablation")
QUADRIPOLAR = catheter_type("quadripolar-2-5-2", "his")


def chain_of(places, score: float = 0.9) -> Chain:
    places = np.asarray(places, dtype=np.float64)
    count = len(places)
    return Chain(
        tuple(range(1, count + 1)), places, np.tile(np.eye(2), (count, 1, 1)), np.full(count, score), (("any", 1.0),)
    )


def row(catheter, tip=(200.0, 200.0), angle: float = 0.0) -> np.ndarray:
    return np.asarray(tip) + np.outer(catheter.arc_lengths_mm * PX_PER_MM, [np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("angle", [0.0, 1.1])
def test_places_along_a_long_tip_are_no_second_catheter(angle):
    ablation = row(ABLATION, angle=angle)
    along = np.array([np.cos(angle), np.sin(angle)])
    on_tip = chain_of(ablation[0] + np.outer([-15.0, -5.0, 5.0, 15.0], along), score=0.99)
    assert lies_on_metal(on_tip, QUADRIPOLAR, chain_of(ablation), ABLATION, PX_PER_MM)
    assert not lies_on_metal(chain_of(ablation), ABLATION, on_tip, QUADRIPOLAR, PX_PER_MM)


def test_the_less_probable_of_two_chains_on_the_same_electrodes_gives_way():
    one, other = chain_of(row(QUADRIPOLAR), 0.9), chain_of(row(QUADRIPOLAR) + 2.0, 0.7)
    assert lies_on_metal(other, QUADRIPOLAR, one, QUADRIPOLAR, PX_PER_MM)
    assert not lies_on_metal(one, QUADRIPOLAR, other, QUADRIPOLAR, PX_PER_MM)


@pytest.mark.parametrize("shared", range(4))
def test_catheters_that_cross_at_an_electrode_are_two(shared):
    one = row(QUADRIPOLAR)
    other = row(QUADRIPOLAR, angle=1.2)
    other += one[shared] - other[shared]
    assert not lies_on_metal(chain_of(other), QUADRIPOLAR, chain_of(one), QUADRIPOLAR, PX_PER_MM)


def test_catheters_side_by_side_are_two():
    one = row(QUADRIPOLAR)
    beside = chain_of(one + np.array([0.0, 2.0 * PX_PER_MM]), 0.5)
    assert not lies_on_metal(beside, QUADRIPOLAR, chain_of(one), QUADRIPOLAR, PX_PER_MM)
