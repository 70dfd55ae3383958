"""Two bridges side by side amid traffic both ways, while everything that can fails, as the lot falls.

CAN_BRIDGE_SOAK_SEED and CAN_BRIDGE_SOAK_S (seconds) choose another order and length of the long one.
"""

import errno
import os
import random
import select
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import pytest
from rig import DEADLINE_S, Resources, Rig, no_huge_pages, wait_until
from test_can232 import balanced
from wired import WiredAdapter, assert_flat, in_order, numbered_frames, plugged, wait_terminal

from bridged.errors import InterfaceError
from bridged.simulators import SIMULATORS, simulator
from bridged.simulators.ends import CAN_FRAME, EXTENDED, open_can, unpack
from bridged.simulators.faults import Fault, meanings
from bridged.simulators.serve import record_line

SHORT_S = 45.0  # each kind of fault about once
LONG_S = float(os.environ.get("CAN_BRIDGE_SOAK_S", "600"))
SEED = os.environ.get("CAN_BRIDGE_SOAK_SEED", "1")

pytestmark = pytest.mark.timeout(600 + 4 * LONG_S)

SENT = 0x1ABCDEF0  # identifier of the frames to the adapters
FPS = 25  # each way
FLOW = 5  # frames each way that show that it runs
OVERLOAD = 2000  # frames at once: more than the queue holds
DEADLINE = 0.5  # seconds
FAULT_S = (0.5, 2.5)
WARM_UP = 5  # phases
LOOK_S = 0.05
RETRY_S = 0.05
MARK_S = 5.0  # for a frame to come through, or another is tried

INTERFACE_FAULTS = ("interface down", "interface deleted")
OTHERS = (*INTERFACE_FAULTS, "overload")
KINDS = {name: (*meanings(simulator(name).FAULTS), *OTHERS) for name in SIMULATORS}
SERIAL_NUMBERS = {"can232": "PY000031", "usb2can": "PY000032"}

# An emulated machine may be so slow that an answer counts as missing: a bridge may begin anew at any time.
ANEW = {"running", "closing", "backoff", "opening", "initialising"}
REFUSED = ANEW | {"rejecting", "fault"}
EXPECTED = {"unplug": ANEW | {"waiting"}, "garbage": REFUSED, "refuseall": REFUSED}


def ip(*arguments: str) -> None:
    subprocess.run(["ip", "link", *arguments], check=True)


class Station(threading.Thread):
    """A node on a bridge's interface: sends numbered frames, notes what it hears; outlives the interface."""

    def __init__(self, interface: str) -> None:
        super().__init__()
        self.born: dict[str, float] = {}  # what was sent, and time.time() just after
        self.heard: list[str] = []
        self._interface = interface
        self._socket: socket.socket | None = None
        self._next_at = time.monotonic()
        self._at_once = 0
        self._wake, self._waker = socket.socketpair()
        self._silence = threading.Event()
        self._quiet = threading.Event()
        self._stop_it = False

    def flood(self, count: int) -> None:
        """Send so many frames at once, also while paused."""
        self._at_once = count
        self._waker.send(b"x")

    def mark(self) -> str:
        """Send one frame, while paused; which it is."""
        self.flood(1)
        wait_until(lambda: not self._at_once, "a frame to be sent")
        return next(reversed(self.born))

    def pause(self) -> None:
        """Send nothing by itself until resume(); it is so when this returns."""
        self._quiet.clear()
        self._silence.set()
        self._waker.send(b"x")
        assert self._quiet.wait(DEADLINE_S)

    def resume(self) -> None:
        self._silence.clear()
        self._waker.send(b"x")

    def stop(self) -> None:
        self._stop_it = True
        self._waker.send(b"x")
        self.join()
        for end in filter(None, (self._socket, self._wake, self._waker)):
            end.close()

    def run(self) -> None:
        # While softirqs are behind, frames of a sender that moves to another processor change places.
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        while not self._stop_it:
            wait_s = RETRY_S if not self._socket else max(0.0, self._next_at - time.monotonic())
            ends = [self._wake, *filter(None, (self._socket,))]
            if self._wake in select.select(ends, [], [], wait_s)[0]:
                self._wake.recv(64)
            try:
                self._socket = self._socket or open_can(self._interface)
                self._listen(self._socket)
                self._send(self._socket)
            except (InterfaceError, OSError) as error:
                if self._socket and getattr(error, "errno", 0) != errno.ENETDOWN:  # that may come back
                    self._socket.close()
                    self._socket = None
            if self._silence.is_set():
                self._next_at = time.monotonic() + RETRY_S
                self._quiet.set()

    def _listen(self, bus: socket.socket) -> None:
        try:
            while True:
                frame = unpack(bus.recv(CAN_FRAME.size, socket.MSG_DONTWAIT))
                if frame:
                    self.heard.append(record_line(frame).strip())
        except BlockingIOError:
            pass

    def _send(self, bus: socket.socket) -> None:
        now = time.monotonic()
        while self._at_once or (self._next_at <= now and not self._silence.is_set()):
            if not self._at_once:
                self._next_at = max(self._next_at, now - 1 / FPS) + 1 / FPS
            data = len(self.born).to_bytes(8, "big")
            bus.send(CAN_FRAME.pack(SENT | EXTENDED, len(data), data))
            self.born[f"{SENT:08X}#{data.hex().upper()}"] = time.time()
            self._at_once -= self._at_once > 0


