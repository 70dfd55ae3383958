"""The image as a user would get it: what is in it, what it may do, and that it starts with nothing at all."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from container.conftest import REPOSITORY, UNPRIVILEGED, Image
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator

from bridged.daemon.status import ANSWER_TIMEOUT_S

SIZE_MAX = 60_000_000  # bytes above the base: Python, can-bridge, what it needs
CHECK_MAX_S = 0.15  # of processor time: a probe asks every few seconds
STOP_MAX_S = 2
USER = "65532:65532"


@pytest.mark.parametrize("name", ["Dockerfile", "config/container/can-utils.Dockerfile"])
def test_hadolint_has_nothing_to_say(name: str) -> None:
    found = subprocess.run(
        [Path(sys.executable).with_name("hadolint"), REPOSITORY / name],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert (found.returncode, found.stdout) == (0, "")


def test_configuration(image: Image) -> None:
    found = image.inspect()
    config = found["Config"]
    assert config["User"] == USER
    assert config["Entrypoint"] == ["can-bridge"]
    assert config["Cmd"] == ["run", "/etc/can-bridge/can-bridge.yaml"]
    assert set(config["Volumes"]) == {"/run/can-bridge", "/var/lib/can-bridge"}
    # Started, not ready: whoever waits for a healthy container must not wait for an adapter to be plugged in.
    assert found["Healthcheck"]["Test"] == ["CMD", "can-bridge", "status", "--check", "started"]
    assert found["Healthcheck"]["Timeout"] > ANSWER_TIMEOUT_S * 1e9  # so that it can say why
    labels = {key.removeprefix("org.opencontainers.image."): value for key, value in found["Labels"].items()}
    assert labels["title"] == "can-bridge"
    assert labels["licenses"] == "MIT"
    assert f"can-bridge {labels['version']}" == image.run("can-bridge", "--version")


def test_size(image: Image) -> None:
    base, whole = map(int, (image.directory / "sizes").read_text().split())
    print(f"{(whole - base) / 1e6:.1f} MB above the base")
    assert whole - base <= SIZE_MAX


def test_nothing_else_is_in_it(image: Image) -> None:
    left = image.run(
        "sh", "-c",
        "for tool in gcc cc pip pip3 git make; do command -v $tool; done; "
        "find /usr/lib/python3/dist-packages -name 'pip*' -o -name 'setuptools*'; "
        "find /var/lib/apt/lists /var/cache/apt /mnt -type f; find /etc /run /usr /opt -name ca.crt; true",
    )  # fmt: skip
    assert left == ""


def test_all_of_it_is_compiled(image: Image) -> None:
    """Nobody can write a __pycache__ in it: what is not compiled would be at each start, and each probe."""
    missing = image.run(
        "python3", "-c",
        "import importlib.util as u, pathlib as p\n"
        "for f in p.Path('/opt/can-bridge/lib').rglob('*.py'):\n"
        "    if not p.Path(u.cache_from_source(str(f))).exists(): print(f)",
    )  # fmt: skip
    assert missing == ""


def test_bill_of_materials(image: Image) -> None:
    text = (image.directory / "sbom.cdx.json").read_text()
    assert JsonStrictValidator(SchemaVersion.V1_5).validate_str(text) is None
    names = {part["name"] for part in json.loads(text)["components"]}
    project = (REPOSITORY / "pyproject.toml").read_text()
    (needed,) = re.findall(r"^dependencies = \[(.*?)\]", project, re.DOTALL | re.MULTILINE)
    wanted = {"can-bridge", "python3.11", "libusb-1.0-0", "debian", *re.findall(r'"([\w-]+)', needed)}
    assert wanted <= {name.lower() for name in names}


def test_buses_of_python_can(image: Image) -> None:
    """A bus of python-can instead of SocketCAN stays possible."""
    opened = "import can, can.interfaces.udp_multicast; can.Bus(interface='virtual', channel='x').shutdown()"
    image.run("python", "-c", opened)


CONFIG = """
adapter: {type: can232, port: /dev/ttyUSB9}
channel: {bitrate: 125000}
bus: {interface: virtual, channel: test}
"""
# What a command costs, from start to end, as the kernel counts it.
COST = """
import resource, subprocess, sys
status = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(status, used.ru_utime + used.ru_stime)
"""


def wait_for_log(image: Image, container: str, text: str) -> None:
    deadline = time.monotonic() + 20
    while text not in image.logs(container):
        assert time.monotonic() < deadline, image.logs(container)
        time.sleep(0.1)


@pytest.fixture
def waiting(image: Image, tmp_path: Path) -> Iterator[str]:
    """A container whose adapter is not there and that may do nothing."""
    (tmp_path / "can-bridge.yaml").write_text(CONFIG)
    tmp_path.chmod(0o755)
    name = image.podman(
        "run", "-d", *UNPRIVILEGED, "-v", f"{tmp_path}:/etc/can-bridge:ro", image.name
    )  # fmt: skip
    try:
        wait_for_log(image, name, "state=waiting")
        yield name
    finally:
        image.podman("rm", "-f", "-v", name)


def test_any_other_user(image: Image, tmp_path: Path) -> None:
    """As `--user` or a platform with a number for each project says; without a volume made for it."""
    (tmp_path / "can-bridge.yaml").write_text(CONFIG)
    tmp_path.chmod(0o755)
    volume = f"{tmp_path}:/etc/can-bridge:ro"
    name = image.podman("run", "-d", *UNPRIVILEGED, "--user", "1234:0", "-v", volume, image.name)
    try:
        wait_for_log(image, name, "state=waiting")
        image.podman("exec", name, "can-bridge", "status", "--check", "started")
        image.podman("exec", name, "sh", "-c", "mkdir /var/lib/can-bridge/can-bridge")
    finally:
        image.podman("rm", "-f", "-v", name)


def test_starts_without_its_adapter_and_without_any_privilege(image: Image, waiting: str) -> None:
    warnings = [line for line in image.logs(waiting).splitlines() if "WARNING" in line]
    assert len(warnings) == 1  # that there is no adapter, and nothing about where it may not write
    for probe, answer in {"started": 0, "live": 0, "ready": 1}.items():
        status, cost = image.podman(
            "exec", waiting, "python3", "-c", COST, "can-bridge", "status", "--check", probe
        ).split()
        print(f"{float(cost):.3f} s of processor time for a check")
        assert int(status) == answer
        assert float(cost) <= CHECK_MAX_S

    begin = time.monotonic()
    image.podman("stop", "-t", "10", waiting)
    took = time.monotonic() - begin
    assert image.podman("inspect", "--format", "{{.State.ExitCode}}", waiting) == "0"
    assert took <= STOP_MAX_S
