"""What a bridge costs before it has moved a frame: time to start, memory, and work while nothing happens.

Starts `can-bridge run` again and again, in turn with `python3 -c pass` of the same interpreter, and looks at
it as systemd does (NOTIFY_SOCKET) and as the kernel does (/proc). The bus is a vcan where the kernel has CAN
and we are root, else a socketpair. The port is a pseudo terminal; behind it is the simulator without a serial
line's delay (start, memory), or an adapter that is faster still (idle, frames).
"""

import argparse
import contextlib
import ctypes
import json
import os
import select
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

DEADLINE_S = 60.0
SETTLE_S = 2.0  # what is still loaded and freed after the start is so by then
INTERFACE = "vcanstart"
FRAME = struct.pack("=IB3x8s", 0x123, 8, b"12345678")
FRAME_SIZE = len(FRAME)
WINDOW = 32
BATCH = 64  # frames on their way at a time
WARM_UP = 2_000
WAKE_UPS_OF_A_POLL = 4
PR_SET_THP_DISABLE = 41  # prctl(2)
LINE = b"t12383132333435363738\r"
# By the first character of a line; for any other it is an empty one.
ANSWERS = {b"V": b"V1013\r", b"N": b"NSTRT\r", b"F": b"F00\r", b"A": b"\a", b"t": b"z\r"}

# The bus of a kernel without CAN: everything else is as in `can-bridge run`.
SOCKETPAIR_RUN = """
import socket, sys
from bridged.interfaces import socketcan
from bridged.cli import main
near = int(sys.argv.pop())
class Bus:
    warning, failure, description = "", None, "socketpair"
    def __init__(self):
        self._socket = socket.socket(fileno=near)
        self._socket.setblocking(False)
        self.fd = self._socket.fileno()
    def dropped(self):
        return {}
    def close(self):
        self.fd = -1
        self._socket.close()
socketcan.open_socketcan = lambda channel, create: Bus()
socketcan.is_up = lambda channel: True
sys.exit(main())
"""


class Figure(NamedTuple):
    """One row of the table. `spread`: of the repetitions, least to most; `target`: at most."""

    name: str
    value: float
    unit: str
    target: float | None = None
    spread: tuple[float, float] | None = None

    def row(self) -> str:
        spread = f"{self.spread[0]:.2f} to {self.spread[1]:.2f}" if self.spread else ""
        target = "" if self.target is None else f"≤ {self.target:g} {'met' if self.met else 'MISSED'}"
        return f"| {self.name:<58} | {self.value:>9.2f} {self.unit:<7} | {spread:<16} | {target:<15} |"

    @property
    def met(self) -> bool:
        return self.target is None or self.value <= self.target


class Memory(NamedTuple):
    """Of a process, MiB. `huge`: of the private ones, in transparent huge pages, wholly used or not."""

    resident: float
    private: float
    huge: float


class Installed(NamedTuple):
    """The can-bridge that is measured."""

    command: Path
    python: str  # its interpreter

    @classmethod
    def find(cls, command: str | None) -> Self:
        beside = Path(sys.executable).with_name("can-bridge")
        found = command or (str(beside) if beside.exists() else shutil.which("can-bridge"))
        if found is None:
            sys.exit("start.py: no can-bridge: install it, or name it with --command")
        first = Path(found).read_text().split("\n", maxsplit=1)[0]
        return cls(Path(found), first.removeprefix("#!").strip())

    def is_editable(self) -> bool:
        where = "import importlib.util; print(importlib.util.find_spec('bridged').origin)"
        found = subprocess.run(
            [self.python, "-c", where], capture_output=True, text=True, check=True, cwd="/"
        )
        return "-packages/" not in found.stdout


