"""What system tests are built from: vcan interfaces, can-utils and can-bridge as processes, candump's logs.

Nothing sleeps for luck: whatever takes time is waited for by its visible effect, with a deadline.
Frames are strings as candump logs them and cansend takes them: ``123#1122``, ``12345678#``, ``123#R5``.
"""

import contextlib
import ctypes
import json
import os
import random
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import pytest
import yaml

from bridged.daemon.status import StatusError, query

# An emulated machine is some twenty times slower than a real one: deadlines are for what will never come.
DEADLINE_S = 60.0
SOCKET_BUFFER = 10_000_000
HOST = Path("/ctl/host")  # shared with the host of the virtual machine, see vm/hostside.py
MONITOR = Path("/dev/virtio-ports/qmp")
PR_SET_THP_DISABLE = 41  # linux/prctl.h

T = TypeVar("T")


def wait_until(condition: Callable[[], T], what: str, deadline_s: float = DEADLINE_S) -> T:
    """Return the condition's first true value; after the deadline fail, naming what was waited for."""
    end = time.monotonic() + deadline_s
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < end, f"waited {deadline_s:g} s in vain for {what}"
        time.sleep(0.02)


def receivers(interface: str, process: int | None = None) -> int:
    """Count the filters by which sockets receive from the interface: zero until somebody listens.

    The interface is in the network namespace of `process`, or in ours.
    """
    lists = Path("/proc", str(process or "self"), "net/can").glob("rcvlist_*")
    return sum(line.split()[:1] == [interface] for path in lists for line in path.read_text().splitlines())


def mixed_frames(count: int, seed: int = 0) -> list[str]:
    """Standard, extended and remote frames of every DLC, the same ones for the same seed."""
    draw = random.Random(seed)
    frames = []
    for _ in range(count):
        identifier = f"{draw.getrandbits(11):03X}" if draw.random() < 0.5 else f"{draw.getrandbits(29):08X}"
        dlc = draw.randint(0, 8)
        if draw.random() < 0.1:
            frames.append(f"{identifier}#R{dlc or ''}")
        else:
            frames.append(f"{identifier}#{draw.randbytes(dlc).hex().upper()}")
    return frames


def assert_same_frames(received: Sequence[str], expected: Sequence[str]) -> None:
    """Fail at the first difference. (pytest's own comparison of two long lists takes minutes.)"""
    if list(received) == list(expected):
        return
    pairs = zip(received, expected, strict=False)
    at = next((n for n, (a, b) in enumerate(pairs) if a != b), min(len(received), len(expected)))
    near = slice(max(0, at - 2), at + 3)
    raise AssertionError(
        f"{len(received)} frames received, {len(expected)} expected, different from number {at} on: "
        f"received … {' '.join(received[near])} … expected … {' '.join(expected[near])} …"
    )


class Resources(NamedTuple):
    threads: int
    descriptors: int
    resident_kib: int


