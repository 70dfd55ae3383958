"""What is measured: the bridge, the floor under it, and its peers, each between a port and a vcan.

All of them run at the same time, each with a vcan and a pseudo terminal of its own, and the load goes to one
after the other: so each sample has a neighbour of every other subject, and a machine that is slow for a
while is slow for all. Those that poll are stopped (SIGSTOP) while it is not their turn.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from bridged.daemon.status import StatusError, query

HERE = Path(__file__).resolve().parent
SUBJECT_CPU, LOAD_CPU = 0, (os.cpu_count() or 1) - 1
START_LIMIT_S = 120.0
SOCKET_BUFFER = 4 << 20  # bytes, as that of a CAN socket
WIDE = 32  # frames unanswered: what comes closest to peers that wait for no answer


def run(*command: str | Path) -> str:
    """Run a program to its end; what it wrote."""
    return subprocess.run([str(c) for c in command], check=True, capture_output=True, text=True).stdout


def wait_for(condition: Callable[[], Any], what: str) -> None:
    end = time.monotonic() + START_LIMIT_S
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError(f"waited in vain for {what}")
        time.sleep(0.05)


def words_of(options: dict[str, Any]) -> Iterator[object]:
    """Options of load.c: `warm_up=1` for --warm-up 1."""
    for key, value in options.items():
        yield f"--{key.replace('_', '-')}"
        yield value


def receivers(interface: str) -> int:
    """How many filters of sockets there are on the interface."""
    lists = Path("/proc/net/can").glob("rcvlist_*")
    return sum(line.split()[:1] == [interface] for path in lists for line in path.read_text().splitlines())


class Load:
    """The program load.c on the ends of one or more subjects."""

    def __init__(self, program: Path) -> None:
        self.program = program

    def command(self, subjects: Sequence[Subject], *options: object) -> list[str]:
        words: list[object] = [self.program, "--protocol", subjects[0].protocol, "--cpu", LOAD_CPU, *options]
        words += [word for subject in subjects for pid in subject.pids for word in ("--watch", pid)]
        words += ["--opaque"] if subjects[0].opaque else []
        words += [word for subject in subjects for word in (subject.port, subject.bus)]
        return [str(word) for word in words]

    def run(self, subjects: Sequence[Subject], *options: object) -> dict[str, Any]:
        """One sample; of several subjects together if they are of one kind."""
        command = self.command(subjects, *options)
        fds = [fd for subject in subjects for fd in subject.fds]
        with contextlib.ExitStack() as stack:
            for subject in subjects:
                stack.enter_context(subject.awake())
            done = subprocess.run(command, capture_output=True, text=True, pass_fds=fds, check=False)
        if done.returncode:
            said = "\n".join(subject.said() for subject in subjects)
            raise RuntimeError(f"{subjects[0].name}: {done.stderr}\n{said}")
        return dict(json.loads(done.stdout))

    def keep(self, subjects: Sequence[Subject]) -> subprocess.Popen[bytes]:
        """Answer the subjects' questions until this is killed."""
        command = self.command(subjects, "--direction", "idle", "--seconds", 1_000_000)
        fds = [fd for subject in subjects for fd in subject.fds]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, pass_fds=fds)


