"""Frames a second to the bus of clones on USB that answer each frame, through a link of 1 ms each way.

Prints a table: can-bridge (relay and adapter as they are), python-can's slcan interface, and a writer that
only counts answers, which is the limit of the simulator, itself a Python program. All write to the same
simulated device in a process of its own; its CAN bus runs at 1 Mbit/s. ./dev python tests/bench/clones.py
"""

import argparse
import contextlib
import json
import math
import multiprocessing
import os
import select
import socket
import struct
import sys
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import can

from bridged.bridge.bridge import Bridge
from bridged.config import load
from bridged.daemon.eeprom_store import FileMemory
from bridged.simulators import make_device
from bridged.simulators.serve import Simulator

LINK_S = 0.001
BITRATE = 1_000_000
FAMILIES = ("nakakiyo", "elmue")
FRAME = struct.Struct("=IB3x8s")
CAN_ID = 0x123
QUEUE = 256  # frames that may wait for can-bridge's adapter
OUTSTANDING = 48  # of the writer: fewer than the device has room for
IDLE_S = 0.5  # without a frame on the bus it is over


class UsbLink:
    """A device behind a link: what either side says is there for the other LINK_S later."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._down: deque[tuple[float, bytes]] = deque()
        self._up: deque[tuple[float, bytes]] = deque()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def host_writes(self, now: float, data: bytes) -> None:
        self._down.append((now + LINK_S, data))

    def advance(self, now: float) -> None:
        while self._down and self._down[0][0] <= now:
            at, data = self._down.popleft()
            self._device.host_writes(at, data)
            if answer := self._device.take_output(at):
                self._up.append((at + LINK_S, answer))
        if output := self._device.take_output(now):
            self._up.append((now + LINK_S, output))

    def take_output(self, now: float) -> bytes:
        self.advance(now)
        output = b""
        while self._up and self._up[0][0] <= now:
            output += self._up.popleft()[1]
        return output

    def next_deadline(self) -> float:
        ends = [queue[0][0] if queue else math.inf for queue in (self._down, self._up)]
        return min(*ends, float(self._device.next_deadline()))


def _simulate(family: str, link: Path, pipe: Connection) -> None:
    """In a process of its own; at the end sends when each frame was on the bus, and its number."""
    seen: list[tuple[float, int]] = []
    simulator = Simulator(
        UsbLink(make_device(family)),
        link=link,
        on_frame=lambda frame: seen.append((time.monotonic(), int.from_bytes(frame.data))),
    )

    def wait() -> None:
        pipe.recv()
        while time.monotonic() - (seen[-1][0] if seen else 0.0) < IDLE_S:
            time.sleep(0.1)
        simulator.stop()

    threading.Thread(target=wait).start()
    simulator.run()
    pipe.send(seen)


class PairBus:
    """A bus of which `far` is the other end."""

    warning = ""
    failure = None
    description = "pair"

    def __init__(self) -> None:
        self._near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._near.setblocking(False)
        self.far.setblocking(False)
        self.fd = self._near.fileno()

    def dropped(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        self._near.close()
        self.far.close()


def due(begin: float, rate: float) -> int:
    """How many frames should have been offered by now, of so many a second since `begin`."""
    return sys.maxsize if rate == math.inf else int((time.monotonic() - begin) * rate)


def by_bridge(link: Path, frames: int, rate: float) -> int:
    """How many frames can-bridge says that it dropped."""
    bus: Any = PairBus()
    path = link.with_name("bench.yaml")
    config = {
        "adapter": {"type": "can232", "port": str(link)},
        "channel": {"bitrate": BITRATE},
        "bus": {"channel": "bench0"},
        "transmit": {"queue": 2 * QUEUE},
    }
    path.write_text(json.dumps(config))
    bridge = Bridge(load(path), FileMemory(link.parent), open_interface=lambda *_args, **_options: bus)
    bridge.start()
    sent, begin = 0, math.inf
    while True:
        timer = bridge.next_timer()
        wait = 0.001 if timer is None else min(0.001, max(0.0, timer - time.monotonic()))
        if select.select(bridge.filenos(), (), (), wait)[0]:
            bridge.on_readable()
        bridge.on_timer(time.monotonic())
        if bridge.state.value != "running":
            continue
        begin = min(begin, time.monotonic())
        counters = bridge.snapshot()["counters"]
        dropped = sum(counters["tx_dropped"].values())
        done = counters["tx_queued"] + dropped
        if done >= frames:
            break
        with contextlib.suppress(BlockingIOError):
            while sent < min(frames, done + QUEUE, due(begin, rate)):
                bus.far.send(FRAME.pack(CAN_ID, 8, sent.to_bytes(8)))
                sent += 1
    bridge.stop()
    while not bridge.finished:
        select.select(bridge.filenos(), (), (), 0.01)
        bridge.on_readable()
        bridge.on_timer(time.monotonic())
    bridge.close()
    return int(dropped)


def by_python_can(link: Path, frames: int, rate: float) -> int:
    """It does not know of lost frames."""
    with can.Bus(interface="slcan", channel=str(link), bitrate=BITRATE, sleep_after_open=0.1) as bus:
        ended = threading.Event()

        def read() -> None:
            while not ended.is_set():
                bus.recv(0.01)

        reader = threading.Thread(target=read)
        reader.start()
        begin = time.monotonic()
        for number in range(frames):
            while number >= due(begin, rate):
                time.sleep(LINK_S)
            bus.send(can.Message(arbitration_id=CAN_ID, is_extended_id=False, data=number.to_bytes(8)))
        time.sleep(IDLE_S)
        ended.set()
        reader.join()
    return 0


def by_writer(link: Path, frames: int, _rate: float) -> int:
    """As fast as the device answers, be it by a refusal: so fast is the simulator."""
    port = os.open(link, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(port)
    os.write(port, b"C\rS8\rO\r")
    time.sleep(0.1)
    os.read(port, 4096)
    sent = answered = 0
    while answered < frames:
        room = min(frames, answered + OUTSTANDING) - sent
        if room:
            lines = [b"t%03X8%016X\r" % (CAN_ID, number) for number in range(sent, sent + room)]
            os.write(port, b"".join(lines))
            sent += room
        said = os.read(port, 4096)
        answered += said.count(b"\r") + said.count(b"\a")
    time.sleep(IDLE_S)
    os.close(port)
    return 0


def measure(family: str, write: Callable[[Path, int, float], int], frames: int, rate: float) -> str:
    """A row of the table, without its beginning."""
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "device"
        ours, theirs = multiprocessing.Pipe()
        process = multiprocessing.Process(target=_simulate, args=(family, link, theirs))
        process.start()
        while not link.exists():
            time.sleep(0.01)
        dropped = write(link, frames, rate)
        ours.send(None)
        seen = ours.recv()
        process.join()
    numbers = [number for _, number in seen]
    on_bus = (len(seen) - 1) / (seen[-1][0] - seen[0][0])
    order = "yes" if numbers == sorted(set(numbers)) else "no"
    offered = "as fast as it goes" if rate == math.inf else f"{rate:.0f}"
    lost = frames - len(seen) - dropped
    return f"{offered} | {on_bus:.0f} | {frames} | {len(seen)} | {dropped} | {lost} | {order} |"


RUNS: tuple[tuple[str, Callable[[Path, int, float], int], float], ...] = (
    ("can-bridge", by_bridge, 3500),
    ("python-can, slcan", by_python_can, 3500),
    ("can-bridge", by_bridge, math.inf),
    ("python-can, slcan", by_python_can, math.inf),
    ("a writer that counts answers", by_writer, math.inf),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    frames = parser.parse_args().frames
    print("| device | by | offered/s | on the bus/s | frames | on the bus | told dropped | lost | in order |")
    print("|---|---|--:|--:|--:|--:|--:|--:|---|")
    for family in FAMILIES:
        for name, write, rate in RUNS:
            print(f"| {family} | {name} | {measure(family, write, frames, rate)}", flush=True)


if __name__ == "__main__":
    main()
