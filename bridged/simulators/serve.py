"""A simulated adapter in real time: a terminal or socket, a bus, faults, made-up traffic, files."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import heapq
import itertools
import json
import math
import random
import select
import socket
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from bridged.simulators import faults
from bridged.simulators.ends import BusEnd, HeldUp, HostEnd, LineEnd, PtyEnd
from bridged.simulators.faults import BURST_S, Fault
from bridged.simulators.sja1000 import Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path
    from typing import BinaryIO

    from bridged.simulators.can232_memory import Eeprom
    from bridged.simulators.device import Device
    from bridged.simulators.uart import Uart

__all__ = ["Fault", "Simulator", "cyclic_frames", "mixed_frames", "record_line"]

UART_QUEUE = 4096  # characters a host's UART takes for a paced line before its write waits
SPIN_S = 0.001  # --precise: no sleeping so close to a deadline,
ACTIVE_S = 0.005  # nor so soon after something happened
BATCH_S = 0.001  # made-up frames wait so long for each other; a host's USB does no better
TRAFFIC_BATCH = 32  # at most, a device has buffers for twice as many
TRAFFIC_LATE_S = 0.05  # a bus does not catch up; it has been silent
RECONNECT_S = 0.1


def mixed_frames(rng: random.Random) -> Iterator[Frame]:
    """Standard, extended and remote frames of all lengths, without end."""
    while True:
        extended = rng.random() < 0.4
        remote = rng.random() < 0.1
        dlc = rng.randrange(9)
        data = b"" if remote else rng.randbytes(dlc)
        yield Frame(rng.getrandbits(29 if extended else 11), extended, remote, dlc, data)


# Of a bus as in a vehicle: identifier, DLC, period in units of its own.
CYCLIC = (
    (0x100, 8, 4),
    (0x110, 8, 4),
    (0x1A0, 6, 8),
    (0x200, 8, 8),
    (0x2F0, 4, 16),
    (0x310, 2, 16),
    (0x4B0, 8, 32),
    (0x5E0, 1, 32),
    (0x18FEF100, 8, 32),
    (0x18FF0A17, 3, 64),
)


def cyclic_frames(rng: random.Random) -> Iterator[Frame]:
    """Ten identifiers, each again and again in its own period, without end.

    The first bytes count the frames of the identifier, low byte first; the others stay as they are.
    """
    # When the next one is due, place in CYCLIC (no two are due at once), and how many there were.
    due = [(rng.random() * period, place, 0) for place, (_, _, period) in enumerate(CYCLIC)]
    heapq.heapify(due)
    constant = rng.randbytes(8)
    while True:
        at, place, count = due[0]
        can_id, dlc, period = CYCLIC[place]
        counter = (count % (1 << 8 * min(dlc, 2))).to_bytes(min(dlc, 2), "little")
        yield Frame(can_id, can_id > 0x7FF, False, dlc, counter + constant[: dlc - len(counter)])
        heapq.heapreplace(due, (at + period, place, count + 1))


def record_line(frame: Frame) -> str:
    """A frame as cansend takes it: `123#1122`, `12345678#`, `123#R5`, `123#R`."""
    can_id = f"{frame.can_id:08X}" if frame.extended else f"{frame.can_id:03X}"
    if frame.remote:
        return f"{can_id}#R{frame.dlc or ''}\n"
    return f"{can_id}#{frame.data.hex().upper()}\n"


def write_json(path: Path, value: object) -> None:
    """Write a file atomically."""
    new = path.with_name(f".{path.name}.new")
    new.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
    new.replace(path)


class Simulator:
    """Runs a device until `stop()`; `run()` blocks, and may be called in a thread.

    The host is at the other end of `line` (see `LineEnd`), or of a new pseudo terminal: `port` names it, and
    it is there from the start; the link and the files while `run()` runs.
    `bus` is any datagram socket that carries `struct can_frame`, left open at the end. What the device puts
    on the bus goes to `on_frame` and, a line each, to `record`, an unbuffered file.
    `traffic_fps` frames a second, mixed_frames() or those of `traffic`, come from a bus that does not exist,
    or `traffic_count` frames in all: then those that the device does not see, because its channel is not
    open, come again.
    `precise` spins instead of sleeping while the line is in use. PortError if an end cannot be made.
    """

    def __init__(
        self,
        device: Device,
        *,
        link: Path | None = None,
        line: str | None = None,
        bus: socket.socket | None = None,
        on_frame: Callable[[Frame], None] | None = None,
        record: BinaryIO | None = None,
        traffic_fps: float = 0.0,
        traffic: Iterator[Frame] | None = None,
        traffic_count: int | None = None,
        faults: Sequence[Fault] = (),
        rng: random.Random | None = None,
        precise: bool = False,
        eeprom_file: Path | None = None,
        state_file: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.device = device
        self._uart: Uart | None = getattr(device, "uart", None)
        self._eeprom: Eeprom | None = getattr(device, "eeprom", None)
        self._link = link
        self._line = line
        self._bus = BusEnd(bus) if bus is not None else None
        self._on_frame = on_frame
        self._record = record
        self._faults = faults
        self._asked_for: deque[Fault] = deque()
        self._precise = precise
        self._eeprom_file = eeprom_file
        self._eeprom_writes = -1  # in the file
        self._state_file = state_file
        self._clock = clock
        self._started = clock()
        self._active_until = 0.0
        self._held_up: Callable[[], float] = float  # 0.0
        self._held_up_s = 0.0
        self._stopping = False
        self._state_wanted = False
        self._host_lost = 0  # by terminals that are no more
        self._order = itertools.count()
        self._agenda: list[tuple[float, int, Callable[[float], None]]] = []  # a heap
        rng = rng or random.Random(0)
        self._noise = random.Random()
        self._noise.setstate(rng.getstate())  # of its own: noise does not change the traffic
        self._traffic = mixed_frames(rng) if traffic is None else traffic
        self._traffic_frame = next(self._traffic)
        self._traffic_s = 1 / traffic_fps if traffic_fps else math.inf
        self._traffic_count = traffic_count
        self._made_up = 0  # frames
        self._next_traffic = math.inf
        self._traffic_wake = math.inf  # when to see to the traffic, not before _next_traffic
        self._reconnecting = False
        self._host: HostEnd | None = self._new_host()
        if isinstance(self._host, LineEnd):
            self._host.open()
        self.port = self._host.name
        self._wake, self._waker = socket.socketpair()
        self._wake.setblocking(False)
        self._waker.setblocking(False)

    def run(self) -> None:
        """Simulate until `stop()`; once only."""
        self._started = now = self._clock()
        self._next_traffic = self._traffic_wake = now + self._traffic_s
        for fault in self._faults:
            self._plan(fault, now)
        try:
            self._make_link()
            if self._uart and self._uart.baud:
                self._held_up = HeldUp()
            while not self._stopping:
                self._turn()
        finally:
            self._save()
            if self._state_file:
                write_json(self._state_file, self.state())
            self._unplug()
            self._wake.close()
            self._waker.close()

    def stop(self) -> None:
        """End `run()`; from any thread, or a signal handler."""
        self._stopping = True
        self._awake()

    def begin(self, fault: Fault) -> None:
        """Have it happen `start_s` from now; from any thread."""
        self._asked_for.append(fault)
        self._awake()

    def request_state(self) -> None:
        """Have `run()` write the state file now; from any thread, or a signal handler."""
        self._state_wanted = True
        self._awake()

    def state(self) -> dict[str, object]:
        """Everything that is counted, in the form of the state file; times in seconds."""
        uart = self._uart
        bus = self._bus
        state: dict[str, object] = {"port": self.port, "elapsed_s": self._clock() - self._started}
        state |= self.device.report()
        if uart:
            state["uart"] = {
                "rate": uart.baud,
                "host_chars": uart.host_chars,
                "host_busy_s": uart.host_busy_s,
                "device_chars": uart.device_chars,
                "device_busy_s": uart.device_busy_s,
                "late_max_s": uart.late_max_s,
                "stalled_s": uart.stalled_s,
            }
        state["traffic"] = {"count": self._traffic_count, "made_up": self._made_up}
        state["host_lost"] = self._host_lost + (self._host.lost if self._host else 0)
        state["bus"] = {"lost": bus.lost, "errors": bus.errors, "ignored": bus.ignored} if bus else None
        return state

    # One turn

    def _turn(self) -> None:
        """Wait for something to happen, then live through all that happened."""
        device = self.device
        host = self._host
        bus = self._bus
        now = self._clock()
        if host and not host.connected and not self._reconnecting:
            self._reconnecting = True
            self._reconnect(now)
        timeout = self._timeout(now)
        readable, writable, seen = self._wait(now, timeout)
        if self._wake in readable:
            self._wake.recv(64)
        if host and host in readable:
            device.host_writes(seen, host.read(UART_QUEUE))
        if bus and bus in readable:
            for age_s, frame in bus.read():
                device.bus_frame(self._clock() - age_s, frame)
        now = self._clock()
        while self._asked_for:
            self._plan(self._asked_for.popleft(), now)
        while self._agenda and self._agenda[0][0] <= now:
            heapq.heappop(self._agenda)[2](now)
        if self._traffic_wake <= now:
            self._make_traffic(now)
        if self._held_back():
            device.advance(now)
            output = b""
        else:
            output = device.take_output(now)
        if output and self._uart:
            self._uart.delivered(self._clock())
        if self._host and (output or self._host in writable):
            self._host.write(output)
        frames = device.take_bus_frames()
        if frames or bus in writable:
            self._to_bus(frames)
        if self._precise and (readable or output or frames):
            self._active_until = now + ACTIVE_S
        self._save()

    def _timeout(self, now: float) -> float | None:
        """How long to wait in seconds, None for ever."""
        deadline = self.device.next_deadline()
        if self._held_back():  # what is due may be just what nobody takes
            deadline = max(deadline, now + BATCH_S)
        deadline = min(deadline, self._traffic_wake)
        if self._agenda:
            deadline = min(deadline, self._agenda[0][0])
        if self._precise:
            if now < self._active_until:
                return 0
            deadline -= SPIN_S
        return None if deadline == math.inf else max(0, deadline - now)

    def _held_back(self) -> bool:
        """Whether the device has to wait for its host: USB has flow control, this RS232 line does not."""
        return not self._uart and self._host is not None and bool(self._host.waiting)

    def _wait(self, now: float, timeout: float | None) -> tuple[list[Any], list[Any], float]:
        """Which ends can be read and written, as select() says, and since when, without our own delay."""
        readers: list[socket.socket | HostEnd | BusEnd] = [self._wake]
        writers: list[HostEnd | BusEnd] = []
        if self._host and self._host.connected:
            if not self._uart or self._uart.host_backlog < UART_QUEUE:
                readers.append(self._host)
            if self._host.waiting:
                writers.append(self._host)
        if self._bus:
            readers.append(self._bus)
            if self._bus.waiting:
                writers.append(self._bus)
        before_s = self._held_up()
        readable, writable, _ = select.select(readers, writers, (), timeout)
        if timeout == 0:  # it came since we last looked, which was just before `now` but for what held us up
            seen = now - max(0.0, before_s - self._held_up_s)
            self._held_up_s = before_s
        else:
            seen = self._clock()
            self._held_up_s = math.inf  # not known
            if self._host in readable:
                self._held_up_s = self._held_up()
                seen -= self._held_up_s - before_s
        return readable, writable, seen

    def _make_traffic(self, now: float) -> None:
        """Some made-up frames that were on the bus up to `now`."""
        counters = self.device.counters
        self._next_traffic = max(self._next_traffic, now - TRAFFIC_LATE_S)
        for _ in range(TRAFFIC_BATCH):
            unseen = counters.frames_unseen
            self.device.bus_frame(self._next_traffic, self._traffic_frame)
            self._next_traffic += self._traffic_s
            if self._traffic_count is None or counters.frames_unseen == unseen:
                self._made_up += 1
                self._traffic_frame = next(self._traffic)
                if self._made_up == self._traffic_count:
                    self._next_traffic = math.inf
            if self._next_traffic > now:
                break
        else:  # not at once, lest they overflow the device
            self._traffic_wake = self._next_traffic
            return
        self._traffic_wake = self._next_traffic if self._precise else max(self._next_traffic, now + BATCH_S)

    def _to_bus(self, frames: list[Frame]) -> None:
        if self._on_frame:
            for frame in frames:
                self._on_frame(frame)
        if self._record and frames:  # in one write: who reads the file sees whole lines
            self._record.write("".join(map(record_line, frames)).encode())
        if self._bus:
            self._bus.write(frames)

    def _save(self) -> None:
        eeprom = self._eeprom
        if eeprom and self._eeprom_file and eeprom.writes != self._eeprom_writes:
            self._eeprom_writes = eeprom.writes
            write_json(self._eeprom_file, dataclasses.asdict(eeprom))
        if self._state_wanted:
            self._state_wanted = False
            if self._state_file:
                write_json(self._state_file, self.state())

    def _awake(self) -> None:
        with contextlib.suppress(OSError):  # full: it is awake; closed: it has ended
            self._waker.send(b"!")

    # Faults

    def _schedule(self, at: float, action: Callable[[float], None]) -> None:
        heapq.heappush(self._agenda, (at, next(self._order), action))

    def _plan(self, fault: Fault, now: float) -> None:
        self._schedule(now + fault.start_s, functools.partial(self._begin, fault))

    def _begin(self, fault: Fault, now: float) -> None:
        faults.begin(self.device, fault, now)
        if fault.kind == "unplug":
            self._unplug()
        repeated = faults.repeated(self.device, fault, self._noise)
        if repeated:
            self._repeat(repeated, now + fault.duration_s, now)
        if fault.duration_s:
            self._schedule(now + fault.duration_s, functools.partial(self._end, fault))

    def _end(self, fault: Fault, now: float) -> None:
        faults.end(self.device, fault, now)
        if fault.kind == "unplug":
            self._plug_in()

    def _repeat(self, action: Callable[[float], None], until: float, now: float) -> None:
        """Once, and again every BURST_S until then."""
        action(now)
        if now + BURST_S < until:
            self._schedule(now + BURST_S, functools.partial(self._repeat, action, until))

    # The host

    def _new_host(self) -> HostEnd:
        return LineEnd(self._line) if self._line else PtyEnd()

    def _make_link(self) -> None:
        if self._link and isinstance(self._host, PtyEnd):
            self._host.link(self._link)

    def _plug_in(self) -> None:
        self._host = self._new_host()
        self.port = self._host.name
        self._make_link()

    def _unplug(self) -> None:
        if self._host:
            self._host_lost += self._host.lost
            self._host.close()
            self._host = None

    def _reconnect(self, now: float) -> None:
        """Nobody is at the other end of the line: look for a host again and again."""
        if self._host and not self._host.reconnect():
            self._schedule(now + RECONNECT_S, self._reconnect)
        else:
            self._reconnecting = False
