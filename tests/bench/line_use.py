"""How much of the serial line is used under flood: frames a second against what the line allows.

Relay and adapter as they are, a simulated CAN232 with its line at 115200 Bd on a real pty, the bus a
socketpair that is never empty. Prints for each window the share of the limit: with a window of 1 a frame and
its answer take 24 character times (22 + 2); with 2 the answers come while the next frame goes out, so 22.
"""

import argparse
import multiprocessing
import select
import socket
import struct
import sys
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from bridged.bridge.bridge import Bridge
from bridged.config import load
from bridged.daemon.eeprom_store import FileMemory
from bridged.simulators.can232 import Can232
from bridged.simulators.serve import Simulator
from bridged.simulators.uart import Uart

BAUD = 115_200
SETTLE_S = 2.0
CHARACTER_S = 10 / BAUD
CHARACTERS = {1: 24, 2: 22}
FRAME = struct.pack("=IB3x8s", 0x123, 8, b"12345678")


class FloodedBus:
    """A bus on which there is always one more frame."""

    warning = ""
    failure = None
    description = "flood"

    def __init__(self) -> None:
        self._near, self._far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._near.setblocking(False)
        self.fd = self._near.fileno()
        threading.Thread(target=self._flood, daemon=True).start()

    def _flood(self) -> None:
        try:
            while True:  # a thousand a second, but seldom: it must not compete for the processors
                for _ in range(50):
                    self._far.send(FRAME)
                time.sleep(0.05)
        except OSError:
            return

    def dropped(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        self._near.close()


def _simulate(link: Path, seconds: float, pipe: Connection) -> None:
    """In a process of its own; sends the line's state at the start and at the end of the measurement."""
    simulator = Simulator(Can232(time.monotonic(), uart=Uart(BAUD)), link=link, precise=True)

    def watch() -> None:
        time.sleep(SETTLE_S)
        pipe.send(simulator.state())
        time.sleep(seconds)
        pipe.send(simulator.state())
        simulator.stop()

    threading.Thread(target=watch).start()
    simulator.run()


def measure(window: int, seconds: float) -> tuple[float, int]:
    """The share of the line's limit that was used, and the characters lost in the adapter's RS232 buffer."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        link = folder / "can232"
        ours, theirs = multiprocessing.Pipe()
        simulator = multiprocessing.Process(target=_simulate, args=(link, seconds, theirs))
        simulator.start()
        while not link.exists():
            time.sleep(0.01)
        path = folder / "flood.yaml"
        path.write_text(
            f"adapter: {{type: can232, port: {link}, baudrate: {BAUD}}}\nchannel: {{bitrate: 1000000}}\n"
            f"bus: {{channel: vcan0}}\ntransmit: {{window: {window}}}\n"
        )
        bridge = Bridge(
            load(path), FileMemory(folder), open_interface=lambda *_args, **_options: FloodedBus()
        )
        bridge.start()
        while simulator.is_alive():
            if select.select(bridge.filenos(), (), (), 0.2)[0]:
                bridge.on_readable()
            bridge.on_timer(time.monotonic())
        bridge.abort()
        bridge.close()
        return _line_use(ours.recv(), ours.recv(), CHARACTERS[window])


def _line_use(start: dict[str, Any], end: dict[str, Any], characters: int) -> tuple[float, int]:
    """By the line's own clock, which stands still while the simulator is the one that is late."""
    frames = end["counters"]["frames_taken"] - start["counters"]["frames_taken"]
    elapsed_s = end["elapsed_s"] - start["elapsed_s"]
    stalled_s = end["uart"]["stalled_s"] - start["uart"]["stalled_s"]
    used = frames * characters * CHARACTER_S / (elapsed_s - stalled_s)
    return used, end["counters"]["rs232_lost"]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args()
    for window, characters in sorted(args.repeat * list(CHARACTERS.items())):
        used, lost = measure(window, args.seconds)
        limit = 1 / (characters * CHARACTER_S)
        print(f"window {window}: {used:.1%} of {limit:.0f} frames/s, {lost} characters lost in the adapter")
    return 0


if __name__ == "__main__":
    sys.exit(main())
