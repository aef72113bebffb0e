"""Answers of an earlier frame, carried along with the catheters that moved since."""

import numpy as np
from scipy.spatial import cKDTree

from fluoromap.segmenter.electrodes.network.carried_network import CarriedNetwork, Motion
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.electrodes.proposals import Proposals

NONE_FOUND = Proposals(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)))
THEN, NOW = np.array([[20.0, 20.0], [60.0, 20.0]]), np.array([[32.0, 26.0], [60.0, 40.0]])


def answered():
    """Answer for electrodes at the places of then, and one at rest."""
    probability, answers = np.zeros((64, 64), np.float32), np.zeros((64, 64, 5), np.float32)
    for number, (u, v) in enumerate([*THEN, (100.0, 100.0)]):
        cell = int(v / 2), int(u / 2)
        probability[cell] = 0.5 + 0.1 * number
        answers[cell] = 0.0, 0.25, 0.0, 0.0, number
    return NetworkResponse(probability, answers, NONE_FOUND, 2.0, 0.0, 1.0)


def test_points_are_asked_about_where_they_were():
    earlier = answered()
    carried = CarriedNetwork(earlier, Motion(cKDTree(NOW), NOW - THEN, 15.0))
    still = np.array([[100.0, 100.0]])
    points = np.concatenate([NOW, still])
    assert np.allclose(carried.probability_at(points, 0), [0.5, 0.6, 0.7])
    assert np.allclose(carried.tip_logits_at(points, 0), [0, 1, 2])
    # Where a catheter was, near its place of now, is nothing now.
    assert carried.probability_at(THEN[:1], 1) < 1e-6
    # Cells point to places that moved along.
    assert np.allclose(carried.aims_at(points), points + np.array([0.5, 0.0]))


def test_without_motion_the_answers_are_those_of_the_earlier_frame():
    earlier = answered()
    carried = CarriedNetwork(earlier, Motion(cKDTree(THEN), np.zeros((2, 2)), 15.0))
    points = np.random.default_rng(5).uniform(0, 127, (200, 2))
    assert np.array_equal(carried.probability_at(points, 1), earlier.probability_at(points, 1))
    assert np.array_equal(carried.aims_at(points), earlier.aims_at(points))
    assert len(carried.halves_of_pairs()) == len(earlier.halves_of_pairs())
