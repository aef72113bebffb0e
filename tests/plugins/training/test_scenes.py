"""Synthetic scenes: the same from the same seed, labels on what is dark, distractors without labels."""

import numpy as np
import pytest
from PIL import Image

from fluoromap.catheters import catheter_type
from fluoromap.training.anatomy import read_backgrounds
from fluoromap.training.contrast_medium import draw_tubing
from fluoromap.training.courses import entering
from fluoromap.training.distractors import draw_distractors
from fluoromap.training.drawing import Canvas
from fluoromap.training.drawn_catheters import LABEL_COLUMNS, design_of, draw_catheters, random_design
from fluoromap.training.printing import printed
from fluoromap.training.randomness import between, random_curve
from fluoromap.training.scenes import CLEAR, CLINICAL_CROWD, make_scene
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
        labels = draw_catheters(random, canvas, 3.2, [random_design(random)], (0.2, 2.3))
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
    labels = draw_catheters(np.random.default_rng(0), Canvas.empty(200), 3.0, [design_of(deca)], (0.2, 2.3))
    seen = np.linalg.norm(np.diff(labels[:, :2], axis=0), axis=1) / 3.0
    assert (seen <= np.asarray(deca.spacing_mm) * 1.02).all()


def test_a_lab_s_frames_are_read_and_an_empty_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=tmp_path.name):
        read_backgrounds(tmp_path)
    Image.fromarray(np.full((80, 90), 200, np.uint8)).save(tmp_path / "frame.png")
    (frame,) = read_backgrounds(tmp_path)
    assert frame.shape == (80, 90)
    assert make_scene(np.random.default_rng(0), 96, backgrounds=(frame,)).pixels.shape == (96, 96)


def test_a_course_leaves_the_scene_from_any_heading():
    for seed in range(40):
        random = np.random.default_rng(seed)
        curve = random_curve(random, between(random, 20.0, 120.0), 0.5, 1.8)
        course = entering(random, 60.0, curve, 40.0)
        end = course.points_mm[-1]
        assert ((end < 0.0) | (end > 60.0)).any()
        assert np.abs(np.diff(course.heading)).max() < 0.2
        seen = np.linalg.norm(np.diff(course.points_mm, axis=0), axis=1)
        np.testing.assert_allclose(seen, course.shortening[:-1] * course.step_mm)


def test_catheters_beside_each_other_keep_their_own_spacings():
    deca = design_of(catheter_type("decapolar-2-5-2", "cs"))
    for seed in range(20):
        labels = draw_catheters(np.random.default_rng(seed), Canvas.empty(160), 3.0, [deca] * 3, (0.2, 2.3))
        assert labels.shape == (30, LABEL_COLUMNS)
        seen = np.linalg.norm(np.diff(labels[:, :2].reshape(3, 10, 2), axis=1), axis=2) / 3.0
        assert (seen <= np.diff(deca.centres_mm) * 1.02).all()


def test_a_larger_scene_has_its_electrodes_as_densely():
    density = {}
    for size, seeds in ((128, 160), (256, 40)):
        inside = 0
        for seed in range(seeds):
            scene = make_scene(np.random.default_rng([5, seed]), size)
            inside += np.count_nonzero(((scene.electrodes_uv > 0) & (scene.electrodes_uv < size)).all(axis=1))
        density[size] = inside / (seeds * size * size)
    assert 0.67 < density[256] / density[128] < 1.5


def test_a_laboratory_s_scene_has_fewer_catheters():
    counts = [
        sum(len(make_scene(np.random.default_rng([6, seed]), 320, crowd=crowd).electrodes_uv) for seed in range(16))
        for crowd in (1.0, CLINICAL_CROWD)
    ]
    assert 0.5 < counts[1] / counts[0] < 0.9


def test_tubes_are_full_along_a_part_only():
    filled = 0
    for seed in range(20):
        canvas = Canvas.empty(160)
        draw_tubing(np.random.default_rng(seed), canvas, 3.2)
        assert np.isfinite(canvas.depth).all()
        filled += canvas.depth.max() > 0.1
    assert filled > 15


def test_a_long_tip_near_its_ring_may_make_one_bar():
    near, far = design_of(catheter_type("ablation-4", "a")), design_of(catheter_type("quadripolar-5-5-5", "q"))
    assert near.merges_tip
    assert not far.merges_tip
    darkest = []
    for seed in range(40):
        canvas = Canvas.empty(160)
        tip, ring = draw_catheters(np.random.default_rng(seed), canvas, 3.2, [near], (1.5, 1.6))[:2, :2]
        u, v = np.rint(0.45 * tip + 0.55 * ring).astype(int)
        if 0 <= u < 160 and 0 <= v < 160 and np.linalg.norm(tip - ring) > 8.0:
            darkest.append(canvas.depth[v, u] > 0.6)
    assert 0.25 < np.mean(darkest) < 0.95


def test_a_printed_picture_keeps_its_size_and_its_places():
    levels = np.full((120, 120), 200, np.uint8)
    levels[58:63, 38:43] = 20
    for seed in range(20):
        random = np.random.default_rng(seed)
        picture = np.asarray(printed(random, Image.fromarray(levels)))
        assert picture.shape == levels.shape
        assert picture.dtype == np.uint8
        if np.abs(picture[50:70, 30:50].astype(int) - levels[50:70, 30:50]).max() < 120:
            v, u = np.nonzero(picture[50:70, 30:50] < 110)
            np.testing.assert_allclose([u.mean() + 30, v.mean() + 50], [40, 60], atol=0.8)


def test_targets_stand_where_the_electrodes_are():
    for seed in range(20):
        scene = make_scene(np.random.default_rng([3, seed]), 160)
        picture, target = training_pair(np.random.default_rng(0), Prepared.of_scene(scene))
        assert picture.shape == (160, 160)
        inside = ((scene.electrodes_uv > 8) & (scene.electrodes_uv < 150)).all(axis=1) & (scene.clearness >= CLEAR)
        apart = {tuple(place) for place in np.rint(scene.electrodes_uv[inside] / 4).tolist()}
        assert np.count_nonzero(target[0] == 1.0) >= len(apart) // 2
        assert (np.abs(target[1:3]) <= 1.5).all()


def test_a_ring_has_the_same_metal_from_every_side():
    wall = 2.0 * np.pi * 5.0**2 * (1.0 - 0.8**2) * 4.0 / (2.0 * 5.0 * np.sqrt(1.0 - 0.8**2))
    for shortening in (0.95, 0.7, 0.4, 0.2):
        canvas = Canvas.empty(60)
        canvas.ring(np.array([30.3, 29.6]), 0.7, 4.0, 5.0, 1.0, 0.8, shortening)
        assert canvas.depth.sum() == pytest.approx(wall, rel=0.02)


def test_an_obliquely_seen_ring_is_open():
    canvas = Canvas.empty(60)
    canvas.ring(np.array([30.0, 30.0]), 0.0, 2.0, 6.0, 1.0, 0.9, 0.25)
    assert canvas.depth[30, 30] == 0.0
    assert min(canvas.depth[30, 22:28].max(), canvas.depth[30, 33:39].max()) > 0.2
