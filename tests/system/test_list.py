"""`can-bridge list` on a real kernel, and a bridge by the port that it shows."""

from __future__ import annotations

import json
import subprocess
from typing import Any

from rig import DEADLINE_S, Rig, wait_until

NOBODY = ("setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups")


def listed(rig: Rig, serial_number: str, *within: str) -> dict[str, Any]:
    """What is said of the USB device with this number."""
    said = subprocess.run(
        [*within, *rig.command, "list", "--json"],
        check=True,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    ).stdout
    (found,) = [
        one for one in json.loads(said) if one["usb"] and one["usb"]["serial_number"] == serial_number
    ]
    assert isinstance(found, dict)
    return found


def test_a_bridge_by_the_port_that_list_shows_without_a_file(rig: Rig) -> None:
    """From the list to a running bridge in one line, and the list tells who has the port then."""
    interface = rig.vcan()
    chip = rig.chip("ftdi0")
    tty = chip.wait_tty()
    rig.host_simulate()
    before = listed(rig, chip.serial_number)
    assert (before["port"], before["node"]) == (f"usb-serial://{chip.serial_number}", str(tty))
    assert (before["driver"], before["usb"]["id"]) == ("ftdi_sio", "0403:6001")
    assert (before["used_by"], before["refused"]) == ([], None)

    refused = listed(rig, chip.serial_number, *NOBODY)["refused"]
    assert "add it to group dialout" in refused

    options = ("--type", "usb2can", "--port", before["port"], "--bitrate", "500000")
    notify = rig.directory / "told"
    script = f'echo "$CAN_BRIDGE_NAME $CAN_BRIDGE_STATE $CAN_BRIDGE_BUS_STATE" >> {notify}'
    bridge = rig.start(*rig.command, "run", *options, "--notify", json.dumps(["sh", "-c", script]), interface)
    bridge.wait_ready(notify.exists, "the command of notify to be run")
    wait_until(lambda: notify.read_text().startswith(f"{interface} running "), "the bridge to run")
    assert listed(rig, chip.serial_number)["used_by"] == [f"bridge {interface} (running)"]
    status = subprocess.run([*rig.command, "status", interface], capture_output=True, text=True, check=True)
    assert f"{interface}: running" in status.stdout
    assert bridge.stop() == 0
