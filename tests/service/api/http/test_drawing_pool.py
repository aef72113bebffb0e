"""The drawing processes: one bad frame harms nobody else."""

from __future__ import annotations

import os
import time

import pytest

from fluoromap_service.api.http import drawing_pool
from fluoromap_service.api.http.problems import Problem
from fluoromap_service.dicom import DicomCode, dicom_problem


def _double(number: int) -> int:
    return 2 * number


def _die() -> None:
    os._exit(1)


def _refuse() -> None:
    raise dicom_problem(DicomCode.UNDECODABLE, "This frame is broken.", "PixelData")


def _hang() -> None:
    time.sleep(600)


@pytest.fixture(scope="module", autouse=True)
def _processes(drawing_processes: None) -> None:
    assert drawing_pool.drawn(_double, 2) == 4


def test_a_frame_that_kills_its_process_is_refused_and_the_next_one_drawn() -> None:
    with pytest.raises(Problem) as refused:
        drawing_pool.drawn(_die)
    assert (refused.value.status, refused.value.code) == (422, "undecodable")
    assert drawing_pool.drawn(_double, 21) == 42


def test_a_files_own_refusal_passes() -> None:
    with pytest.raises(Problem) as refused:
        drawing_pool.drawn(_refuse)
    assert (refused.value.status, refused.value.errors[0][0]) == (422, "PixelData")


def test_a_frame_that_hangs_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing_pool, "LONGEST_SECONDS", 0.2)
    with pytest.raises(Problem) as refused:
        drawing_pool.drawn(_hang)
    assert refused.value.code == "undecodable"
    monkeypatch.undo()
    assert drawing_pool.drawn(_double, 1) == 2
