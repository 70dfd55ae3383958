"""How much of the serial line is used under flood: frames a second against what the line allows.

Relay and adapter as they are, a simulated CAN232 with its line at 115200 Bd on a real pty, the bus a socketpair
that is never empty. Prints, for each window, the share of the limit: with a window of 1 a frame and its answer
take 24 character times (22 + 2); with 2 the answers come while the next frame goes out, so 22.
"""

import argparse
import multiprocessing
import socket
import struct
import sys
import tempfile
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

from bridged import bridge as bridge_module
from bridged.bridge import Bridge
from bridged.config import load
from bridged.lifecycle import State
from bridged.memory import FileMemory
from bridged.simulators.can232 import Can232
from bridged.simulators.serve import Simulator
from bridged.simulators.uart import Uart

BAUD = 115_200
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
            while True:
                self._far.send(FRAME)
                time.sleep(0.0005)
        except OSError:
            return

    def dropped(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        self._near.close()


def _simulate(link: Path, seconds: float, pipe: Connection) -> None:
    device = Can232(time.monotonic(), uart=Uart(BAUD))
    simulator = Simulator(device, link=link, precise=True)
    threading.Timer(seconds, simulator.stop).start()
    simulator.run()
    pipe.send(simulator.state())


def measure(window: int, seconds: float) -> tuple[float, int]:
    """The share of the line's limit that was used, and the characters lost in the adapter's RS232 buffer."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        link = folder / "can232"
        ours, theirs = multiprocessing.Pipe()
        simulator = multiprocessing.Process(target=_simulate, args=(link, seconds + 3, theirs))
        simulator.start()
        while not link.exists():
            time.sleep(0.01)
        path = folder / "flood.yaml"
        path.write_text(
            f"adapter: {{type: can232, port: {link}, baudrate: {BAUD}}}\nchannel: {{bitrate: 1000000}}\n"
            f"bus: {{channel: vcan0}}\ntransmit: {{window: {window}}}\n"
        )
        bridge_module.open_bus = lambda *_args, **_options: FloodedBus()  # type: ignore[assignment]
        bridge = Bridge(load(path), FileMemory(folder))
        bridge.start()
        used = _run(bridge, window, seconds)
        simulator.join()
        state = ours.recv()
        return used, state["counters"]["rs232_lost"]


def _run(bridge: Bridge, window: int, seconds: float) -> float:
    import select

    def turn() -> None:
        if select.select(bridge.filenos(), (), (), 0.05)[0]:
            bridge.on_readable()
        bridge.on_timer(time.monotonic())

    while bridge.state is not State.RUNNING:
        turn()
    time.sleep(0.5)  # the window is full, the line in its stride
    frames, start = bridge.snapshot()["counters"]["tx_frames"], time.monotonic()
    while time.monotonic() < start + seconds:
        turn()
    frames = bridge.snapshot()["counters"]["tx_frames"] - frames
    rate = frames / (time.monotonic() - start)
    bridge.stop()
    while not bridge.finished:
        turn()
    bridge.close()
    return rate * CHARACTERS[window] * CHARACTER_S


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    args = parser.parse_args()
    for window in CHARACTERS:
        used, lost = measure(window, args.seconds)
        limit = 1 / (CHARACTERS[window] * CHARACTER_S)
        print(f"window {window}: {used:.1%} of {limit:.0f} frames/s, {lost} characters lost in the adapter")
    return 0


if __name__ == "__main__":
    sys.exit(main())
