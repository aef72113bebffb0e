"""The house around the code: containers, settings page, entry points and scripts hold what they promise."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from fluoromap.reasons import Reason
from fluoromap_service.cli.app import program
from fluoromap_service.jobs.queue import DRAIN_SECONDS
from fluoromap_service.settings import Settings

TOP = Path(__file__).parent.parent
COMPOSE: dict[str, Any] = yaml.safe_load((TOP / "docker-compose.yml").read_text())
SERVICES: dict[str, Any] = COMPOSE["services"]
OWN = [name for name, service in SERVICES.items() if "build" in service]
PROJECT: dict[str, Any] = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]


def _parse(arguments: list[str]) -> None:
    """Parse the arguments as the program does.

    The command does not run. A wrong argument raises.
    """
    command = program
    context = command.make_context("fluoromap", list(arguments))
    while hasattr(command, "resolve_command"):
        rest = [*context._protected_args, *context.args]
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)


def test_compose_file_follows_the_specification() -> None:
    checker = Path(sys.executable).parent / "check-jsonschema"
    subprocess.run(
        [checker, "--builtin-schema", "vendor.compose-spec", TOP / "docker-compose.yml"],
        check=True,
        capture_output=True,
    )


def test_compose_refers_only_to_what_exists() -> None:
    volumes, secrets = set(COMPOSE["volumes"]), set(COMPOSE["secrets"])
    for service in SERVICES.values():
        for other, wanted in service.get("depends_on", {}).items():
            if wanted["condition"] == "service_healthy":
                assert "healthcheck" in SERVICES[other]
            else:
                assert wanted["condition"] == "service_completed_successfully"
                assert SERVICES[other]["restart"] == "on-failure"
        assert {volume.split(":")[0] for volume in service.get("volumes", [])} <= volumes
        assert set(service.get("secrets", [])) <= secrets
        for name in service.get("environment", {}):
            if name.startswith("FLUOROMAP_"):
                assert name.removeprefix("FLUOROMAP_").lower() in Settings.model_fields
    assert {volume.split(":")[0] for service in SERVICES.values() for volume in service.get("volumes", [])} == volumes


@pytest.mark.parametrize("name", OWN)
def test_compose_commands_are_the_programs(name: str) -> None:
    _parse(SERVICES[name]["command"])


def test_wrong_commands_would_be_noticed() -> None:
    for wrong in (["serve"], ["db", "downgrade"], ["api", "--porto", "1"], ["token", "create", "--name", "n"]):
        with pytest.raises(Exception, match=r"(?i)no such|missing"):
            _parse(wrong)


def test_images_are_pinned_and_ports_stay_on_this_machine() -> None:
    for service in SERVICES.values():
        assert re.search(r":\d", service["image"]), service["image"]
        for port in service.get("ports", []):
            assert port.startswith("127.0.0.1:")
    for line in (TOP / "Dockerfile").read_text().splitlines():
        if line.startswith("FROM"):
            assert re.search(r":\d\S*@sha256:[0-9a-f]{64}\b", line)


def test_long_running_services_are_watched_and_may_end_their_work() -> None:
    for name in ("postgres", "redis", "api", "worker"):
        assert "healthcheck" in SERVICES[name]
        assert SERVICES[name]["restart"] == "unless-stopped"
    assert int(SERVICES["worker"]["stop_grace_period"].removesuffix("s")) > DRAIN_SECONDS
    program, *arguments = SERVICES["worker"]["healthcheck"]["test"][1:]
    assert program == "fluoromap"
    _parse(arguments)


def test_image_does_not_run_as_root_and_starts_a_command() -> None:
    lines = (TOP / "Dockerfile").read_text().splitlines()
    last_stage = lines[[number for number, line in enumerate(lines) if line.startswith("FROM")][-1] :]
    assert [line for line in last_stage if line.startswith("USER")] == ["USER fluoromap"]
    assert 'ENTRYPOINT ["fluoromap"]' in last_stage
    command = next(line for line in last_stage if line.startswith("CMD"))
    _parse(yaml.safe_load(command.removeprefix("CMD ")))


def test_everything_the_image_copies_exists_and_is_sent_to_the_builder() -> None:
    allowed = {line.removeprefix("!") for line in (TOP / ".dockerignore").read_text().splitlines() if line[:1] == "!"}
    for line in (TOP / "Dockerfile").read_text().splitlines():
        if line.startswith("COPY") and "--from" not in line:
            for source in line.split()[1:-1]:
                assert (TOP / source).exists()
                assert source in allowed


def test_settings_page_shows_every_setting_and_no_other() -> None:
    page = (TOP / "docs" / "settings.md").read_text()
    rows = dict(re.findall(r"^\| `(FLUOROMAP_\w+)` \| .+? \| (.+) \|$", page, flags=re.MULTILINE))
    described = {f"FLUOROMAP_{name.upper()}": field.description for name, field in Settings.model_fields.items()}
    assert rows == described


def test_settings_page_shows_the_defaults() -> None:
    page = (TOP / "docs" / "settings.md").read_text()
    for name, field in Settings.model_fields.items():
        if name in ("data_dir", "workers") or field.default == "":
            continue  # depend on user and machine
        assert f"| `FLUOROMAP_{name.upper()}` | `{field.default}` |" in page


def test_reasons_page_is_complete() -> None:
    page = (TOP / "docs" / "reasons.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", page, flags=re.MULTILINE))
    assert rows == {str(reason): reason.sentence for reason in Reason}


def test_every_entry_point_exists() -> None:
    groups = PROJECT["entry-points"] | {"scripts": PROJECT["scripts"]}
    for group in groups.values():
        for name, target in group.items():
            module, _, attribute = target.partition(":")
            assert hasattr(importlib.import_module(module), attribute), name


@pytest.mark.parametrize(
    "page", sorted(str(path.relative_to(TOP)) for path in [*TOP.glob("*.md"), *TOP.glob("docs/*.md")])
)
def test_links_between_pages_lead_somewhere(page: str) -> None:
    text = (TOP / page).read_text()
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        if "://" not in target:
            assert (TOP / page).parent.joinpath(target).exists(), target


def test_licence_is_whole() -> None:
    text = (TOP / "LICENSE").read_text()
    assert "Apache License" in text
    assert "APPENDIX: How to apply the Apache License to your work." in text


@pytest.mark.parametrize("script", ["run", ".ci/run"])
def test_scripts_are_executable_and_parse(script: str) -> None:
    assert os.access(TOP / script, os.X_OK)
    subprocess.run(["bash", "-n", TOP / script], check=True)


def test_run_prints_its_usage() -> None:
    answer = subprocess.run([TOP / "run"], capture_output=True, text=True)
    assert answer.returncode == 2
    assert "usage: ./run demo" in answer.stderr


def test_run_names_what_to_install_when_python_is_too_old(tmp_path: Path) -> None:
    old = tmp_path / "python3"
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    answer = _run_in_a_copy(tmp_path)
    assert answer.returncode == 1
    assert re.fullmatch(r"run: Python 3\.11 or newer .*install .*\n", answer.stderr)


def test_run_names_what_to_install_when_venv_is_missing(tmp_path: Path) -> None:
    partial = tmp_path / "python3"
    partial.write_text(f'#!/bin/sh\ncase "$2" in *ensurepip*) exit 1 ;; esac\nexec {sys.executable} "$@"\n')
    partial.chmod(0o755)
    answer = _run_in_a_copy(tmp_path)
    assert answer.returncode == 1
    assert re.fullmatch(r"run: python3 .*python3-venv\)\.\n", answer.stderr)


def _run_in_a_copy(tmp_path: Path) -> subprocess.CompletedProcess[str]:
    """Run ``./run demo`` in a folder without an environment.

    PATH has only the tools it needs and a prepared Python.
    """
    copy = tmp_path / "checkout"
    copy.mkdir()
    for name in ("run", "requirements.lock", "pyproject.toml"):
        (copy / name).write_bytes((TOP / name).read_bytes())
    (copy / "run").chmod(0o755)
    for tool in ("bash", "env", "dirname", "grep", "cat", "cksum", "rm"):
        found = next(Path(folder) / tool for folder in ("/usr/bin", "/bin") if (Path(folder) / tool).exists())
        (tmp_path / tool).symlink_to(found)
    return subprocess.run([copy / "run", "demo"], env={"PATH": str(tmp_path)}, capture_output=True, text=True)