class Adapter:
    """A CAN232 on a pseudo terminal that answers at once, in a thread; frames go as fast as they can."""

    def __init__(self) -> None:
        self._fd, self._near = os.openpty()  # ours stays open: without it a pty hangs up
        tty.setraw(self._near)
        self.path = os.ttyname(self._near)
        self.polls = 0
        self._taken = 0  # frames
        self._progress = threading.Condition()
        self._end = os.pipe()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        os.write(self._end[1], b"x")
        self._thread.join()
        for fd in (self._fd, self._near, *self._end):
            os.close(fd)

    def _serve(self) -> None:
        rest = b""
        while self._end[0] not in select.select([self._fd, self._end[0]], (), ())[0]:
            *lines, rest = (rest + os.read(self._fd, 65536)).split(b"\r")
            os.write(self._fd, b"".join(map(_answer, lines)))
            self.polls += lines.count(b"F")
            with self._progress:
                self._taken += sum(line.startswith(b"t") for line in lines)
                self._progress.notify()

    def to_device(self, bus: socket.socket, frames: int) -> None:
        """Put frames on the bus, and wait until all have come."""
        for at in range(0, frames, BATCH):
            count = min(BATCH, frames - at)
            wanted = self._taken + count
            for _ in range(count):
                bus.send(FRAME)
            with self._progress:
                if not self._progress.wait_for(partial(self._has_taken, wanted), DEADLINE_S):
                    sys.exit(f"start.py: {wanted - self._taken} frames did not reach the adapter")

    def _has_taken(self, frames: int) -> bool:
        return self._taken >= frames

    def to_bus(self, bus: socket.socket, frames: int) -> None:
        """Send frames to the host, and wait until all are on the bus."""
        for at in range(0, frames, BATCH):
            count = min(BATCH, frames - at)
            os.write(self._fd, count * LINE)
            for _ in range(count):
                bus.recv(FRAME_SIZE)


class Bench:
    """Where bridges are started: their folder, their bus."""

    def __init__(self, installed: Installed, folder: Path) -> None:
        self.installed = installed
        self.folder = folder
        self.can = _has_can()

    def configure(
        self, port: str, adapter: str = "can232", interval_s: float = 0.25, window: int = 1, **keys: str
    ) -> Path:
        path = self.folder / "start.yaml"
        adapter_keys: dict[str, object] = {"type": adapter, "port": port, **keys}
        if adapter == "can232":
            adapter_keys["baudrate"] = 115200
        path.write_text(
            f"adapter: {json.dumps(adapter_keys)}\nchannel: {{bitrate: 1000000}}\n"
            f"bus: {{channel: {INTERFACE}, create: true}}\nhealth: {{interval: {interval_s}}}\n"
            f"transmit: {{window: {window}, deadline: 10}}\n"
        )
        return path

    @contextlib.contextmanager
    def bridge(self, config: Path) -> Iterator["Bridge"]:
        bridge = Bridge(self, config)
        try:
            yield bridge
        finally:
            bridge.stop()

    @contextlib.contextmanager
    def simulator(self, adapter: str) -> Iterator[str]:
        """The path of a simulated adapter, which is up; it answers as fast as it can."""
        link = self.folder / adapter
        process = subprocess.Popen(
            [self.installed.command, "simulate", adapter, "--link", link], stdout=subprocess.DEVNULL
        )
        try:
            end = time.monotonic() + DEADLINE_S
            while not link.exists():
                if process.poll() is not None or time.monotonic() > end:
                    sys.exit("start.py: the simulator did not start")
                time.sleep(0.02)
            yield str(link)
        finally:
            process.terminate()
            process.wait()

    def interpreter_s(self) -> float:
        """How long `python3 -c pass` takes."""
        start = time.monotonic()
        subprocess.run([self.installed.python, "-c", "pass"], check=True)
        return time.monotonic() - start


