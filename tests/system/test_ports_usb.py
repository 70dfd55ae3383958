"""Ports that are USB devices, on a real kernel: raw through libusb, and by way of ftdi_sio as a tty.

Two kinds of chip: QEMU's (only in our virtual machine), which sends nothing when idle and can be unplugged by
hand of the monitor, and our own behind vhci-hcd, which sends empty packets as a real FT245 does.
"""

import contextlib
import json
import os
import random
import select
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import ftdi_vhci
import pytest
from ftdi_vhci import FakeFt245
from rig import DEADLINE_S, HOST, Chip, Rig, wait_until

from bridged.errors import PortError
from bridged.ports import Port, open_port

pytestmark = pytest.mark.timeout(600)

AMOUNT = 20_000
BLOCK = 4096


def some_bytes(seed: int) -> bytes:
    """With everything that a terminal might take for a control character."""
    return bytes(range(256)) + random.Random(seed).randbytes(AMOUNT - 256)


def exchange(fd: int, outgoing: bytes, incoming: int) -> bytes:
    """Write all of `outgoing` while `incoming` bytes are read; those."""
    read = b""
    while outgoing or len(read) < incoming:
        readable, writable, _ = select.select([fd], [fd] if outgoing else [], [], DEADLINE_S)
        assert readable or writable, f"{len(read)} of {incoming} bytes came, {len(outgoing)} are not sent"
        if readable:
            block = os.read(fd, BLOCK)
            assert block, f"end of file after {len(read)} bytes"
            read += block
        if writable:
            with contextlib.suppress(BlockingIOError):
                outgoing = outgoing[os.write(fd, outgoing[:BLOCK]) :]
    return read


def assert_nothing_comes(fd: int, for_s: float = 0.3) -> None:
    assert not select.select([fd], [], [], for_s)[0], os.read(fd, BLOCK)


def assert_ends(port: Port) -> None:
    assert select.select([port.fd], [], [], DEADLINE_S)[0], "the port does not end"
    with contextlib.suppress(OSError):  # EIO, of some drivers
        assert os.read(port.fd, 1) == b""


def tty_of(serial_number: str) -> Path | None:
    """The terminal that udev has made of the device."""
    links = Path("/dev/serial/by-id").glob(f"*{serial_number}*")
    return next((link.resolve() for link in links if link.exists()), None)


def wait_tty(serial_number: str) -> str:
    return str(wait_until(lambda: tty_of(serial_number), f"the terminal of {serial_number}"))


def latency_timer(tty: str) -> int:
    return int((Path("/sys/class/tty") / Path(tty).name / "device/latency_timer").read_text())


@pytest.fixture
def plug() -> Iterator[Callable[[str], FakeFt245]]:
    """Makes chips behind vhci-hcd, plugged in; its terminal is there."""
    if not ftdi_vhci.load_driver():
        pytest.skip("this kernel has no vhci-hcd, or does not let us use it")
    chips = []

    def plug(serial_number: str) -> FakeFt245:
        chip = FakeFt245(serial_number)
        chips.append(chip)
        chip.plug()
        wait_tty(serial_number)
        return chip

    yield plug
    for chip in chips:
        chip.unplug()
    wait_until(lambda: not any(tty_of(chip.serial_number) for chip in chips), "the fake chips to be gone")


@pytest.fixture
def far_end(rig: Rig) -> Iterator[int]:
    """What QEMU's chip `ftdi1` is wired to: its descriptor, with nothing left in it."""
    fd = os.open(rig.chip("ftdi1").far_end, os.O_RDWR | os.O_NONBLOCK)
    while select.select([fd], [], [], 0.3)[0] and os.read(fd, BLOCK):
        pass
    yield fd
    os.close(fd)


