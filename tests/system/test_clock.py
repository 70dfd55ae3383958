"""The machine's clock is set, or senders stamp their own frames: none is sent late, none is lost for it."""

import contextlib
import os
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from rig import Bridge, Candump, Rig, wait_until
from test_can232 import balanced, taken_for_can232

pytestmark = pytest.mark.timeout(600)

SO_TXTIME = 61  # asm-generic/socket.h; SCM_TXTIME is the same
S = 1_000_000_000
LATE_S = 2.0
FRAMES = 100  # more than the relay reads at once


class Bench:
    """A bridge with a deadline of 0.5 s, and a program on its interface that numbers its frames."""

    def __init__(self, rig: Rig) -> None:
        self.near, far = rig.vcan(), rig.vcan()
        _, port = rig.slcanpty(far)
        self.bridge: Bridge = rig.bridge(taken_for_can232(port, self.near, queue=1024, deadline=0.5))
        self.bridge.wait_state("running")
        self.arrived: Candump = rig.candump(far)
        self.program = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.program.bind((self.near,))
        self.program.setsockopt(socket.SOL_SOCKET, SO_TXTIME, struct.pack("iI", time.CLOCK_MONOTONIC, 0))
        self.count = 0

    def send(self, stamp_ns: int | None = None) -> None:
        """A frame; with a time stamp it is the sender's, not the kernel's."""
        packet = struct.pack("=IB3x8s", 0x123, 8, self.count.to_bytes(8, "big"))
        stamp = [] if stamp_ns is None else [(socket.SOL_SOCKET, SO_TXTIME, struct.pack("=q", stamp_ns))]
        self.program.sendmsg([packet], stamp)
        self.count += 1

    def dropped_as_stale(self) -> int:
        """Once all is dealt with."""
        status = self.bridge.wait_status(
            lambda s: s["queued"] == 0 and s["counters"]["bus_read"] == self.count, "every frame's fate"
        )
        stale: int = balanced(status)["tx_dropped"]["stale"]
        wait_until(lambda: self.arrived.count >= self.count - stale, "the frames that were sent")
        assert self.arrived.count == self.count - stale
        return stale

    @contextlib.contextmanager
    def late(self) -> Iterator[None]:
        """The bridge gets no processor time for LATE_S, at the beginning of which the frames come."""
        os.kill(self.bridge.pid, signal.SIGSTOP)
        threads = list(Path("/proc", str(self.bridge.pid), "task").iterdir())
        wait_until(
            lambda: all("\nState:\tT" in (thread / "status").read_text() for thread in threads),
            "each thread of the bridge to stop",
        )
        began = time.monotonic()
        try:
            yield
            time.sleep(began + LATE_S - time.monotonic())
        finally:
            os.kill(self.bridge.pid, signal.SIGCONT)


@pytest.fixture
def bench(rig: Rig) -> Iterator[Bench]:
    made = Bench(rig)
    yield made
    made.program.close()


@pytest.fixture
def step() -> Iterator[Callable[[float], None]]:
    """Sets the wall clock by seconds; it is right again afterwards."""
    if not Path("/ctl").is_dir():
        pytest.skip("sets the clock: only in the virtual machine, ./dev vm run")

    def ahead() -> float:
        return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)

    def set_by(seconds: float) -> None:
        time.clock_settime(time.CLOCK_REALTIME, time.time() + seconds)

    right = ahead()
    yield set_by
    set_by(right - ahead())


def test_a_clock_that_is_set_while_the_bridge_is_late_sends_no_old_frame(
    bench: Bench, step: Callable[[float], None]
) -> None:
    for seconds in (0, -0.3, -2, -10, -3600, 3600):
        before = bench.dropped_as_stale()
        with bench.late():
            for _ in range(FRAMES):
                bench.send()
            step(seconds)
        assert bench.dropped_as_stale() == before + FRAMES, f"the clock was set by {seconds} s"


def test_the_same_with_an_interface_that_was_down_meanwhile(
    bench: Bench, step: Callable[[float], None]
) -> None:
    with bench.late():
        for _ in range(FRAMES):
            bench.send()
        for state in ("down", "up"):
            subprocess.run(["ip", "link", "set", bench.near, state], check=True)
        step(-10)
    assert bench.dropped_as_stale() == FRAMES


def test_a_clock_that_is_set_costs_a_bridge_in_time_no_frame(
    bench: Bench, step: Callable[[float], None]
) -> None:
    for seconds in (-0.3, -10, -3600, 3600, 10, 0.3):
        for _ in range(20):
            bench.send()
        step(seconds)
        for _ in range(20):
            bench.send()
            time.sleep(0.01)
    assert bench.dropped_as_stale() == 0


def made_up_stamps() -> list[int]:
    """Of clocks that a sender may take for the right one, and nonsense."""
    wall = time.time_ns()
    return [
        1000,
        time.monotonic_ns(),
        wall - 3600 * S,
        wall - 600_000_000,
        wall + 37 * S,
        wall + 3600 * S,
        2**62,
    ]


def test_frames_that_are_stamped_by_their_sender(bench: Bench) -> None:
    for stamp in made_up_stamps():
        bench.send(stamp)
        time.sleep(0.3)  # an idle interface: the frame is the first for long
    assert bench.dropped_as_stale() == 0
    with bench.late():
        for stamp in made_up_stamps():
            bench.send(stamp)
    assert bench.dropped_as_stale() == len(made_up_stamps())
