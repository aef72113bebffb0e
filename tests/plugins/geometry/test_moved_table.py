"""The table of a real C-arm: eight runs of a static phantom, its landmarks marked by hand (``moved_table.json``)."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from fluoromap.geometry import Camera, Gantry, camera_from_gantry

EXTRACT: dict[str, Any] = json.loads((Path(__file__).parent / "moved_table.json").read_text())
RUNS = tuple(EXTRACT["runs"])


def gantry(run: str) -> Gantry:
    values = EXTRACT["runs"][run]
    return Gantry(
        values["PositionerPrimaryAngle"],
        values["PositionerSecondaryAngle"],
        values["DistanceSourceToDetector"],
        values["DistanceSourceToPatient"],
        tuple(EXTRACT["pixel_spacing_mm"]),
        EXTRACT["rows"],
        EXTRACT["columns"],
    )


def table_mm(run: str) -> np.ndarray:
    """Return the table's position (3,) by GE's private block.

    Lateral is +X, vertical +Y, longitudinal +Z.
    """
    values = EXTRACT["runs"][run]
    return np.array([values["(0019,1023)"], values["(0019,1021)"], values["(0019,1022)"]])


def cameras(signs: tuple[float, float, float]) -> dict[str, Camera]:
    """Return the cameras in the frame of the phantom at run 1.

    ``signs`` are those of the table's displacement along X, Y and Z.
    """
    return {
        run: camera_from_gantry(gantry(run)).translated(np.multiply(signs, table_mm(run) - table_mm(RUNS[0])))
        for run in RUNS
    }


def landmark_rms_px(views: dict[str, Camera], runs: Iterable[str] = RUNS) -> float:
    """Return the RMS distance of the landmarks from the projections of their best points, px."""
    squares: list[np.ndarray] = []
    for marks in EXTRACT["landmarks_px"].values():
        marked = {run: np.array(marks[run]) for run in runs if run in marks}
        if len(marked) < 2:
            continue

        def residuals(point: np.ndarray, marked: dict[str, np.ndarray] = marked) -> np.ndarray:
            return np.concatenate([views[run].project(point) - pixel for run, pixel in marked.items()])

        squares.append((least_squares(residuals, np.zeros(3)).fun.reshape(-1, 2) ** 2).sum(axis=1))
    return float(np.sqrt(np.concatenate(squares).mean()))


def test_the_runs_agree_only_with_the_table_s_displacement_in_the_camera() -> None:
    assert landmark_rms_px(cameras((1, 1, 1)), RUNS[:4]) < 2
    assert landmark_rms_px(cameras((1, 1, 1))) == pytest.approx(2.50, abs=0.02)
    assert landmark_rms_px(cameras((0, 0, 0))) == pytest.approx(22.90, abs=0.05)


@pytest.mark.parametrize("signs", [signs for signs in itertools.product((1, -1), repeat=3) if min(signs) < 0])
def test_every_other_sign_of_the_table_is_far_worse(signs: tuple[int, int, int]) -> None:
    assert landmark_rms_px(cameras(signs)) > 40


def test_exchanged_lateral_and_longitudinal_are_far_worse() -> None:
    exchanged = {
        run: camera_from_gantry(gantry(run)).translated((table_mm(run) - table_mm(RUNS[0]))[[2, 1, 0]]) for run in RUNS
    }
    assert landmark_rms_px(exchanged) > 30


def epipolar_px(first: Camera, second: Camera, pixels: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distances (N,) of pixels from their epipolar lines in the second view.

    pixels, others : (N, 2) of the first and of the second view.
    """
    near, far = (first.back_project(pixels, depth) for depth in (600.0, 850.0))
    start, end = second.project(near), second.project(far)
    along = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
    across = others - start
    distances: np.ndarray = np.abs(along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0])
    return distances


@pytest.mark.parametrize(
    ("first", "second", "apart_mm", "still_px", "moved_px"), [("5", "6", 36, 70.4, 3.6), ("7", "8", 39, 39.3, 1.5)]
)
def test_two_runs_with_a_moved_table_become_a_usable_pair(
    first: str, second: str, apart_mm: float, still_px: float, moved_px: float
) -> None:
    assert np.linalg.norm(table_mm(first) - table_mm(second)) == pytest.approx(apart_mm, abs=0.6)
    marks = [each for each in EXTRACT["landmarks_px"].values() if first in each and second in each]
    pixels, others = (np.array([each[run] for each in marks]) for run in (first, second))
    for signs, expected in (((0, 0, 0), still_px), ((1, 1, 1), moved_px)):
        views = cameras(signs)
        apart = epipolar_px(views[first], views[second], pixels, others)
        assert np.sqrt((apart**2).mean()) == pytest.approx(expected, abs=0.1)