def exchange_through(port: Port, far_end: int) -> None:
    """AMOUNT each way, first this way and then that: neither end may wait for the other one's reader."""
    for source, sink, seed in ((port.fd, far_end, 1), (far_end, port.fd, 2)):
        data, arrived = some_bytes(seed), b""
        for at in range(0, AMOUNT, 2000):
            exchange(source, data[at : at + 2000], 0)
            arrived += exchange(sink, b"", min(2000, AMOUNT - at))
        assert arrived == data


class TestQemusChip:
    def test_raw(self, rig: Rig, far_end: int) -> None:
        chip = rig.chip("ftdi1")
        port = open_port(f"usb://0403:6001/{chip.serial_number}", 57600)
        assert port.serial_number == chip.serial_number
        assert chip.tty is None or not chip.tty.exists()
        exchange_through(port, far_end)
        assert_nothing_comes(port.fd)  # longer than a read waits
        port.close()
        assert port.failure is None
        chip.wait_tty()

    def test_tty(self, rig: Rig, far_end: int) -> None:
        chip = rig.chip("ftdi1")
        tty = str(chip.wait_tty())
        port = open_port(tty, 57600)
        assert port.serial_number == chip.serial_number
        assert latency_timer(tty) == 1
        exchange_through(port, far_end)
        port.close()

    def test_link_of_udev(self, rig: Rig) -> None:
        chip = rig.chip("ftdi1")
        chip.wait_tty()
        link = next(Path("/dev/serial/by-id").glob(f"*{chip.serial_number}*"))
        port = open_port(str(link), 57600)
        assert port.serial_number == chip.serial_number
        port.close()

    def test_two_alike(self, rig: Rig) -> None:
        for name in ("ftdi0", "ftdi1"):
            rig.chip(name)
        with pytest.raises(PortError, match=r"2 of them: add a serial number \(RIG0001, RIG0002\)"):
            open_port("usb://0403:6001", 57600)

    @pytest.mark.parametrize("raw", [True, False])
    def test_unplug_and_plug(self, rig: Rig, *, raw: bool) -> None:
        chip = rig.chip("ftdi1")
        address = f"usb://0403:6001/{chip.serial_number}"
        port = open_port(address if raw else str(chip.tty), 57600)
        chip.unplug()
        assert_ends(port)
        if raw:
            assert str(port.failure).startswith(f"{address}: unplugged"), port.failure
        port.close()
        with pytest.raises(PortError, match=r"no such USB device|does not exist"):
            open_port(port.description, 57600)
        chip.plug()
        tty = chip.wait_tty()
        port = open_port(address if raw else str(tty), 57600)
        assert port.serial_number == chip.serial_number
        port.close()
        chip.wait_tty()


