"""Which devices there are, by a made-up /sys; what each is called in a configuration."""

from __future__ import annotations

from pathlib import Path

import pytest
from benches.usb_devices import FakeMachine

from bridged.ports import inventory, permission
from bridged.ports.inventory import Device, UsbDevice


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeMachine:
    return FakeMachine(tmp_path, monkeypatch)


def ports() -> list[str]:
    return [device.port for device in inventory.devices()]


def test_all_that_is_known_of_a_serial_port(machine: FakeMachine) -> None:
    machine.plug(
        "3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="ftdi_sio",
        manufacturer="FTDI", product="FT232R USB UART", serial="A6008isP",
    )  # fmt: skip
    usb = UsbDevice((0x0403, 0x6001), "FTDI", "FT232R USB UART", "A6008isP")
    assert inventory.devices() == [
        Device("usb-serial://A6008isP", machine.dev / "ttyUSB0", "ftdi_sio", usb),
    ]


def test_a_name_that_stays_where_the_number_does_not_do(machine: FakeMachine) -> None:
    """Two devices with one number, the second line of a device, no number, a space in it."""
    machine.plug("3-1", "1:1", ttys={0: "ttyUSB0"}, driver="a", serial="SAME")
    machine.plug("3-2", "1:1", ttys={0: "ttyUSB1"}, driver="a", serial="SAME")
    machine.plug("3-3", "1:1", ttys={0: "ttyUSB2", 1: "ttyUSB3"}, driver="a", serial="TWO")
    machine.plug("3-4", "1:1", ttys={0: "ttyUSB4"}, driver="a")
    machine.plug("3-5", "1:1", ttys={0: "ttyACM0"}, driver="a", serial="a b")
    machine.link("by-id/usb-same-if00", "ttyUSB1")
    machine.link("by-path/pci-usb-1", "ttyUSB0")
    machine.link("by-path/pci-usb-2", "ttyUSB1")
    machine.link("by-id/usb-two-if01", "ttyUSB3")
    serial = machine.dev / "serial"
    expected = {
        "ttyUSB0": f"{serial}/by-path/pci-usb-1",
        "ttyUSB1": f"{serial}/by-id/usb-same-if00",
        "ttyUSB2": "usb-serial://TWO",
        "ttyUSB3": f"{serial}/by-id/usb-two-if01",
        "ttyUSB4": f"{machine.dev}/ttyUSB4",
        "ttyACM0": f"{machine.dev}/ttyACM0",
    }
    assert {device.node.name: device.port for device in inventory.devices()} == expected


def test_ports_of_the_machine_only_with_a_chip(machine: FakeMachine) -> None:
    for index, type_ in enumerate((4, 0, 0)):
        machine.add_uart(f"ttyS{index}", type_)
    (machine.sys / "class/tty/tty1").mkdir()  # a console
    assert ports() == [f"{machine.dev}/ttyS0"]


def test_the_driver_above_the_serial_core(machine: FakeMachine) -> None:
    machine.add_uart("ttyS0", 4)
    device = machine.sys / "devices/pnp0/ttyS0"
    machine._bind(device / "00:01.0", "port")
    (device / "tty/ttyS0/device").unlink()
    (device / "tty/ttyS0/device").symlink_to(device / "00:01.0")
    assert [found.driver for found in inventory.devices()] == ["serial"]


def test_usb_devices_without_a_serial_port(machine: FakeMachine) -> None:
    """FTDI's can be had raw, others have no port; hubs are left out."""
    machine.plug("3-1", "0403:6001", serial="A1")
    machine.plug("3-2", "1d50:606f", driver="gs_usb")
    machine.plug("usb3", "1d6b:0002", bDeviceClass="09", serial="0000:00:14.0")
    assert [(found.port, found.node.name, found.driver) for found in inventory.devices()] == [
        ("usb://0403:6001/A1", "001", None),
        ("", "002", "gs_usb"),
    ]


@pytest.mark.parametrize(
    ("port", "is_meant"),
    [
        ("{dev}/ttyUSB0", True),
        ("{dev}/serial/by-id/x", True),
        ("usb-serial://A1", True),
        ("usb://0403:6001", True),
        ("usb://0403:6001/A1", True),
        ("{dev}/ttyUSB1", False),
        ("usb-serial://A2", False),
        ("usb://0403:6001/A2", False),
        ("usb://0403:6010", False),
        ("usb://nonsense", False),
        ("socket://A1:4001", False),
    ],
)
def test_the_port_of_a_configuration(machine: FakeMachine, port: str, is_meant: bool) -> None:
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="a", serial="A1")
    machine.link("by-id/x", "ttyUSB0")
    (device,) = inventory.devices()
    assert device.is_meant_by(port.format(dev=machine.dev)) is is_meant


def test_permission(machine: FakeMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine.plug("3-1", "0403:6001", ttys={0: "ttyUSB0"}, driver="a", serial="A1")
    machine.plug("3-2", "0403:6001", serial="A2")
    tty, raw = inventory.devices()
    assert tty.refusal() == ""
    monkeypatch.setattr(inventory.os, "access", lambda *_args, **_options: False)
    monkeypatch.setattr(permission, "explain_refused", lambda node: f"tty {node.name}")
    assert tty.refusal() == "tty ttyUSB0"
    raw.node.chmod(0)
    assert 'ATTR{idProduct}=="6001"' in raw.refusal()
    tty.node.unlink()
    assert "there is no" in tty.refusal()