class Side:
    """A bridge, its adapter behind a fake chip, and a station on its interface."""

    def __init__(self, rig: Rig, chip: WiredAdapter) -> None:
        adapter, serial_number = chip.adapter, chip.serial_number
        self.chip = chip
        self.resources: list[Resources] = []
        self._interface = rig.vcan()
        self._others = numbered_frames()
        self._unread = self._unheard = 0
        self._kind = ""
        self._kinds = self._draw_kinds()
        settings: dict[str, Any] = {"type": adapter, "port": f"usb://0403:6001/{serial_number}"}
        if adapter == "can232":
            settings |= {"port": str(wait_terminal(serial_number)), "baudrate": 115_200}
        self.bridge = rig.bridge(
            {
                "adapter": settings,
                "channel": {"bitrate": 125_000},
                "bus": {"channel": self._interface, "create": True},
                "transmit": {"deadline": DEADLINE},
                "reconnect": {"maximum": 1.0},
            },
            name=adapter,
        )
        self.station = Station(self._interface)
        self.bridge.wait_state("running")

    def _draw_kinds(self) -> Iterator[str]:
        """All kinds in some order, and again."""
        draw = random.Random(f"{SEED} {self.chip.adapter}")
        kinds = KINDS[self.chip.adapter]
        while True:
            yield from draw.sample(kinds, len(kinds))

    def begin(self) -> str:
        """The next fault; its kind."""
        self._kind = next(self._kinds)
        match self._kind:
            case "unplug":
                self.chip.unplug()
            case "interface down":
                ip("set", self._interface, "down")
            case "interface deleted":
                ip("del", self._interface)
            case "overload":
                self.station.flood(OVERLOAD)
            case kind:
                self.chip.begin(Fault(kind, 0, 1))
        return self._kind

    def end(self) -> None:
        """Its cause is gone."""
        match self._kind:
            case "unplug":
                self.chip.plug()
            case "interface down":
                ip("set", self._interface, "up")
            case "interface deleted" | "overload":
                pass  # it makes the interface itself
            case kind:
                self.chip.end(Fault(kind, 0, 1))

    def look(self) -> dict[str, Any]:
        """The status, which is one of those that this fault may lead to."""
        status = self.bridge.snapshot()
        assert status, f"no answer: {self.bridge}"
        expected = EXPECTED.get(self._kind, ANEW)
        assert status["state"] in expected, f"{status['state']} ({status['reason']}) in phase {self._kind}"
        return status

    def wait_flowing(self) -> None:
        """Wait until it runs, and frames go both ways."""
        before: dict[str, Any] = {}

        def flowing() -> bool:
            nonlocal before
            status = self.look()
            counters = status["counters"]
            if status["state"] != "running" or not before:
                before = counters
                return False
            return all(counters[key] >= before[key] + FLOW for key in ("rx_frames", "tx_frames"))

        wait_until(flowing, f"frames both ways after {self._kind}: {self.bridge}")

    def assert_books(self) -> None:
        """Nobody sends for a moment, until all frames have gone somewhere: the counters agree with that."""
        self.station.pause()
        self.chip.hear()
        wait_until(self._marks_come, f"a last frame to come through each way: {self.bridge}")
        counters = balanced(wait_until(self._idle, f"an empty queue: {self.bridge}"))
        dropped = counters["tx_dropped"]
        unread = len(self.station.born) - counters["bus_read"] - dropped.get("socket-overflow", 0)
        unheard = counters["rx_frames"] - len(self.station.heard)
        if self._kind in INTERFACE_FAULTS:  # sent or delivered while nobody could read it
            assert unread >= self._unread
            assert unheard >= self._unheard
            self._unread, self._unheard = unread, unheard
        assert (unread, unheard) == (self._unread, self._unheard), self._kind
        taken = sum(life.taken for life in self.chip.lives)
        assert counters["tx_frames"] <= taken <= counters["tx_frames"] + dropped["unanswered"], self._kind
        self.resources.append(self.bridge.resources())
        self.station.resume()
        self.chip.hear(self._others, FPS)

    def _marks_come(self) -> bool:
        """Whether a frame comes through each way: what was sent before it has come, or never will."""
        sent, heard = self.station.mark(), next(self._others)
        self.chip.hear([heard])
        until = time.monotonic() + MARK_S
        while time.monotonic() < until:
            time.sleep(LOOK_S)
            self.look()
            handed = self.chip.life.handed[-1:]
            if self.station.heard[-1:] == [record_line(heard).strip()] and handed and handed[0][1] == sent:
                return True
        return False

    def _idle(self) -> dict[str, Any]:
        """The status, once it runs and nothing waits."""
        status = self.look()
        return status if status["state"] == "running" and not status["queued"] else {}

    def assert_all(self) -> None:
        """After the end: on both buses all came from the other one, in its order, and nothing too late."""
        born, lives = self.station.born, self.chip.lives
        assert in_order((frame for life in lives for frame in life.sent), born)
        assert in_order(self.station.heard, (frame for life in lives for frame in life.heard))
        for life in lives:
            assert [frame for frame in life.sent if born[frame] < life.since - DEADLINE] == []
            assert life.handed_late(born, DEADLINE) == []
        assert "Traceback" not in self.bridge.err
        assert self.bridge.status == 0
        assert_flat(self.resources[WARM_UP:])


