"""The watch for devices where no device events come, as in a container with a user namespace."""

from __future__ import annotations

import select
from collections.abc import Iterator
from pathlib import Path

import pytest
from benches.machine import Machine

from bridged.ports import inotify, watch
from bridged.ports.watch import Watch


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    monkeypatch.setattr(watch, "open_socket", lambda: None)
    made = Machine(tmp_path, monkeypatch)
    yield made
    made.close()


def wakes(looking: Watch) -> bool:
    return bool(select.select([looking.fd], [], [], 0)[0])


def assert_comes(looking: Watch) -> None:
    """It has come, and that is told once."""
    assert wakes(looking)
    assert looking.has_come()
    assert not wakes(looking)
    assert not looking.has_come()


def test_a_node_comes_again_and_again(machine: Machine) -> None:
    looking = machine.watch(machine.dev / "ttyUSB0")
    looking.arm()
    for _ in range(2):
        machine.plug("ttyUSB1")
        assert not looking.has_come()
        machine.plug("ttyUSB0")
        assert_comes(looking)
        machine.unplug("ttyUSB0")
        machine.unplug("ttyUSB1")
    assert not looking.has_come()


def test_nothing_is_told_unless_armed(machine: Machine) -> None:
    looking = machine.watch(machine.dev / "ttyUSB0")
    machine.plug("ttyUSB0")
    assert not wakes(looking)
    looking.arm()
    machine.unplug("ttyUSB0")
    machine.plug("ttyUSB0")
    looking.disarm()
    assert not wakes(looking)
    assert not looking.has_come()
    machine.unplug("ttyUSB0")
    looking.arm()
    machine.plug("ttyUSB0")
    assert_comes(looking)
    looking.close()
    looking.close()


def test_a_link_in_directories_that_are_made_for_it(machine: Machine) -> None:
    """As /dev/serial/by-id: udev makes it with the first link, and removes it with the last."""
    link = machine.dev / "serial/by-id/usb-FTDI_A1-if00-port0"
    looking = machine.watch(link)
    looking.arm()
    for name in ("ttyUSB0", "ttyUSB1"):
        machine.plug(name)
        link.parent.parent.mkdir()
        looking.has_come()  # in the midst of it
        link.parent.mkdir()
        link.symlink_to(f"../../{name}")
        assert_comes(looking)
        link.unlink()
        link.parent.rmdir()
        link.parent.parent.rmdir()
        assert not looking.has_come()
        machine.unplug(name)


def test_directories_and_the_link_before_anybody_looks(machine: Machine) -> None:
    link = machine.dev / "serial/by-id/usb-FTDI_A1-if00-port0"
    looking = machine.watch(link)
    looking.arm()
    machine.plug("ttyUSB0")
    link.parent.mkdir(parents=True)
    link.symlink_to("../../ttyUSB0")
    assert_comes(looking)


def test_directories_that_come_while_one_looks(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the two, inotify is told of them in vain, and then of the one that they are in."""
    link = machine.dev / "serial/by-id/usb-FTDI_A1-if00-port0"
    add = inotify.Inotify.add

    def add_late(names: inotify.Inotify, directories: set[Path]) -> bool:
        new = add(names, directories - {machine.dev})
        link.parent.mkdir(parents=True, exist_ok=True)
        return add(names, {machine.dev}) or new

    monkeypatch.setattr(inotify.Inotify, "add", add_late)
    machine.plug("ttyUSB0")
    looking = machine.watch(link)
    looking.arm()
    link.symlink_to("../../ttyUSB0")
    assert_comes(looking)


@pytest.mark.parametrize("absolute", [False, True])
def test_a_link_whose_target_comes(machine: Machine, tmp_path: Path, absolute: bool) -> None:
    """Through a link to a directory, and a second link."""
    (tmp_path / "names").mkdir()
    (tmp_path / "short").symlink_to("names")
    node = machine.dev / "ttyUSB0"
    (tmp_path / "names/adapter").symlink_to(node if absolute else "../dev/ttyUSB0")
    looking = machine.watch(tmp_path / "short/adapter")
    looking.arm()
    (tmp_path / "names/other").touch()
    assert not looking.has_come()
    machine.plug("ttyUSB0")
    assert_comes(looking)


def test_links_in_a_circle(machine: Machine) -> None:
    (machine.dev / "a").symlink_to("b")
    (machine.dev / "b").symlink_to("a")
    looking = machine.watch(machine.dev / "a")
    looking.arm()
    (machine.dev / "ttyUSB0").touch()
    assert not looking.has_come()


@pytest.mark.parametrize("port", ["usb-serial://A1", "/dev/ttyUSB7"])
def test_another_node_of_the_same_device(machine: Machine, port: str) -> None:
    looking = machine.watch(port, "A1")
    looking.arm()
    for name in ("ttyUSB0", "ttyUSB3", "ttyACM0"):
        machine.plug("ttyUSB1", "B2")
        assert not looking.has_come()
        machine.plug(name, "A1")
        assert_comes(looking)
        (machine.dev / "ttyS7").touch()  # while the adapter is there, but does not work
        assert not looking.has_come()
        (machine.dev / "ttyS7").unlink()
        machine.unplug("ttyUSB1")
        machine.unplug(name)


@pytest.mark.parametrize("url", ["usb://0403:6001", "usb://0403:6001/A1"])
def test_a_raw_usb_device(machine: Machine, url: str) -> None:
    looking = machine.watch(url)
    looking.arm()
    machine.plug("1-1", "A1", node="001/004")  # with /dev/bus/usb and a bus that are new, too
    assert_comes(looking)
    (machine.dev / "bus/usb/001/005").touch()
    assert not looking.has_come()
    machine.unplug("1-1")
    machine.plug("1-1", "A1", node="001/006")
    assert_comes(looking)
    machine.unplug("1-1")
    machine.plug("1-1", "A1", node="002/001")
    assert_comes(looking)


def test_lost_events_are_reason_enough_to_look(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    looking = machine.watch(machine.dev / "ttyUSB0")
    looking.arm()
    monkeypatch.setattr(inotify.Inotify, "read", lambda _: (set(), True))
    assert not looking.has_come()
    machine.plug("ttyUSB0")
    assert looking.has_come()


def test_where_the_kernel_gives_no_inotify(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inotify, "_INIT_FLAGS", -1)
    looking = machine.watch(machine.dev / "ttyUSB0")
    looking.arm()
    machine.plug("ttyUSB0")
    assert not looking.has_come()
    assert looking.is_there()
    looking.disarm()
