"""Probabilities of alternative pairings."""

import numpy as np
import pytest
from scipy.special import logit

from fluoromap.matching.joint_choice import _on_grid


@pytest.mark.parametrize("probability", [1e-300, 1e-9, 0.0199, 0.02, 0.1, 0.3456, 0.5])
def test_the_odds_of_an_alternative_are_rounded_by_a_twentieth_at_most(probability: float) -> None:
    assert abs(logit(_on_grid(probability)) - logit(probability)) < 0.0501
    assert _on_grid(_on_grid(probability)) == _on_grid(probability) <= 0.5


def test_most_small_changes_of_other_sites_leave_an_alternative_exactly_as_it_was() -> None:
    before = np.random.default_rng(1).uniform(0.02, 0.5, 500)
    after = before * (1 + 2e-3)
    unchanged = [_on_grid(float(one)) == _on_grid(float(other)) for one, other in zip(before, after, strict=True)]
    assert np.mean(unchanged) > 0.9
