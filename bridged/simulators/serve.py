"""A simulated CAN232 in real time: `can-bridge simulate can232`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import heapq
import itertools
import json
import math
import random
import re
import select
import signal
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bridged.errors import PortError
from bridged.simulators.can232 import Can232, Eeprom
from bridged.simulators.ends import BusEnd, HeldUp, HostEnd, open_can
from bridged.simulators.sja1000 import Frame
from bridged.simulators.uart import Uart

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

UART_QUEUE = 4096  # characters a host's UART takes for a paced line before its write waits
SPIN_S = 0.001  # --precise: no sleeping so close to a deadline,
ACTIVE_S = 0.005  # nor so soon after something happened
GARBAGE_S = 0.01  # between two bursts

FAULTS = ("silence", "garbage", "busoff", "refuse", "drop", "reset", "poweroff", "unplug")


class Fault(NamedTuple):
    """One of FAULTS, `start_s` after the start; without a duration once, or for good."""

    kind: str
    start_s: float
    duration_s: float = 0.0


def parse_fault(text: str) -> Fault:
    """`KIND@START[+DURATION]` in seconds, as `silence@5+3`; ArgumentTypeError if it is not."""
    match = re.fullmatch(r"([a-z]+)@(\d+\.?\d*)(?:\+(\d+\.?\d*))?", text)
    if not match or match[1] not in FAULTS:
        raise argparse.ArgumentTypeError(f"{text!r} is not KIND@START[+DURATION], KIND {', '.join(FAULTS)}")
    return Fault(match[1], float(match[2]), float(match[3] or 0))


def mixed_frames(rng: random.Random) -> Iterator[Frame]:
    """Standard, extended and remote frames of all lengths, without end."""
    while True:
        extended = rng.random() < 0.4
        remote = rng.random() < 0.1
        dlc = rng.randrange(9)
        data = b"" if remote else rng.randbytes(dlc)
        yield Frame(rng.getrandbits(29 if extended else 11), extended, remote, dlc, data)


def write_json(path: Path, value: object) -> None:
    """Write a file atomically."""
    new = path.with_name(f".{path.name}.new")
    new.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
    new.replace(path)


class Simulator:
    """Runs a device on a pty until `stop()`; `run()` blocks, and may be called in a thread.

    `port` names the terminal, which is there from the start; the link and the files while `run()` runs.
    `bus` is any datagram socket that carries `struct can_frame`, left open at the end. `on_frame` is called
    with what the device puts on the bus. `traffic_fps` frames a second come from a bus that does not exist.
    `precise` spins instead of sleeping while the line is in use. PortError if an end cannot be made.
    """

    def __init__(
        self,
        device: Can232,
        *,
        link: Path | None = None,
        bus: socket.socket | None = None,
        on_frame: Callable[[Frame], None] | None = None,
        traffic_fps: float = 0.0,
        faults: Sequence[Fault] = (),
        rng: random.Random | None = None,
        precise: bool = False,
        eeprom_file: Path | None = None,
        state_file: Path | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.device = device
        self._link = link
        self._bus = BusEnd(bus) if bus is not None else None
        self._on_frame = on_frame
        self._faults = faults
        self._rng = rng or random.Random(0)
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
        self._traffic = mixed_frames(self._rng)
        self._traffic_s = 1 / traffic_fps if traffic_fps else math.inf
        self._next_traffic = math.inf
        self._wake, self._waker = socket.socketpair()
        self._wake.setblocking(False)
        self._waker.setblocking(False)
        self._host: HostEnd | None = HostEnd()
        self.port = self._host.name

    def run(self) -> None:
        """Simulate until `stop()`; once only."""
        self._started = now = self._clock()
        self._next_traffic = now + self._traffic_s
        for fault in self._faults:
            self._schedule(now + fault.start_s, functools.partial(self._begin, fault))
        try:
            if self._host and self._link:
                self._host.link(self._link)
            if self.device.uart.baud:
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

    def request_state(self) -> None:
        """Have `run()` write the state file now; from any thread, or a signal handler."""
        self._state_wanted = True
        self._awake()

    def state(self) -> dict[str, object]:
        """Everything that is counted, in the form of the state file; times in seconds."""
        device = self.device
        uart = device.uart
        bus = self._bus
        return {
            "port": self.port,
            "elapsed_s": self._clock() - self._started,
            "channel": device.state.value,
            "bitrate": device.bitrate,
            "code": device.code.hex().upper(),
            "mask": device.mask.hex().upper(),
            "counters": vars(device.counters) | {"commands": dict(device.counters.commands)},
            "eeprom": dataclasses.asdict(device.eeprom),
            "uart": {
                "rate": uart.baud,
                "host_chars": uart.host_chars,
                "host_busy_s": uart.host_busy_s,
                "device_chars": uart.device_chars,
                "device_busy_s": uart.device_busy_s,
                "late_max_s": uart.late_max_s,
                "stalled_s": uart.stalled_s,
            },
            "host_lost": self._host_lost + (self._host.lost if self._host else 0),
            "bus": {"lost": bus.lost, "errors": bus.errors, "ignored": bus.ignored} if bus else None,
        }

    # One turn

    def _turn(self) -> None:
        """Wait for something to happen, then live through all that happened."""
        device = self.device
        host = self._host
        bus = self._bus
        now = self._clock()
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
        while self._agenda and self._agenda[0][0] <= now:
            heapq.heappop(self._agenda)[2](now)
        while self._next_traffic <= now:
            device.bus_frame(self._next_traffic, next(self._traffic))
            self._next_traffic += self._traffic_s
        output = device.take_output(now)
        if output:
            device.uart.delivered(self._clock())
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
        deadline = min(self.device.next_deadline(), self._next_traffic)
        if self._agenda:
            deadline = min(deadline, self._agenda[0][0])
        if self._precise:
            if now < self._active_until:
                return 0
            deadline -= SPIN_S
        return None if deadline == math.inf else max(0, deadline - now)

    def _wait(self, now: float, timeout: float | None) -> tuple[list[Any], list[Any], float]:
        """Which ends can be read and written, as select() says, and since when, without our own delay."""
        readers: list[socket.socket | HostEnd | BusEnd] = [self._wake]
        writers: list[HostEnd | BusEnd] = []
        if self._host:
            if self.device.uart.host_backlog < UART_QUEUE:
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

    def _to_bus(self, frames: list[Frame]) -> None:
        if self._on_frame:
            for frame in frames:
                self._on_frame(frame)
        if self._bus:
            self._bus.write(frames)

    def _save(self) -> None:
        eeprom = self.device.eeprom
        if self._eeprom_file and eeprom.writes != self._eeprom_writes:
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

    def _begin(self, fault: Fault, now: float) -> None:
        device = self.device
        match fault.kind:
            case "silence":
                device.silent = True
            case "garbage":
                self._make_noise(now + fault.duration_s, now)
            case "busoff":
                device.set_bus_off(now, True)
            case "refuse":
                device.refusals = sys.maxsize if fault.duration_s else 1
            case "drop":
                device.drop_answers = sys.maxsize if fault.duration_s else 1
            case "reset":
                device.power_cycle(now)
            case "poweroff":
                device.power_off(now)
            case "unplug":
                device.power_off(now)
                self._unplug()
        if fault.duration_s:
            self._schedule(now + fault.duration_s, functools.partial(self._end, fault))

    def _end(self, fault: Fault, now: float) -> None:
        device = self.device
        match fault.kind:
            case "silence":
                device.silent = False
            case "busoff":
                device.set_bus_off(now, False)
            case "refuse":
                device.refusals = 0
            case "drop":
                device.drop_answers = 0
            case "poweroff":
                device.power_on(now)
            case "unplug":
                device.power_on(now)
                self._plug_in()

    def _make_noise(self, until: float, now: float) -> None:
        self.device.garbage(now, self._rng.randbytes(self._rng.randint(1, 16)))
        if now + GARBAGE_S < until:
            self._schedule(now + GARBAGE_S, functools.partial(self._make_noise, until))

    def _plug_in(self) -> None:
        self._host = HostEnd()
        self.port = self._host.name
        if self._link:
            self._host.link(self._link)

    def _unplug(self) -> None:
        if self._host:
            self._host_lost += self._host.lost
            self._host.close()
            self._host = None


def load_eeprom(path: Path | None) -> Eeprom:
    """What a Simulator kept in a file, a new EEPROM if there is none; PortError if it is something else."""
    if path is None or not path.exists():
        return Eeprom()
    try:
        return Eeprom(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise PortError(f"{path}: not an EEPROM file of this simulator: {error}") from error


def positive(text: str) -> float:
    """A finite number above 0, for argparse."""
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a number above 0")
    return value


def _whole(text: str) -> int:
    return int(positive(str(int(text))))


def _matching(pattern: str, meaning: str) -> Callable[[str], str]:
    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise argparse.ArgumentTypeError(f"{text!r} is not {meaning}")
        return text

    return check


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `can-bridge simulate can232`."""
    add = parser.add_argument
    add(
        "--link",
        type=Path,
        metavar="PATH",
        help="symbolic link to the terminal, made now, removed at the end",
    )
    add("--bus", metavar="IFACE", help="SocketCAN interface on its CAN side, as vcan1")
    add(
        "--traffic",
        type=positive,
        default=0.0,
        metavar="FPS",
        help="mixed frames a second from a made-up bus",
    )
    add(
        "--uart-rate",
        type=_whole,
        metavar="BAUD",
        help="pace the line at this rate; default: as fast as it goes",
    )
    add(
        "--processing",
        type=positive,
        default=0.0,
        metavar="SECONDS",
        help="time the device takes for a command",
    )
    version = _matching(r"V\d{4}", "a version like V1324")
    add("--version", type=version, default="V1324", dest="device_version", metavar="V", help="answer to V")
    serial = _matching(r"[0-9A-Z]{4}", "a serial number like A123")
    add("--serial-number", type=serial, default="A123", metavar="N", help="answer to N, without the N")
    add("--eeprom", type=Path, metavar="FILE", help="keeps the EEPROM and its write count, as JSON")
    add("--state", type=Path, metavar="FILE", help="counters as JSON, written at the end and on SIGUSR1")
    faults = f"KIND@START[+DURATION] in seconds, KIND {', '.join(FAULTS)}; may be repeated"
    add("--fault", type=parse_fault, action="append", default=[], metavar="SPEC", help=faults)
    add("--seed", type=int, default=0, metavar="N", help="of traffic and garbage")
    add("--precise", action="store_true", help="spin while the line is in use: exact, takes a processor")


def run(args: argparse.Namespace) -> int:
    """Simulate until SIGTERM or SIGINT, then return 0; PortError, BusError if an end cannot be had."""
    device = Can232(
        time.monotonic(),
        eeprom=load_eeprom(args.eeprom),
        uart=Uart(args.uart_rate),
        version=args.device_version,
        serial_number=args.serial_number,
        processing_s=args.processing,
    )
    for path in (args.link, args.state, args.eeprom):
        if path and not path.parent.is_dir():
            raise PortError(f"{path}: there is no directory {path.parent}")
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(open_can(args.bus)) if args.bus else None
        simulator = Simulator(
            device,
            link=args.link,
            bus=bus,
            traffic_fps=args.traffic,
            faults=args.fault,
            rng=random.Random(args.seed),
            precise=args.precise,
            eeprom_file=args.eeprom,
            state_file=args.state,
        )
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: simulator.stop())
        signal.signal(signal.SIGUSR1, lambda *_: simulator.request_state())
        print(f"CAN232 {args.serial_number} on {args.link or simulator.port}", flush=True)
        simulator.run()
    return 0