class Subject:
    """One program with its ends: a pseudo terminal and a vcan, or a socketpair where the kernel has no CAN.

    `port` and `bus` are what the load gets, `fds` what it inherits; `pids` are the processes it watches.
    """

    protocol = "can232"
    opaque = False
    polls = False  # it wakes up by itself: stopped while it is not measured

    def __init__(self, name: str, directory: Path, load: Load, *, vcan: str | None) -> None:
        self.name = name
        self.load = load
        self.directory = directory
        self.vcan = vcan
        self.fds: tuple[int, ...] = ()
        self.pids: list[int] = []
        self.port = ""
        self._given: tuple[int, ...] = ()  # descriptors that the subject inherits
        self._log = directory / f"{name}.log"
        self._process: subprocess.Popen[bytes] | None = None
        if vcan is not None:
            self.bus = self.bus_of_subject = vcan
            run("ip", "link", "add", "dev", vcan, "type", "vcan")
            run("ip", "link", "set", "dev", vcan, "up")
            return
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._sockets = (near, far)
        for end in self._sockets:
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BUFFER)
        self._given, self.bus_of_subject = (near.fileno(),), str(near.fileno())
        self.fds, self.bus = (far.fileno(),), str(far.fileno())

    def start(self) -> None:
        raise NotImplementedError

    @contextlib.contextmanager
    def awake(self) -> Iterator[None]:
        """While it is measured."""
        if self.polls:
            for pid in self.pids:
                os.kill(pid, signal.SIGCONT)
        yield
        if self.polls:
            for pid in self.pids:
                os.kill(pid, signal.SIGSTOP)

    def said(self) -> str:
        return self._log.read_text(errors="replace")[-2000:] if self._log.exists() else ""

    def _make_pty(self) -> str:
        """The load has the master; the name of the slave."""
        master, self._slave = os.openpty()  # the slave is held open: a subject may come late
        tty.setraw(self._slave)
        self.fds, self.port = (*self.fds, master), str(master)
        return os.ttyname(self._slave)

    def _spawn(self, *command: object) -> None:
        words = ["taskset", "-c", str(SUBJECT_CPU), *(str(word) for word in command)]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, pass_fds=self._given
            )
        self.pids = [self._process.pid]

    def alive(self) -> bool:
        if self._process is not None and self._process.poll() is not None:
            raise RuntimeError(f"{self.name} has ended: {self.said()}")
        return True

    def stop(self) -> None:
        """Ends it, and gives back its ends."""
        if self._process is not None:
            self._process.send_signal(signal.SIGCONT)
            self._process.terminate()
            self._process.wait(30)
        if self.vcan is not None:
            run("ip", "link", "delete", "dev", self.vcan)
        else:
            for end in self._sockets:
                end.close()


class Ours(Subject):
    """`can-bridge run`; its questions are answered by an idle load while another one is measured."""

    adapter = "can232"
    transmit = ""
    _keeper: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self.prepare()
        self._keep()
        self.launch()

    def prepare(self) -> None:
        """Its port and its configuration; before it is launched somebody must play the adapter."""
        self.protocol = self.adapter
        slave = self._make_pty()
        self._socket = self.directory / f"{self.name}.sock"
        self._configuration = self.directory / f"{self.name}.yaml"
        # The adapter that somebody plays answers F always, as a CAN232 does only when it is open.
        keys = ", baudrate: 115200, firmware: can232" if self.adapter == "can232" else ""
        self._configuration.write_text(
            f"adapter: {{type: {self.adapter}, port: {slave}{keys}}}\nchannel: {{bitrate: 1000000}}\n"
            f"bus: {{channel: {self.bus}}}\n{self.transmit}"
        )

    def launch(self) -> None:
        self._spawn(*self._command(), "run", self._configuration, "--socket", self._socket)
        wait_for(lambda: self.alive() and self.status().get("state") == "running", f"{self.name} to run")

    def _keep(self) -> None:
        self._keeper = self.load.keep([self])

    def _unkeep(self) -> None:
        if self._keeper is not None:
            self._keeper.kill()
            self._keeper.wait()

    def _command(self) -> list[object]:
        if self.vcan is not None:
            return ["can-bridge"]
        return [sys.executable, HERE / "on_socketpair.py", self.bus_of_subject]

    def status(self) -> dict[str, Any]:
        """As `can-bridge status --json`; empty while there is nobody to ask."""
        try:
            return query(self._socket)
        except StatusError:
            return {}

    def settled_counters(self) -> dict[str, Any]:
        """Its accounting, once no frame is on its way."""
        counters: dict[str, Any] = {}

        def settled() -> bool:
            nonlocal counters
            status = self.status()
            counters = status["counters"] | {"queued": status["queued"]}
            return not status["queued"]

        wait_for(settled, f"{self.name} to have sent what it has")
        return counters

    def dropped(self) -> int:
        """Frames that it says it dropped, both ways, once none is on its way."""
        c = self.settled_counters()
        return int(sum(c["tx_dropped"].values()) + sum(c["rx_dropped"].values()))

    def unaccounted(self) -> int:
        """Frames that its counters do not explain."""
        c = self.settled_counters()
        to_device = c["bus_read"] - c["tx_frames"] - c["queued"] - sum(c["tx_dropped"].values())
        to_device += c["tx_dropped"].get("socket-overflow", 0)  # they were never read
        to_bus = c["decoded"] - c["rx_frames"] - c["rx_pending"] - sum(c["rx_dropped"].values())
        return int(abs(to_device) + abs(to_bus))

    @contextlib.contextmanager
    def awake(self) -> Iterator[None]:
        self._unkeep()
        yield
        self._keep()

    def stop(self) -> None:
        super().stop()
        self._unkeep()


