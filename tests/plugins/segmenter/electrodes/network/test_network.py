"""The network's forward pass, what it sees, and its weights file."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import affine_transform

from fluoromap.segmenter.electrodes.network.ensemble import NetworkEnsemble
from fluoromap.segmenter.electrodes.network.forward import ElectrodeNetwork, Part
from fluoromap.segmenter.electrodes.network.layers import AROUND, CONVOLUTIONS, HEADS
from fluoromap.segmenter.electrodes.network.network_response import (
    NETWORK_PX_PER_MM,
    NetworkResponse,
    answer,
    network_scale,
)
from fluoromap.segmenter.electrodes.network.normalisation import normalise
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, read_weights
from fluoromap.segmenter.electrodes.proposals import Proposals
from fluoromap.segmenter.picture.resampling import add_moved, resampled

REFERENCE = Path(__file__).with_name("pytorch_answers.npz")
"""Made by ``python -m fluoromap.training --reference``."""


@pytest.fixture(scope="module")
def weights():
    random = np.random.default_rng(0)
    stored = {}
    for name, layer in CONVOLUTIONS.items():
        shape = (layer.width, layer.width, layer.inputs, layer.outputs)
        stored[f"{name}.taps"] = (random.normal(size=shape) / np.sqrt(np.prod(shape[:3]))).astype(np.float32)
        stored[f"{name}.bias"] = random.normal(size=layer.outputs).astype(np.float32)
    return stored


def plain_convolution(x, taps, bias, layer):
    """Compute one layer in double precision, window by window.

    x is (rows, columns, channels).
    """
    reach = layer.width // 2 * layer.dilation
    padded = np.pad(x.astype(np.float64), ((reach, reach), (reach, reach), (0, 0)))
    rows, columns = x.shape[0] // layer.stride, x.shape[1] // layer.stride
    out = np.zeros((rows, columns, layer.outputs)) + bias
    for i in range(layer.width):
        for j in range(layer.width):
            v, u = i * layer.dilation, j * layer.dilation
            window = padded[v : v + x.shape[0] : layer.stride, u : u + x.shape[1] : layer.stride]
            out += window @ taps[i, j].astype(np.float64)
    return np.maximum(out, 0.0) if layer.rectified else out


@pytest.mark.parametrize("name", CONVOLUTIONS)
@pytest.mark.parametrize("size", [(8, 8), (24, 40), (72, 16)])
def test_each_layer_equals_a_plain_convolution(weights, name, size):
    layer = CONVOLUTIONS[name]
    x = np.random.default_rng(1).normal(size=(*size, layer.inputs)).astype(np.float32)
    fast = ElectrodeNetwork.of_weights(weights).layers[name](x)
    plain = plain_convolution(x, weights[f"{name}.taps"], weights[f"{name}.bias"], layer)
    np.testing.assert_allclose(fast, plain, atol=2e-5, rtol=2e-5)


def test_the_whole_network_is_its_layers_in_a_row(weights):
    picture = np.random.default_rng(2).normal(size=(64, 48)).astype(np.float32)

    def apply(name, x):
        return plain_convolution(x, weights[f"{name}.taps"], weights[f"{name}.bias"], CONVOLUTIONS[name])

    quarter = apply("at_quarter_again", apply("at_quarter", apply("at_half", picture[..., None])))
    eighth = apply("at_eighth", quarter)
    for name in AROUND:
        eighth = eighth + apply(name, eighth)
    heads = apply("heads", apply("merged", quarter + apply("back", eighth).repeat(2, 0).repeat(2, 1)))
    answers = ElectrodeNetwork.of_weights(weights)(picture)
    assert answers.shape == (32, 24, len(HEADS))
    for head in range(len(HEADS)):
        for down in range(2):
            for right in range(2):
                np.testing.assert_allclose(
                    answers[down::2, right::2, head], heads[..., 4 * head + 2 * down + right], atol=1e-4
                )


def test_it_answers_as_pytorch_does_with_the_shipped_weights():
    with np.load(REFERENCE) as stored:
        picture, expected, digest = stored["picture"].astype(np.float32), stored["answers"], str(stored["sha256"])
    assert digest == hashlib.sha256(SHIPPED.read_bytes()).hexdigest(), (
        f"write {REFERENCE.name} again: python -m fluoromap.training --reference {REFERENCE}"
    )
    networks = read_weights(SHIPPED).ensemble.networks
    assert len(networks) == len(expected)
    for network, of_pytorch in zip(networks, expected, strict=True):
        np.testing.assert_allclose(network(picture), of_pytorch, atol=1e-4, rtol=1e-4)


def test_an_ensemble_answers_the_mean_and_a_mixture_s_variance(weights):
    other = {name: value[..., ::-1].copy() if name == "heads.taps" else value for name, value in weights.items()}
    both = {name: np.stack([weights[name], other[name]]) for name in weights}
    picture = np.random.default_rng(4).normal(size=(40, 48)).astype(np.float32)
    ensemble = NetworkEnsemble.of_weights(both)
    one, two = (network(picture).astype(np.float64) for network in ensemble.networks)
    answers = ensemble(picture)
    for name in ("heat", "offset_u", "offset_v", "tip"):
        head = HEADS.index(name)
        np.testing.assert_allclose(answers[..., head], 0.5 * (one + two)[..., head], atol=1e-4)
    variance = HEADS.index("log_variance")
    # Of two equally likely places, the variance is a quarter of their squared distance; u and v have one in common.
    squares = sum((one - two)[..., HEADS.index(name)] ** 2 for name in ("offset_u", "offset_v"))
    stated = 0.5 * (np.exp(one[..., variance]) + np.exp(two[..., variance]))
    np.testing.assert_allclose(answers[..., variance], np.log(stated + squares / 8), atol=1e-3)
    part = Part(3, 5, 11, 17)
    np.testing.assert_allclose(ensemble(picture, part), answers[3:11, 5:17], atol=2e-4)


def test_pictures_of_any_size_get_answers_for_all_their_cells():
    trained = read_weights(SHIPPED)
    for shape in ((16, 16), (17, 33), (101, 64)):
        answers = answer(trained, np.zeros(shape, np.float32))
        assert answers.shape == (-(-shape[0] // 2), -(-shape[1] // 2), len(HEADS))


@pytest.mark.parametrize(
    "cells",
    [Part(30, 40, 31, 41), Part(0, 0, 7, 9), Part(61, 50, 104, 128), Part(3, 17, 90, 111), Part(0, 0, 104, 128)],
)
def test_a_part_of_the_cells_gets_the_answers_that_it_has_in_the_whole_picture(cells):
    network = read_weights(SHIPPED).ensemble
    picture = np.random.default_rng(3).normal(0.0, 1.0, (208, 256)).astype(np.float32)
    whole = network(picture)
    part = network(picture, cells)
    np.testing.assert_allclose(part, whole[cells.top : cells.bottom, cells.left : cells.right], atol=2e-4)


def test_grey_levels_and_their_range_do_not_matter():
    picture = np.random.default_rng(0).normal(size=(96, 128)).astype(np.float32)
    seen = normalise(picture)
    np.testing.assert_allclose(normalise(40.0 * picture + 900.0), seen, atol=2e-3)
    assert 0.5 < seen.std() < 1.2
    np.testing.assert_allclose(normalise(np.full((64, 64), 7.0, np.float32)), 0.0, atol=1e-3)


@pytest.mark.parametrize("scale", [0.31, 0.5565, 0.8, 1.0, 1.3])
def test_reduced_pictures_keep_places_and_levels(scale):
    v, u = np.mgrid[:90, :120].astype(np.float32)
    small = resampled(2.0 * u + 0.5 * v, scale)
    rows, columns = np.mgrid[: small.shape[0], : small.shape[1]]
    expected = 2.0 * ((columns + 0.5) / scale - 0.5) + 0.5 * ((rows + 0.5) / scale - 0.5)
    inside = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(small[inside], expected[inside], atol=0.2)
    np.testing.assert_allclose(resampled(np.ones((50, 61), np.float32), scale), 1.0, atol=1e-5)


def test_moved_pictures_are_those_of_scipy():
    random = np.random.default_rng(3)
    image = random.normal(size=(60, 80)).astype(np.float32)
    turn = np.array([[0.9, -0.2], [0.25, 1.1]])
    for shift in ([-9.0, 3.5], [30.2, 20.7]):
        total = np.ones((40, 50), np.float32)
        add_moved(image, turn, np.array(shift), total)
        moved = affine_transform(image, turn[::-1, ::-1], shift[::-1], total.shape, order=1, mode="nearest")
        np.testing.assert_allclose(total, 1.0 + moved, atol=1e-5)


def test_frames_near_the_network_s_scale_are_taken_as_they_are():
    assert network_scale(3.1) == 1.0
    for px_per_mm in (3.6, 5.75):
        assert network_scale(px_per_mm) == pytest.approx(NETWORK_PX_PER_MM / px_per_mm)


def test_the_shipped_weights_are_small_and_their_origin_is_known():
    described = json.loads(SHIPPED.with_suffix(".json").read_text())
    assert described["sha256"] == hashlib.sha256(SHIPPED.read_bytes()).hexdigest()
    assert described["pictures"] == "synthetic scenes only"
    assert described["command"].startswith("python -m fluoromap.training")
    assert isinstance(described["seed"], int)
    assert SHIPPED.stat().st_size <= 1_000_000


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", b"\x93NUMPY"])
def test_a_file_that_holds_no_weights_is_refused_by_name(tmp_path, content):
    path = tmp_path / "mine.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"mine\.npz"):
        read_weights(path)


def test_weights_of_another_network_are_refused(tmp_path, weights):
    path = tmp_path / "other.npz"
    calibration = np.array([1, 0, 1], np.float32)
    of_one = {name: value[None] for name, value in weights.items()}
    np.savez(path, **{**of_one, "heads.bias": np.zeros((1, 3), np.float32)}, calibration=calibration)
    with pytest.raises(ValueError, match="heads"):
        read_weights(path)
    np.savez(path, **weights)
    with pytest.raises(ValueError, match="calibration"):
        read_weights(path)
    np.savez(path, calibration=calibration)
    with pytest.raises(ValueError, match="no network"):
        read_weights(path)


def answered(probability, offset_u):
    """Return the network's response to cells that point ``offset_u`` cells aside."""
    answers = np.zeros((*probability.shape, len(HEADS)), np.float32)
    answers[..., HEADS.index("offset_u")] = offset_u
    row, column = np.unravel_index(int(np.argmax(probability)), probability.shape)
    places = np.array([[column + offset_u[row, column], row]], dtype=np.float64) * 2.0
    found = Proposals(places, np.array([probability.max()], np.float64), np.eye(2)[None])
    return NetworkResponse(probability.astype(np.float32), answers, found, 2.0, 0.0, 1.0)


