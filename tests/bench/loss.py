"""Loss: an adapter with room for two commands at 115200 Bd, and a bus with twice what its line carries.

The adapter is simulated on the host of the virtual machine (tests/system/vm/hostside.py), so that its line
has its real rate, and is wired to the machine's FTDI chip. Meanwhile frames come the other way too.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from subjects import HERE, Ours, PythonCan, Subject, receivers, run, wait_for, words_of

sys.path.insert(0, str(HERE.parent / "system"))
from rig import HOST, Chip, HostProcess

if TYPE_CHECKING:
    from guest import Session

BAUD = 115_200
LINE_RATE = BAUD / 10 / 22  # frames a second: "t1238" and 16 digits and CR, 10 bits each
RATE = round(2 * LINE_RATE)
TRAFFIC = 100  # frames a second from the adapter's bus


class Adapter:
    """The simulated one, on the host."""

    def __init__(self, name: str) -> None:
        self._state = HOST / f"loss-{name}.state"
        # Not --precise: it would spin, and take from the virtual machine the processor that it needs.
        arguments = [
            "simulate", "can232", "--line", "unix:../ftdi0.sock", "--uart-rate", BAUD,
            "--traffic", TRAFFIC, "--mixed", "--state", self._state.name,
        ]  # fmt: skip
        self._process = HostProcess([str(argument) for argument in arguments], f"loss-{name}")
        wait_for(lambda: self._process.out, "the simulated adapter")

    def state(self) -> dict[str, Any]:
        self._state.unlink(missing_ok=True)
        self._process.user_signal()
        wait_for(self._state.exists, "the simulator's state")
        return dict(json.loads(self._state.read_text()))

    def wait_quiet(self) -> dict[str, Any]:
        """Until no frame has come for two looks; its counters."""
        before: dict[str, Any] = {}

        def quiet() -> bool:
            nonlocal before
            time.sleep(1)
            last, before = before, self.state()["counters"]
            return all(last.get(key) == before[key] for key in ("frames_taken", "rs232_lost"))

        wait_for(quiet, "the line to be quiet")
        return before

    def stop(self) -> None:
        self._process.stop()


class LossOurs(Ours):
    def _make_pty(self) -> str:
        return terminal(self)

    def _keep(self) -> None:
        """The adapter answers for itself."""


class LossPythonCan(PythonCan):
    polls = False

    def _make_pty(self) -> str:
        return terminal(self)


class LossKernelSlcan(Subject):
    """As its manual page has it: `slcand`, an interface with the queue it comes with, `cangw`."""

    def start(self) -> None:
        run("modprobe", "-a", "slcan", "can-gw")
        self._spawn("slcand", "-F", "-o", "-s8", "-S", BAUD, terminal(self), "loss0")
        wait_for(lambda: self.alive() and Path("/sys/class/net/loss0").exists(), "slcand's interface")
        self.pids = []
        run("ip", "link", "set", "dev", "loss0", "up")
        for source, target in (("loss0", self.bus), (self.bus, "loss0")):
            run("cangw", "-A", "-s", source, "-d", target, "-e")
        wait_for(lambda: receivers(self.bus), "cangw to listen")

    def told(self) -> int:
        """Frames that the kernel says it dropped."""
        statistics = Path("/sys/class/net/loss0/statistics")
        dropped = sum(int((statistics / name).read_text()) for name in ("tx_dropped", "tx_errors"))
        queue = subprocess.run(
            ["tc", "-s", "qdisc", "show", "dev", "loss0"], capture_output=True, text=True, check=False
        )
        return dropped + sum(int(n) for n in re.findall(r"dropped (\d+)", queue.stdout))


def terminal(subject: Subject) -> str:
    """The FTDI chip's; the load has no port."""
    subject.port = "-"
    return str(Chip("ftdi0").wait_tty())


def told_by(subject: Subject) -> int:
    """Frames that it says it dropped."""
    if isinstance(subject, Ours):
        return sum(subject.settled_counters()["tx_dropped"].values())
    return subject.told() if isinstance(subject, LossKernelSlcan) else 0


def measure(session: Session) -> None:
    """Each subject for the same time."""
    seconds = 5 if session.quick else 60
    kinds: dict[str, type[Subject]] = {
        "can-bridge": LossOurs,
        "kernel-slcan": LossKernelSlcan,
        "python-can": LossPythonCan,
    }
    for number, (name, kind) in enumerate(kinds.items()):
        adapter = Adapter(name)
        subject = kind(f"loss-{name}", session.directory, session.load, vcan=f"benchl{number}")
        subject.start()
        before = adapter.wait_quiet()
        told_before = told_by(subject)
        options = {"direction": "to-device", "rate": RATE, "seconds": seconds, "warm_up": 0, "drain": 0}
        result = session.load.run([subject], *words_of(options))
        told = told_by(subject) - told_before
        after = adapter.wait_quiet()
        taken = after["frames_taken"] - before["frames_taken"]
        result |= {
            "figure": "loss", "subject": name, **options, "told": told, "taken": taken,
            "unaccounted": result["sent"] - taken - told,
            "adapter_characters_lost": after["rs232_lost"] - before["rs232_lost"],
            "adapter_refused": after["refused"] - before["refused"],
        }  # fmt: skip
        if isinstance(subject, Ours):
            result["confirmed"] = subject.settled_counters()["tx_frames"]
            result["books"] = subject.unaccounted()
        session.samples.append(result)
        print({key: result.get(key) for key in ("subject", "sent", "taken", "told", "unaccounted",
               "adapter_characters_lost", "adapter_refused", "confirmed", "books")}, flush=True)  # fmt: skip
        subject.stop()
        adapter.stop()
