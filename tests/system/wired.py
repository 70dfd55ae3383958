"""Simulated adapters behind fake FT245 chips, in a thread of the test: plugged in, each starts anew, at once.

(A simulator of its own for each time of being plugged in would take seconds to start in an emulated machine.)
The device's power comes by the USB cable; of a CAN232 the EEPROM survives.
"""

import contextlib
import dataclasses
import itertools
import math
import random
import re
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import ftdi_vhci
import pytest
from rig import Bridge, Resources, wait_until

from bridged.simulators import faults
from bridged.simulators.can232 import Can232
from bridged.simulators.can232_memory import Counters, Eeprom
from bridged.simulators.faults import BURST_S, Fault
from bridged.simulators.serve import TRAFFIC_LATE_S, record_line
from bridged.simulators.sja1000 import Frame
from bridged.simulators.uart import Uart
from bridged.simulators.usb2can import STOP_GRACE_S, Usb2can
from bridged.simulators.usb2can import Counters as Usb2canCounters

HEARD = 0x1ABCDEF8  # identifier of `numbered_frames`
HEARD_FPS = 50
IDLE_S = 0.016  # a real chip reports each ms; an emulated machine would do little else
TRANSPORT_S = 1.0  # at the very most, from the relay's clock to the chip: an emulated machine may be busy
GROWTH_KIB = 256  # of resident memory, but for some steps that are larger
TABLES, TABLE_KIB = 3, range(128, 1025)
CHIP_FIFO = 256  # bytes from the device that nobody reads
UART_RATE = 115_200
LONGEST_MESSAGE = 32  # bytes, of either protocol

# What a host sends for an extended data frame of 8 bytes: identifier, data
HANDED = {
    "can232": re.compile(rb"T([0-9A-F]{8})8([0-9A-F]{16})\r"),
    "usb2can": re.compile(rb"\x0f\x40\x0d\x88(.{4})(.{8})", re.DOTALL),
}


def numbered_frames() -> Iterator[Frame]:
    """No two alike, without end."""
    for number in itertools.count():
        yield Frame(HEARD, True, False, 8, number.to_bytes(8, "big"))


def in_order(some: Iterable[str], of: Iterable[str]) -> bool:
    """Whether they are all among these, in their order."""
    rest = iter(of)
    return all(frame in rest for frame in some)


def find_terminal(serial_number: str) -> Path | None:
    """The link that udev has made; None while another than the kernel's driver has the chip."""
    return next(Path("/dev/serial/by-id").glob(f"*{serial_number}*"), None)


def wait_terminal(serial_number: str) -> Path:
    link = wait_until(lambda: find_terminal(serial_number), f"the terminal of {serial_number}")
    assert link
    return link


def find_device(serial_number: str) -> Path | None:
    """The chip's directory in /sys, None while it is unplugged."""
    for file in Path("/sys/bus/usb/devices").glob("*/serial"):
        with contextlib.suppress(OSError):  # just unplugged
            if file.read_text().strip() == serial_number:
                return file.parent
    return None


@dataclasses.dataclass
class Life:
    """One time of being plugged in."""

    device: Can232 | Usb2can
    since: float  # time.time() before it was plugged in
    heard: list[str] = dataclasses.field(default_factory=list)  # on its bus, received or not
    sent: list[str] = dataclasses.field(default_factory=list)  # what it has put on its bus
    handed: list[tuple[float, str]] = dataclasses.field(default_factory=list)
    """What the host sent to it of extended frames with 8 bytes: came after this time.time(), frame."""

    first_at: float = 0.0
    """When the first of these came, time.time()."""

    @property
    def taken(self) -> int:
        """Frames that it has taken into its buffer."""
        counters: Counters | Usb2canCounters = self.device.counters
        return counters.frames_taken

    def handed_late(self, born: dict[str, float], deadline_s: float) -> list[tuple[str, float]]:
        """What the host handed over when it was older than the deadline: the frame, and how old it was."""
        ages = ((frame, at - born[frame]) for at, frame in self.handed)
        return [(frame, age_s) for frame, age_s in ages if age_s > deadline_s + TRANSPORT_S]


