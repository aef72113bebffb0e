"""Network and blobs together: contrast excuses doubt only in noise."""

import numpy as np
import pytest

from fluoromap.segmenter.electrodes.joint_evidence import JointEvidence
from fluoromap.segmenter.electrodes.proposals import Proposals


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


class Points:
    """A network and blobs that propose the same electrodes; the network's cells point to the nearest of ``electrodes``."""

    def __init__(self, proposed_uv, electrodes_uv):
        self._proposed = np.array(proposed_uv, dtype=np.float64)
        self._electrodes = np.array(electrodes_uv, dtype=np.float64)

    def proposals(self, allowed, expected):
        count = len(self._proposed)
        return Proposals(self._proposed, np.full(count, 0.8), np.tile(np.eye(2), (count, 1, 1)))

    def probability_at(self, points_uv, reach_cells=1):
        return np.full(len(points_uv), 0.8)

    def scores_at(self, points_uv):
        return np.full(len(points_uv), 20.0)

    def aims_at(self, points_uv):
        away = np.linalg.norm(points_uv[:, None] - self._electrodes, axis=2)
        return self._electrodes[away.argmin(axis=1)]


EVERYWHERE = np.ones((64, 64), np.bool_)


@pytest.mark.parametrize(
    ("blobs_uv", "electrodes_uv", "expected_uv"),
    [
        pytest.param([[30, 28], [30, 32]], [[30, 30]], [[30, 30]], id="two rims of a ring: its middle"),
        pytest.param([[30, 27.5], [30.5, 30], [30, 32.5]], [[30, 30]], [[30.5, 30]], id="rims and the middle: the blob there"),
        pytest.param([[30, 28], [30, 32]], [[30, 28], [30, 32]], [[30, 28], [30, 32]], id="two electrodes"),
        pytest.param([[30, 20], [30, 32]], [[30, 26]], [[30, 20], [30, 32]], id="farther apart than a ring is wide"),
    ],
)  # fmt: skip
def test_parts_of_one_electrode_are_proposed_once(blobs_uv, electrodes_uv, expected_uv):
    says = Points(blobs_uv, electrodes_uv)
    proposed = JointEvidence(says, says, 3.2, 0.0).proposals(EVERYWHERE, 4)
    assert sorted(proposed.points_uv.tolist()) == pytest.approx(np.array(expected_uv, dtype=float))
    assert len(proposed.probability) == len(expected_uv)
    # The scatter of the parts is across the ring.
    merged = len(blobs_uv) > len(expected_uv)
    assert np.allclose(proposed.covariance_px2[:, 0, 0], 1.0, atol=0.2)
    assert ((proposed.covariance_px2[:, 1, 1] > 3.0) == merged).all()


def test_an_image_may_show_nothing():
    says = Points(np.zeros((0, 2)), [[30, 30]])
    assert len(JointEvidence(says, says, 3.2, 0.0).proposals(EVERYWHERE, 4)) == 0
