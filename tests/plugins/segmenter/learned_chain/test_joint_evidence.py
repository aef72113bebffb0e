"""Network and blobs together: contrast excuses doubt only in noise."""

import numpy as np

from fluoromap.segmenter.learned_chain.joint_evidence import JointEvidence


class Says:
    """A network or blobs that say the same at all points."""

    def __init__(self, value):
        self._value = value

    def probability_at(self, points_uv, reach_cells=1):
        return np.full(len(points_uv), self._value)

    def scores_at(self, points_uv):
        return np.full(len(points_uv), self._value)


def joint(network_probability, contrast):
    return JointEvidence(Says(network_probability), Says(contrast), 3.2, 0.0)


def test_doubt_about_a_clear_blob_is_no_electrode_and_about_a_faint_one_may_be():
    at = np.zeros((1, 2))
    assert joint(0.1, 20.0).scores_at(at) < 0.15
    assert joint(0.1, 5.0).scores_at(at) > 0.5
    assert joint(0.001, 5.0).scores_at(at) < 0.15


def test_both_count_alike_for_a_place():
    at = np.zeros((1, 2))
    assert joint(0.5, 4.0).probability_at(at) == 0.5
    assert joint(0.5, 8.0).probability_at(at) > 0.6
    assert joint(0.8, 4.0).probability_at(at) > 0.6


def test_more_than_enough_contrast_does_not_make_a_blob_an_electrode():
    at = np.zeros((1, 2))
    assert joint(0.1, 60.0).probability_at(at) > 0.8
    assert joint(0.1, 60.0).kind_odds_at(at) < 0.0
    assert joint(0.1, 60.0).kind_odds_at(at) == joint(0.1, 8.0).kind_odds_at(at)
    assert joint(0.1, 6.0).kind_odds_at(at) < joint(0.1, 8.0).kind_odds_at(at)