class Bridge:
    """A running `can-bridge run`."""

    def __init__(self, bench: Bench, config: Path) -> None:
        self._log = bench.folder / "bridge.log"
        self._news = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._news_path = bench.folder / "notify"
        self._news.bind(str(self._news_path))
        self._news.settimeout(DEADLINE_S)
        arguments = ["run", str(config), "--socket", str(bench.folder / "status")]
        near: socket.socket | None = None
        self.bus: socket.socket | None = None
        if bench.can:
            command = [str(bench.installed.command), *arguments]
        else:
            near, self.bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            command = [bench.installed.python, "-P", "-c", SOCKETPAIR_RUN, *arguments, str(near.fileno())]
        environment = os.environ | {
            "NOTIFY_SOCKET": str(self._news_path),
            "STATE_DIRECTORY": str(bench.folder),
        }
        with self._log.open("wb") as log:
            self._start = time.monotonic()
            self._process = subprocess.Popen(
                command, env=environment, stderr=log, pass_fds=[near.fileno()] if near else []
            )
        if near:
            near.close()

    def wait(self, word: str) -> float:
        """Seconds from its start to the first notification that begins with `word`."""
        try:
            while not self._news.recv(4096).decode().startswith(word):
                pass
        except TimeoutError:
            sys.exit(f"start.py: no {word} from can-bridge:\n{self._log.read_text()}")
        return time.monotonic() - self._start

    def wait_running(self) -> float:
        return self.wait("STATUS=running")

    def connect(self) -> socket.socket:
        """The far side of its bus."""
        if self.bus is None:
            self.bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            self.bus.bind((INTERFACE,))
        return self.bus

    def memory(self) -> Memory:
        lines = Path(f"/proc/{self._process.pid}/smaps_rollup").read_text().splitlines()[1:]
        mib = {name: int(value.split()[0]) / 1024 for name, value in (line.split(":") for line in lines)}
        return Memory(mib["Rss"], mib["Private_Clean"] + mib["Private_Dirty"], mib["AnonHugePages"])

    def effort(self) -> tuple[int, int]:
        """Since its start, of all threads: nanoseconds of processor time, and how often one went to sleep."""
        spent_ns = sleeps = 0
        for task in Path(f"/proc/{self._process.pid}/task").iterdir():
            spent_ns += int((task / "schedstat").read_text().split()[0])
            status = (task / "status").read_text().partition("\nvoluntary_ctxt_switches:")
            sleeps += int(status[2].split(maxsplit=1)[0])
        return spent_ns, sleeps

    def stop(self) -> None:
        self._process.send_signal(signal.SIGTERM)
        if self._process.wait(DEADLINE_S) != 0:
            sys.exit(f"start.py: can-bridge failed:\n{self._log.read_text()}")
        self._news.close()
        self._news_path.unlink()
        if self.bus:
            self.bus.close()


def _answer(line: bytes) -> bytes:
    return ANSWERS.get(line[:1], b"\r")


def _has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return os.geteuid() == 0


def _median(name: str, values: Sequence[float], unit: str, target: float | None = None) -> Figure:
    return Figure(name, statistics.median(values), unit, target, (min(values), max(values)))


def measure_start(bench: Bench, adapter: str, repeat: int) -> Iterator[Figure]:
    """Each start by the mean of two runs of an interpreter that does nothing, before and after it."""
    passes, ready, running = [bench.interpreter_s()], [], []
    with bench.simulator(adapter) as port:
        config = bench.configure(port, adapter)
        for turn in range(1 + repeat):  # one more, to fill the caches
            with bench.bridge(config) as bridge:
                times_s = bridge.wait("READY=1"), bridge.wait_running()
                if turn == repeat:
                    time.sleep(SETTLE_S)
                    memory = bridge.memory()
            passes.append(bench.interpreter_s())
            floor_s = sum(passes[-2:]) / 2
            ready.append(times_s[0] / floor_s)
            running.append(times_s[1] / floor_s)
    yield _median("python3 -c pass", [1000 * t for t in passes[2:]], "ms")
    yield _median(f"start to READY, {adapter}, by python3 -c pass", ready[1:], "x", 6)
    yield _median(f"start to running, {adapter}, by python3 -c pass", running[1:], "x")
    yield Figure(f"resident memory, {adapter}", memory.resident, "MiB", 24)
    yield Figure(f"private memory, {adapter}", memory.private, "MiB", 12)
    yield Figure(f"of it in huge pages, {adapter}", memory.huge, "MiB")


