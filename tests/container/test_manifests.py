"""The manifests in config/container: generated as they stand, valid by the tools of those who read them."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from container.manifests import CONFIGURATION, DIRECTORY, MANIFESTS

from bridged.config import check
from bridged.daemon.status import ANSWER_TIMEOUT_S

PODS = sorted(name for name in MANIFESTS if name != "compose.yaml")
COMPOSE = DIRECTORY / "compose.yaml"


def tool(name: str, *arguments: str | Path) -> str:
    """The output of a program of this environment, which must succeed."""
    done = subprocess.run(
        [Path(sys.executable).with_name(name), *arguments],
        check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.mark.parametrize("name", MANIFESTS)
def test_is_current(name: str) -> None:
    assert (DIRECTORY / name).read_text() == MANIFESTS[name](), "run tests/container/manifests.py"


@pytest.mark.parametrize("name", PODS)
def test_kubernetes_takes_the_pod(name: str) -> None:
    assert f"pod/{pod(name)['metadata']['name']} against" in tool(
        "kubernetes-validate", "--strict", DIRECTORY / name
    )


def test_compose_takes_its_file() -> None:
    tool("check-jsonschema", "--builtin-schema", "vendor.compose-spec", COMPOSE)
    services = json.loads(tool("docker-compose", "-f", COMPOSE, "config", "--format", "json"))["services"]
    assert services["application"]["depends_on"]["bridge"]["condition"] == "service_healthy"
    for service in services.values():
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
    assert [name for name, service in services.items() if "cap_add" in service] == ["interface"]


def pod(name: str) -> dict[str, Any]:
    (found,) = (one for one in yaml.safe_load_all((DIRECTORY / name).read_text()) if one["kind"] == "Pod")
    return dict(found)


@pytest.mark.parametrize("name", PODS)
def test_only_who_makes_the_interface_has_a_capability(name: str) -> None:
    spec = pod(name)["spec"]
    containers = spec["initContainers"] + spec["containers"]
    privileged = [one["name"] for one in containers if "add" in one["securityContext"]["capabilities"]]
    assert privileged == ["interface"]
    assert all(one["securityContext"]["capabilities"]["drop"] == ["ALL"] for one in containers)


@pytest.mark.parametrize("name", [name for name in PODS if name.startswith("kubernetes")])
def test_a_probe_has_the_time_to_say_why(name: str) -> None:
    """`status` gives up by itself, with a line that names the reason; kubelet must not end it before."""
    (bridge,) = (one for one in pod(name)["spec"]["initContainers"] if one["name"] == "bridge")
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert bridge[probe]["timeoutSeconds"] > ANSWER_TIMEOUT_S


@pytest.mark.parametrize("name", MANIFESTS)
def test_the_bridge_takes_its_configuration(name: str, tmp_path: Path) -> None:
    documents = list(yaml.safe_load_all((DIRECTORY / name).read_text()))
    if name == "compose.yaml":
        text = documents[0]["configs"]["bridge"]["content"].replace("${CAN_PORT:-", "").replace("}", "")
    else:
        text = next(one["data"][CONFIGURATION] for one in documents if one["kind"] == "ConfigMap")
    file = tmp_path / CONFIGURATION
    file.write_text(text)
    config, warnings = check(file)
    assert (config.bus.channel, warnings) == ("vcan0", [])
