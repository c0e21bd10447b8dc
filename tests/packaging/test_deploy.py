"""The files for deployment: their schemas, the settings in them, and the configuration of NATS."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from scripts.scale_lab.nats_server import binary
from server.config.settings import Settings, load

yaml = pytest.importorskip("yaml")
kubernetes_validate = pytest.importorskip("kubernetes_validate")

DEPLOY = Path(__file__).resolve().parents[2] / "scripts" / "deploy"
ENV_PREFIX = "SOVEREIGN_"
KUBERNETES = "1.30"
"""Version of Kubernetes whose schemas are used."""


def manifests() -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((DEPLOY / "kubernetes.yaml").read_text()))


def inherited(command: list[str]) -> dict[str, str]:
    """Returns the settings that the image has and the command of a part does not remove."""
    assert command == ["env", "-u", command[2], "sovereign-server"]
    text = (DEPLOY / "Dockerfile").read_text()
    found = dict(re.findall(r"(SOVEREIGN_\w+)=(\S+)", text.rpartition("FROM")[2].partition("USER")[0]))
    return {name: value for name, value in found.items() if name != command[2]}


def parts() -> Iterator[tuple[str, dict[str, str]]]:
    """Yields name and environment of each part of the world in the compose file and in Kubernetes."""
    services = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    for name, service in services.items():
        if "build" in service:
            yield f"compose {name}", {**inherited(service["entrypoint"]), **service["environment"]}
    objects = {(each["kind"], each["metadata"]["name"]): each for each in manifests()}
    common = objects["ConfigMap", "sovereign"]["data"]
    for (kind, name), each in objects.items():
        if kind == "Deployment":
            (container,) = each["spec"]["template"]["spec"]["containers"]
            own = {entry["name"]: entry.get("value", "") for entry in container["env"]}
            yield f"kubernetes {name}", {**inherited(container["command"]), **common, **own}


def settings(environment: dict[str, str], tmp_path: Path) -> Settings:
    """Returns the settings that a part has. `$(NODE)` and the file of the key are replaced."""
    key = tmp_path / "key"
    key.write_text("k" * 64)
    known = {name: value for name, value in environment.items() if name.startswith(ENV_PREFIX)}
    if "SOVEREIGN_AUTH_KEY_FILE" in known:
        known["SOVEREIGN_AUTH_KEY_FILE"] = str(key)
    return load({}, {name: value.replace("$(NODE)", "10.0.0.1") for name, value in known.items()})


@pytest.mark.parametrize("manifest", manifests(), ids=lambda each: f"{each['kind']}-{each['metadata']['name']}")
def test_a_manifest_follows_the_schema_of_kubernetes(manifest: dict[str, Any]) -> None:
    kubernetes_validate.validate(manifest, KUBERNETES, strict=True)
    wrong = json.loads(json.dumps(manifest))
    wrong["speck"] = {}
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(wrong, KUBERNETES, strict=True)


def test_the_compose_file_follows_its_schema(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"]
    assert subprocess.run([*command, str(DEPLOY / "compose.yaml")], check=False).returncode == 0
    wrong = tmp_path / "compose.yaml"
    wrong.write_text((DEPLOY / "compose.yaml").read_text().replace("stop_grace_period", "stop_grace"))
    assert subprocess.run([*command, str(wrong)], check=False, capture_output=True).returncode == 1


def test_each_part_has_settings_that_the_server_takes(tmp_path: Path) -> None:
    made = {name: settings(environment, tmp_path) for name, environment in parts()}
    assert len(made) == 7
    roles = [each.role for each in made.values()]
    assert (roles.count("sequencer"), roles.count("standby"), roles.count("edge")) == (2, 2, 3)
    for name, each in made.items():
        assert each.bus_replicas == 3
        assert (each.public_url is not None) == (each.role == "edge"), name
        assert each.role == "edge" or each.durability == "power"
    urls = [each.public_url for name, each in made.items() if each.role == "edge" and name.startswith("compose")]
    assert len(set(urls)) == len(urls)


def test_selectors_and_ports_fit() -> None:
    pods: dict[str, Any] = {}
    for each in manifests():
        if each["kind"] in ("Deployment", "StatefulSet"):
            template = each["spec"]["template"]
            assert each["spec"]["selector"]["matchLabels"].items() <= template["metadata"]["labels"].items()
            pods[template["metadata"]["labels"]["app"]] = template["spec"]
    for each in manifests():
        if each["kind"] == "Service":
            (container,) = pods[each["spec"]["selector"]["app"]]["containers"]
            open_ports = {port["containerPort"] for port in container["ports"]}
            assert {port["port"] for port in each["spec"]["ports"]} <= open_ports


def test_nats_takes_its_configuration_and_writes_at_once(tmp_path: Path) -> None:
    server = binary()
    if not server:
        pytest.skip("there is no nats-server here")
    text = (DEPLOY / "nats.conf").read_text()
    assert "sync_interval: always" in text

    def check(config: str) -> subprocess.CompletedProcess[str]:
        path = tmp_path / "nats.conf"
        path.write_text(config)
        command = [server, "-t", "-c", str(path)]
        return subprocess.run(command, env={"NATS_NAME": "nats-0"}, check=False, capture_output=True, text=True)

    assert check(text).returncode == 0, check(text).stderr
    assert check(text.replace("sync_interval", "sync_intervall")).returncode != 0