def measure_idle(bench: Bench, seconds: float) -> Iterator[Figure]:
    """A health poll wakes both threads twice: to ask, and for the answer. Nothing else should."""
    for interval_s in (0.5, 0.25):
        config = bench.configure((adapter := Adapter()).path, interval_s=interval_s, firmware="can232")
        with adapter, bench.bridge(config) as bridge:
            bridge.wait_running()
            time.sleep(SETTLE_S)
            before, polls, start = bridge.effort(), -adapter.polls, time.monotonic()
            time.sleep(seconds)
            after, took_s = bridge.effort(), time.monotonic() - start
            polls += adapter.polls
        share = 100 * (after[0] - before[0]) / took_s / 1e9
        beyond = (after[1] - before[1] - WAKE_UPS_OF_A_POLL * polls) / took_s
        target = 0.1 if interval_s == 0.25 else None  # the default
        yield Figure(f"idle, processor time, a poll each {interval_s} s", share, "%", target)
        # Not 0: a poll may be cut at either end, and on a busy machine one thread waits for the other.
        slack = round(0.3 + WAKE_UPS_OF_A_POLL / took_s, 1)
        yield Figure(f"idle, wake-ups beyond polls, one each {interval_s} s", beyond, "/s", slack)
    rate = WAKE_UPS_OF_A_POLL / interval_s
    yield Figure(f"processor time of {rate:g} sleeps a second", 100 * _sleeper(rate, seconds), "%")


def _sleeper(rate: float, seconds: float) -> float:
    """The share of a processor that it takes to sleep and wake up: what is left when there is no work."""
    start_ns, end = time.thread_time_ns(), time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(1 / rate)
    return (time.thread_time_ns() - start_ns) / seconds / 1e9


def measure_frames(bench: Bench, frames: int) -> Iterator[Figure]:
    """Memory before and after many frames, half of them each way; none may get lost."""
    _refuse_huge_pages()
    with (
        Adapter() as adapter,
        bench.bridge(bench.configure(adapter.path, window=WINDOW, firmware="can232")) as bridge,
    ):
        bridge.wait_running()
        time.sleep(SETTLE_S)
        bus = bridge.connect()
        bus.settimeout(DEADLINE_S)
        # Some to begin with: code and buffers that no frame has gone through are not resident yet.
        for count in (WARM_UP, frames):
            before = bridge.memory()
            adapter.to_device(bus, count // 2)
            adapter.to_bus(bus, count // 2)
        after = bridge.memory()
    name = f"{frames:,} frames"
    yield Figure(f"resident memory after {name}", after.resident, "MiB", 24)
    yield Figure(f"private memory after {name}", after.private, "MiB", 12)
    # Of all that is resident: a file's pages turn private and back as other programs end and start.
    grown = after.resident - before.resident
    yield Figure(f"resident memory, growth with {name}", 1024 * grown, "KiB", 64)


def _refuse_huge_pages() -> None:
    """For what is started from now on: the kernel rounds up to 2 MiB what is in use, whenever it likes."""
    ctypes.CDLL(None).prctl(PR_SET_THP_DISABLE, 1, 0, 0, 0)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer repetitions and frames, shorter")
    parser.add_argument("--repeat", type=int, help="how often a bridge is started (21, quick 3)")
    parser.add_argument("--seconds", type=float, help="how long an idle bridge is watched (20, quick 5)")
    parser.add_argument("--frames", type=int, help="how many frames are relayed (10 million, quick 100000)")
    parser.add_argument(
        "--command", help="the can-bridge to measure; else the one of this Python, or of PATH"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    args = parser.parse_args()
    repeat = args.repeat or (3 if args.quick else 21)
    seconds = args.seconds or (5.0 if args.quick else 20.0)
    frames = args.frames or (100_000 if args.quick else 10_000_000)

    installed = Installed.find(args.command)
    figures: list[Figure] = []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(installed, Path(folder))
        print(
            f"{installed.command}, bus: {'vcan' if bench.can else 'socketpair'}, start: of {repeat}, medians"
        )
        if installed.is_editable():
            print(
                "an editable install: its finder costs time at each start that an installed package does not"
            )
        for measured in (
            measure_start(bench, "can232", repeat),
            measure_start(bench, "usb2can", repeat),
            measure_idle(bench, seconds),
            measure_frames(bench, frames),
        ):
            for figure in measured:
                figures.append(figure)
                print(figure.row(), flush=True)
    if args.json:
        rows = [figure._asdict() | {"met": figure.met} for figure in figures]
        args.json.write_text(json.dumps(rows, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