class TestChipThatSendsEmptyPackets:
    def test_raw(self, plug: Callable[[str], FakeFt245]) -> None:
        chip = plug("PY000001")
        chip.requests.clear()
        port = open_port("usb://0403:6001/PY000001", 57600)
        assert chip.requests == [(0x40, 0, 0, 0), (0x40, 0, 1, 0), (0x40, 0, 2, 0), (0x40, 9, 1, 0)]
        assert (chip.latency_ms, port.serial_number) == (1, "PY000001")
        assert tty_of("PY000001") is None

        idle = chip.idle_packets
        wait_until(lambda: chip.idle_packets > idle + 20, "empty packets")
        assert_nothing_comes(port.fd, 0.0)

        incoming, outgoing = some_bytes(3), some_bytes(4)
        chip.send(incoming)
        assert exchange(port.fd, outgoing, AMOUNT) == incoming
        wait_until(lambda: len(chip.received) >= AMOUNT, "all bytes to arrive")
        assert chip.received == outgoing
        port.close()
        assert port.failure is None
        wait_tty("PY000001")  # the kernel's driver has it again

    def test_tty(self, plug: Callable[[str], FakeFt245]) -> None:
        chip = plug("PY000002")
        tty = wait_tty("PY000002")
        port = open_port(tty, 57600)
        assert port.serial_number == "PY000002"
        assert (chip.latency_ms, latency_timer(tty)) == (1, 1)
        incoming, outgoing = some_bytes(5), some_bytes(6)
        chip.send(incoming)
        assert exchange(port.fd, outgoing, AMOUNT) == incoming
        wait_until(lambda: len(chip.received) >= AMOUNT, "all bytes to arrive")
        assert chip.received == outgoing
        port.close()

    def test_two_alike_are_told_apart(self, plug: Callable[[str], FakeFt245]) -> None:
        chips = {number: plug(number) for number in ("PY000003", "PY000004")}
        with pytest.raises(PortError, match=r"of them: add a serial number \(.*PY000003, PY000004"):
            open_port("usb://0403:6001", 57600)
        ports = {number: open_port(f"usb://0403:6001/{number}", 57600) for number in chips}
        for number, chip in chips.items():
            chip.send(number.encode())
            assert exchange(ports[number].fd, b"", len(number)) == number.encode()
        for port in ports.values():
            port.close()
        with pytest.raises(PortError, match=r"no such USB device: there is .*PY000003, PY000004"):
            open_port("usb://0403:6001/PY000009", 57600)

    def test_in_use(self, plug: Callable[[str], FakeFt245]) -> None:
        plug("PY000005")
        address, tty = "usb://0403:6001/PY000005", wait_tty("PY000005")
        program = (
            "from bridged.ports import open_port\n"
            f"port = open_port({tty!r}, 57600)\n"
            "print('open', flush=True)\n"
            "input()\n"
        )
        with subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other:
            assert other.stdout
            assert other.stdout.readline() == b"open\n"
            with pytest.raises(
                PortError, match=rf"{tty} is in use by python3.* .process {other.pid}.: stop that"
            ):
                open_port(address, 57600)
            other.kill()
        assert wait_tty("PY000005") == tty  # it was not taken away
        port = open_port(address, 57600)
        with pytest.raises(PortError, match="in use by"):
            open_port(address, 57600)
        port.close()

    def test_no_permission(self, plug: Callable[[str], FakeFt245]) -> None:
        plug("PY000006")
        program = (
            "import os; os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
            "from bridged.errors import PortError; from bridged.ports import open_port\n"
            "try: open_port('usb://0403:6001/PY000006', 57600)\n"
            "except PortError as error: print(error)\n"
        )
        said = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        ).stdout
        assert "user nobody has no permission for /dev/bus/usb/" in said
        assert 'SUBSYSTEM=="usb", ATTR{idVendor}=="0403", ATTR{idProduct}=="6001"' in said

    def test_unplug_and_plug(self, plug: Callable[[str], FakeFt245]) -> None:
        chip = plug("PY000007")
        for _ in range(2):
            port = open_port("usb://0403:6001/PY000007", 57600)
            chip.unplug()
            assert_ends(port)
            assert str(port.failure).startswith("usb://0403:6001/PY000007: unplugged"), port.failure
            port.close()
            with pytest.raises(PortError, match="no such USB device"):
                open_port("usb://0403:6001/PY000007", 57600)
            chip.plug()
            wait_tty("PY000007")


class TestHostSide:
    """What the tests of adapters on USB stand on: a simulator at full speed, on the host."""

    @pytest.fixture(autouse=True)
    def in_our_machine(self, rig: Rig) -> Chip:
        return rig.chip("ftdi0")

    def test_simulator_on_the_host(self, rig: Rig, in_our_machine: Chip) -> None:
        (HOST / "state.json").unlink(missing_ok=True)
        simulator = rig.host_simulate("--state", "state.json", adapter="can232")
        port = open_port(str(in_our_machine.wait_tty()), 57600)
        exchange(port.fd, b"V\r", 0)
        assert exchange(port.fd, b"", 6).startswith(b"V1")
        port.close()
        simulator.user_signal()
        wait_until((HOST / "state.json").exists, "the state that SIGUSR1 asks for")
        assert simulator.stop() == 0, str(simulator)
        assert json.loads((HOST / "state.json").read_text())
