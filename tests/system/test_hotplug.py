"""An adapter that is plugged in late, under any name: noticed, permitted, found by its serial number.

What a container has is made here part by part; containers themselves are in test_containers_hotplug.py.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rig import Chip, Rig, wait_until

pytestmark = pytest.mark.timeout(600)

INTERFACE = "cbtplug"
# So long that only the news of the device can end them within a test.
PAUSES = {"initial": 300, "maximum": 300}
# Root of a namespace without any right outside of it; the network namespace is its own, too.
USER_NAMESPACE = ("unshare", "--user", "--map-root-user", "--net")
INSTANCES = Path("/proc/sys/fs/inotify/max_user_instances")


def configuration(port: str, **adapter: Any) -> dict[str, Any]:
    return {
        "adapter": {"type": "can232", "port": port} | adapter,
        "channel": {"bitrate": 125_000},
        "bus": {"channel": INTERFACE, "create": True},
        "reconnect": PAUSES,
    }


@pytest.fixture
def chips(rig: Rig) -> tuple[Chip, Chip]:
    """Both of the machine's, pulled out: the adapter, and another device."""
    found = rig.chip("ftdi0"), rig.chip("ftdi1")
    for chip in found:
        chip.unplug()
    return found


@pytest.fixture
def no_inotify() -> Iterator[None]:
    """For programs started meanwhile."""
    before = INSTANCES.read_text()
    INSTANCES.write_text("0")
    yield
    INSTANCES.write_text(before)


def plugged_in_under_other_names(rig: Rig, chips: tuple[Chip, Chip], within: tuple[str, ...] = ()) -> None:
    chip, other = chips
    port = f"usb-serial://{chip.serial_number}"
    rig.host_simulate(adapter="can232")
    bridge = rig.bridge(configuration(port), within=within)
    status = bridge.wait_state("waiting")
    assert (
        status["reason"]
        == f"{port}: no USB device with a serial line has this serial number; those here: none"
    )
    names = set()
    for round_ in range(3):
        if round_ == 1:
            other.plug()
            other.wait_tty()  # it has the adapter's name now
        chip.plug()
        status = bridge.wait_state("running")
        assert status["counters"]["reconnects"] == round_
        tty = chip.wait_tty()
        names.add(tty)
        assert f"{tty} is opened for {port}, by its serial number" in bridge.err
        chip.unplug()
        bridge.wait_status(lambda status: status["state"] in {"waiting", "backoff"}, "the loss to be noticed")
    assert len(names) == 2
    assert bridge.err.count(f"{port} was plugged in") == 3
    assert "permission" not in bridge.err
    bridge.stop_cleanly()


@pytest.mark.usefixtures("no_inotify")
def test_taken_up_by_device_events(rig: Rig, chips: tuple[Chip, Chip]) -> None:
    plugged_in_under_other_names(rig, chips)


def test_taken_up_without_device_events(rig: Rig, chips: tuple[Chip, Chip]) -> None:
    """In a namespace of a user, where the kernel sends none."""
    plugged_in_under_other_names(rig, chips, USER_NAMESPACE)


def test_a_link_is_taken_up_without_device_events(rig: Rig, chips: tuple[Chip, Chip]) -> None:
    """Which udev makes on the host, with the directories on the way to it."""
    chip = chips[0]
    chip.plug()
    chip.wait_tty()
    link = next(Path("/dev/serial/by-id").glob(f"*{chip.serial_number}*"))
    chip.unplug()
    wait_until(lambda: not link.parent.parent.exists(), "udev to remove the directories")
    rig.host_simulate(adapter="can232")
    bridge = rig.bridge(configuration(str(link)), within=USER_NAMESPACE)
    bridge.wait_state("waiting")
    chip.plug()
    bridge.wait_state("running")
    bridge.stop_cleanly()


@pytest.mark.parametrize("raw", [False, True], ids=["tty", "libusb"])
def test_the_device_cgroup(rig: Rig, raw: bool) -> None:
    """A device that is not in its list gives an error that names the rule."""
    chip = rig.chip("ftdi0")
    tty = chip.wait_tty()
    rig.host_simulate(adapter="usb2can")
    port = f"usb://0403:6001/{chip.serial_number}" if raw else f"usb-serial://{chip.serial_number}"
    settings = configuration(port, type="usb2can")
    scope = ("systemd-run", "--scope", "--quiet", "--property=DevicePolicy=closed")
    bridge = rig.bridge(settings, within=scope)
    reason = bridge.wait_state("backoff")["reason"]
    major = 189 if raw else 188
    assert "is none of the devices that this program may use: " in reason
    assert f'run the container with --device-cgroup-rule="c {major}:* rmw"' in reason
    assert raw or reason.startswith(f"{tty}: {tty} is none")
    bridge.stop_cleanly()
    kind = "char-usb_device" if raw else "char-ttyUSB"
    bridge = rig.bridge(settings, "allowed", within=(*scope, f"--property=DeviceAllow={kind} rw"))
    bridge.wait_state("running")
    bridge.stop_cleanly()
