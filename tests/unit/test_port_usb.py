"""usb:// ports with libusb and its chips faked: the bytes, whose device it is, what the errors say."""

from __future__ import annotations

import ctypes
import errno
import os
import random
import select
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
import usb.backend.libusb1
from benches.fake_libusb import Chip, FakeLibusb, usb_error
from usb.core import USBError

from bridged.errors import NotPermittedError, PortError
from bridged.ports import open_port, permission, sysfs
from bridged.ports import usb as ports
from bridged.ports.usb import strip_status

if TYPE_CHECKING:
    from collections.abc import Callable

LIMIT_S = 30.0  # for what takes milliseconds
URL = "usb://0403:6001"
STATUS = b"\x01\x60"


@pytest.fixture(autouse=True)
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine without USB devices in /sys and /dev; its root."""
    monkeypatch.setattr(sysfs, "_SYS", tmp_path / "sys")
    monkeypatch.setattr(ports, "_DEV", tmp_path / "dev")
    monkeypatch.setattr(ports, "_POLL_INTERVAL_MS", 10)
    return tmp_path


@pytest.fixture
def plug(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    def plug(*chips: Chip) -> None:
        backend = FakeLibusb(*chips)
        monkeypatch.setattr(ports, "_load_libusb", lambda _: backend)

    return plug


@pytest.fixture
def chip(plug: Callable[..., None]) -> Chip:
    chip = Chip()
    plug(chip)
    return chip


def read_exactly(fd: int, n: int) -> bytes:
    data = b""
    while len(data) < n:
        assert select.select([fd], [], [], LIMIT_S)[0], f"nothing came after {data!r}"
        block = os.read(fd, n - len(data))
        assert block, f"end of file after {data!r}"
        data += block
    return data


def read_end(fd: int) -> None:
    assert select.select([fd], [], [], LIMIT_S)[0], "nothing came"
    assert os.read(fd, 1) == b""


def in_packets(data: bytes, size: int = 64) -> bytes:
    """As the chip sends it in one transfer: at least one packet, all but the last full."""
    step = size - 2
    return b"".join(STATUS + data[at : at + step] for at in range(0, max(1, len(data)), step))


class TestStripStatus:
    @pytest.mark.parametrize(
        ("transfer", "data"),
        [
            (b"\x01\x60", b""),
            (b"\x01\x60AB", b"AB"),
            (b"\x01\x60" + b"A" * 62, b"A" * 62),
            (b"\x01\x60" + b"A" * 62 + b"\x01\x60", b"A" * 62),
            (b"\x01\x60" + b"A" * 62 + b"\x01\x60B", b"A" * 62 + b"B"),
            (b"\x01", b""),  # a chip sends no such thing; a broken one shall do no harm
            (b"\x01\x60" + b"A" * 62 + b"\x01", b"A" * 62),
        ],
    )
    def test_by_example(self, transfer: bytes, data: bytes) -> None:
        assert strip_status(memoryview(transfer), 64) == data

    @pytest.mark.parametrize("size", [64, 512])
    def test_any_length(self, size: int) -> None:
        data = random.Random(1).randbytes(64 * size)
        for n in [*range(300), *range(1000, len(data), 997)]:
            assert strip_status(memoryview(in_packets(data[:n], size)), size) == data[:n]


class TestOpen:
    def test_takes_the_chip_and_gives_it_back(self, chip: Chip) -> None:
        port = open_port(URL, 57600)
        assert chip.calls[-6:] == ["detach", "claim", (0, 0), (0, 1), (0, 2), (9, 1)]
        assert (port.description, port.serial_number, port.failure) == (URL, "A1", None)
        port.close()
        port.close()
        assert port.fd == -1
        assert chip.calls[-2:] == ["release", "attach"]
        assert (chip.driver, chip.claimed, chip.opened) == (True, False, 0)

    def test_gives_nothing_to_a_kernel_that_had_nothing(self, chip: Chip) -> None:
        chip.driver = False
        open_port(URL, 57600).close()
        assert not {"detach", "attach"} & set(chip.calls)
        assert chip.opened == 0

    def test_configures_only_what_is_not_configured(self, chip: Chip) -> None:
        open_port(URL, 57600).close()
        assert "set_configuration" not in chip.calls
        chip.configuration = 0
        open_port(URL, 57600).close()
        assert chip.calls.count("set_configuration") == 1

    def test_chip_without_a_latency_timer(self, chip: Chip) -> None:
        chip.refuse[9, 1] = errno.EPIPE
        open_port(URL, 57600).close()

    def test_again_and_again_without_leaks(self, chip: Chip) -> None:
        before = os.listdir("/proc/self/fd"), threading.active_count()  # noqa: PTH208 - names, not paths
        for _ in range(20):
            open_port(URL, 57600).close()
            chip.refuse["claim"] = errno.EBUSY
            with pytest.raises(PortError):
                open_port(URL, 57600)
            chip.refuse.clear()
        assert (os.listdir("/proc/self/fd"), threading.active_count()) == before  # noqa: PTH208


class TestBytes:
    def test_both_ways(self, chip: Chip) -> None:
        port = open_port(URL, 57600)
        everything = random.Random(2).randbytes(4000)
        with pytest.raises(BlockingIOError):
            os.read(port.fd, 1)
        for transfer in (
            STATUS,
            in_packets(everything[:3000]),
            STATUS,
            STATUS,
            in_packets(everything[3000:]),
        ):
            chip.transfers.put(transfer)
        assert read_exactly(port.fd, 4000) == everything
        assert os.write(port.fd, everything) == 4000
        written = b""
        while len(written) < 4000:
            written += chip.written.get(timeout=LIMIT_S)
        assert written == everything
        port.close()
        assert port.failure is None

    def test_chip_that_takes_bytes_by_and_by(self, chip: Chip) -> None:
        port = open_port(URL, 57600)
        chip.room = [1, 0, 2, 0, 0, 3]
        os.write(port.fd, b"ABCDEFGH")
        assert [chip.written.get(timeout=LIMIT_S) for _ in range(4)] == [b"A", b"BC", b"DEF", b"GH"]
        port.close()
        assert port.failure is None

    def test_what_was_written_goes_out_in_spite_of_close(self, chip: Chip) -> None:
        port = open_port(URL, 57600)
        os.write(port.fd, b"\x0f\x02\x00")
        port.close()
        assert chip.written.get_nowait() == b"\x0f\x02\x00"

    def test_chip_that_takes_nothing_pushes_back_and_does_not_delay_close(self, chip: Chip) -> None:
        port = open_port(URL, 57600)
        chip.stuck.set()
        written = 0
        for _ in range(4096):
            try:
                written += os.write(port.fd, bytes(16))
            except BlockingIOError:
                break
        # A block of the pump and what the kernel holds: the others wait in the relay, which drops old ones.
        assert written < 2 * 4096
        start = time.monotonic()
        port.close()
        assert time.monotonic() - start < 15.0  # it does not hang; how fast it is, is no matter for a test
        assert (port.failure, chip.driver, chip.opened) == (None, True, 0)

    def test_close_while_nobody_reads(self, chip: Chip) -> None:
        port = open_port(URL, 57600)
        for _ in range(400):
            chip.transfers.put(in_packets(bytes(62 * 64)))
        assert select.select([port.fd], [], [], LIMIT_S)[0]
        port.close()
        assert port.failure is None


class TestUnplug:
    @pytest.mark.parametrize(
        ("number", "text"),
        [
            (errno.ENODEV, f"{URL}: unplugged (No such device)"),
            (errno.EIO, f"{URL}: unplugged, or its cable is bad (Input/output error)"),
            (errno.EPIPE, f"{URL}: USB error: Broken pipe"),
        ],
    )
    def test_ends_the_descriptor_and_says_why(self, chip: Chip, number: int, text: str) -> None:
        port = open_port(URL, 57600)
        chip.transfers.put(in_packets(b"last words"))
        chip.transfers.put(usb_error(number))
        assert read_exactly(port.fd, 10) == b"last words"
        read_end(port.fd)
        assert isinstance(port.failure, PortError)
        assert str(port.failure) == text
        chip.refuse = dict.fromkeys(("release", "attach"), errno.ENODEV)
        port.close()
        assert chip.opened == 0

    def test_noticed_when_writing(self, chip: Chip) -> None:
        port = open_port(URL, 57600)
        chip.refuse["write"] = errno.ENODEV
        os.write(port.fd, b"A")
        read_end(port.fd)
        assert str(port.failure) == f"{URL}: unplugged (No such device)"
        port.close()

    def test_while_it_is_opened(self, chip: Chip) -> None:
        for call in ("open", "claim", (0, 0), (9, 1)):
            chip.refuse = dict.fromkeys((call, "release", "attach"), errno.ENODEV)
            with pytest.raises(PortError, match=r"it was just unplugged \(No such device\)") as caught:
                open_port(URL, 57600)
            assert isinstance(caught.value.__cause__, USBError)
            assert chip.opened == 0
            chip.driver = True


class TestChoice:
    def test_by_serial_number(self, plug: Callable[..., None]) -> None:
        chips = [Chip("A1", 4), Chip("B2", 5), Chip("C3", 6)]
        plug(*chips)
        port = open_port(f"{URL}/B2", 57600)
        assert port.serial_number == "B2"
        assert [chip.claimed for chip in chips] == [False, True, False]
        port.close()
        assert [chip.opened for chip in chips] == [0, 0, 0]

    def test_a_serial_number_has_no_control_characters(self, plug: Callable[..., None]) -> None:
        plug(Chip("A\x1b[2J\n"))
        port = open_port(URL, 57600)
        assert port.serial_number == r"A\x1b[2J\n"
        port.close()

    def test_several_and_none_is_named(self, plug: Callable[..., None]) -> None:
        plug(Chip("B2", 4), Chip("A1", 5))
        text = rf"^{URL}: 2 of them: add a serial number \(A1, B2\), as {URL}/B2$"
        with pytest.raises(PortError, match=text):
            open_port(URL, 57600)

    def test_not_there(self, plug: Callable[..., None]) -> None:
        plug()
        with pytest.raises(PortError, match=f"^{URL}: no such USB device, is it plugged in"):
            open_port(URL, 57600)
        plug(Chip())
        with pytest.raises(PortError, match=r"^usb://0403:6010: no such USB device, is it plugged in"):
            open_port("usb://0403:6010", 57600)
        plug(Chip("B2", 4), Chip("A1", 5), Chip("", 6))
        text = f"^{URL}/X: no such USB device: there is A1, B2, one without serial number$"
        with pytest.raises(PortError, match=text):
            open_port(f"{URL}/X", 57600)

    @pytest.mark.parametrize("number", ["", "A1"])
    def test_not_to_be_told_apart(self, plug: Callable[..., None], number: str) -> None:
        plug(Chip(number, 4), Chip(number, 5))
        with pytest.raises(PortError, match="2 devices alike cannot be told apart: plug in only one"):
            open_port(f"{URL}/{number}" if number else URL, 57600)

    def test_serial_numbers_come_from_sys_without_permission(
        self, machine: Path, plug: Callable[..., None]
    ) -> None:
        chips = [Chip("A1", 4), Chip("B2", 5)]
        for chip in chips:
            device = machine / f"sys/bus/usb/devices/1-{chip.address}"
            device.mkdir(parents=True)
            (device / "idVendor").write_text("0403\n")
            (device / "serial").write_text(f"{chip.serial_number}\n")
            chip.refuse["open"] = errno.EACCES
        plug(*chips)
        with pytest.raises(PortError, match="A1, B2"):
            open_port(URL, 57600)
        assert chips[0].calls == chips[1].calls == []
        with pytest.raises(PortError, match="has no permission for"):
            open_port(f"{URL}/B2", 57600)

    @pytest.mark.parametrize(
        "bad", ["usb://", "usb://0403", "usb://0403:", "usb://403:6001", "usb://ftdi:6001", f"{URL}/"]
    )
    def test_malformed(self, bad: str) -> None:
        with pytest.raises(PortError, match="not of the form usb://VID:PID"):
            open_port(bad, 57600)

    @pytest.mark.usefixtures("chip")
    def test_case_does_not_matter(self) -> None:
        with pytest.raises(PortError, match="no such USB device"):
            open_port("usb://ABCD:ef01", 57600)


class TestErrors:
    @pytest.mark.parametrize("group", ["plugdev", "can-bridge"])
    def test_no_permission(
        self, chip: Chip, machine: Path, monkeypatch: pytest.MonkeyPatch, group: str
    ) -> None:
        """The group of the service, where that is installed."""
        groups = {"can-bridge": SimpleNamespace(gr_name="can-bridge")} if group == "can-bridge" else {}
        monkeypatch.setattr(permission.grp, "getgrnam", groups.__getitem__)
        chip.refuse["open"] = errno.EACCES
        with pytest.raises(NotPermittedError) as caught:
            open_port(URL, 57600)
        text = str(caught.value)
        attributes = 'ATTR{idVendor}=="0403", ATTR{idProduct}=="6001"'
        rule = f'SUBSYSTEM=="usb", {attributes}, MODE="0660", GROUP="{group}"'
        for part in (f"{machine}/dev/bus/usb/001/004", rule, "/etc/udev/rules.d/70-can-bridge.rules"):
            assert part in text
        assert "udevadm control --reload && udevadm trigger" in text

    def test_not_in_the_device_cgroup(
        self, chip: Chip, machine: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """libusb says EIO for EPERM."""
        chip.refuse["open"] = errno.EIO
        forbidden: list[Path] = []
        monkeypatch.setattr(ports, "explain_forbidden", lambda node: forbidden.append(node) or "forbidden")
        with pytest.raises(PortError, match=f"^{URL}: forbidden$"):
            open_port(URL, 57600)
        assert forbidden == [machine / "dev/bus/usb/001/004"]

    def test_in_use_by_another_bridge(self, chip: Chip, monkeypatch: pytest.MonkeyPatch) -> None:
        chip.driver = False
        chip.refuse["claim"] = errno.EBUSY
        with pytest.raises(PortError, match=r"in use by another program, another bridge perhaps: stop that"):
            open_port(URL, 57600)
        users = [f"python3 (process {os.getpid()})", "can-bridge (process 1)"]
        monkeypatch.setattr(sysfs, "users", lambda _: users)
        with pytest.raises(PortError, match=r": in use by can-bridge \(process 1\): stop that first$"):
            open_port(URL, 57600)

    def test_tty_in_use_is_not_taken_away(
        self, chip: Chip, machine: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (machine / "sys/bus/usb/devices/1-4/1-4:1.0/ttyUSB3").mkdir(parents=True)
        holders = {machine / "dev/ttyUSB3": ["slcand (process 7)"]}
        monkeypatch.setattr(sysfs, "users", holders.__getitem__)
        with pytest.raises(PortError, match=r"ttyUSB3 is in use by slcand \(process 7\): stop that first"):
            open_port(URL, 57600)
        assert "detach" not in chip.calls
        assert chip.opened == 0

    def test_busy_after_the_kernels_driver_was_sent_away(self, chip: Chip) -> None:
        chip.refuse["claim"] = errno.EBUSY
        with pytest.raises(PortError, match="in use by"):
            open_port(URL, 57600)
        assert (chip.driver, chip.opened) == (True, 0)

    def test_not_an_ftdi_chip(self, chip: Chip) -> None:
        chip.refuse[0, 0] = errno.EPIPE
        with pytest.raises(PortError, match="not an FTDI chip, it refused a reset"):
            open_port(URL, 57600)
        assert (chip.driver, chip.opened) == (True, 0)
        chip.endpoints = [0x81]
        with pytest.raises(PortError, match="not an FTDI chip, it has other endpoints"):
            open_port(URL, 57600)
        assert (chip.driver, chip.opened) == (True, 0)

    def test_anything_else(self, chip: Chip) -> None:
        chip.refuse[0, 0] = errno.ETIMEDOUT
        with pytest.raises(PortError, match="cannot be opened: Connection timed out"):
            open_port(URL, 57600)

    def test_libusb(self, machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def missing(name: str) -> None:
            raise OSError(f"{name}: cannot open shared object file")

        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda **_: None)
        with monkeypatch.context() as patch:
            patch.setattr(ctypes, "CDLL", missing)
            with pytest.raises(PortError, match=r"libusb-1.0 is missing: `apt install libusb-1.0-0`"):
                open_port(URL, 57600)
        monkeypatch.setattr(ctypes, "CDLL", lambda _: None)
        with pytest.raises(PortError, match="this machine has no USB"):
            open_port(URL, 57600)
        (machine / "dev/bus/usb").mkdir(parents=True)
        with pytest.raises(PortError, match="libusb cannot start: allow AF_NETLINK"):
            open_port(URL, 57600)