def soak(sides: Sequence[Side], seconds: float) -> None:
    began = time.monotonic()
    draw = random.Random(SEED)
    while time.monotonic() < began + seconds:
        duration_s = draw.uniform(*FAULT_S)
        at_s = time.monotonic() - began
        kinds = [side.begin() for side in sides]
        print(f"{at_s:5.1f} s, for {duration_s:.1f} s: {', '.join(kinds)}")
        over_at = time.monotonic() + duration_s
        while time.monotonic() < over_at:
            for side in sides:
                side.look()
            time.sleep(LOOK_S)
        for side in sides:
            side.end()
        for side in sides:
            side.wait_flowing()
        for side in sides:
            side.assert_books()


@pytest.mark.parametrize("seconds", [SHORT_S, pytest.param(LONG_S, marks=pytest.mark.long)])
def test_soak(rig: Rig, seconds: float) -> None:
    print(f"CAN_BRIDGE_SOAK_SEED={SEED}")
    no_huge_pages()
    with (
        plugged("can232", SERIAL_NUMBERS["can232"]) as can232,
        plugged("usb2can", SERIAL_NUMBERS["usb2can"]) as usb2can,
    ):
        sides = [Side(rig, can232), Side(rig, usb2can)]
        try:
            for side in sides:
                side.station.start()
                side.assert_books()
            soak(sides, seconds)
            for side in sides:
                side.bridge.stop_cleanly()
        finally:
            for side in sides:
                side.station.stop()
                print(side.bridge)
        for side in sides:
            side.assert_all()
