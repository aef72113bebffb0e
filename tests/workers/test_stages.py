"""The table of stages: every stage is whole, and what depends on what is in order."""

from __future__ import annotations

import dataclasses
from typing import get_args

from fluoromap.registry import GROUPS, Kind
from fluoromap_service.jobs.pipeline import PIPELINE, STAGES, StageName, after
from fluoromap_workers import stage_inputs


def test_stages_come_after_those_they_depend_on() -> None:
    known: set[str] = set()
    for stage in PIPELINE:
        assert set(stage.depends_on) <= known
        known.add(stage.name)
    assert known == set(get_args(StageName))


def test_each_kind_of_plugin_computes_one_stage() -> None:
    kinds = [stage.kind for stage in PIPELINE if stage.kind is not None]
    assert sorted(kinds) == sorted(get_args(Kind)) == sorted(GROUPS)


def test_results_are_dataclasses_that_can_be_stored() -> None:
    assert all(dataclasses.is_dataclass(stage.result) for stage in PIPELINE)


def test_what_depends_on_a_stage() -> None:
    assert after("segment") == {"match", "triangulate", "fuse", "monoplane"}
    assert after("triangulate") == {"fuse", "monoplane"}
    assert after("fuse") == after("monoplane") == frozenset()


def test_the_workers_have_one_function_for_each_stage() -> None:
    assert set(stage_inputs._PREPARE) == set(STAGES)
