"""A bridge in a container, its application in another, the interface in their own network namespace."""

import subprocess
from typing import Any

import pytest
from containers import INTERFACE_MAKER, UNPRIVILEGED, Containers

pytestmark = pytest.mark.timeout(900)

NEAR = "vcan0"


def configuration(port: str, **adapter: Any) -> dict[str, Any]:
    return {
        "adapter": {"type": "can232", "port": port, "baudrate": 115200} | adapter,
        "channel": {"bitrate": 1_000_000},
        "bus": {"channel": NEAR},
    }


def has_interface(name: str) -> bool:
    """Whether this machine's own namespace sees it."""
    return (
        subprocess.run(["ip", "link", "show", "dev", name], check=False, capture_output=True).returncode == 0
    )


def test_started_without_its_adapter(containers: Containers) -> None:
    pod = containers.pod()
    containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", NEAR)
    assert not has_interface(NEAR)
    settings = containers.configuration(configuration("/dev/ttyUSB9"))
    bridge = containers.start("--pod", pod, *UNPRIVILEGED, *settings, "can-bridge")
    bridge.wait_log("state=waiting")
    bridge.wait_check("started")
    assert bridge.stop() == 0
