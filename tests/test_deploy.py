"""The files under ``deploy/``: the Kubernetes manifests fit to the schema of its API and to the program."""

from __future__ import annotations

import ipaddress
import json
import re
import shutil
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
CUSTOMIZATIONS: dict[Path, dict[str, Any]] = {
    folder: yaml.safe_load((folder / "kustomization.yaml").read_text())
    for folder in (FOLDER / "service", FOLDER / "dicom")
}
OBJECTS: list[dict[str, Any]] = [
    each
    for folder, customization in CUSTOMIZATIONS.items()
    for name in customization["resources"]
    if name != "../service"
    for each in yaml.safe_load_all((folder / name).read_text())
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
    for folder, customization in CUSTOMIZATIONS.items():
        files = {path.name for path in folder.glob("*.yaml")}
        assert files == {*customization["resources"], "kustomization.yaml"} - {"../service"}
    assert "../service" in CUSTOMIZATIONS[FOLDER / "dicom"]["resources"]


def test_no_customization_is_a_cycle() -> None:
    """Kustomize refuses a resource that is a folder around the customization itself."""
    for folder, customization in CUSTOMIZATIONS.items():
        for name in customization["resources"]:
            resource = (folder / name).resolve()
            assert resource.exists()
            assert not folder.resolve().is_relative_to(resource)


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is not installed; it builds the customizations")
@pytest.mark.parametrize("folder", CUSTOMIZATIONS, ids=lambda folder: folder.name)
def test_kubectl_builds_the_customization(folder: Path) -> None:
    answer = subprocess.run(["kubectl", "kustomize", folder], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    built = {(each["kind"], each["metadata"]["name"]) for each in yaml.safe_load_all(answer.stdout)}
    expected = {(each["kind"], each["metadata"]["name"]) for each in OBJECTS}
    assert built == expected if folder.name == "dicom" else built < expected


def test_all_parts_have_one_image() -> None:
    tags = {image["newTag"] for customization in CUSTOMIZATIONS.values() for image in customization["images"]}
    images = {container["image"] for _, container in _containers()}
    assert images == {f"fluoromap:{tag}" for tag in tags}
    assert len(tags) == 1


def test_the_page_applies_the_customization() -> None:
    """With ``--filename`` the image of ``kustomization.yaml`` does not count, and the API refuses that file itself."""
    commands = re.findall(r"kubectl apply [^`\n]+", (FOLDER / "README.md").read_text())
    assert commands == [f"kubectl apply --kustomize deploy/kubernetes/{folder}" for folder in ("service/", "dicom/")]


def test_the_page_makes_every_secret() -> None:
    """A pod waits without end for a secret, or for a key of it, that nobody made."""
    page = (FOLDER / "README.md").read_text()
    made = {
        name: set(re.findall(r"--from-(?:literal|file)=([\w.-]+)", keys))
        for name, keys in re.findall(r"create secret generic (\S+) \\\n((?:  --from.*\n)+)", page)
    }
    needed = {(volume["secret"]["secretName"], each["key"]) for volume, each in _secret_files()}
    needed |= {
        (source["name"], source["key"])
        for _, container in _containers()
        for variable in container["env"]
        if (source := variable.get("valueFrom", {}).get("secretKeyRef"))
    }
    assert {name for name, _ in needed} | {"fluoromap-configuration"} == set(made)
    assert [each for each in needed if each[1] not in made[each[0]]] == []
    (sender,) = PODS["sender"]["containers"]
    assert Path(sender["args"][-1]).name in made["fluoromap-configuration"]


def _secret_files() -> list[tuple[dict[str, Any], dict[str, Any]]]:
    return [
        (volume, each)
        for spec in PODS.values()
        for volume in spec["volumes"]
        for each in volume.get("secret", {}).get("items", [])
    ]


def _containers() -> list[tuple[str, dict[str, Any]]]:
    return [
        (pod, container)
        for pod, spec in PODS.items()
        for container in [*spec.get("initContainers", []), *spec["containers"]]
    ]


def test_containers_are_closed_and_limited() -> None:
    assert len(_containers()) == 6
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


def _policies() -> list[dict[str, Any]]:
    return [each["spec"] for each in OBJECTS if each["kind"] == "NetworkPolicy"]


def _rules(pod: str, direction: str) -> list[dict[str, Any]]:
    """Return the rules that let traffic of a direction ("ingress" or "egress") through to or from a pod."""
    template = next(each for each in OBJECTS if each["metadata"]["name"] == pod and "template" in each.get("spec", {}))
    labels = template["spec"]["template"]["metadata"]["labels"]
    return [
        rule
        for policy in _policies()
        if policy["podSelector"].get("matchLabels", {}).items() <= labels.items()
        for rule in policy.get(direction, [])
    ]


def _peers(rules: list[dict[str, Any]], side: str) -> set[tuple[str, int]]:
    """Return the pairs of place and port; a rule without places lets all through."""
    return {
        (place.get("namespaceSelector", {}).get("matchLabels", {}).get("kubernetes.io/metadata.name")
         or place.get("ipBlock", {}).get("cidr", "anywhere"), port["port"])
        for rule in rules
        for place in rule.get(side, [{}])
        for port in rule["ports"]
    }  # fmt: skip


def test_nothing_is_allowed_that_no_policy_names() -> None:
    assert {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]} in _policies()
    for policy in _policies():
        assert all(rule.get("to") and rule.get("ports") for rule in policy.get("egress", []))
        assert all(rule.get("ports") for rule in policy.get("ingress", []))


STORES = {("kube-system", 53), ("databases", 5432), ("databases", 6379)}


@pytest.mark.parametrize(
    ("pod", "into", "out"),
    [
        ("api", {("ingress-nginx", 8000), ("monitoring", 8000)}, STORES),
        ("worker", set(), STORES),
        ("migrate", set(), STORES),
        ("dicom-listener", {("anywhere", 11112)}, STORES),
        ("sender", set(), STORES | {("192.0.2.0/24", port) for port in (104, 443, 2762, 11112)}),
    ],
)
def test_each_part_talks_to_whom_it_must(pod: str, into: set[tuple[str, int]], out: set[tuple[str, int]]) -> None:
    """Prometheus reaches the API; only the sender leaves the cluster; a worker, which reads hostile files, does not."""
    assert _peers(_rules(pod, "ingress"), "from") == into
    assert _peers(_rules(pod, "egress"), "to") == out
    assert set(PODS) == {"api", "worker", "migrate", "dicom-listener", "sender"}


def test_every_part_can_check_the_certificates_of_the_servers() -> None:
    for _, container in _containers():
        assert {"name": "authority", "mountPath": "/run/secrets/authority", "readOnly": True} in container[
            "volumeMounts"
        ]
    page = (FOLDER / "README.md").read_text()
    assert "sslmode=verify-full&sslrootcert=/run/secrets/authority/authority.pem" in page
    assert "rediss://" in page
    assert "ssl_cert_reqs=required&ssl_check_hostname=true&ssl_ca_certs=/run/secrets/authority/authority.pem" in page


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


@pytest.mark.parametrize("folder", ["proxy", "tls"])
def test_overlay_follows_the_specification(folder: str) -> None:
    checker = Path(sys.executable).parent / "check-jsonschema"
    file = TOP / "deploy" / folder / "docker-compose.yml"
    subprocess.run([checker, "--builtin-schema", "vendor.compose-spec", file], check=True, capture_output=True)


def test_the_api_trusts_the_address_of_the_proxy_alone() -> None:
    compose = yaml.safe_load((TOP / "deploy" / "proxy" / "docker-compose.yml").read_text())
    api, proxy = compose["services"]["api"], compose["services"]["proxy"]
    address = proxy["networks"]["front"]["ipv4_address"]
    (subnet,) = (each["subnet"] for each in compose["networks"]["front"]["ipam"]["config"])
    assert ipaddress.ip_address(address) in ipaddress.ip_network(subnet)
    assert set(api["networks"]) == {"default", "front"}
    values = {name.removeprefix("FLUOROMAP_").lower(): value for name, value in api["environment"].items()}
    assert values["trusted_proxies"] == address
    Settings(**values | {"allowed_hosts": values["allowed_hosts"].replace("${PROXY_NAME:-localhost}", "localhost")})


def test_every_container_has_limits_and_a_bounded_log() -> None:
    first, second = (
        yaml.safe_load((folder / "docker-compose.yml").read_text())["services"]
        for folder in (TOP, TOP / "deploy" / "proxy")
    )
    # The second file adds to services of the first.
    for services in (first, {name: first.get(name, {}) | service for name, service in second.items()}):
        for name, service in services.items():
            assert service["mem_limit"], name
            assert service["logging"]["options"]["max-size"], name
            assert "no-new-privileges:true" in service["security_opt"], name
            assert "build" in service or re.search(r":\d\S*@sha256:[0-9a-f]{64}$", service["image"]), name
