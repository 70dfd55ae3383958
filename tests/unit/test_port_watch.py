"""The watch for devices: events as the kernel and udev send them, by way of a made-up /sys and /dev."""

from __future__ import annotations

import select
import shutil
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridged.ports import sysfs, watch
from bridged.ports.watch import Watch, _properties


def kernel_event(**properties: str) -> bytes:
    lines = [f"add@{properties['DEVPATH']}", *(f"{key}={value}" for key, value in properties.items())]
    return "".join(f"{line}\0" for line in lines).encode()


def udev_event(**properties: str) -> bytes:
    """Systemd's device-monitor.c: prefix, magic, size of the header, offset and length, four hashes."""
    body = "".join(f"{key}={value}\0" for key, value in properties.items()).encode()
    return (
        b"libudev\0"
        + struct.pack(">I", 0xFEEDCAFE)
        + struct.pack("=7I", 40, 40, len(body), 1, 2, 3, 4)
        + body
    )


def tty_event(name: str, action: str = "add", *, udev: bool = False) -> bytes:
    node = f"/dev/{name}" if udev else name
    build = udev_event if udev else kernel_event
    return build(ACTION=action, DEVPATH=f"/devices/x/tty/{name}", SUBSYSTEM="tty", DEVNAME=node)


def usb_event(product: str, devtype: str = "usb_device") -> bytes:
    return kernel_event(
        ACTION="add", DEVPATH="/devices/usb1/1-1", SUBSYSTEM="usb", DEVTYPE=devtype, PRODUCT=product
    )


class Machine:
    """A /dev and a /sys without anything in it; `events` stands for the kernel."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.dev, self.sys = root / "dev", root / "sys"
        self.watches: list[Watch] = []
        self.dev.mkdir()
        (self.sys / "class/tty").mkdir(parents=True)
        (self.sys / "bus/usb/devices").mkdir(parents=True)
        monkeypatch.setattr(watch, "_DEV", self.dev)
        monkeypatch.setattr(watch, "_SYS", self.sys)
        monkeypatch.setattr(sysfs, "_SYS", self.sys)

    def plug(self, name: str, serial: str | None = None) -> Path:
        usb = self.sys / "devices" / name
        directory = usb / f"1-1:1.0/{name}/tty/{name}"
        directory.mkdir(parents=True)
        (usb / "idVendor").write_text("0403\n")
        (usb / "idProduct").write_text("6001\n")
        if serial:
            (usb / "serial").write_text(f"{serial}\n")
        (self.sys / "class/tty" / name).symlink_to(directory)
        (self.sys / "bus/usb/devices" / name).symlink_to(usb)
        (self.sys / "bus/usb/devices" / f"{name}:1.0").mkdir()  # its interface
        (self.dev / name).touch()
        return self.dev / name

    def watch(self, port: Path | str, serial_number: str | None = None) -> Watch:
        self.watches.append(Watch(str(port), serial_number))
        return self.watches[-1]

    def unplug(self, name: str) -> None:
        (self.dev / name).unlink()
        for folder in ("class/tty", "bus/usb/devices"):
            (self.sys / folder / name).unlink()
        (self.sys / "bus/usb/devices" / f"{name}:1.0").rmdir()
        shutil.rmtree(self.sys / "devices" / name)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    made = Machine(tmp_path, monkeypatch)
    yield made
    for looking in made.watches:
        looking.close()


def told(looking: Watch, *events: bytes) -> bool:
    """What has_come() makes of these events."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setblocking(False)
    looking.close()
    looking._socket = near
    for event in events:
        far.send(event)
    far.close()
    try:
        return looking.has_come()
    finally:
        looking.close()


def test_properties_of_both_senders() -> None:
    wanted = {"ACTION": "add", "DEVPATH": "/d", "X": "a=b", "EMPTY": ""}
    assert _properties(kernel_event(**wanted)) == wanted
    assert _properties(udev_event(**wanted)) == wanted


@pytest.mark.parametrize(
    "junk",
    [
        b"",
        b"\0\0",
        b"libudev\0",
        b"libudev\0" + bytes(16),
        b"libudev\0" + b"\xff" * 40,
        b"\xff=\xfe\0",
        b"=\0=",
    ],
)
def test_junk_is_no_device(machine: Machine, junk: bytes) -> None:
    assert not told(machine.watch(machine.plug("ttyUSB0")), junk)


