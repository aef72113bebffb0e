"""Conduction velocity against plane waves of known speed."""

import numpy as np
import pytest

from fluoromap.fuser.conduction import conduction_velocity
from fluoromap.fuser.reentry_cycle import Cycle

UP = np.array([0.0, 0.0, 1.0])


def grid(step_mm=5.0, count=6):
    x, y = np.meshgrid(step_mm * np.arange(count), step_mm * np.arange(count))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(count * count)])


def velocity(places, times, sd_ms, difference=np.subtract):
    return conduction_velocity(places, np.tile(UP, (len(places), 1)), times, np.full(len(places), sd_ms), difference)


@pytest.mark.parametrize("speed", [0.3, 0.8, 2.0])
def test_a_plane_wave_has_its_speed(speed):
    places = grid()
    found = velocity(places, places @ [0.6, 0.8, 0.0] / speed, 0.01)
    assert found.median_m_per_s == pytest.approx(speed, rel=1e-3)
    assert found.low_m_per_s <= speed * 1.001
    assert found.high_m_per_s >= speed * 0.999


def test_the_interval_holds_the_truth_and_the_median_is_not_drawn_by_noise():
    places, inside, medians = grid(), 0, []
    for seed in range(30):
        noise = np.random.default_rng(seed).normal(size=len(places))
        found = velocity(places, places @ [0.6, 0.8, 0.0] / 0.8 + noise, 1.0)
        inside += found.low_m_per_s <= 0.8 <= found.high_m_per_s
        medians.append(found.median_m_per_s)
    assert inside >= 26
    assert np.mean(medians) == pytest.approx(0.8, rel=0.03)


def test_a_curved_wall_is_unfolded():
    angle, height = np.meshgrid(np.arange(0, 2.0, 0.2), np.arange(0, 40.0, 6.0))
    normals = np.column_stack([np.cos(angle.ravel()), np.sin(angle.ravel()), np.zeros(angle.size)])
    places = 25 * normals + height.ravel()[:, None] * UP
    times = 25 * angle.ravel() / 0.7
    found = conduction_velocity(places, normals, times, np.full(len(times), 0.3), np.subtract)
    assert found.median_m_per_s == pytest.approx(0.7, rel=0.03)


def test_few_far_or_simultaneous_sites_give_nothing():
    places = grid()
    assert velocity(places[:3], places[:3, 0], 0.1) is None
    assert velocity(4 * places, places[:, 0], 0.1) is None
    assert velocity(places, np.zeros(len(places)), 1.0) is None
    assert velocity(np.outer(np.arange(8.0), [2, 0, 0]), np.arange(8.0), 0.1) is None


def test_a_site_on_the_opposite_wall_is_not_near():
    wall = grid(5.0, 2)
    places = np.vstack([wall[:2], wall[2:] + 6 * UP])
    normals = np.vstack([-UP, -UP, UP, UP])
    assert conduction_velocity(places, normals, places[:, 0], np.full(4, 0.1), np.subtract) is None


def test_across_the_end_of_the_cycle():
    places = grid()
    cycle = Cycle(200.0, -100.0)
    times = places[:, 0] / 0.8 + 85
    found = velocity(places, cycle.into_window(times), 0.01, cycle.difference)
    assert found.median_m_per_s == pytest.approx(0.8, rel=1e-3)