class Process:
    """A program running beside the test, its output in files."""

    def __init__(self, arguments: Sequence[str | Path], log: Path) -> None:
        self.arguments = [str(argument) for argument in arguments]
        self.log = log
        self._out, self._err = log.with_suffix(".out"), log.with_suffix(".err")
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self._popen = subprocess.Popen(self.arguments, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
        self.pid = self._popen.pid

    @property
    def out(self) -> str:
        return self._out.read_text(errors="replace")

    @property
    def err(self) -> str:
        return self._err.read_text(errors="replace")

    @property
    def status(self) -> int | None:
        """The exit status, None while it runs."""
        return self._popen.poll()

    def wait(self, deadline_s: float = DEADLINE_S) -> int:
        """Wait for its end; the exit status."""
        try:
            return self._popen.wait(deadline_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running after {deadline_s:g} s: {self}") from None

    def wait_ready(self, condition: Callable[[], T], what: str, deadline_s: float = DEADLINE_S) -> T:
        """wait_until, but a program that ends meanwhile fails the test at once."""

        def ready() -> T:
            value = condition()
            assert value or self.status is None, f"ended while we waited for {what}: {self}"
            return value

        return wait_until(ready, f"{what}: {self}", deadline_s)

    def stop(self, with_signal: int = signal.SIGTERM, deadline_s: float = DEADLINE_S) -> int:
        """Ask it to end, and wait for that; the exit status, negative if the signal killed it."""
        if self.status is None:
            self._popen.send_signal(with_signal)
        return self.wait(deadline_s)

    def kill(self) -> None:
        if self.status is None:
            self._popen.kill()
            self._popen.wait()

    def __str__(self) -> str:
        return (
            f"{' '.join(self.arguments)} (exit status {self.status})\n{self.out[-1000:]}\n{self.err[-3000:]}"
        )


class Place(NamedTuple):
    """Where can-utils run: here, or in the network namespace of a process, by a command before theirs."""

    prefix: Sequence[str] = ()
    process: int | None = None


HERE = Place()


class Candump(Process):
    """A candump that listens already when it is made, with room for all that comes."""

    def __init__(self, interface: str, log: Path, *, errors: bool = False, place: Place = HERE) -> None:
        before = receivers(interface, place.process)
        source = f"{interface},0:0,#FFFFFFFF" if errors else interface
        super().__init__([*place.prefix, "candump", "-L", "-d", "-r", str(SOCKET_BUFFER), source], log)
        self.wait_ready(lambda: receivers(interface, place.process) > before, "candump to listen")

    @property
    def count(self) -> int:
        """How many frames there are so far."""
        return self._out.read_bytes().count(b"\n")

    @property
    def stamped(self) -> list[tuple[float, str]]:
        """The frames there are so far, each with its time in seconds."""
        lines = self.out.rpartition("\n")[0].splitlines()
        rows = [line.split() for line in lines if line.startswith("(")]  # a loss is told in between
        return [(float(stamp[1:-1]), frame) for stamp, _, frame in rows]

    @property
    def frames(self) -> list[str]:
        return [frame for _, frame in self.stamped]

    def finish(self, count: int, *, deadline_s: float = DEADLINE_S, quiet_s: float = 0.5) -> list[str]:
        """All frames, once ``count`` have come and no more have followed for ``quiet_s``."""
        try:
            wait_until(lambda: self.count >= count, f"{count} frames in {self.log.name}", deadline_s)
        except AssertionError as error:
            raise AssertionError(f"{error}; {self.count} have come, the last {self.frames[-1:]}") from None
        seen, since = self.count, time.monotonic()
        while time.monotonic() - since < quiet_s:
            time.sleep(0.05)
            if self.count != seen:
                seen, since = self.count, time.monotonic()
        self.stop()
        assert "DROPCOUNT" not in self.out + self.err, f"candump itself lost frames: {self}"
        return self.frames


class Bridge(Process):
    """A running ``can-bridge run FILE --socket PATH``."""

    def __init__(self, command: Sequence[str], configuration: Path, socket: Path, log: Path) -> None:
        self._command, self._socket = command, socket
        super().__init__([*command, "run", configuration, "--socket", socket], log)

    def read_status(self) -> dict[str, Any]:
        """What ``can-bridge status`` says, empty while there is nobody to ask."""
        if not self._socket.exists():
            return {}
        asked = subprocess.run(
            [*self._command, "status", "--socket", str(self._socket), "--json"],
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        return dict(json.loads(asked.stdout)) if asked.stdout else {}

    def snapshot(self) -> dict[str, Any]:
        """The same, straight from its socket: it takes no program that must start first."""
        try:
            return query(self._socket)
        except StatusError:
            return {}

    def resources(self) -> Resources:
        """What the process holds at this moment; see `no_huge_pages`."""
        process = Path("/proc", str(self.pid))
        pages = int((process / "statm").read_text().split()[1])
        return Resources(
            threads=len(list((process / "task").iterdir())),
            descriptors=len(list((process / "fd").iterdir())),
            resident_kib=pages * os.sysconf("SC_PAGE_SIZE") // 1024,
        )

    def wait_status(
        self, condition: Callable[[dict[str, Any]], bool], what: str, deadline_s: float = DEADLINE_S
    ) -> dict[str, Any]:
        """Wait until the status fulfils the condition; that status."""
        last: dict[str, Any] = {}

        def fulfilled() -> dict[str, Any]:
            nonlocal last
            last = self.snapshot()
            return last if last and condition(last) else {}

        try:
            return self.wait_ready(fulfilled, what, deadline_s)
        except AssertionError as error:
            raise AssertionError(f"{error}\nlast status: {last}") from None

    def wait_state(self, state: str, deadline_s: float = DEADLINE_S) -> dict[str, Any]:
        """Wait until the status says this state; that status."""
        return self.wait_status(lambda status: status.get("state") == state, f"state {state}", deadline_s)

    def stop_cleanly(self) -> None:
        """SIGTERM, and exit status 0."""
        assert self.stop() == 0, str(self)


class HostProcess(Process):
    """A simulator that ``vm/hostside.py`` runs for us on the host of the virtual machine, at its full speed.

    Its directory is HOST here and the current one there, so relative paths mean the same file to both.
    """

    def __init__(self, arguments: Sequence[str | Path], name: str) -> None:
        self.arguments = [str(argument) for argument in arguments]
        self.log = HOST / name
        self._out, self._err = self.log.with_suffix(".out"), self.log.with_suffix(".err")
        draft = self.log.with_suffix(".argv-new")
        draft.write_text("".join(f"{argument}\n" for argument in self.arguments))
        draft.rename(self.log.with_suffix(".argv"))
        wait_until(lambda: self._number("pid") or self.status is not None, "the host to start a program")
        self.pid = self._number("pid") or -1

    def _number(self, suffix: str) -> int | None:
        file = self.log.with_suffix(f".{suffix}")
        return int(file.read_text()) if file.exists() else None

    @property
    def status(self) -> int | None:
        """The exit status, None while it runs."""
        return self._number("status")

    def wait(self, deadline_s: float = DEADLINE_S) -> int:
        """Wait for its end; the exit status."""
        wait_until(lambda: self.status is not None, f"the end of {self}", deadline_s)
        return self._number("status") or 0

    def user_signal(self, deadline_s: float = DEADLINE_S) -> None:
        """SIGUSR1; returns when it is sent."""
        draft, request = self.log.with_suffix(".usr1-new"), self.log.with_suffix(".usr1")
        draft.touch()  # making a file over 9p fails if the other side removes it in that moment
        draft.rename(request)
        wait_until(lambda: not request.exists() or self.status is not None, "the host to signal", deadline_s)

    def stop(self, with_signal: int = signal.SIGTERM, deadline_s: float = DEADLINE_S) -> int:
        """Ask it to end, by SIGTERM only, and wait for that; the exit status."""
        assert with_signal == signal.SIGTERM
        self.log.with_suffix(".stop").touch()
        return self.wait(deadline_s)

    def kill(self) -> None:
        if self.status is None:
            self.stop()


class Chip:
    """One of the virtual machine's two FTDI chips (``vm/run.sh``); QEMU's monitor is the hand at its plug."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.serial_number = {"ftdi0": "RIG0001", "ftdi1": "RIG0002"}[name]

    @property
    def usb(self) -> Path | None:
        """Its directory in /sys, None while it is unplugged."""
        for file in Path("/sys/bus/usb/devices").glob("*/serial"):
            with contextlib.suppress(OSError):  # just unplugged
                if file.read_text().strip() == self.serial_number:
                    return file.parent
        return None

    @property
    def tty(self) -> Path | None:
        """Its terminal once udev has seen to it; None while it is unplugged or has another driver."""
        links = Path("/dev/serial/by-id").glob(f"*{self.serial_number}*")
        return next((link.resolve() for link in links if link.exists()), None)

    @property
    def far_end(self) -> Path:
        """What the chip is wired to, where that is in this machine."""
        return Path("/dev/virtio-ports") / self.name

    def wait_tty(self) -> Path:
        tty = wait_until(lambda: self.tty, f"the terminal of {self.name}")
        assert tty
        return tty

    def unplug(self) -> None:
        ask_monitor("device_del", id=self.name)
        wait_until(lambda: self.usb is None and self.tty is None, f"{self.name} to be gone")

    def plug(self) -> None:
        """Plug it in again. Its terminal follows, unless a bridge takes the chip from the kernel's driver."""
        ask_monitor(
            "device_add",
            driver="usb-serial",
            id=self.name,
            chardev=self.name,
            serial=self.serial_number,
            **{"always-plugged": True},
        )
        wait_until(lambda: self.usb, f"{self.name} to be plugged in")

    def restore(self) -> None:
        """Plugged in, with the kernel's driver: a bridge that was killed has not given it back."""
        usb = self.usb
        if usb is None:
            self.plug()
        elif self.tty is None:
            with contextlib.suppress(OSError):  # just plugged in: the kernel has yet to look at it, and will
                Path("/sys/bus/usb/drivers_probe").write_text(f"{usb.name}:1.0")
        self.wait_tty()


def ask_monitor(command: str, **arguments: Any) -> Any:
    """Have QEMU's monitor execute a command of QMP; what it returns."""
    # It accepts its first command only after qmp_capabilities, and that only once.
    requests = [{"execute": "qmp_capabilities"}, {"execute": command, "arguments": arguments, "id": command}]
    monitor = os.open(MONITOR, os.O_RDWR)
    try:
        os.write(monitor, "".join(json.dumps(request) + "\r\n" for request in requests).encode())
        text = b""
        while True:
            assert select.select([monitor], [], [], DEADLINE_S)[0], f"the monitor does not answer: {text!r}"
            text += os.read(monitor, 65536)
            *lines, text = text.split(b"\n")
            for line in lines:
                with contextlib.suppress(json.JSONDecodeError):  # the rest of what the last one did not read
                    reply = json.loads(line)
                    if reply.get("id") == command:
                        assert "error" not in reply, f"{requests[1]}: {reply}"
                        return reply["return"]
    finally:
        os.close(monitor)


def no_huge_pages() -> None:
    """For programs started from now on: the kernel fills them up when it likes, which looks like a leak."""
    assert ctypes.CDLL(None).prctl(PR_SET_THP_DISABLE, 1, 0, 0, 0) == 0


class Rig:
    """Makes the parts of one test in its own directory, and clears them away afterwards."""

    _interfaces_made = 0

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._processes: list[Process] = []
        self._interfaces: list[str] = []
        self._descriptors: list[int] = []
        self._chips: list[Chip] = []
        installed = shutil.which("can-bridge")
        self.command = [installed] if installed else [sys.executable, "-m", "bridged"]

    def _log(self, name: str) -> Path:
        return self.directory / f"{len(self._processes):02}-{name}"

    def vcan(self) -> str:
        """A new vcan interface, up; its name."""
        Rig._interfaces_made += 1
        name = f"cbt{os.getpid() % 100000}-{Rig._interfaces_made}"
        subprocess.run(["ip", "link", "add", "dev", name, "type", "vcan"], check=True)
        self._interfaces.append(name)
        subprocess.run(["ip", "link", "set", "dev", name, "up"], check=True)
        return name

    def start(self, *arguments: str | Path) -> Process:
        """Any program, not waited for."""
        process = Process(arguments, self._log(Path(arguments[0]).name))
        self._processes.append(process)
        return process

    def candump(self, interface: str, *, errors: bool = False, place: Place = HERE) -> Candump:
        """A log of what appears on the interface from now on; with ``errors`` error frames too."""
        dump = Candump(interface, self._log(f"candump-{interface}"), errors=errors, place=place)
        self._processes.append(dump)
        return dump

    def cansend(self, interface: str, frame: str) -> None:
        """One frame."""
        subprocess.run(["cansend", interface, frame], check=True, timeout=DEADLINE_S)

    def cangen(
        self, interface: str, count: int, *options: str, gap_ms: float = 0, place: Place = HERE
    ) -> Process:
        """Generate frames, see cangen's options; it waits for room where the interface has a queue."""
        return self.start(
            *place.prefix, "cangen", interface, "-g", str(gap_ms), "-n", str(count), "-p", "100", *options
        )

    def play(
        self, interface: str, frames: Sequence[str], rate: float | None = None, *, place: Place = HERE
    ) -> Process:
        """Send exactly these frames: as fast as it goes, or ``rate`` of them a second."""
        log = self._log("play").with_suffix(".log")
        step = 1 / rate if rate else 0.0
        log.write_text("".join(f"({n * step:.6f}) {interface} {frame}\n" for n, frame in enumerate(frames)))
        pace = ["-g", "1"] if rate else ["-t"]
        # On one processor: while softirqs are behind, frames of a sender that moves to another change places.
        processor = str(min(os.sched_getaffinity(0)))
        return self.start(*place.prefix, "taskset", "-c", processor, "canplayer", "-I", log, *pace)

    def slcanpty(self, interface: str) -> tuple[Process, Path]:
        """can-utils' slcan adapter on a pseudo-terminal: the process, and the terminal a bridge opens."""
        process = self.start("stdbuf", "-oL", "slcanpty", "/dev/ptmx", interface)
        process.wait_ready(lambda: "/dev/pts/" in process.out, "slcanpty to name its terminal")
        terminal = Path(re.findall(r"/dev/pts/\d+", process.out)[0])
        # It ends when nobody has its terminal open any more.
        self._descriptors.append(os.open(terminal, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
        return process, terminal

    def simulate(self, interface: str | None, *options: str, adapter: str = "can232") -> tuple[Process, Path]:
        """A simulated adapter with its CAN side on the interface: the process, and the path of its port."""
        link = self.directory / f"adapter{len(self._processes)}"
        bus = ["--bus", interface] if interface else []
        before = receivers(interface) if interface else -1
        process = self.start(*self.command, "simulate", adapter, "--link", link, *bus, *options)
        process.wait_ready(link.exists, "the simulated adapter's port")
        if interface:
            process.wait_ready(lambda: receivers(interface) > before, "the simulated adapter to listen")
        return process, link

    def host_simulate(self, *options: str, adapter: str = "usb2can") -> HostProcess:
        """A simulated adapter on the host of the virtual machine, behind the chip ``ftdi0``: its process.

        Its CAN side is made of --traffic and --record; a relative path there is one in HOST here.
        """
        number = len(list(HOST.glob("*.argv")))
        arguments = ["simulate", adapter, "--line", "unix:../ftdi0.sock", *options]
        process = HostProcess(arguments, f"{number:02}-{adapter}")
        self._processes.append(process)
        process.wait_ready(lambda: process.out, "the simulated adapter to be ready")
        return process

    def chip(self, name: str) -> Chip:
        """One of the virtual machine's FTDI chips, ``ftdi0`` or ``ftdi1``, plugged in; skips elsewhere."""
        if not MONITOR.exists():
            pytest.skip("needs the FTDI chips of our virtual machine: ./dev vm run")
        chip = Chip(name)
        self._chips.append(chip)
        chip.wait_tty()
        return chip

    def bridge(
        self, configuration: dict[str, Any], name: str = "bridge", within: Sequence[str] = ()
    ) -> Bridge:
        """A bridge with this configuration, not waited for; `within`: a command that starts it."""
        file = self.directory / f"{name}.yaml"
        file.write_text(yaml.safe_dump(configuration, sort_keys=False))
        bridge = Bridge([*within, *self.command], file, self.directory / f"{name}.sock", self._log(name))
        self._processes.append(bridge)
        return bridge

    def clear(self) -> None:
        """End and remove everything; print the logs, which pytest shows if the test has failed."""
        for process in reversed(self._processes):
            process.kill()
        for chip in self._chips:
            chip.restore()
        for descriptor in self._descriptors:
            os.close(descriptor)
        for interface in self._interfaces:
            with contextlib.suppress(subprocess.CalledProcessError):
                subprocess.run(["ip", "link", "delete", "dev", interface], check=True, capture_output=True)
        for process in self._processes:
            print(process)