class WiredAdapter(ftdi_vhci.FakeFt245):
    """An adapter behind its chip. `lives` has the times of being plugged in."""

    def __init__(self, adapter: str, serial_number: str) -> None:
        super().__init__(serial_number, IDLE_S)
        self.adapter = adapter
        self.lives: list[Life] = []
        self.eeprom = Eeprom()
        self._others: Iterator[Frame] = iter(())
        self._heard_s = math.inf
        self._heard_at = math.inf
        self._noise = random.Random(0)
        self._repeated: Callable[[float], None] | None = None
        self._repeat_at = math.inf
        self._tail = b""

    def plug(self) -> None:
        now = time.monotonic()
        device: Can232 | Usb2can
        if self.adapter == "can232":
            device = Can232(now, eeprom=self.eeprom, uart=Uart(UART_RATE))
        else:
            device = Usb2can(now, stop_grace_s=STOP_GRACE_S)
        self._tail = b""
        self._repeat_at = math.inf
        self.lives.append(Life(device, time.time()))
        super().plug()

    @property
    def life(self) -> Life:
        """The present one, or the last."""
        return self.lives[-1]

    @contextlib.contextmanager
    def device(self) -> Iterator[Any]:
        """The device, which does nothing meanwhile."""
        with self._lock:
            yield self.life.device
        self._awake()

    def begin(self, fault: Fault) -> None:
        """It happens now, and goes on until `end`."""
        with self.device() as device:
            now = time.monotonic()
            faults.begin(device, fault, now)
            self._repeated = faults.repeated(device, fault, self._noise)
            self._repeat_at = now if self._repeated else math.inf

    def end(self, fault: Fault) -> None:
        """It is over."""
        with self.device() as device:
            self._repeat_at = math.inf
            faults.end(device, fault, time.monotonic())

    def hear(self, frames: Iterable[Frame] = (), fps: float = HEARD_FPS) -> None:
        """Others on its bus send these from now on, also while it is unplugged."""
        with self._lock:
            self._others, self._heard_s = iter(frames), 1 / fps
            self._heard_at = time.monotonic()
        self._awake()

    # In the chip's thread

    def _arrived(self, data: bytes) -> None:
        with self._lock:
            self.life.device.host_writes(time.monotonic(), data)
            data = self._tail + data
            end = 0
            for match in HANDED[self.adapter].finditer(data):
                identifier, content = match.groups()
                if self.adapter == "usb2can":
                    number = int.from_bytes(identifier, "big") >> 3
                    identifier, content = b"%08X" % number, content.hex().upper().encode()
                self.life.handed.append((self.heard_all_at, f"{identifier.decode()}#{content.decode()}"))
                end = match.end()
                self.life.first_at = self.life.first_at or time.time()
            self._tail = data[max(end, len(data) - LONGEST_MESSAGE) :]

    def _work_at(self) -> float:
        with self._lock:
            return min(self._heard_at, self._repeat_at, self._device_at())

    def _device_at(self) -> float:
        """A device behind a full FIFO waits until it is read, an RS232 line does not."""
        device = self.life.device
        full = len(self._to_send) >= CHIP_FIFO and isinstance(device, Usb2can)
        return math.inf if full else device.next_deadline()

    def _work(self) -> None:
        with self._lock:
            now = time.monotonic()
            life = self.life
            device = life.device
            if self._repeated and self._repeat_at <= now:
                self._repeated(now)
                self._repeat_at = now + BURST_S
            if self._heard_at <= now:
                self._hear(now, life)
            if isinstance(device, Usb2can) and len(self._to_send) >= CHIP_FIFO:
                device.advance(now)
            else:
                self._to_send += device.take_output(now)
            if isinstance(device, Can232):
                device.uart.delivered(time.monotonic())
                del self._to_send[CHIP_FIFO:]
            life.sent += [record_line(frame).strip() for frame in device.take_bus_frames()]

    def _hear(self, now: float, life: Life) -> None:
        self._heard_at = max(self._heard_at, now - TRAFFIC_LATE_S)
        while self._heard_at <= now:
            frame = next(self._others, None)
            if frame is None:
                self._heard_at = math.inf
                return
            self._heard_at += self._heard_s
            life.heard.append(record_line(frame).strip())
            life.device.bus_frame(now, frame)


@contextlib.contextmanager
def plugged(adapter: str, serial_number: str) -> Iterator[WiredAdapter]:
    """An adapter, plugged in; pulled out at the end. Skips where the kernel cannot."""
    if not ftdi_vhci.load_driver():
        pytest.skip("this kernel has no vhci-hcd, or does not let us use it")
    chip = WiredAdapter(adapter, serial_number)
    chip.plug()
    try:
        yield chip
    finally:
        chip.unplug()
        wait_until(lambda: not find_terminal(serial_number), "the fake chip to be gone")


def assert_flat(resources: list[Resources]) -> None:
    """Nothing grows; but a table may, such as that of Python's interned strings, which pathlib fills."""
    resident_kib = [n.resident_kib for n in resources]
    print(f"resident KiB: {' '.join(map(str, resident_kib))}")
    steps = [after - before for before, after in itertools.pairwise(resident_kib)]
    tables = [step for step in steps if step >= TABLE_KIB.start]
    assert len(tables) <= TABLES
    assert all(step in TABLE_KIB for step in tables)
    assert sum(steps) - sum(tables) <= GROWTH_KIB
    assert resources[-1][:2] == resources[0][:2], "threads, descriptors"


def wait_flowing(bridge: Bridge, frames: int) -> dict[str, Any]:
    """Wait until it runs, and so many more frames have gone each way; the status."""
    before = bridge.wait_state("running")["counters"]
    keys = ("rx_frames", "tx_frames")
    return bridge.wait_status(
        lambda status: all(status["counters"][key] >= before[key] + frames for key in keys),
        "frames both ways",
    )
