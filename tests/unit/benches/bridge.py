"""A bridge, relay and adapter on a simulated device behind a real pty; only the interface is a socketpair."""

import contextlib
import gc
import json
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from books import check_books

from bridged.adapters.base import Exchange, Steps
from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import State
from bridged.config import load
from bridged.daemon.eeprom_store import FileMemory
from bridged.ports import open_port
from bridged.ports.watch import Watch
from bridged.simulators import make_device, simulator
from bridged.simulators.device import Device
from bridged.simulators.ends import pack
from bridged.simulators.serve import Fault, Simulator
from bridged.simulators.sja1000 import Frame
from bridged.simulators.usb2can import Usb2can

FRAME = struct.Struct("=IB3x8s")
LIMIT_S = 30.0
STOP_GRACE_S = 5.0  # for what is on its way when the device says stop: this machine may be slow


class PairBus:
    """A bus like socketcan's, whose other end is `far`."""

    warning = ""
    failure = None

    def __init__(self) -> None:
        self._near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._near.setblocking(False)
        self.far.settimeout(LIMIT_S)
        self.fd = self._near.fileno()
        self.description = "pair"

    def dropped(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        self._near.close()


class Bench:
    """A simulated adapter, a bridge on it, and the far end of its bus. The bridge runs in run_until()."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.link = folder / "can232"
        self.frames: list[Frame] = []  # that the adapter put on its CAN bus
        self.on_bus: Callable[[Frame], None] = self.frames.append
        self.bus = PairBus()
        self.open_port: Callable[[str, int], Any] = open_port
        self.open_interface: Callable[..., Any] = lambda *_args, **_options: self.bus
        self.watch: Watch | None = None
        self._bridges: list[Bridge] = []
        self._simulator: Simulator | None = None
        self._thread: threading.Thread | None = None

    def plug_in(self, device: Device, **options: Any) -> None:
        """`options` of the Simulator."""
        self.device: Any = device
        self._simulator = Simulator(device, link=self.link, on_frame=self.on_bus, **options)
        self._thread = threading.Thread(target=self._simulator.run)
        self._thread.start()
        while not self.link.exists():
            os.sched_yield()

    def befall(self, fault: Fault) -> None:
        assert self._simulator
        self._simulator.begin(fault)

    def pull_out(self) -> None:
        if self._simulator and self._thread:
            self._simulator.stop()
            self._thread.join()
            self._simulator = None

    def bridge(
        self, channel: str = "bitrate: 125000", transmit: str = "{}", more: str = "", **adapter: object
    ) -> Bridge:
        path = self.folder / "bench.yaml"
        options = "".join(f", {key}: {value}" for key, value in adapter.items())
        path.write_text(
            f"adapter: {{type: can232, port: {self.link}, baudrate: 115200{options}}}\n"
            f"channel: {{{channel}}}\nbus: {{channel: vcan0}}\n{more}\ntransmit: {transmit}\n".replace(
                "transmit: {}\n", ""
            )
        )
        return self.bridge_of(path)

    def bridge_of(self, path: Path) -> Bridge:
        bridge = Bridge(
            load(path),
            FileMemory(self.folder / "state"),
            open_port=self._open_port,
            open_interface=self.open_interface,
            watch=self.watch,
        )
        self._bridges.append(bridge)
        return bridge

    def _open_port(self, port: str, baudrate: int) -> Any:
        """As `open_port` says at that time."""
        return self.open_port(port, baudrate)

    def watch_events(self) -> tuple[socket.socket, socket.socket]:
        """Where the kernel would tell the next bridge of devices, and where that listens."""
        kernel, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        ours.setblocking(False)
        self.watch = Watch(str(self.link), events=ours)
        return kernel, ours

    def close(self) -> None:
        for bridge in self._bridges:  # of a test that failed: its relay would keep pytest from ending
            if not bridge.finished:
                bridge.abort()
                bridge.close()
        self._bridges.clear()  # who refer to this: their descriptors would wait for the garbage collector
        self.pull_out()
        self.bus.close()
        self.bus.far.close()


class ContractBench(Bench):
    """Any simulator of the registry, and the type of adapter that goes with it."""

    def __init__(self, folder: Path, name: str) -> None:
        super().__init__(folder)
        self.name = name
        self.link = folder / "device"
        self.asked: list[Exchange] = []  # the steps of all initialisations and closings
        self._ends = [*socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)]

    def new_device(self) -> Device:
        return make_device(self.name)

    def plug_in(self, device: Device, **options: Any) -> None:
        super().plug_in(device, bus=self._ends[0], **options)

    def bridge(
        self,
        *,
        bitrate: int = 500_000,
        deadline_s: float = LIMIT_S,
        health_s: float = 0.1,
        **_options: object,
    ) -> Bridge:
        """One after the other, each with an interface of its own. Steps that are asked for are in `asked`."""
        self.bus.close()
        self.bus.far.close()
        self.bus = PairBus()
        path = self.folder / "bench.yaml"
        adapter = simulator(self.name).ADAPTER
        serial = {"baudrate": 1_000_000} if adapter["type"] == "can232" else {}
        config = {
            "adapter": {**adapter, "port": str(self.link), **serial},
            "channel": {"bitrate": bitrate},
            "health": {"interval": health_s},
            "bus": {"channel": "vcan0"},
            "reconnect": {"initial": 0.01, "maximum": 0.01},
            "transmit": {"deadline": deadline_s},
        }
        path.write_text(json.dumps(config))
        bridge = self.bridge_of(path)
        adapter = bridge.adapter
        adapter.init_steps, adapter.close_steps = map(self._noted, (adapter.init_steps, adapter.close_steps))  # type: ignore[method-assign]
        return bridge

    def _noted(self, procedure: Callable[..., Steps]) -> Callable[..., Steps]:
        def noted(*arguments: Any) -> Steps:
            steps = procedure(*arguments)
            with contextlib.suppress(StopIteration):
                exchange = next(steps)
                while True:
                    self.asked.append(exchange)
                    exchange = steps.send((yield exchange))

        return noted

    def send(self, *frames: Frame) -> None:
        for frame in frames:
            self.bus.far.send(pack(frame))

    def send_from_its_bus(self, *frames: Frame) -> None:
        for frame in frames:
            self._ends[1].send(pack(frame))

    def close(self) -> None:
        super().close()
        for end in self._ends:
            end.close()
        self._bridges.clear()
        gc.collect()  # noting the steps ties each bridge, with the descriptors of its relay, in a circle


class Usb2canBench(Bench):
    """A simulated USB2CAN; `on_frame` is called in its thread for each frame that it puts on its bus."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.link = folder / "usb2can"
        self.on_frame: Callable[[Usb2can], None] = lambda _device: None
        self._buses = [self.bus]
        self._near, self._far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._far.settimeout(LIMIT_S)

    def device_plugged_in(self, traffic_fps: float = 0.0, **options: Any) -> Usb2can:
        device = Usb2can(time.monotonic(), stop_grace_s=STOP_GRACE_S, **options)

        def on_frame(frame: Frame) -> None:
            self.frames.append(frame)
            self.on_frame(device)

        self._simulator = Simulator(
            device, link=self.link, bus=self._near, on_frame=on_frame, traffic_fps=traffic_fps
        )
        self._thread = threading.Thread(target=self._simulator.run)
        self._thread.start()
        end = time.monotonic() + LIMIT_S
        while not self.link.exists():
            assert time.monotonic() < end
            time.sleep(0)
        return device

    def bridge(self, channel: str = "bitrate: 500000", transmit: str = "", **adapter: object) -> Bridge:
        """One after the other, each with a bus of its own."""
        self.bus = PairBus()
        self._buses.append(self.bus)
        path = self.folder / "bench.yaml"
        options = "".join(f", {key}: {value}" for key, value in adapter.items())
        text = f"adapter: {{type: usb2can, port: {self.link}{options}}}\nchannel: {{{channel}}}\n"
        text += "bus: {channel: vcan0}\n" + (f"transmit: {transmit}\n" if transmit else "")
        path.write_text(text)
        return self.bridge_of(path)

    def send(self, *frames: Frame) -> None:
        for frame in frames:
            self.bus.far.send(pack(frame))

    def send_from_its_bus(self, *frames: Frame) -> None:
        for frame in frames:
            self._far.send(pack(frame))

    def close(self) -> None:
        for bridge in self._bridges:
            if not bridge.finished:
                bridge.abort()
        self.pull_out()
        self._near.close()
        self._far.close()
        for bus in self._buses:
            bus.close()
            bus.far.close()


def run_until(bridge: Bridge, condition: Callable[[], object]) -> None:
    """What service.serve does, until something is so."""
    end = time.monotonic() + LIMIT_S
    while not condition():
        timer = bridge.next_timer()
        wait = 0.05 if timer is None else min(0.05, max(0.0, timer - time.monotonic()))
        if select.select(bridge.filenos(), (), (), wait)[0]:
            bridge.on_readable()
        bridge.on_timer(time.monotonic())
        assert time.monotonic() < end, f"still {bridge.state}: {bridge.reason}"


def started(bridge: Bridge, state: State = State.RUNNING) -> Bridge:
    bridge.start()
    run_until(bridge, lambda: bridge.state is state)
    return bridge


def stopped(bridge: Bridge) -> dict[str, Any]:
    """Stops it; its last snapshot, with the books checked."""
    bridge.stop()
    run_until(bridge, lambda: bridge.finished)
    bridge.close()
    status = bridge.snapshot()
    check_books(status["counters"], status["queued"])
    return status


class PairPort:
    """A port whose device is a thread of the test."""

    description = "pair"
    failure = None
    serial_number: str | None = None
    product: str | None = None

    def __init__(self, kind: int = socket.SOCK_STREAM) -> None:
        self._near, self.far = socket.socketpair(socket.AF_UNIX, kind)
        self._near.setblocking(False)
        self.far.settimeout(LIMIT_S)
        self.fd = self._near.fileno()

    def close(self) -> None:
        self._near.close()
