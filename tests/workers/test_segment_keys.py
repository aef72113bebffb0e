"""The keys of the stage ``segment``, which a process remembers for the runs that did not change."""

from __future__ import annotations

from typing import Any

import pytest
from finished_study import make_study

from fluoromap_service.store.engine import reading
from fluoromap_service.store.models import Job
from fluoromap_service.study.snapshot import CorrectedElectrode, Snapshot
from fluoromap_workers import stage_inputs


def test_a_remembered_key_is_the_key_of_the_same_inputs_only(data_dir: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    study = make_study()
    with reading() as session:
        first = Snapshot.model_validate(session.get_one(Job, study.job_id).snapshot)
    uid, run = next(iter(first.runs.items()))
    mark = CorrectedElectrode(catheter="mapping", electrode=1, u_px=10.0, v_px=20.0, sd_px=0.6)
    others = [
        (first.model_copy(update={"segmenter": first.segmenter.model_copy(update={"params": {"limit": 2}})}), run),
        (first.model_copy(update={"segmenter": first.segmenter.model_copy(update={"version": "2"})}), run),
        (first.model_copy(update={"mapping": "reference", "reference": "mapping"}), run),
        (first, run.model_copy(update={"corrections": {1: (mark,)}})),
        (first, run.model_copy(update={"gantry": run.gantry.model_copy(update={"source_detector_mm": 990.0})})),
        (first, run.model_copy(update={"facts": run.facts | {"r_wave_frames": [1]}})),
        (first, run.model_copy(update={"sha256": "0" * 64})),
    ]
    keys = stage_inputs._SegmentKeys()
    own = keys.of(first, run, first.catalogue)
    found = [keys.of(snapshot, changed, snapshot.catalogue) for snapshot, changed in others]
    assert len({own, *found}) == 1 + len(others)
    fresh = stage_inputs._SegmentKeys()
    assert [fresh.of(snapshot, changed, snapshot.catalogue) for snapshot, changed in others] == found
    assert keys.of(first, run, first.catalogue) == own

    def never(*_: object) -> str:
        raise AssertionError("computed again")

    monkeypatch.setattr(stage_inputs, "_key", never)
    again = Snapshot.model_validate(first.model_dump(mode="json"))
    assert keys.of(again, again.runs[uid], again.catalogue) == own
