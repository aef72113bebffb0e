"""Synthetic scenes: the same from the same seed, labels on what is dark, distractors without labels."""

import numpy as np
import pytest
from PIL import Image

from fluoromap.catheters import catheter_type
from fluoromap.training.anatomy import read_backgrounds
from fluoromap.training.distractors import draw_distractors
from fluoromap.training.drawing import Canvas
from fluoromap.training.drawn_catheters import design_of, draw_catheter, random_design
from fluoromap.training.scenes import CLEAR, make_scene
from fluoromap.training.targets import Prepared, training_pair


def test_a_seed_gives_one_scene():
    one, again, other = (make_scene(np.random.default_rng(seed), 96) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one.pixels, again.pixels)
    np.testing.assert_array_equal(one.electrodes_uv, again.electrodes_uv)
    assert (one.pixels != other.pixels).any()


def test_labels_lie_on_drawn_electrodes():
    for seed in range(12):
        random = np.random.default_rng(seed)
        canvas = Canvas.empty(160)
        labels = draw_catheter(random, canvas, 3.2, random_design(random), (0.2, 2.3))
        for u, v in np.rint(labels[:, :2]).astype(int):
            if 2 <= u < 158 and 2 <= v < 158:
                assert canvas.depth[v - 1 : v + 2, u - 1 : u + 2].max() > 0.03


def test_distractors_darken_scenes_and_have_no_labels():
    canvas = Canvas.empty(160)
    for seed in range(4):
        assert draw_distractors(np.random.default_rng(seed), canvas, 3.2) is None
    assert canvas.depth.max() > 0.1


def test_a_lab_s_catheter_has_its_own_spacings():
    deca = catheter_type("decapolar-2-5-2", "cs")
    np.testing.assert_allclose(np.diff(design_of(deca).centres_mm), deca.spacing_mm)
    labels = draw_catheter(np.random.default_rng(0), Canvas.empty(200), 3.0, design_of(deca), (0.2, 2.3))
    seen = np.linalg.norm(np.diff(labels[:, :2], axis=0), axis=1) / 3.0
    assert (seen <= np.asarray(deca.spacing_mm) * 1.02).all()


def test_a_lab_s_frames_are_read_and_an_empty_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=tmp_path.name):
        read_backgrounds(tmp_path)
    Image.fromarray(np.full((80, 90), 200, np.uint8)).save(tmp_path / "frame.png")
    (frame,) = read_backgrounds(tmp_path)
    assert frame.shape == (80, 90)
    assert make_scene(np.random.default_rng(0), 96, backgrounds=(frame,)).pixels.shape == (96, 96)


def test_targets_stand_where_the_electrodes_are():
    for seed in range(20):
        scene = make_scene(np.random.default_rng([3, seed]), 160)
        picture, target = training_pair(np.random.default_rng(0), Prepared.of_scene(scene))
        assert picture.shape == (160, 160)
        inside = ((scene.electrodes_uv > 8) & (scene.electrodes_uv < 150)).all(axis=1) & (scene.clearness >= CLEAR)
        apart = {tuple(place) for place in np.rint(scene.electrodes_uv[inside] / 4).tolist()}
        assert np.count_nonzero(target[0] == 1.0) >= len(apart) // 2
        assert (np.abs(target[1:3]) <= 1.5).all()
