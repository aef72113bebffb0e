"""Motion between the sites as a sign of the reference catheter."""

from __future__ import annotations

import numpy as np
import pytest

from fluoromap.matching.identity import CLEARLY_STILLER, stiller


def places(own_sd_mm: float, common: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.normal(0, own_sd_mm, common.shape) + common


def test_the_catheter_that_moves_less_is_stiller() -> None:
    rng = np.random.default_rng(1)
    breathing = rng.normal(0, [0.5, 0.5, 2.0], (8, 3))
    still, moving = places(0.2, breathing, rng), places(1.5, breathing, rng)
    assert stiller(still, moving) > CLEARLY_STILLER
    assert stiller(moving, still) == pytest.approx(-stiller(still, moving))


def test_a_moved_table_hides_the_stiller_catheter_but_never_exchanges_it() -> None:
    wrong = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        table = np.where(np.arange(5)[:, None] < rng.integers(1, 5), 0.0, rng.uniform(-30, 30, 3))
        still, moving = places(0.2, table, rng), places(0.8, table, rng)
        wrong += stiller(moving, still) > CLEARLY_STILLER
    assert wrong == 0


def test_irregular_beats_alone_make_no_catheter_the_stiller_one() -> None:
    # Simulated study 90141 of benchmarks/silent_wrongs.py: the beats move the reference at rest by 1 mm at three sites.
    pacing = np.array([
        [0.09, -2.81, 1.87], [-0.17, -1.58, -0.98], [-0.14, 0.79, -1.33],
        [-0.22, -0.42, -2.81], [0.29, 3.68, 3.38], [0.16, 0.34, -0.12],
    ])  # fmt: skip
    reference = np.array([
        [-0.92, -2.66, 2.32], [-0.40, -3.64, -0.40], [1.84, 1.09, -0.59],
        [0.35, 1.15, -5.54], [-1.02, 2.56, 3.71], [0.13, 1.49, 0.50],
    ])  # fmt: skip
    assert abs(stiller(pacing, reference, irregular=True)) < CLEARLY_STILLER
    # At a regular rhythm the same places would decide.
    assert stiller(pacing, reference) > CLEARLY_STILLER
