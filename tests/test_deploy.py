"""The files under ``deploy/``: the Kubernetes manifests fit to the schema of its API and to the program."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from fluoromap_service.settings import Settings

TOP = Path(__file__).parent.parent
FOLDER = TOP / "deploy" / "kubernetes"
SCHEMA: dict[str, Any] = json.loads((TOP / "tests" / "kubernetes_schema.json").read_text())
GROUPS = {
    "apps/v1": "io.k8s.api.apps.v1",
    "batch/v1": "io.k8s.api.batch.v1",
    "v1": "io.k8s.api.core.v1",
    "networking.k8s.io/v1": "io.k8s.api.networking.v1",
}
CUSTOMIZATION: dict[str, Any] = yaml.safe_load((FOLDER / "kustomization.yaml").read_text())
OBJECTS: list[dict[str, Any]] = [
    each for name in CUSTOMIZATION["resources"] for each in yaml.safe_load_all((FOLDER / name).read_text())
]
PODS: dict[str, dict[str, Any]] = {
    each["metadata"]["name"]: each["spec"]["template"]["spec"] for each in OBJECTS if "template" in each.get("spec", {})
}


def _validate(kind: dict[str, Any]) -> None:
    reference = f"#/$defs/{GROUPS[kind['apiVersion']]}.{kind['kind']}"
    jsonschema.Draft202012Validator({"$ref": reference, "$defs": SCHEMA["$defs"]}).validate(kind)


@pytest.mark.parametrize("kind", OBJECTS, ids=lambda each: f"{each['kind']}-{each['metadata']['name']}")
def test_manifests_fit_to_the_schema(kind: dict[str, Any]) -> None:
    _validate(kind)


def test_a_wrong_manifest_would_be_noticed() -> None:
    api = next(each for each in OBJECTS if each["kind"] == "Deployment")
    wrong = json.loads(json.dumps(api))
    wrong["spec"]["template"]["spec"]["containers"][0]["memory"] = "1Gi"
    with pytest.raises(jsonschema.ValidationError):
        _validate(wrong)


def test_every_manifest_is_applied() -> None:
    assert {path.name for path in FOLDER.glob("*.yaml")} == {*CUSTOMIZATION["resources"], "kustomization.yaml"}


def test_the_page_applies_the_customization() -> None:
    """With ``--filename`` the image of ``kustomization.yaml`` does not count, and the API refuses that file itself."""
    commands = re.findall(r"kubectl apply [^`\n]+", (FOLDER / "README.md").read_text())
    assert commands == ["kubectl apply --kustomize deploy/kubernetes/"]


def _containers() -> list[tuple[str, dict[str, Any]]]:
    return [
        (pod, container)
        for pod, spec in PODS.items()
        for container in [*spec.get("initContainers", []), *spec["containers"]]
    ]


def test_containers_are_closed_and_limited() -> None:
    assert len(_containers()) == 4
    for _, container in _containers():
        security = container["securityContext"]
        assert security["readOnlyRootFilesystem"] is True
        assert security["allowPrivilegeEscalation"] is False
        assert security["capabilities"] == {"drop": ["ALL"]}
        assert container["resources"]["limits"]["memory"]
        for variable in container["env"]:
            assert variable["name"].removeprefix("FLUOROMAP_").lower() in Settings.model_fields
    for spec in PODS.values():
        assert spec["securityContext"]["runAsNonRoot"] is True
        assert spec["automountServiceAccountToken"] is False
        volumes = {volume["name"] for volume in spec["volumes"]}
        for container in [*spec.get("initContainers", []), *spec["containers"]]:
            assert {mount["name"] for mount in container["volumeMounts"]} <= volumes


@pytest.mark.parametrize(("pod", "container"), _containers(), ids=lambda value: value if isinstance(value, str) else "")
def test_commands_are_the_programs(pod: str, container: dict[str, Any]) -> None:
    from test_house import _parse

    _parse(container["args"])


def test_a_worker_is_alive_as_in_docker_compose() -> None:
    compose = yaml.safe_load((TOP / "docker-compose.yml").read_text())["services"]["worker"]["healthcheck"]["test"]
    (container,) = PODS["worker"]["containers"]
    assert ["CMD", *container["livenessProbe"]["exec"]["command"]] == compose


def test_a_worker_s_stages_fit_into_its_container() -> None:
    (container,) = PODS["worker"]["containers"]
    stages = next(int(each["value"]) for each in container["env"] if each["name"] == "FLUOROMAP_WORKERS")
    assert stages == int(container["resources"]["requests"]["cpu"])
    limit_mib = 1024 * int(container["resources"]["limits"]["memory"].removesuffix("Gi"))
    assert stages * Settings.model_fields["worker_memory_mib"].default <= limit_mib


def test_proxy_file_follows_the_specification() -> None:
    checker = Path(sys.executable).parent / "check-jsonschema"
    file = TOP / "deploy" / "proxy" / "docker-compose.yml"
    subprocess.run([checker, "--builtin-schema", "vendor.compose-spec", file], check=True, capture_output=True)


def test_every_container_has_limits_and_a_bounded_log() -> None:
    for file in (TOP / "docker-compose.yml", TOP / "deploy" / "proxy" / "docker-compose.yml"):
        for name, service in yaml.safe_load(file.read_text())["services"].items():
            assert service["mem_limit"], name
            assert service["logging"]["options"]["max-size"], name
            assert "no-new-privileges:true" in service["security_opt"], name
            assert "build" in service or re.search(r":\d\S*@sha256:[0-9a-f]{64}$", service["image"]), name
