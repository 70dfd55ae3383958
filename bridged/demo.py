"""can-bridge demo: a simulated adapter, the real bridge, and a program on the CAN interface.

The simulator speaks the adapter's protocol on a pseudo terminal; the bridge does not know that it is no
device. Where the kernel has CAN the interface is vcan0, else python-can's `virtual` inside this process.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import can

from bridged.bridge.bridge import Bridge
from bridged.config import load
from bridged.daemon.eeprom_store import FileMemory
from bridged.daemon.service import serve
from bridged.errors import NO_CAN, InterfaceError
from bridged.interfaces.socketcan import open_socketcan
from bridged.simulators import SIMULATORS, make_device, simulator
from bridged.simulators.options import positive
from bridged.simulators.serve import Simulator, cyclic_frames

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

CHANNEL = "vcan0"
UART_RATE = 115_200
STATUS_INTERVAL_S = 1.0
CLOSED = ("closed", "config")  # what the devices call it
CONFIG = """\
adapter:
{adapter}
channel:
  bitrate: 125000
bus:
  interface: {interface}
  channel: {channel}
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `can-bridge demo`."""
    driven = [name for name in SIMULATORS if simulator(name).ADAPTER]
    first = driven[0]
    parser.add_argument(
        "adapter", nargs="?", choices=driven, default=first, help=f"which one; default: {first}"
    )
    parser.add_argument("--duration", type=positive, default=10.0, metavar="SECONDS", help="default: 10")
    parser.add_argument(
        "--rate", type=positive, default=5.0, metavar="FPS", help="frames a second each way; default: 5"
    )


def candump_line(channel: str, message: can.Message) -> str:
    """As candump prints it: `  vcan0  123   [2]  AA BB`."""
    can_id = f"{message.arbitration_id:08X}" if message.is_extended_id else f"{message.arbitration_id:03X}"
    data = "remote request" if message.is_remote_frame else " ".join(f"{byte:02X}" for byte in message.data)
    return f"  {channel}  {can_id:>8}   [{message.dlc}]  {data}"


def _say(line: str) -> None:
    """In one write, so that two threads do not share a line."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


class Program:
    """What a user would run on the interface: sends frames at a steady rate and prints all that arrives."""

    def __init__(self, interface: str, channel: str, rate_fps: float) -> None:
        self.received = 0
        self.sent = 0
        self._channel = channel
        self._interval_s = 1 / rate_fps
        self._stop = threading.Event()
        self._bus = can.Bus(interface=interface, channel=channel)
        self._threads = [
            threading.Thread(target=self._quietly, args=(loop,)) for loop in (self._receive, self._send)
        ]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def _quietly(self, loop: Callable[[], None]) -> None:
        with contextlib.suppress(OSError):  # nobody reads what we print; _Watch ends it all
            loop()

    def _receive(self) -> None:
        while not self._stop.is_set():
            if message := self._bus.recv(0.1):
                self.received += 1
                _say(f"{candump_line(self._channel, message)}   from the adapter")

    def _send(self) -> None:
        rng = random.Random(1)
        while not self._stop.wait(self._interval_s):
            data = rng.randbytes(rng.randrange(9))
            message = can.Message(arbitration_id=rng.randrange(0x800), is_extended_id=False, data=data)
            self._bus.send(message)
            self.sent += 1
            _say(f"{candump_line(self._channel, message)}   to the adapter")

    def stop(self) -> None:
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()
        self._bus.shutdown()


def _interface() -> tuple[str, str]:
    """python-can's interface and channel: vcan0 if the kernel has it or can make it, else `virtual`."""
    made = not Path("/sys/class/net", CHANNEL).exists()
    try:
        open_socketcan(CHANNEL, create=True).close()
    except InterfaceError as error:
        cause = NO_CAN if str(error).startswith(NO_CAN) else error  # what helps is not for a demo
        print(f"# No {CHANNEL} here: {cause}.")
        print("# So the frames stay inside this process: python-can's interface 'virtual'.")
        return "virtual", "demo"
    print(f"# Interface {CHANNEL}: look on from another terminal with `candump {CHANNEL}`.")
    if made:
        print(f"# It was made for this demo and stays: `ip link delete {CHANNEL}` removes it.")
    return "socketcan", CHANNEL


