"""The earliest site as a set with probabilities, against the normal distribution and drawing lots."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fluoromap.fuser.earliest import earliest_sites


def test_two_sites_agree_with_the_normal_distribution():
    answer = dict(earliest_sites(("early", "late"), np.array([0.0, 3.0]), np.array([2.0, 1.0])))
    expected = 0.5 * (1 + math.erf(3 / math.sqrt(5) / math.sqrt(2)))
    assert answer["early"] == pytest.approx(expected, abs=1e-3)


@settings(max_examples=20, deadline=None)
@example([0.0] * 6 + [-13.0], 688)
@given(st.lists(st.floats(-50, 50), min_size=2, max_size=8), st.integers(0, 1000))
def test_agrees_with_drawing_lots(times, seed):
    rng = np.random.default_rng(seed)
    lat, sd = np.array(times), rng.uniform(0.5, 6, size=len(times))
    names = tuple(f"S{index}" for index in range(len(times)))
    answer = dict(earliest_sites(names, lat, sd))
    winners = (lat + sd * rng.normal(size=(20_000, len(lat)))).argmin(axis=1)
    drawn = np.bincount(winners, minlength=len(lat)) / 20_000
    for name, share in zip(names, drawn, strict=True):
        assert answer.get(name, 0.0) == pytest.approx(share, abs=0.02)


def test_equal_sites_share():
    answer = earliest_sites(("a", "b", "c"), np.array([5.0, 5.0, 80.0]), np.ones(3))
    assert dict(answer) == {"a": pytest.approx(0.5), "b": pytest.approx(0.5)}


def test_many_improbable_sites_are_not_hidden_by_a_probable_one():
    """Forty sites of about 1 % each leave the first one uncertain."""
    lat = np.concatenate([[0.0], np.full(40, 13.0)])
    answer = earliest_sites(tuple(f"S{index}" for index in range(41)), lat, np.full(41, 5.0))
    rng = np.random.default_rng(0)
    drawn = np.mean((lat + 5.0 * rng.normal(size=(20_000, 41))).argmin(axis=1) == 0)
    assert drawn < 0.8
    assert answer[0] == ("S0", pytest.approx(drawn, abs=0.02))
    assert 0.99 <= sum(probability for _, probability in answer) <= 1 + 1e-9


def test_two_hundred_equal_sites_are_all_as_probable():
    answer = earliest_sites(tuple(f"S{index}" for index in range(200)), np.zeros(200), np.ones(200))
    assert len(answer) >= 198
    assert [probability for _, probability in answer] == pytest.approx([1 / 200] * len(answer))
