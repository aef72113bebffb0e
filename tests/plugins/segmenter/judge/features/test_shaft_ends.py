"""The end that the shaft leaves, on drawn lines."""

import numpy as np
import pytest

from fluoromap.catheters import catheter_type
from fluoromap.segmenter.judge.features.shaft_ends import shaft_beyond_ends, shafts_at_ends
from fluoromap.segmenter.picture.shaft_image import ShaftImage

PX = 3.2
ABLATION = catheter_type("ablation-4", "ablation")


def drawn(path, depth=0.2, size=200):
    """Draw a dark line along a path (n, 2) into a bright log image."""
    v, u = np.mgrid[:size, :size].astype(np.float64)
    away = np.min([np.hypot(u - x, v - y) for x, y in path], axis=0)
    return (6.0 - depth * (away < 0.9 * PX)).astype(np.float32)


def row_and_shaft(turn_rad):
    """Return electrodes along +u, and a shaft's path that turns behind them."""
    row = np.array([60.0, 100.0]) + np.outer(ABLATION.arc_lengths_mm * PX, [1.0, 0.0])
    behind = row[-1] + np.outer(np.arange(0.0, 40.0), [np.cos(turn_rad), np.sin(turn_rad)])
    return row, np.concatenate([np.linspace(row[0], row[-1], 60), behind])


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, -20.0])
@pytest.mark.parametrize("reduction", [1, 2])
def test_the_shaft_leaves_behind_the_last_electrode(turn_deg, reduction):
    row, path = row_and_shaft(np.deg2rad(turn_deg))
    image = drawn(path)
    if reduction == 2:
        image = image.reshape(100, 2, 100, 2).mean(axis=(1, 3))
    shaft = ShaftImage(image, reduction, 0.1, PX)
    forth, back = shaft_beyond_ends(np.stack([row, row[::-1]]), ABLATION, shaft)
    assert forth > 0.8
    assert back < -0.4


def test_a_line_past_both_ends_says_nothing():
    row, path = row_and_shaft(0.0)
    before = row[0] + np.outer(np.arange(0.0, 50.0), [-1.0, 0.0])
    shaft = ShaftImage(drawn(np.concatenate([path, before])), 1, 0.1, PX)
    assert np.abs(shaft_beyond_ends(row[None], ABLATION, shaft)) < 0.1


def test_outside_the_image_there_is_no_shaft():
    row, _ = row_and_shaft(0.0)
    shaft = ShaftImage(np.full((200, 200), 6.0, np.float32), 1, 0.1, PX)
    assert np.all(shaft_beyond_ends((row + np.array([120.0, 0.0]))[None], ABLATION, shaft) == 0.0)


@pytest.mark.parametrize("turn_deg", [0.0, 12.0, -12.0])
def test_a_mean_shows_the_shaft_at_one_end_of_a_path(turn_deg):
    row, path = row_and_shaft(np.deg2rad(turn_deg))
    shaft = ShaftImage(drawn(path, depth=0.04), 1, 0.03, PX)
    before, behind = shafts_at_ends(row, shaft)
    assert behind > 0.8
    assert before < 0.2
    assert shafts_at_ends(row[::-1], shaft).tolist() == [behind, before]
    assert shafts_at_ends(row + np.array([120.0, 0.0]), shaft)[1] == 0.0


@pytest.mark.parametrize("turn_deg", [0.0, -20.0, -40.0])
def test_the_shaft_of_a_loop_may_leave_it_aside_and_the_loop_itself_is_none(turn_deg):
    loop = catheter_type("circular-10", "loop")
    angles = loop.angles_on_loop_rad
    around = np.linspace(0.0, angles[-1], 200)
    radius = PX / loop.curvature_per_mm
    electrodes, path = (100.0 + radius * np.stack([np.cos(a), np.sin(a)], axis=1) for a in (angles, around))
    heading = angles[-1] + np.pi / 2 + np.deg2rad(turn_deg)
    behind = electrodes[-1] + np.outer(np.arange(0.0, 40.0), [np.cos(heading), np.sin(heading)])
    shaft = ShaftImage(drawn(np.concatenate([path, behind])), 1, 0.1, PX)
    forth, back = shaft_beyond_ends(np.stack([electrodes, electrodes[::-1]]), loop, shaft)
    assert forth > 0.5
    assert back == pytest.approx(-forth)
