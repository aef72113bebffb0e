"""The commands ``fluoromap deliveries`` and ``fluoromap sender``."""

from __future__ import annotations

from pathlib import Path

import pytest
from delivery_peers import TARGETS
from finished_study import make_study
from program import Program, one_sentence
from typer.testing import CliRunner

from fluoromap_service.cli.commands import deliveries
from fluoromap_service.deliveries import outbox
from fluoromap_service.deliveries.outbox import Failure
from fluoromap_service.store import schema
from fluoromap_service.store.engine import writing


def test_list_show_retry_and_send(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "check", lambda: None)
    monkeypatch.setenv("COLUMNS", "80")
    with writing() as session:
        outbox.register(session, TARGETS)
    study = make_study()
    study.finish()
    with writing() as session:
        outbox.plan(session, "pacs", ["succeeded"])
        held = outbox.claim(session, "pacs", "tester")
        assert held is not None
        outbox.begin_objects(session, held, {"1.2.3": "report.dcm"})
        outbox.fail(session, held, Failure("unreachable", "No answer."), wait_seconds=None, give_up_days=7)

    def run(*arguments: str) -> str:
        answer = CliRunner().invoke(deliveries.app, arguments, catch_exceptions=False)
        assert answer.exit_code == 0, answer.output
        return answer.output

    listed = run("list", "--state", "failed")
    assert all(text in listed for text in (held.delivery_id, "pacs", study.job_id, "unreachable"))
    assert held.delivery_id not in run("list", "--target", "archive")
    shown = run("show", held.delivery_id)
    assert shown.splitlines()[:2] == [f"failed: job {study.job_id} to pacs", "  report.dcm  pending"]
    assert "unreachable: No answer." in shown
    run("retry", held.delivery_id)
    assert "pending" in run("show", held.delivery_id)
    sent = run("send", study.job_id, "archive").strip()
    assert sent in run("list", "--state", "pending", "--target", "archive")


def test_sender_needs_targets(fluoromap: Program, tmp_path: Path) -> None:
    assert "[targets.NAME]" in one_sentence(fluoromap("sender"))
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("[targets.pacs]\nkind = 'ftp'\n")
    for command in ("sender", "up", "api"):
        fluoromap("db", "upgrade")
        answer = fluoromap(command, FLUOROMAP_CONFIG=str(wrong))
        assert "wrong.toml cannot be used (targets.pacs" in one_sentence(answer)
