"""`can-bridge list`: what it says of each device, and that it opens none."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from benches.usb_devices import FakeMachine

from bridged import listing
from bridged.adapters import TYPES
from bridged.adapters.usb_families import _KNOWN, family_of
from bridged.cli import main
from bridged.daemon.status import StatusError

FTDI = {"manufacturer": "FTDI", "product": "FT232R USB UART", "serial": "A6008isP"}


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeMachine:
    monkeypatch.setattr(listing, "running_sockets", list)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    return FakeMachine(tmp_path, monkeypatch)


def listed(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    assert main(["list", "--json"]) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    return found


def text(capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["list"]) == 0
    return capsys.readouterr().out


def run_bridge(monkeypatch: pytest.MonkeyPatch, port: str) -> None:
    status = {"name": "pc", "state": "running", "adapter": {"port": port}, "counters": {}}
    monkeypatch.setattr(listing, "running_sockets", lambda: [Path("/run/can-bridge/pc.sock")])
    monkeypatch.setattr(listing, "query", lambda _path: status)


def test_as_a_user_reads_it(
    machine: FakeMachine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="ftdi_sio", **FTDI)
    machine.add_uart("ttyS0", 4)
    run_bridge(monkeypatch, "usb-serial://A6008isP")
    assert text(capsys).replace(str(machine.dev), "/dev") == (
        "port: /dev/ttyS0\n"
        "  device    /dev/ttyS0, driver serial\n"
        "  used by   nobody\n"
        "\n"
        "port: usb-serial://A6008isP\n"
        "  device    /dev/ttyUSB0, driver ftdi_sio\n"
        "  USB       0403:6001, FTDI, FT232R USB UART, serial number A6008isP\n"
        "  may be    a USB2CAN, a CAN232 on a cable with an FTDI chip, or anything else with such a chip\n"
        "  used by   bridge pc (running)\n"
    )


def test_why_a_port_cannot_be_opened(machine: FakeMachine, capsys: pytest.CaptureFixture[str]) -> None:
    """As in a container without the host's /dev; under a label that leaves a space."""
    machine.add_uart("ttyS0", 4)
    (machine.dev / "ttyS0").unlink()
    (line,) = (line for line in text(capsys).splitlines() if "there is no" in line)
    assert line.startswith("  refused   there is no ")


def test_as_a_program_reads_it(machine: FakeMachine, capsys: pytest.CaptureFixture[str]) -> None:
    machine.plug("3-1", "16d0:117e", ttys={0: "ttyACM0"}, driver="cdc_acm", product="CANable2 b158aa7 x")
    node = str(machine.dev / "ttyACM0")
    assert listed(capsys) == [
        {
            "port": node,
            "node": node,
            "driver": "cdc_acm",
            "usb": {
                "id": "16d0:117e",
                "manufacturer": None,
                "product": "CANable2 b158aa7 x",
                "serial_number": None,
            },
            "family": "a CANable 2.0 with its slcan firmware, a clone of the CAN232",
            "type": "can232",
            "used_by": [],
            "refused": None,
        }
    ]


def test_usb_devices_only_if_they_are_known(machine: FakeMachine, capsys: pytest.CaptureFixture[str]) -> None:
    machine.plug("3-1", "046d:c31c", driver="usbhid", product="keyboard")
    machine.plug("3-2", "1d50:606f", driver="gs_usb")
    machine.plug("3-3", "0403:ffa8")
    assert [(found["port"], found["driver"]) for found in listed(capsys)] == [
        (None, "gs_usb"),
        ("usb://0403:ffa8", None),
    ]
    shown = text(capsys)
    assert "no port for a bridge\n" in shown
    assert "none: `modprobe -a ftdi_sio" in shown


