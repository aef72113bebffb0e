import numpy as np

from fluoromap.segmenter.frames.electrode_detector import ALONE, IN_A_RUN
from fluoromap.segmenter.judge.acceptance import Acceptance, ScoreLimits


def test_a_long_row_is_accepted_with_less_from_each_electrode():
    doubted = np.full(10, 0.3)
    assert IN_A_RUN.accepts(doubted, 2.5)
    assert not IN_A_RUN.accepts(doubted, 1.5)
    assert not IN_A_RUN.accepts(doubted[:4], 2.5)
    assert not IN_A_RUN.accepts(np.full(10, 0.1), 8.0)


def test_a_row_displaced_by_a_pair_is_not_accepted():
    displaced = np.array([0.9] * 8 + [0.01] * 2)
    assert not IN_A_RUN.accepts(displaced, 5.0)
    assert not IN_A_RUN.accepts(displaced[::-1], 5.0)
    assert IN_A_RUN.accepts(np.array([0.9] * 6 + [0.01] * 2 + [0.9] * 2), 5.0)


def test_something_may_hide_a_pair_in_a_run_only():
    hidden = np.array([0.9] * 8 + [0.01] * 2)
    assert IN_A_RUN.hidden_pair.allow(hidden)
    assert not IN_A_RUN.hidden_pair.allow(np.array([0.9] * 7 + [0.01] * 3))
    assert not IN_A_RUN.hidden_pair.allow(np.array([0.6] * 8 + [0.01] * 2))
    assert not ALONE.hidden_pair.allow(hidden)


def test_chains_are_accepted_one_by_one():
    scores = np.stack([np.full(4, 0.9), np.full(4, 0.1)])
    assert IN_A_RUN.accepts(scores, np.array([5.0, 5.0])).tolist() == [True, False]


def test_another_catheter_in_the_image_lowers_the_limits():
    limits, beside = ScoreLimits(0.4, seen=0.15, least_seen=0.85), ScoreLimits(0.3, seen=0.1, least_seen=0.7)
    doubted = np.array([[0.35] * 4, [0.35, 0.35, 0.35, 0.05], [0.35, 0.35, 0.05, 0.05]])
    for acceptance, expected in (
        (Acceptance(0.1, 0.1, 0.1, 0.3, limits, beside), [True, True, False]),
        (Acceptance(0.1, 0.1, 0.1, 0.3, limits), [False] * 3),
    ):
        assert acceptance.accepts(doubted, np.zeros(3)).tolist() == [False] * 3
        assert acceptance.accepts(doubted, np.zeros(3), beside=True).tolist() == expected


def test_electrodes_outside_the_field_do_not_count_but_enough_must_lie_in_it():
    good = np.full(4, 0.9)
    assert IN_A_RUN.accepts(np.append(good[:3], np.nan), 2.5)
    assert not IN_A_RUN.accepts(np.append(good[:2], [np.nan, np.nan]), 2.5)
    assert not IN_A_RUN.accepts(np.append(np.full(3, 0.1), np.nan), 2.5)
    assert IN_A_RUN.accepts(np.append(np.full(5, 0.9), np.full(5, np.nan)), 2.5)
    assert not IN_A_RUN.accepts(np.append(np.full(4, 0.9), np.full(6, np.nan)), 2.5)
