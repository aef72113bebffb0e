"""Answers of the network near a few places equal those to the whole image."""

import numpy as np
import pytest

from fluoromap.segmenter.electrodes.network import nearby_network
from fluoromap.segmenter.electrodes.network.nearby_network import NearbyNetwork
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, read_weights
from fluoromap.segmenter.electrodes.proposals import log_odds

CHAIN = np.array([[0.0, 0], [30, 10], [60, 15]])


@pytest.fixture(scope="module")
def image():
    random = np.random.default_rng(5)
    x = random.normal(5.0, 0.05, (403, 520)).astype(np.float32)
    for u, v in random.integers(0, (520, 403), (60, 2)):
        x[max(v - 3, 0) : v + 4, max(u - 3, 0) : u + 4] -= 0.5
    return x


@pytest.mark.parametrize("px_per_mm", [3.2, 5.75, 2.0])
@pytest.mark.parametrize("corner", [(0.0, 0.0), (201.3, 170.9), (450.0, 380.0), (-30.0, 100.0)])
@pytest.mark.parametrize("reach", [1, 2])
def test_probabilities_near_places_equal_those_of_the_whole_image(image, px_per_mm, corner, reach):
    trained = read_weights(SHIPPED)
    places = CHAIN + corner
    whole = NetworkResponse.of_image(image, trained, px_per_mm).probability_at(places, reach)
    near = NearbyNetwork(image, trained, px_per_mm).probability_at(places, reach)
    np.testing.assert_allclose(log_odds(near), log_odds(whole), atol=1e-4)


def test_the_network_is_asked_once_about_the_same_places(image, monkeypatch):
    asked = []
    padded = nearby_network.padded
    monkeypatch.setattr(nearby_network, "padded", lambda part: asked.append(part.shape) or padded(part))
    near = NearbyNetwork(image, read_weights(SHIPPED), 3.2)
    first = near.probability_at(CHAIN + 200.0)
    assert np.array_equal(near.probability_at(CHAIN + 200.0), first)
    near.probability_at(CHAIN[:2] + 200.0)
    assert len(asked) == 1
    assert asked[0][0] * asked[0][1] < 0.35 * image.size
    near.probability_at(CHAIN + 100.0)
    assert len(asked) == 2


def test_proposals_aims_and_tips_need_the_whole_image(image):
    trained = read_weights(SHIPPED)
    whole, near = NetworkResponse.of_image(image, trained, 3.2), NearbyNetwork(image, trained, 3.2)
    everywhere = np.ones(image.shape, np.bool_)
    assert np.array_equal(near.proposals(everywhere, 4).points_uv, whole.proposals(everywhere, 4).points_uv)
    assert np.array_equal(near.halves_of_pairs(), whole.halves_of_pairs())
    assert np.array_equal(near.tip_logits_at(CHAIN), whole.tip_logits_at(CHAIN))
    assert np.array_equal(near.aims_at(CHAIN), whole.aims_at(CHAIN))
