"""An adapter that is plugged in, pulled out and plugged in elsewhere while its bridge is in a container."""

import pytest
from containers import INTERFACE_MAKER, UNPRIVILEGED, Containers
from rig import Rig
from test_containers import NEAR, configuration

pytestmark = pytest.mark.timeout(900)

RULE = "c 188:* rmw"


def test_plugged_in_pulled_out_and_plugged_in_elsewhere(containers: Containers, rig: Rig) -> None:
    """By another user than root, without any capability."""
    chip, other = rig.chip("ftdi0"), rig.chip("ftdi1")
    group = str(chip.wait_tty().stat().st_gid)
    for one in (chip, other):
        one.unplug()
    rig.host_simulate(adapter="can232")
    pod = containers.pod()
    containers.once("--pod", pod, *INTERFACE_MAKER, "can-bridge", "interface", NEAR)
    settings = configuration(f"usb-serial://{chip.serial_number}", baudrate=57_600)
    settings["channel"] = {"bitrate": 125_000}
    settings["reconnect"] = {"initial": 300, "maximum": 300}  # only the news of the device can end them
    mounted = containers.configuration(settings)
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
