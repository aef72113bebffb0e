"""What a pool child does before its first stage."""

from __future__ import annotations

import pytest
from structlog.testing import capture_logs

from fluoromap.registry import Plugin
from fluoromap_workers import pool_child


class Prepared:
    called = 0

    @classmethod
    def warm_up(cls) -> None:
        cls.called += 1


class Broken:
    @classmethod
    def warm_up(cls) -> None:
        raise RuntimeError("no compiler")


def test_plugins_prepare_themselves_and_one_that_cannot_stops_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    stages = {"segmenter": Broken, "triangulator": object, "monoplane": Prepared, "fuser": Prepared}
    rows = {kind: Plugin(kind, kind, "1", None, stage, None) for kind, stage in stages.items()}  # type: ignore[arg-type]
    monkeypatch.setattr(pool_child, "DEFAULTS", {kind: kind for kind in stages})
    monkeypatch.setattr(pool_child, "plugins", lambda: tuple(rows.values()))
    monkeypatch.setattr(pool_child, "plugin", lambda kind, name: rows[kind])
    with capture_logs() as logs:
        pool_child.warm_up()
    assert Prepared.called == 2
    assert [(entry["event"], entry["plugin"]) for entry in logs] == [("plugin_not_warm", "segmenter")]
