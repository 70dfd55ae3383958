"""What /sys and /proc tell of a tty: the serial number of the USB device that it is, its timer, its users."""

from __future__ import annotations

import os
import socket
import subprocess
from pathlib import Path

import pytest

from bridged.ports import open_port, sysfs


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sysfs, "_SYS", tmp_path / "sys")
    return tmp_path


@pytest.fixture
def tty(machine: Path) -> Path:
    """…/usb1/1-4/1-4:1.0/ttyUSB0/tty/ttyUSB0, with a hub above that has a serial number, too."""
    hub = machine / "sys/devices/usb1"
    tty = hub / "1-4/1-4:1.0/ttyUSB0/tty/ttyUSB0"
    tty.mkdir(parents=True)
    (tty / "device").symlink_to("../..")
    for device, number in ((hub, "0000:00:04.0"), (hub / "1-4", "A6001234")):
        (device / "idVendor").write_text("0403\n")
        (device / "serial").write_text(f"{number}\n")
    return tty


def test_serial_number(tty: Path) -> None:
    assert sysfs.serial_number(tty) == "A6001234"
    (tty.parents[3] / "serial").unlink()
    assert sysfs.serial_number(tty) is None  # and not the hub's


def test_product(tty: Path) -> None:
    (tty.parents[4] / "product").write_text("hub\n")
    assert sysfs.product(tty) is None
    (tty.parents[3] / "product").write_text("CANtact dev\n")
    assert sysfs.product(tty) == "CANtact dev"


def test_usb_ttys(machine: Path, tty: Path) -> None:
    """Each device's in the order of its interfaces; what is no USB device's is none."""
    places = {
        "ttyUSB10": "usb1/1-4/1-4:1.1/ttyUSB10",  # the second line of the device of ttyUSB0
        "ttyACM0": "usb1/1-2/1-2:1.10",
        "ttyACM1": "usb1/1-2/1-2:1.2",
        "ttyS0": "pnp0/00:01",
    }
    (machine / "sys/class/tty").mkdir(parents=True)
    (machine / "sys/class/tty/ttyUSB0").symlink_to(tty)
    (machine / "sys/class/tty/console").symlink_to(tty)
    for name, place in places.items():
        directory = machine / "sys/devices" / place / "tty" / name
        directory.mkdir(parents=True)
        (machine / "sys/class/tty" / name).symlink_to(directory)
    (machine / "sys/devices/usb1/1-2/idVendor").write_text("1209\n")
    found = [(text.device, text.interface, text.name, number) for text, number in sysfs.usb_ttys().items()]
    assert found == [
        ("1-2", 2, "ttyACM1", ""),
        ("1-2", 10, "ttyACM0", ""),
        ("1-4", 0, "ttyUSB0", "A6001234"),
        ("1-4", 1, "ttyUSB10", "A6001234"),
    ]
    assert [text.name for text in sysfs.usb_ttys_of("A6001234")] == ["ttyUSB0", "ttyUSB10"]


def test_no_usb_device(machine: Path) -> None:
    assert sysfs.serial_number(machine) is None


def test_latency_timer(tty: Path) -> None:
    assert sysfs.latency_ms(tty) is None
    (tty.parents[1] / "latency_timer").write_text("16\n")
    assert sysfs.latency_ms(tty) == 16


def test_by_the_number_of_the_device(tty: Path, machine: Path) -> None:
    with Path("/dev/null").open("rb") as null:
        number = os.fstat(null.fileno()).st_rdev
        assert sysfs.tty_directory(null.fileno()) is None
        link = machine / f"sys/dev/char/{os.major(number)}:{os.minor(number)}"
        link.parent.mkdir(parents=True)
        link.symlink_to(tty)
        assert sysfs.tty_directory(null.fileno()) == tty


def test_users(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    assert sysfs.users(file) == []
    with file.open("rb"):
        assert [user.endswith(f"(process {os.getpid()})") for user in sysfs.users(file)] == [True]


def test_users_of_a_terminal() -> None:
    """Whoever has made it is its other end, and no other user."""
    master, slave = os.openpty()
    path = Path(os.ttyname(slave))
    assert sysfs.users(path) == []
    with subprocess.Popen(["cat"], stdin=slave, stdout=subprocess.DEVNULL) as cat:
        try:
            assert sysfs.users(path) == [f"cat (process {cat.pid})"]
        finally:
            cat.kill()
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (
            "/usr/bin/python3 /usr/bin/can-bridge run --socket /run/x.sock /etc/can-bridge/pc.yaml",
            "bridge pc",
        ),
        ("/usr/bin/python3 -m bridged run pc --verbose", "bridge pc"),
        ("/usr/bin/python3 -m bridged run --verbose --user 65532 pc", "bridge pc"),
        ("can-bridge run --type can232 --port=/dev/ttyUSB0 --create vcan0", "bridge vcan0"),
        ("/usr/bin/python3 /usr/bin/can-bridge simulate can232", "can-bridge"),
        ("vi can-bridge run", "can-bridge"),
    ],
)
def test_a_bridge_is_named(tmp_path: Path, command: str, name: str) -> None:
    process = tmp_path / "12"
    process.mkdir()
    (process / "comm").write_text("can-bridge\n")
    (process / "cmdline").write_text(command.replace(" ", "\0") + "\0")
    assert sysfs._described(process) == f"{name} (process 12)"


def test_ports_that_are_no_usb_devices() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = open_port(f"socket://127.0.0.1:{listener.getsockname()[1]}", 57600)
        assert (port.serial_number, port.product) == (None, None)
        port.close()
    port = open_port("loop://", 57600)
    assert (port.serial_number, port.product) == (None, None)
    port.close()


def test_a_port_tells_the_product_of_its_device(tty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tty.parents[3] / "product").write_text("CANtact dev\n")
    monkeypatch.setattr(sysfs, "tty_directory", lambda _fd: tty)
    terminal, line = os.openpty()
    port = open_port(os.ttyname(line), 57600)
    assert (port.serial_number, port.product) == ("A6001234", "CANtact dev")
    port.close()
    os.close(terminal)
    os.close(line)


def test_a_serial_number_has_no_control_characters(tty: Path) -> None:
    (tty.parents[3] / "serial").write_text("A\x1b[2J\nroot: all is well\n")
    assert sysfs.serial_number(tty) == r"A\x1b[2J\nroot: all is well"
