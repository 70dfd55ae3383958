"""An adapter that is plugged in, pulled out and plugged in elsewhere while its bridge is in a container."""

from pathlib import Path
from typing import Any

import pytest
from containers import INTERFACE_MAKER, UNPRIVILEGED, Containers
from rig import Chip, Rig
from test_containers import NEAR

pytestmark = pytest.mark.timeout(900)

RULE = "c 188:* rmw"


def configuration(chip: Chip) -> dict[str, Any]:
    """So that only the news of the device can end a pause within a test."""
    return {
        "adapter": {"type": "can232", "port": f"usb-serial://{chip.serial_number}"},
        "channel": {"bitrate": 125_000},
        "bus": {"channel": NEAR},
        "reconnect": {"initial": 300, "maximum": 300},
    }


def test_plugged_in_pulled_out_and_plugged_in_elsewhere(containers: Containers, rig: Rig) -> None:
    """By another user than root, without any capability."""
    chip, other = rig.chip("ftdi0"), rig.chip("ftdi1")
    group = str(chip.wait_tty().stat().st_gid)
    for one in (chip, other):
        one.unplug()
    rig.host_simulate(adapter="can232")
    pod = containers.pod()
    containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", NEAR)
    mounted = containers.configuration(configuration(chip))
    usual = ("--pod", pod, *UNPRIVILEGED, *mounted, "--volume", "/dev:/dev")
    bridge = containers.start(*usual, "--device-cgroup-rule", RULE, "--group-add", group, "can-bridge")
    bridge.wait_log("state=waiting")
    names = set()
    for round_ in range(3):
        if round_ == 1:
            other.plug()
            other.wait_tty()  # it has the adapter's name now
        chip.plug()
        bridge.wait_check("ready")
        names.add(chip.wait_tty())
        assert f"{chip.wait_tty()} is opened for usb-serial://{chip.serial_number}" in bridge.logs
        chip.unplug()
        bridge.wait_check("started")
    assert len(names) == 2
    assert "permission" not in bridge.logs
    assert bridge.stop() == 0


def test_what_a_container_lacks_is_said(containers: Containers, rig: Rig) -> None:
    chip = rig.chip("ftdi0")
    group = chip.wait_tty().stat().st_gid
    pod = containers.pod()
    containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", NEAR)
    settings = configuration(chip)
    usual = ("--pod", pod, *UNPRIVILEGED, *containers.configuration(settings), "--volume", "/dev:/dev")
    refused = containers.start(*usual, "--device-cgroup-rule", RULE, "can-bridge")
    refused.wait_log(f"run the container with --group-add {group} ")
    assert refused.stop() == 0
    forbidden = containers.start(*usual, "--group-add", str(group), "can-bridge")
    forbidden.wait_log(f'run the container with --device-cgroup-rule="{RULE}" ')
    assert forbidden.stop() == 0
    unbound = containers.start("--pod", pod, *UNPRIVILEGED, *containers.configuration(settings), "can-bridge")
    unbound.wait_log(f"there is no {Path('/dev') / chip.wait_tty().name} in this container")
    assert unbound.stop() == 0
