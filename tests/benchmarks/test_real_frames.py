"""What the benchmark of real frames reads from a folder of labels."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import real_frames
from changed_copies import changed_copy
from PIL import Image
from scipy.ndimage import gaussian_filter

from fluoromap.contracts import Chain

LABELS = "file,catheter,electrode,u_px,v_px\n"


def read(folder: Path) -> list[real_frames.LabelledRun]:
    given = argparse.Namespace(folder=folder, frames=1000, px_per_mm=None, catheter=[])
    return real_frames.labelled_runs(given)


def write(folder: Path, name: str, pictures: int, rows: str) -> None:
    for number in range(pictures):
        Image.fromarray(np.full((40, 50), 128, np.uint8)).save(folder / f"{name}_{number}.png")
    (folder / f"{name}_labels.csv").write_text(LABELS + rows)
    facts = {"px_per_mm": 4.0, "catheters": [{"name": "cs", "type": "decapolar-2-5-2"}]}
    (folder / f"{name}_set.json").write_text(json.dumps(facts))


def test_a_set_may_list_one_catheter(tmp_path: Path) -> None:
    write(tmp_path, "a", 2, "a_0.png,cs,1,10.0,20.0\na_1.png,cs,1,11.0,20.0\n")
    (one,) = read(tmp_path)
    assert one.catalogue.names == ("cs",)
    assert one.catalogue.reference is None
    assert [list(labels) for labels in one.labels] == [["cs"], ["cs"]]


def test_labels_without_rows_are_of_pictures_without_electrodes(tmp_path: Path) -> None:
    write(tmp_path, "a", 3, "")
    write(tmp_path, "b", 1, "b_0.png,cs,1,10.0,20.0\n")
    empty, other = read(tmp_path)
    assert len(empty.run.frames) == 3
    assert empty.labels == [{}, {}, {}]
    assert len(other.run.frames) == 1


def test_a_name_counts_where_it_is_the_most_probable_or_as_probable() -> None:
    places = np.array([[10.0, 20.0], [20.0, 20.0]])

    def named(kinds: dict[str, float]) -> int:
        chain = Chain((1, 2), places, np.tile(np.eye(2), (2, 1, 1)), np.ones(2), tuple(kinds.items()))
        labels = {"his": {1: places[0], 2: places[1]}}
        return int(real_frames.score((chain,), labels)[3])

    assert named({"his": 0.9, "rv": 0.1}) == 2
    assert named({"his": 0.5, "rv": 0.5}) == 2
    assert named({"his": 0.1, "rv": 0.9}) == 0


def test_the_labels_of_a_changed_copy_lie_where_its_electrodes_are() -> None:
    """A dark spot stays under its label; a copy is as the seed says."""
    frame = np.full((60, 80), 200, np.uint8)
    frame[18:23, 48:53] = 20
    for seed in range(8):
        copies = [
            changed_copy(np.random.default_rng(seed), [frame], [{"cs": {1: np.array([50.0, 20.0])}}]) for _ in range(2)
        ]
        (copied, labels, size), (again, _, _) = copies
        place = labels[0]["cs"][1]
        blurred = gaussian_filter(copied[0].astype(np.float64), 2.0 * size)
        v, u = np.unravel_index(np.argmin(blurred), blurred.shape)
        assert np.hypot(u - place[0], v - place[1]) <= 2.0
        assert np.array_equal(copied[0], again[0])
