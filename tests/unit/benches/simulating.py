"""What the tests of the simulator in real time share: it runs, a host, a clock that a test sets."""

import contextlib
import os
import select
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import bridged
from bridged.simulators.can232 import Can232
from bridged.simulators.device import Device
from bridged.simulators.faults import meanings, parse_fault
from bridged.simulators.serve import Simulator

TIMEOUT_S = 20
# What a simulator cannot do without, in the command line.
OPTIONS = {"replay": [str(Path(__file__).parents[2] / "golden/captures/can232.txt")]}
# A USB2CAN, from its power-up to frames at 1 Mbit/s, and what it answers to that.
_PASS_ALL = b"".join(b"\x0f\x12\x02" + bytes((16 + n, 0 if n < 4 else 0xFF)) for n in range(8))
START = (
    b"\x0f\x02\x00"  # CONFIG_MODE
    b"\x0f\x12\x02\x00\x01\x0f\x12\x02\x1f\xc0" + _PASS_ALL + b"\x0f\x12\x02\x08\xda\x0f\x12\x02\x04\x03"
    b"\x0f\x12\x02\x06\x00\x0f\x12\x02\x07\x14"  # 1 Mbit/s
    b"\x0f\x20\x02\x00\x0f\x0f\x20\x02\x01\x07"  # limits
    b"\x0f\x03\x00\x0f\x12\x02\x00\x00"  # NORMAL_MODE, MOD
)
START_ANSWER = b"\xff\xff" + b"".join(
    b"\x0f\x12\x01" + bytes((register,)) for register in (0, 31, *range(16, 24), 8, 4, 6, 7, 0)
)


@contextlib.contextmanager
def running(simulator: Simulator) -> Iterator[Simulator]:
    thread = threading.Thread(target=simulator.run)
    thread.start()
    try:
        yield simulator
    finally:
        simulator.stop()
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()


@contextlib.contextmanager
def host(port: str | Path) -> Iterator[int]:
    fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        tty.setraw(fd)
        yield fd
    finally:
        os.close(fd)


def read(fd: int, length: int) -> bytes:
    """So many bytes, or what there was when time was up."""
    data = b""
    deadline = time.monotonic() + TIMEOUT_S
    while len(data) < length and select.select([fd], [], [], max(0, deadline - time.monotonic()))[0]:
        piece = os.read(fd, length - len(data))
        if not piece:
            break
        data += piece
    return data


def ask(fd: int, commands: bytes, answer: bytes) -> None:
    os.write(fd, commands)
    assert read(fd, len(answer)) == answer


def until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline
        select.select([], [], [], 0.002)


class HandClock:
    """A clock that a test sets; it wakes the simulator to see it."""

    def __init__(self) -> None:
        self.now = 0.0
        self.simulator: Simulator | None = None

    def __call__(self) -> float:
        return self.now

    def set(self, now: float) -> None:
        assert self.simulator
        self.now = now
        self.simulator.request_state()


def by_hand(device: Device | None = None, *faults: str, **options: object) -> tuple[Simulator, HandClock]:
    clock = HandClock()
    device = device or Can232()
    clock.simulator = Simulator(
        device,
        faults=[parse_fault(text, meanings(device.own_faults)) for text in faults],
        clock=clock,
        **options,  # type: ignore[arg-type]
    )
    return clock.simulator, clock


@contextlib.contextmanager
def process(tmp_path: Path, adapter: str, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "bridged", "simulate", adapter, "--link", f"{tmp_path}/tty"]
    root = Path(bridged.__file__).parents[1]
    with subprocess.Popen([*command, "--state", f"{tmp_path}/state", *options], cwd=root) as child:
        try:
            until(lambda: (tmp_path / "tty").is_symlink() or child.poll() is not None)
            yield child
        finally:
            child.kill()


def count_calls(where: object, name: str) -> list[None]:
    calls: list[None] = []
    method = getattr(where, name)

    def counted(*arguments: object) -> object:
        calls.append(None)
        return method(*arguments)

    setattr(where, name, counted)
    return calls
