"""A bridge between a bus at full speed and a hostile device, then a good one: what must never happen.

    ./dev python tests/hostile/world.py ADAPTER [--seed N] [--build plain|asan|tsan] [--kinds NAME,…]

The seed chooses settings, kinds, their order and lengths; how the processes take turns it does not, so that a
failure may take several tries to come again. Always checked, beside what under_test.py checks of the books:

- what the device understood as frames for its bus was sent, with these bytes (frames.py)
- none of them was written after the deadline; what comes after the line was empty was written since then
- no frame comes twice, but for one that the device refused, or might seem to have; and in order
- no frame comes from who has heard "stop" and no "go"
- once the device is good the bridge runs again, and all frames pass both ways
- the log and the error frames on the bus have a limit; a stop, memory and descriptors too
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import itertools
import json
import math
import os
import pty
import random
import select
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
import tty
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import frames
from builds import BUILDS, interpreter
from devices import Can232, Usb2can
from hostility import KINDS, Good, HangUp

HERE = Path(__file__).parent
DEVICES = {"can232": Can232, "usb2can": Usb2can}
LATE_S = 0.25  # between the decision to send a frame and its bytes: this machine may be slow
SLOW_S = 0.02
LIE_S = 1.0  # a lie may be taken for an answer to what was sent, or is sent, so much later
AGAIN_S = 15.0  # until all is well with a good device
PROOF = 100  # frames that show it
HEALTH_S = 1.0
PENDING_MAX = 1 << 16  # bytes that the device would say, if the bridge listened
REMEMBERED = 1 << 17  # frames
STOP_S = 2.5  # the bridge waits 1.2 s for its adapter
LOG_LINES, LOG_LINES_PER_S = 200, 40
ERROR_FRAMES, ERROR_FRAMES_PER_S = 200, 110
GROWTH_KB = 12_000
PHASE_S = (0.2, 1.0)
HONEST_FIRST = 0.5  # part of the runs: doubles and order are not judged just after a lie
ABRUPT = 0.2  # part of the runs that are stopped in the middle of it, with the device as it is


class Failure(Exception):  # noqa: N818 - it is one
    pass


class Station(threading.Thread):
    """A node on the bus of the host: sends frames, hears those of the device."""

    def __init__(self, end: socket.socket, draw: random.Random) -> None:
        super().__init__(name="station", daemon=True)
        self._end = end
        self._draw = draw
        self._end.setblocking(False)
        self.rate = 0.0  # frames a second; math.inf: as fast as they are taken
        self.listens = True
        self.odd = False  # also what is no frame for an adapter
        self.sent = self.heard = self.error_frames = 0
        self.slow: set[int] = set()  # frames that were sent much later than they say
        self.numbers = itertools.count()
        self.proof: deque[tuple[int, bytes]] = deque(maxlen=PROOF)
        self.ends = False
        self.quiet = threading.Event()
        self.silent = True

    def send(self) -> int:
        """One frame; its number. BlockingIOError: the bus is full."""
        number = next(self.numbers)
        born = time.monotonic()
        can_id, data = frames.make(number, int(1000 * born))
        try:
            self._end.send(frames.STRUCT.pack(can_id, len(data), data))
        except BlockingIOError:
            self.numbers = itertools.count(number)
            raise
        if time.monotonic() - born > SLOW_S:
            self.slow.add(number)
        self.sent += 1
        return number

    def _send_odd(self) -> None:
        """An error frame, one of CAN FD, one that is too short, one whose identifier or length cannot be."""
        error = frames.STRUCT.pack(0x20000004, 8, bytes(8))
        wide = frames.STRUCT.pack(0x22222222, 8, bytes(8))
        self._end.send(
            self._draw.choice((error, bytes(72), b"x" * 7, wide, frames.STRUCT.pack(0x123, 9, bytes(8))))
        )
        self.sent += 1

    def run(self) -> None:
        next_at = time.monotonic()
        while not self.ends:
            if self.listens:
                self._hear()
            now = time.monotonic()
            if self.silent or not self.rate:
                self.quiet.set()
                next_at = now
                time.sleep(0.002)
                continue
            self.quiet.clear()
            if now < next_at:
                time.sleep(min(0.002, next_at - now))
                continue
            next_at = max(next_at, now - 0.01) + 1 / self.rate
            try:
                if self.odd and self._draw.random() < 0.01:
                    self._send_odd()
                else:
                    self.send()
            except BlockingIOError:
                select.select((), [self._end], (), 0.002)
            except OSError:  # the bridge has ended
                self.ends = True

    def _hear(self) -> None:
        with contextlib.suppress(OSError):
            for _ in range(200):
                message = self._end.recv(80)
                if not message:  # the bridge has ended
                    return
                can_id, length, data = frames.STRUCT.unpack(message)
                if can_id & 0x20000000:
                    self.error_frames += 1
                else:
                    self.heard += 1
                    self.proof.append((can_id, data[:length]))

    def pause(self) -> None:
        self.silent = True
        self.quiet.clear()
        if not self.quiet.wait(5):
            raise Failure("the station does not come to rest")


class World:
    """The device on its pty, turn by turn; see hostility.World."""

    def __init__(self, adapter: str, seed: int, folder: Path, deadline: float) -> None:
        self.draw = random.Random(f"{adapter} {seed} device")
        self.deadline = deadline
        self.device = DEVICES[adapter](self)
        self.link = folder / "port"
        self.reading, self._holding = True, False
        self.kind: Good = Good(self)
        self._steps = self.kind.steps()
        self._step_at = 0.0
        self._numbers = itertools.count()
        self._due: list[tuple[float, int, bytes]] = []
        self._tie = itertools.count()
        self._held: list[bytes] = []
        self._pending = bytearray()
        self._master = self._slave = -1
        self._empty_at = 0.0  # what is read now was written since then
        self._lied_at = -math.inf
        self._last: dict[int, int] = {}
        self._seen: dict[int, list[float]] = {}  # number -> times, refusals, first seen
        self.failures: list[str] = []
        self.counts: Counter[str] = Counter()
        self.on_frame: Callable[[int], None] = lambda _number: None
        self.slow: set[int] = set()
        self.plug_in()

    # --- of the device's Line -----------------------------------------------------------------

    def saw(self, can_id: int, data: bytes, since: float, *, sent: bool) -> int | None:
        now = time.monotonic()
        told = frames.read(can_id, data) if data else None
        if told is None:
            if sent:
                self.fail(f"a frame that nobody sent: {can_id:08X}#{data.hex()}")
            return None
        self.counts["checked"] += 1
        number, born_ms = told
        late_s = frames.age_ms(born_ms, int(1000 * since)) / 1000 - self.deadline
        if late_s > LATE_S and number not in self.slow:
            self.fail(f"frame {number}: {late_s:.3f} s after the deadline")
        lies = now - self._lied_at < LIE_S
        entry = self._seen.setdefault(number, [0, 0, now])
        entry[0] += 1
        if entry[0] > 1 + entry[1] and self._lied_at < entry[2] - LIE_S:
            self.fail(f"frame {number}: {entry[0]:.0f} times, refused {entry[1]:.0f} times")
        if len(self._seen) > REMEMBERED:
            del self._seen[next(iter(self._seen))]
        if isinstance(self.device, Usb2can) and self.device.stopped and not lies:
            self.fail(f"frame {number} although the device has said stop")
        if sent:
            self.counts["taken"] += 1
            of = 0 if isinstance(self.device, Can232) else can_id  # what is in order
            if number < self._last.get(of, -1) and not lies:
                self.fail(f"frame {number} after {self._last[of]}")
            if not (of & frames.EXTENDED and len(data) < 8):
                self._last[of] = number
            self.on_frame(number)
        return number

    def refused(self, number: int | None) -> None:
        self.counts["refused"] += 1
        if number is not None:
            self._seen[number][1] += 1

    def answer(self, data: bytes) -> None:
        if self._holding:
            self._held.append(data)
        else:
            self.kind.answer(data)

    # --- of hostility.World -------------------------------------------------------------------

    def put(self, data: bytes, after: float = 0.0) -> None:
        at = time.monotonic() + after
        if self._due and not after:  # in their order
            at = max(at, *(due for due, _, _ in self._due))
        heapq.heappush(self._due, (at, next(self._tie), data))

    def lie(self) -> None:
        self._lied_at = time.monotonic()

    @property
    def holding(self) -> bool:
        return self._holding

    @holding.setter
    def holding(self, value: bool) -> None:
        self._holding = value
        held, self._held = ([], self._held) if value else (self._held, [])
        for data in held:
            self.kind.answer(data)

    def traffic(self, count: int) -> None:
        if len(self._pending) < PENDING_MAX // 2:
            now_ms = int(1000 * time.monotonic())
            for _ in range(count):
                self._pending += self.device.received(*frames.make(next(self._numbers) % (1 << 23), now_ms))

    def shout(self, data: bytes) -> None:
        if len(self._pending) < PENDING_MAX // 2:
            self._pending += data

    def fill(self, room: int) -> None:
        """A pty makes room by the block, always as much: how much, the round before shows."""
        size = 0
        for _ in range(3):
            size = self._write_filler(1 << 20)
            while not select.select((), [self._slave], (), 0)[1]:
                self._read()
                time.sleep(0.0002)
        self._write_filler(size - room)

    def _write_filler(self, size: int) -> int:
        written = 0
        with contextlib.suppress(BlockingIOError):
            while written < size:
                written += os.write(self._slave, bytes((frames.FILLER,)) * min(256, size - written))
        return written

    def flow(self, action: int) -> None:
        """Stop (TCOOFF), but take what is on the line, or go on (TCOON)."""
        if action == termios.TCOON:
            self.counts["cut"] += self.device.inside
        if self._slave >= 0:
            termios.tcflow(self._slave, action)

    def hang_up(self) -> None:
        self.link.unlink(missing_ok=True)
        for fd in (self._master, self._slave):
            if fd >= 0:
                os.close(fd)
        self._master = self._slave = -1
        self._pending.clear()
        self._due.clear()
        self._held.clear()

    def plug_in(self) -> None:
        if self._master >= 0:
            return
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        name = os.ttyname(slave)
        self._slave = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        os.close(slave)
        self.link.symlink_to(name)

    # --- turns --------------------------------------------------------------------------------

    def fail(self, text: str) -> None:
        if len(self.failures) < 20:
            self.failures.append(f"{type(self.kind).__name__}: {text}")

    def close(self) -> None:
        self._steps.close()  # type: ignore[attr-defined]
        self.hang_up()

    def begin(self, kind: type[Good]) -> None:
        self._steps.close()  # type: ignore[attr-defined]
        if not self.reading or self._holding:
            raise AssertionError("a kind left its mark")
        self.kind = kind(self)
        self._steps = self.kind.steps()
        self._step_at = 0.0

    def turn(self) -> None:
        now = time.monotonic()
        if now >= self._step_at:
            pause_s = next(self._steps)  # a step takes its time
            now = time.monotonic()
            self._step_at = now + pause_s
        if self._master < 0:
            time.sleep(0.001)
            return
        while self._due and self._due[0][0] <= now:
            data = heapq.heappop(self._due)[2]
            if len(self._pending) < PENDING_MAX:
                self._pending += data
        readers = [self._master] if self.reading else []
        wait = min(0.005, max(0.0, self._step_at - now))
        if self._due:
            wait = min(wait, max(0.0, self._due[0][0] - now))
        readable, writable, _ = select.select(readers, [self._master] if self._pending else [], (), wait)
        if readable:
            self._read()
        elif readers:
            self._empty_at = now
        if writable:
            with contextlib.suppress(BlockingIOError):
                n = os.write(self._master, self._pending[:4096])
                self.counts["said"] += n
                del self._pending[:n]
        self.device.turn()

    def _read(self) -> None:
        try:
            data = os.read(self._master, 65536 if self.reading else 64)
        except BlockingIOError:
            return
        self.counts["got"] += len(data)
        self.device.take(data, self._empty_at)


class Run:
    """One seed."""

    def __init__(
        self, adapter: str, seed: int, build: str, *, kinds: list[str] | None = None, scale: float = 1.0
    ) -> None:
        self.name = f"{adapter} seed {seed} {build}"
        self.draw = random.Random(f"{adapter} {seed}")
        self.adapter, self.seed, self.build, self.scale = adapter, seed, build, scale
        self.kinds = [kind for kind in KINDS if kinds is None or kind.__name__ in kinds]
        self._said: dict[str, Any] = {}
        self._state = ""
        self._states: Counter[str] = Counter()
        self._resident: list[int] = []

    def run(self) -> dict[str, Any]:
        """Everything; what was seen. Failure: what was wrong."""
        with tempfile.TemporaryDirectory(prefix="can-bridge-") as name, contextlib.ExitStack() as stack:
            folder = Path(name)
            self.deadline = self.draw.choice((0.05, 0.2, 0.5, 1.0))
            self.world = World(self.adapter, self.seed, folder, self.deadline)
            stack.callback(self.world.close)
            near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            stack.enter_context(far)
            self.station = Station(far, random.Random(f"{self.seed} station"))
            self.world.slow = self.station.slow
            self.log = folder / "log"
            with near:
                self.process = self._start(folder, near.fileno(), stack)
            try:
                self.station.start()
                return self._course()
            except (Failure, BrokenPipeError) as failure:
                raise Failure(f"{self.name}: {failure}\n{self._tail()}") from failure
            finally:
                self.station.ends = True
                self.station.join()
                self.process.kill()
                self.process.wait()
                self._reader.join()

    def _tail(self) -> str:
        text = self.log.read_text(errors="replace")
        return text if len(text) < 8000 else f"{text[:2000]}\n[…]\n{text[-6000:]}"

    def _configuration(self, folder: Path) -> Path:
        draw = self.draw
        adapter: dict[str, Any] = {"type": self.adapter, "port": str(folder / "port")}
        queue, window = draw.choice((1, 16, 1024)), draw.choice((1, 2, draw.randrange(3, 32), 32))
        if self.adapter == "usb2can":
            critical = draw.randrange(3, 19)
            adapter |= {"critical_limit": critical, "ready_limit": draw.randrange(1, critical)}
        else:
            adapter["baudrate"] = 115_200
            if self.deadline < 0.1:  # more would take too long on such a line: it is refused
                window = min(window, 10)
        settings = {
            "adapter": adapter,
            "channel": {"bitrate": 500_000},
            "bus": {"channel": "vcan0"},
            "transmit": {"queue": queue, "window": window, "deadline": self.deadline},
            "health": {"interval": draw.choice((0.1, 0.25))},
            "reconnect": {"initial": 0.02, "maximum": 0.3},
        }
        path = folder / "hostile.yaml"
        path.write_text(json.dumps(settings))
        self.settings = f"queue={queue} window={window} deadline={self.deadline} {adapter}"
        return path

    def _start(self, folder: Path, bus: int, stack: contextlib.ExitStack) -> subprocess.Popen[bytes]:
        command, environment = interpreter(self.build)
        process = subprocess.Popen(
            [*command, str(HERE / "under_test.py"), str(self._configuration(folder)), str(bus)],
            pass_fds=[bus],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stack.enter_context(self.log.open("wb")),
            env={**os.environ, **environment},
        )
        stack.enter_context(process)  # type: ignore[arg-type]
        self._reader = threading.Thread(target=self._listen, args=(process,), daemon=True)
        self._reader.start()
        return process

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout
        for line in process.stdout:
            said = json.loads(line)
            if "state" in said:
                self._state = said["state"]
                self._states[self._state] += 1
                if self._state == "running":
                    self._resident.append(said["resident_kb"])
            else:
                self._said = said

    # --- the course of things -----------------------------------------------------------------

    def _turn(self) -> None:
        self.world.turn()
        if self.world.failures:
            raise Failure("\n".join(self.world.failures))
        if self.process.poll() is not None:
            self._reader.join()
            raise Failure(f"the bridge ended with status {self.process.returncode}")

    def _turns(self, seconds: float, until: Callable[[], object] = lambda: False) -> bool:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._turn()
            if until():
                return True
        return False

    def _tell(self, order: str) -> None:
        assert self.process.stdin
        self.process.stdin.write(order.encode() + b"\n")
        self.process.stdin.flush()

    def _course(self) -> dict[str, Any]:
        began = time.monotonic()
        if not self._turns(AGAIN_S, lambda: self._state == "running"):
            raise Failure(f"does not start: {self._state}")
        course = self.draw.sample(self.kinds, len(self.kinds))
        if self.draw.random() < HONEST_FIRST:
            course.sort(key=lambda kind: not kind.honest)
        if abrupt := self.draw.random() < ABRUPT:
            course = course[: self.draw.randrange(1, len(course) + 1)]
        for kind in course:
            self._phase(kind)
        if abrupt:
            self.station.pause()
            self._turns(0.2 * self.draw.random())
            return self._report(began, None, self._stop())
        self.world.begin(Good)
        good_at = time.monotonic()
        self._prove(good_at + AGAIN_S)
        again_s = time.monotonic() - good_at
        return self._report(began, again_s, self._stop())

    def _report(self, began: float, again_s: float | None, end: dict[str, Any]) -> dict[str, Any]:
        seconds = time.monotonic() - began
        self._judge(seconds, end["lines"], end["resident_kb"])
        counters = end["status"]["counters"]
        return {
            "run": self.name,
            "settings": self.settings,
            "seconds": round(seconds, 1),
            "sent": self.station.sent,
            "heard": self.station.heard,
            **dict(self.world.counts),
            "confirmed": counters["tx_frames"],
            "reconnects": counters["reconnects"],
            "events_lost": counters["events_lost"],
            "looks": end["looks"],
            "log_lines": end["lines"],
            "resident_kb": end["resident_kb"],
            "longest_loop_s": round(end["longest_loop_s"], 3),
            "again_s": again_s and round(again_s, 3),
            "stop_s": round(end["stopped_s"], 3),
        }

    def _phase(self, kind: type[Good]) -> None:
        draw, station = self.draw, self.station
        station.rate = draw.choice((1e9, 1e9, 2000.0, 200.0))
        station.listens = draw.random() < 0.8
        station.odd = draw.random() < 0.5
        station.silent = False
        self.world.begin(kind)
        seconds = draw.uniform(*PHASE_S) * self.scale
        self._turns(seconds * draw.random())
        self._tell(f"queue {draw.choice((1, 16, 1024))}")
        self._turns(seconds / 2)
        if kind is HangUp:
            self.world.begin(Good)
            self._turns(0.3)
        station.listens = True

    def _prove(self, end: float) -> None:
        """All is well: PROOF frames each way come through, in order. Until then it may try again."""
        self._tell("queue 1024")
        tried = ""
        while time.monotonic() < end:
            self.station.pause()
            if self._state != "running" or self._turns(0.1, lambda: self._state != "running"):
                self._turns(0.05)
                continue
            tried = self._try()
            if not tried:
                return
        raise Failure(
            f"not well {AGAIN_S:g} s after the device is good: {self._state}; {tried or 'not tried'}"
        )

    def _try(self) -> str:
        """What was missing; nothing if all came."""
        came: list[int] = []
        self.world.on_frame = came.append
        self.station.proof.clear()
        sent = []
        said = [frames.make(n, n) for n in range(PROOF)]
        for can_id, data in said:
            sent.append(self.station.send())
            self.world.put(self.world.device.received(can_id, data))
            self._turn()
        proof, asked = self.station.proof, self.world.device.questions
        if not self._turns(max(0.5, self.deadline), lambda: came == sent and list(proof) == said):
            return f"of {PROOF} frames {len(came)} came to the device, {len(proof)} to the bus"
        if not self._turns(HEALTH_S, lambda: self.world.device.questions > asked):
            return "its health is not asked any more"
        return ""

    def _judge(self, seconds: float, lines: int, resident_kb: int) -> None:
        if lines > LOG_LINES + LOG_LINES_PER_S * seconds:
            raise Failure(f"{lines} lines in the log in {seconds:.1f} s")
        if self.station.error_frames > ERROR_FRAMES + ERROR_FRAMES_PER_S * seconds:
            raise Failure(f"{self.station.error_frames} error frames on the bus in {seconds:.1f} s")
        growth = resident_kb - self._resident[0]
        if self.build == "plain" and growth > GROWTH_KB:
            raise Failure(f"memory grows: {self._resident[0]} to {resident_kb} KiB")

    def _stop(self) -> dict[str, Any]:
        self._said = {}
        self._tell("stop")
        end = time.monotonic() + STOP_S + 10
        while self.process.poll() is None and time.monotonic() < end:
            self.world.turn()
        self._reader.join(timeout=5)
        if self.process.returncode != 0 or "status" not in self._said:
            raise Failure(f"the stop ended with status {self.process.returncode}")
        said = self._said
        if said["stopped_s"] > STOP_S:
            raise Failure(f"it took {said['stopped_s']:.1f} s to stop")
        if said["descriptors_kept"] != 0:
            raise Failure(f"{said['descriptors_kept']} descriptors are still open")
        read = said["status"]["counters"]["bus_read"]
        if read != self.station.sent:
            raise Failure(f"{self.station.sent} frames were sent, {read} read")
        if self.world.failures:
            raise Failure("\n".join(self.world.failures))
        return said


def main() -> int:
    parser = argparse.ArgumentParser(description="one bridge, one hostile device")
    parser.add_argument("adapter", choices=DEVICES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--runs", type=int, default=1, help="so many seeds from this one on")
    parser.add_argument("--build", choices=BUILDS, default="plain")
    parser.add_argument("--kinds", help=f"some of {', '.join(kind.__name__ for kind in KINDS)}")
    parser.add_argument("--scale", type=float, default=1.0, help="phases so many times as long")
    options = parser.parse_args()
    sys.setswitchinterval(0.0005)
    kinds = options.kinds.split(",") if options.kinds else None
    for seed in range(options.seed, options.seed + options.runs):
        try:
            run = Run(options.adapter, seed, options.build, kinds=kinds, scale=options.scale)
            print(json.dumps(run.run()), flush=True)
        except Failure as failure:
            print(failure)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
