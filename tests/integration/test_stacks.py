"""The whole flow through command line and HTTP alone, on both stacks: embedded, and PostgreSQL with Redis.

A study runs undisturbed on the embedded stack, then on each stack from nothing with a worker that is killed in the middle. The
results must be equal.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from processes import Fresh, Kill, client_of, embedded, environment_of, wait_until_ready, with_servers

from fluoromap_service.cli.client import Client
from fluoromap_service.cli.submission import find_files
from fluoromap_service.cli.supervisor import free_port

pytestmark = pytest.mark.timeout(900)

QUICK = {"pipeline": {"segmenter": {"name": "catheter-chain"}}}
"""What a killed worker leaves does not depend on the segmenter."""


def _run_job(client: Client, folder: Path, kill: Kill | None) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Send the study, run a job and kill the worker meanwhile.

    Return the ended job and its points.
    """
    with client:
        study = client.make_study("stack")
        inputs = find_files(folder)
        assert not any(client.upload(study, path).objections for path in inputs.runs)
        assert inputs.activation_times is not None
        assert client.put_activation_times(study, inputs.activation_times) == []
        job: dict[str, Any] = {}
        for job in client.follow(client.start_job(study, QUICK)):
            done = any(row["state"] == "done" for row in job["stages"])
            if kill is not None and done and _running(job):
                kill()
                # A worker can die between two stages. Only a stage that stays "running" was really interrupted.
                if _running(next(client.follow(job["id"]))):
                    kill = None
        assert kill is None, "the job ended before the worker could be killed"
        return job, client.points(job["id"])


def _running(job: dict[str, Any]) -> bool:
    return any(row["state"] == "running" for row in job["stages"])


def _without_chance(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(points, key=lambda point: (point["site"], point["catheter"], point["electrode"]))


def test_a_killed_worker_changes_nothing(
    simulated_study: Path, tmp_path: Path, fresh_postgres: Fresh, fresh_redis: Fresh
) -> None:
    results = {}
    for stack, disturbed in (("embedded", False), ("embedded", True), ("servers", True)):
        data_dir = tmp_path / f"{stack}-{disturbed}"
        with ExitStack() as opened:
            # The short lease makes the test fast, but on a busy machine it can expire while the worker is alive.
            settings = {} if disturbed else {"FLUOROMAP_LEASE_SECONDS": "60"}
            if stack == "servers":
                settings["FLUOROMAP_DATABASE_URL"] = opened.enter_context(fresh_postgres())
                settings["FLUOROMAP_BROKER_URL"] = opened.enter_context(fresh_redis())
            environment = environment_of(data_dir, **settings)
            port = free_port()
            start = embedded if stack == "embedded" else with_servers
            kill = opened.enter_context(start(environment, port))
            url = f"http://127.0.0.1:{port}"
            wait_until_ready(url, data_dir)
            results[stack, disturbed] = _run_job(
                client_of(environment, port), simulated_study, kill if disturbed else None
            )
    undisturbed, points = results.pop(("embedded", False))
    assert undisturbed["state"] == "succeeded"
    assert max(row["attempt"] for row in undisturbed["stages"]) == 1
    assert any(point["x_mm"] is not None for point in points)
    for job, points_again in results.values():
        assert job["state"] == "succeeded"
        assert max(row["attempt"] for row in job["stages"]) > 1
        assert _without_chance(points_again) == _without_chance(points)
