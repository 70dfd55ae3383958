"""The watch for devices: events as the kernel and udev send them, by way of a made-up /sys and /dev."""

from __future__ import annotations

import select
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from benches.machine import Machine, kernel_event, udev_event

from bridged.ports import uevents, watch
from bridged.ports.uevents import Uevents
from bridged.ports.watch import Watch


def tty_event(name: str, action: str = "add", *, udev: bool = False) -> bytes:
    node = f"/dev/{name}" if udev else name
    build = udev_event if udev else kernel_event
    return build(ACTION=action, DEVPATH=f"/devices/x/tty/{name}", SUBSYSTEM="tty", DEVNAME=node)


def usb_event(product: str, devtype: str = "usb_device") -> bytes:
    return kernel_event(
        ACTION="add", DEVPATH="/devices/usb1/1-1", SUBSYSTEM="usb", DEVTYPE=devtype, PRODUCT=product
    )


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    made = Machine(tmp_path, monkeypatch)
    yield made
    made.close()


def told(looking: Watch, *events: bytes) -> bool:
    """What has_come() makes of these events."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setblocking(False)
    looking.close()
    looking._uevents = Uevents(near)
    for event in events:
        far.send(event)
    far.close()
    try:
        return looking.has_come()
    finally:
        looking.close()


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


def test_the_tty_of_a_usb_device(machine: Machine) -> None:
    """Whatever the kernel calls it; and of two with the same serial number none is taken."""
    url = "usb-serial://A1"
    looking = machine.watch(url)
    assert (looking.path(), looking.is_there()) == (url, False)
    machine.plug("ttyUSB0", "B2")
    assert not looking.is_there()
    for name in ("ttyUSB1", "ttyACM0"):
        node = machine.plug(name, "A1")
        assert (looking.path(), looking.is_there()) == (str(node), True)
        assert told(machine.watch(url), tty_event(name))
        assert not told(machine.watch(url), tty_event("ttyUSB0"), tty_event(name, "remove"))
        machine.unplug(name)
    machine.plug("ttyUSB1", "A1")
    machine.plug("ttyUSB2", "A1")
    assert (looking.path(), looking.is_there()) == (url, True)


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

    monkeypatch.setattr(uevents.socket, "socket", refuse)
    monkeypatch.setattr(watch.select, "epoll", refuse)
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
        looking._uevents = Uevents(Overflowing())  # type: ignore[arg-type]
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
