"""The earliest site as a set with probabilities, against the normal distribution and drawing lots."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fluoromap.fuser.earliest import earliest_sites


def test_two_sites_agree_with_the_normal_distribution():
    answer = dict(earliest_sites(("early", "late"), np.array([0.0, 3.0]), np.array([2.0, 1.0])))
    expected = 0.5 * (1 + math.erf(3 / math.sqrt(5) / math.sqrt(2)))
    assert answer["early"] == pytest.approx(expected, abs=1e-3)


@settings(max_examples=20, deadline=None)
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