class OursWide(Ours):
    transmit = f"transmit: {{window: {WIDE}}}\n"


class OursUsb2can(Ours):
    adapter = "usb2can"


class Floor(Subject):
    opaque = True
    window = 1

    def start(self) -> None:
        self._spawn(self.load.program.with_name("floor"), self._make_pty(), self.bus_of_subject, self.window)
        wait_for(lambda: self.alive() and "ready" in self.said(), "the floor to be ready")


class FloorWide(Floor):
    window = WIDE


class Slcanpty(Subject):
    """can-utils' CAN232 on a pseudo terminal: the roles are mirrored, what is moved is the same."""

    protocol = "host"

    def start(self) -> None:
        self._spawn("stdbuf", "-oL", "slcanpty", "/dev/ptmx", self.bus)
        wait_for(lambda: self.alive() and "/dev/pts/" in self.said(), "slcanpty to name its terminal")
        self.port = re.findall(r"/dev/pts/\d+", self.said())[0]
        self._slave = os.open(self.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._slave)
        os.write(self._slave, b"O\r")  # nothing goes either way before
        wait_for(lambda: receivers(self.bus) and self._answer(), "slcanpty to open its channel")

    def _answer(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return os.read(self._slave, 100)
        return b""


class KernelSlcan(Subject):
    """The kernel's slcan, attached by slcand, joined to the vcan by cangw. No process moves its frames."""

    def start(self) -> None:
        run("modprobe", "-a", "slcan", "can-gw")
        slave = self._make_pty()
        self._spawn("slcand", "-F", "-o", "-s8", "-S", "115200", slave, "slcan0")
        self.pids = []
        wait_for(lambda: self.alive() and Path("/sys/class/net/slcan0").exists(), "slcan0")
        # With the usual 10 its queue overflows at once, and nobody is told.
        run("ip", "link", "set", "dev", "slcan0", "txqueuelen", "1000")
        run("ip", "link", "set", "dev", "slcan0", "up")
        for source, target in (("slcan0", self.bus), (self.bus, "slcan0")):
            run("cangw", "-A", "-s", source, "-d", target, "-e")


class PythonCan(Subject):
    """python-can's slcan and socketcan as its can_bridge joins them: a reader each way."""

    polls = True

    def start(self) -> None:
        slave = self._make_pty()
        # As its command line tool has it: -i slcan -c TERMINAL … -- socketcan …
        self._spawn("env", f"PYTHONPATH={HERE / 'build' / 'python-can'}", sys.executable, "-m", "can.bridge",
            "--bus1-interface", "slcan", "--bus1-channel", slave, "--bus1-bitrate", 1_000_000,
            "--bus2-interface", "socketcan", "--bus2-channel", self.bus)  # fmt: skip
        wait_for(lambda: self.alive() and receivers(self.bus), "python-can to be ready")
        if self.polls:
            os.kill(self.pids[0], signal.SIGSTOP)


SUBJECTS: dict[str, type[Subject]] = {
    "floor": Floor,
    "can-bridge": Ours,
    "floor-wide": FloorWide,
    "can-bridge-wide": OursWide,
    "can-bridge-usb2can": OursUsb2can,
    "slcanpty": Slcanpty,
    "kernel-slcan": KernelSlcan,
    "python-can": PythonCan,
}