@pytest.mark.parametrize("udev", [False, True])
def test_a_tty_comes(machine: Machine, udev: bool) -> None:
    port = str(machine.plug("ttyUSB0"))
    assert told(machine.watch(port), tty_event("ttyUSB1"), tty_event("ttyUSB0", udev=udev))
    assert not told(machine.watch(port), tty_event("ttyUSB1", udev=udev))
    assert not told(machine.watch(port), tty_event("ttyUSB0", "remove", udev=udev))
    assert not told(machine.watch(port), tty_event("ttyUSB0", "change", udev=udev))
    assert not told(machine.watch(port))


def test_a_tty_that_is_gone_again_has_not_come(machine: Machine) -> None:
    machine.plug("ttyUSB0")
    machine.unplug("ttyUSB0")
    assert not told(machine.watch(machine.dev / "ttyUSB0"), tty_event("ttyUSB0"))


def test_a_link_comes_when_udev_has_made_it(machine: Machine) -> None:
    link = machine.dev / "serial/by-id/usb-FTDI_A1-if00-port0"
    looking = machine.watch(link)
    assert not looking.is_there()
    node = machine.plug("ttyUSB3")
    assert not told(machine.watch(link), tty_event("ttyUSB3"))
    link.parent.mkdir(parents=True)
    link.symlink_to(node)
    assert looking.is_there()
    assert told(machine.watch(link), tty_event("ttyUSB3", udev=True))
    machine.unplug("ttyUSB3")
    assert not looking.is_there()


def test_the_same_device_at_another_path(machine: Machine) -> None:
    port = str(machine.plug("ttyUSB0", "A1"))
    looking = machine.watch(port, "A1")
    assert looking.path() == port
    machine.unplug("ttyUSB0")
    assert (looking.path(), looking.is_there()) == (port, False)
    machine.plug("ttyUSB0", "B2")
    machine.plug("ttyUSB1")
    assert looking.path() == port  # another device, which the adapter will refuse
    other = str(machine.plug("ttyUSB2", "A1"))
    assert (looking.path(), looking.is_there()) == (other, True)
    assert told(machine.watch(port, "A1"), tty_event("ttyUSB2"))
    assert not told(machine.watch(port, "A1"), tty_event("ttyUSB0"))
    assert machine.watch("socket://h:1", "A1").path() == "socket://h:1"


@pytest.mark.parametrize(
    ("url", "there"),
    [
        ("usb://0403:6001", True),
        ("usb://0403:6001/A1", True),
        ("usb://0403:6001/B2", False),
        ("usb://0403:6015", False),
        ("usb://0404:6001", False),
    ],
)
def test_usb(machine: Machine, url: str, there: bool) -> None:
    assert not machine.watch(url).is_there()
    machine.plug("1-1", "A1")
    assert machine.watch(url).is_there() is there
    event = usb_event("403/6001/600")
    assert told(machine.watch(url), event) is there
    assert not told(
        machine.watch(url), usb_event("403/6001/600", "usb_interface"), usb_event("403/60012/600")
    )
    machine.unplug("1-1")
    assert not told(machine.watch(url), event)


def test_what_cannot_be_looked_for_is_taken_to_be_there(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    for url in ("socket://h:1", "rfc2217://h:1"):
        looking = machine.watch(url)
        assert (looking.fd, looking.is_there(), looking.path()) == (-1, True, url)
    port = machine.plug("ttyUSB0")
    shutil.rmtree(machine.sys / "bus")
    assert machine.watch("usb://0403:6001").is_there()  # a container without /sys

    def refuse(*_args: object) -> None:
        raise OSError

    monkeypatch.setattr(watch.socket, "socket", refuse)
    looking = machine.watch(port)
    assert (looking.fd, looking.is_there(), looking.has_come()) == (-1, True, False)
    looking.arm()
    looking.disarm()
    looking.close()


class Overflowing:
    """A socket whose queue was too short."""

    def __init__(self) -> None:
        self.answers = [OSError(105, "ENOBUFS"), BlockingIOError(11, "EAGAIN")]

    def recv(self, _size: int) -> bytes:
        raise self.answers.pop(0)

    def close(self) -> None:
        pass


def test_lost_events_are_reason_enough_to_look(machine: Machine) -> None:
    looking = machine.watch(machine.dev / "ttyUSB0")
    for there in (False, True):
        looking.close()
        looking._socket = Overflowing()  # type: ignore[assignment]
        assert looking.has_come() is there
        if not there:
            machine.plug("ttyUSB0")
    looking.close()


def test_a_real_socket_is_silent_unless_armed() -> None:
    looking = Watch("/dev/ttyUSB0")
    if looking.fd < 0:
        pytest.skip("no AF_NETLINK here")
    looking.arm()
    looking.arm()
    assert not looking.has_come()
    looking.disarm()
    assert not select.select([looking.fd], (), (), 0)[0]
    looking.close()
    looking.close()
    assert looking.fd == -1