def test_no_device_is_opened(
    machine: FakeMachine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """To open a terminal may reset what is behind it. /sys is read, and nothing of /dev."""
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="ftdi_sio", **FTDI)
    machine.plug("3-2", "0403:6001", **FTDI)
    machine.add_uart("ttyS0", 4)
    machine.link("by-id/usb-FTDI", "ttyUSB0")
    run_bridge(monkeypatch, "/dev/ttyUSB9")
    opened: list[str] = []
    watching = True

    def note(event: str, arguments: tuple[Any, ...]) -> None:
        if watching and event == "open":
            opened.append(str(arguments[0]))

    sys.addaudithook(note)  # cannot be removed
    try:
        assert len(listed(capsys)) == 3
        text(capsys)
    finally:
        watching = False
    assert any(path.startswith(str(machine.sys)) for path in opened)  # the hook works
    assert [path for path in opened if path.startswith((str(machine.dev), "/dev/"))] == []


def test_a_program_that_has_it_open(machine: FakeMachine, capsys: pytest.CaptureFixture[str]) -> None:
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="ftdi_sio", **FTDI)
    with (machine.dev / "ttyUSB0").open("rb"):
        (user,) = listed(capsys)[0]["used_by"]
    assert user.endswith(f"(process {os.getpid()})")


def test_a_bridge_is_named_once(
    machine: FakeMachine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="ftdi_sio", **FTDI)
    run_bridge(monkeypatch, str(machine.dev / "ttyUSB0"))
    monkeypatch.setattr(listing.sysfs, "users", lambda _node: ["bridge pc (process 4)", "cat (process 5)"])
    assert listed(capsys)[0]["used_by"] == ["bridge pc (running)", "cat (process 5)"]


def test_what_cannot_be_known_is_said(
    machine: FakeMachine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(_path: Path) -> dict[str, Any]:
        raise StatusError("no permission for it")

    machine.add_uart("ttyS0", 4)
    monkeypatch.setattr(listing, "running_sockets", lambda: [Path("/run/can-bridge/pc.sock")])
    monkeypatch.setattr(listing, "query", refused)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    shown = text(capsys)
    assert "Bridge pc is not known: no permission for it." in shown
    assert "used by   none of your programs\n" in shown
    assert listing.ONLY_YOURS in shown


@pytest.mark.usefixtures("machine")
def test_nothing_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert listed(capsys) == []
    shown = text(capsys)
    assert "Plug it in" in shown
    assert max(map(len, shown.splitlines())) <= listing.WIDTH


def test_fits_a_narrow_terminal(
    machine: FakeMachine, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="ftdi_sio", **FTDI)
    monkeypatch.setattr(listing, "_width", lambda: 60)
    lines = text(capsys).splitlines()
    assert max(len(line) for line in lines if str(machine.dev) not in line) <= 60
    assert f"{' ' * listing.LABEL}" in "\n".join(lines)


def test_a_device_does_not_move_the_cursor(machine: FakeMachine, capsys: pytest.CaptureFixture[str]) -> None:
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="ftdi_sio", product="x\x1b[2Jy")
    assert r"x\x1b[2Jy" in text(capsys)


@pytest.mark.parametrize(
    ("usb_id", "product", "type_"),
    [
        ((0x0403, 0xFFA8), None, "can232"),
        ((0x0403, 0x6001), "USB2CAN", "usb2can"),
        ((0x0403, 0x6001), "FT232R USB UART", None),
        ((0xAD50, 0x60C4), "CANtact dev", None),
        ((0xAD50, 0x60C4), "CANable 8ca5d39 github.com/normaldotcom/canable-fw.git", "can232"),
        ((0x1D50, 0x606F), "canable gs_usb", None),
    ],
)
def test_families(usb_id: tuple[int, int], product: str | None, type_: str | None) -> None:
    family = family_of(usb_id, product)
    assert family is not None
    assert family.type == type_


def test_every_type_is_one() -> None:
    assert {family.type for _, _, family in _KNOWN} <= {*TYPES, None}


def test_an_unknown_device_has_no_family() -> None:
    assert family_of((0x046D, 0xC31C), "CAN keyboard") is None