class _Watch(threading.Thread):
    """Starts the program when the bridge runs, prints a status line each second, stops all in time."""

    def __init__(self, bridge: Bridge, program: Program, duration_s: float) -> None:
        super().__init__(name="watch")
        self._bridge = bridge
        self._program = program
        self._duration_s = duration_s
        self.done = threading.Event()

    def run(self) -> None:
        try:
            self._watch()
        except OSError:  # nobody reads what we print
            pass
        finally:
            self._program.stop()
            if not self.done.is_set():
                _end_serving()

    def _watch(self) -> None:
        end = time.monotonic() + self._duration_s
        running = False
        while time.monotonic() < end and not self.done.wait(STATUS_INTERVAL_S if running else 0.02):
            status = self._bridge.snapshot()
            if not running and status["state"] == "running":
                running = True
                self._program.start()
            if running:
                _say(_status_line(status))


def _status_line(status: dict[str, Any]) -> str:
    counters = status["counters"]
    dropped = sum(counters["tx_dropped"].values()) + sum(counters["rx_dropped"].values())
    return (
        f"# {status['state']}: {counters['rx_frames']} from the adapter, {_given(counters)} to it, "
        f"{status['queued']} queued, {dropped} dropped"
    )


def _given(counters: dict[str, Any]) -> int:
    """Frames that the adapter got, whatever its word on them is worth."""
    given: int = counters["tx_frames"] + counters["tx_queued"] + counters["tx_unconfirmed"]
    return given


def _end_serving() -> None:
    """Ends serve() as Ctrl-C would."""
    os.kill(os.getpid(), signal.SIGTERM)


def run(args: argparse.Namespace) -> int:
    """The demo; 0 if frames went both ways."""
    device = make_device(args.adapter, uart_rate=UART_RATE)
    serial = {"baudrate": UART_RATE} if hasattr(device, "uart") else {}
    simulated = Simulator(device, traffic_fps=args.rate, traffic=cyclic_frames(random.Random(0)))
    rate = f" at {UART_RATE} Bd" if serial else ""
    print(f"# Simulated {args.adapter.upper()} on {simulated.port}{rate}, bit rate 125 kbit/s.")
    thread = threading.Thread(target=simulated.run)
    interface, channel = _interface()
    adapter = {**simulator(args.adapter).ADAPTER, "port": simulated.port, **serial}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "demo.yaml")
        path.write_text(
            CONFIG.format(
                adapter="\n".join(f"  {key}: {value}" for key, value in adapter.items()),
                interface=interface,
                channel=channel,
            )
        )
        bridge = Bridge(load(path), FileMemory(Path(folder)))
        program = Program(interface, channel, args.rate)
        watch = _Watch(bridge, program, args.duration)
        thread.start()
        watch.start()
        try:
            serve(bridge, None)
        finally:
            watch.done.set()
            watch.join()
            simulated.stop()
            thread.join()
    counters = bridge.snapshot()["counters"]
    confirmed, given = counters["tx_frames"], _given(counters)
    rest = f", {given - confirmed} given to it that it does not vouch for" if given > confirmed else ""
    print(
        f"# Done: received {program.received} frames on {channel}, sent {program.sent}, "
        f"{'all' if confirmed == program.sent else confirmed} confirmed by the adapter{rest}. Its channel is "
        f"{'closed' if device.state.value in CLOSED else device.state.value}."
    )
    print("# With an adapter of your own: see First configuration in the README.")
    return 0 if counters["rx_frames"] and given else 1
