"""Drawn cines: the truth moves with what is drawn, and coders do what is said of them."""

import math

import numpy as np
import pytest

from fluoromap.training.cines import CineConditions, _electrodes, _Layer, _placed, as_video, draw_cine


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_an_electrode_is_where_its_layer_is_drawn(angle: float) -> None:
    """The centre of a spot that a layer draws is the electrode's place in each frame."""
    v, u = np.mgrid[:96, :96]
    spot = np.exp(-((u - 60.0) ** 2 + (v - 30.0) ** 2) / 8.0).astype(np.float32)
    turned = 1.1 * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    moves = [(np.eye(2), np.zeros(2)), (turned, np.array([7.0, -3.0]))]
    layer = _Layer(spot, np.array([[60.0, 30.0]]), "a", moves)
    places = _electrodes(layer, 2)
    for frame in range(2):
        drawn = _placed(layer, frame, 0.5)
        centre = np.array([(drawn * u).sum(), (drawn * v).sum()]) / drawn.sum()
        np.testing.assert_allclose(centre, places[frame, 0], atol=0.15)


def test_a_cine_depends_on_its_seed_alone() -> None:
    conditions = CineConditions(("quadripolar-2-5-2", "ablation-4"), size=128, frames=3, storage="jpeg")
    one, again, other = (draw_cine(np.random.default_rng(seed), conditions) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.pixels, again.pixels)
    assert (one.pixels != other.pixels).any()


def test_catheters_beyond_the_list_have_no_name() -> None:
    conditions = CineConditions(
        ("decapolar-2-5-2", "quadripolar-2-5-2"),
        listed=("quadripolar-2-5-2", "ablation-4"),
        leads=1,
        size=128,
        frames=2,
    )
    cine = draw_cine(np.random.default_rng(3), conditions)
    assert list(cine.truth) == ["quadripolar-2-5-2 0"]
    assert [uv.shape[1] for uv in cine.unlisted if uv.shape[1] > 2] == [10]
    assert cine.catalogue.mapping == "ablation-4 1"


def test_the_longest_way_between_frames_is_the_one_that_was_asked_for() -> None:
    conditions = CineConditions(("ablation-4",), size=128, frames=4, step_px=(30.0, 30.0))
    longest = []
    for seed in range(6):
        cine = draw_cine(np.random.default_rng(seed), conditions)
        (places,) = cine.truth.values()
        longest.append(float(np.linalg.norm(np.diff(places.mean(axis=1), axis=0), axis=1).max()))
    # Turning and stretching about the picture's centre add some pixels; a catheter at rest hardly moves.
    assert sum(20.0 < way < 45.0 for way in longest) >= 4


def test_fine_coding_keeps_frames_and_coarse_coding_repeats_noise() -> None:
    random = np.random.default_rng(5)
    frames = (128 + random.normal(0.0, 2.0, (3, 32, 32))).astype(np.uint8)
    fine, coarse = as_video(frames, 0.5), as_video(frames, 24.0)
    assert np.abs(fine.astype(int) - frames).max() <= 1
    np.testing.assert_array_equal(coarse[1], coarse[2])