def test_cells_that_point_to_two_places_see_a_pair():
    probability, offset = np.zeros((16, 16)), np.zeros((16, 16))
    probability[8, 6:9] = 0.7, 0.9, 0.8
    offset[8, 6:9] = 0.9, 0.0, -0.9
    assert len(answered(probability, offset).halves_of_pairs()) == 0
    offset[8, 6:9] = 0.3, 0.0, -0.3
    one, other = sorted(answered(probability, offset).halves_of_pairs().tolist())
    assert other[0] - one[0] > 4.0
    assert one[1] == pytest.approx(16.0, abs=0.5) == other[1]


def test_one_cell_speaks_for_one_electrode_of_a_chain():
    probability = np.zeros((16, 16))
    probability[8, 7:9] = 0.9, 0.2
    response = answered(probability, np.zeros((16, 16)))
    near = np.array([[14.2, 16.0], [16.4, 16.0], [28.0, 16.0]])
    assert response.probability_at(near) == pytest.approx([0.9, 0.9, 0.0])
    assert response.shares_at(near) == pytest.approx([0.9, 0.2, 0.0])
    assert response.shares_at(near[1:]) == pytest.approx([0.9, 0.0])


def test_cells_point_to_places():
    offset = np.zeros((16, 16))
    offset[8, 6], offset[8, 7] = 1.0, 9.0
    response = answered(np.zeros((16, 16)), offset)
    places = np.array([[12.4, 16.3], [14.0, 16.0], [20.0, 16.0], [-9.0, 99.0]])
    assert response.aims_at(places).tolist() == [[14.0, 16.0], [17.0, 16.0], [20.0, 16.0], [0.0, 30.0]]


def test_the_most_probable_cell_near_a_place_says_whether_it_is_a_tip():
    probability = np.zeros((16, 16))
    probability[8, 7:9] = 0.9, 0.3
    response = answered(probability, np.zeros((16, 16)))
    response.answers[8, 7, HEADS.index("tip")] = 3.0
    response.answers[8, 8, HEADS.index("tip")] = -3.0
    assert response.tip_logits_at(np.array([[16.0, 16.0]])) == pytest.approx([3.0])
