"""The network asked about a picture in several orientations."""

import numpy as np

from fluoromap.segmenter.electrodes.network.layers import CELL_PX, HEADS
from fluoromap.segmenter.electrodes.network.orientations import ALL_ORIENTATIONS, mean_answer
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, read_weights

OFFSET_U, OFFSET_V = HEADS.index("offset_u"), HEADS.index("offset_v")


def slopes(picture):
    """Answer each cell's first pixel, and the slope there as offset."""
    wide = np.pad(picture, 1, mode="edge")
    answers = np.zeros((*picture[::CELL_PX, ::CELL_PX].shape, len(HEADS)), np.float32)
    answers[..., 0] = picture[::CELL_PX, ::CELL_PX]
    answers[..., OFFSET_U] = (wide[1:-1, 2:] - wide[1:-1, :-2])[::CELL_PX, ::CELL_PX]
    answers[..., OFFSET_V] = (wide[2:, 1:-1] - wide[:-2, 1:-1])[::CELL_PX, ::CELL_PX]
    return answers


def test_every_orientation_is_turned_back_onto_the_picture():
    picture = np.random.default_rng(0).normal(size=(32, 48)).astype(np.float32)
    answers = mean_answer(slopes, picture, ALL_ORIENTATIONS)
    np.testing.assert_allclose(answers[1:-1, 1:-1], slopes(picture)[1:-1, 1:-1], atol=1e-6)
    np.testing.assert_array_equal(mean_answer(slopes, picture, 1), slopes(picture))


def test_the_mean_does_not_depend_on_how_a_picture_lies():
    network = read_weights(SHIPPED).ensemble
    picture = np.random.default_rng(1).normal(size=(96, 96)).astype(np.float32)
    transposed = mean_answer(network, np.ascontiguousarray(picture.T), ALL_ORIENTATIONS).transpose(1, 0, 2)
    answers = mean_answer(network, picture, ALL_ORIENTATIONS)
    np.testing.assert_allclose(transposed[..., 0], answers[..., 0], atol=1e-3)
    np.testing.assert_allclose(transposed[..., OFFSET_U], answers[..., OFFSET_V], atol=1e-3)


def test_what_one_orientation_sees_counts_for_an_eighth():
    def sees_one(picture):
        answers = np.zeros((*picture[::CELL_PX, ::CELL_PX].shape, len(HEADS)), np.float32)
        answers[..., 0] = 8.0 * np.array_equal(picture, asked)
        return answers

    asked = np.random.default_rng(2).normal(size=(16, 24)).astype(np.float32)
    np.testing.assert_allclose(mean_answer(sees_one, asked, ALL_ORIENTATIONS)[..., 0], 1.0)
    np.testing.assert_allclose(mean_answer(sees_one, asked, 2)[..., 0], 4.0)
