"""The firmwares that speak almost a CAN232's protocol: each one's simulator, and a bridge on it."""

import contextlib
import json
import random
import select
import socket
import time
from pathlib import Path
from typing import Any, NamedTuple

from benches.bridge import LIMIT_S, Bench, PairBus
from bridged.adapters.base import Remote
from bridged.adapters.can232 import Can232
from bridged.bridge.bridge import Bridge
from bridged.simulators import make_device
from bridged.simulators.device import Device
from bridged.simulators.ends import pack, unpack
from bridged.simulators.serve import mixed_frames
from bridged.simulators.sja1000 import Frame

SLOW = 20_000  # bit/s: where frames are lost if this machine lets the simulator wait for too long
BACKLOG = 400  # frames that may wait for the adapter; more than any has room for


class Family(NamedTuple):
    """One firmware. `ahead`: how many frames may be on their way to the host at once, as it has room for."""

    firmware: str  # the profile that drives it
    simulator: str
    options: tuple[str, ...] = ()
    named: bool = False  # has to be told to the bridge
    ahead: int = 32
    bitrate: int = 1_000_000


FAMILIES = {
    "canable1": Family("canable1", "canable1", ahead=1, bitrate=SLOW),
    "canable2": Family("canable2", "canable2", bitrate=SLOW),
    "nakakiyo": Family("nakakiyo", "nakakiyo", bitrate=125_000),
    "nakakiyo-vw1k": Family("nakakiyo", "nakakiyo", ("--version", "VW1K2"), bitrate=125_000),
    "weact": Family("weact", "weact", ahead=8),
    "elmue": Family("elmue", "elmue", bitrate=125_000),
    "usbtin": Family("usbtin", "usbtin", ahead=4),
    "esp32": Family("esp32", "esp32", ahead=5),
    "slcanuino": Family("slcanuino", "slcanuino", ahead=2),
    "catompiler": Family("catompiler", "catompiler"),
    "slcanpty": Family("slcanpty", "slcanpty", named=True),
}


class FamilyBench(Bench):
    """A simulated clone, its CAN bus, and a bridge that has to find out what it is."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.link = folder / "device"
        self.near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._buses = [self.bus]

    def plug_in(self, device: Device, **options: Any) -> None:
        self.near.close()
        self.far.close()
        self.near, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        super().plug_in(device, bus=self.near, **options)

    def family(self, family: Family, **sections: dict[str, object]) -> Bridge:
        """Its device is plugged in; `sections` of the configuration beside what it needs."""
        self.plug_in(make_device(family.simulator, family.options))
        adapter: dict[str, object] = {"firmware": family.firmware} if family.named else {}
        channel = {"bitrate": family.bitrate} | sections.pop("channel", {})
        return self.configured(adapter, channel=channel, **sections)

    def configured(self, adapter: dict[str, object], **sections: dict[str, object]) -> Bridge:
        """A bridge on what is plugged in."""
        self.bus = PairBus()
        self._buses.append(self.bus)
        path = self.folder / "bench.yaml"
        config: dict[str, dict[str, object]] = {
            "adapter": {"type": "can232", "port": str(self.link), "baudrate": 1_000_000, **adapter},
            "channel": {"bitrate": 1_000_000},
            "bus": {"channel": "vcan0"},
            "reconnect": {"initial": 0.01, "maximum": 0.01},
            "transmit": {"deadline": LIMIT_S, "queue": 2 * BACKLOG},
        }
        for name, keys in sections.items():
            config[name] = config.get(name, {}) | keys
        path.write_text(json.dumps(config))
        return self.bridge_of(path)

    def send(self, *frames: Frame) -> None:
        for frame in frames:
            self.bus.far.send(pack(frame))

    def close(self) -> None:
        super().close()
        self.near.close()
        self.far.close()
        for bus in self._buses:
            bus.close()
            bus.far.close()


class Traffic:
    """Frames both ways through a running bridge: no more at once than a family has room for.

    `sendable`: those for the adapter that its firmware can send; the others are to be dropped.
    """

    def __init__(self, bench: FamilyBench, bridge: Bridge, family: Family, count: int) -> None:
        self.bench, self.bridge, self.family = bench, bridge, family
        out, back = mixed_frames(random.Random(1)), mixed_frames(random.Random(2))
        self.to_device = [next(out) for _ in range(count)]
        self.to_host = [next(back) for _ in range(count)]
        assert isinstance(bridge.adapter, Can232)
        remote = bridge.adapter.sending.remote
        self.sendable = [frame for frame in self.to_device if can_send(remote, frame)]
        self.received: list[Frame] = []
        self._fed = self._heard = 0
        bench.bus.far.setblocking(False)

    def run(self) -> None:
        """Until all have arrived that can."""
        end = time.monotonic() + LIMIT_S + 0.01 * len(self.to_device)
        while not self._all_through():
            select.select([*self.bridge.filenos(), self.bench.bus.far], (), (), 0.001)
            self.bridge.on_readable()
            self.bridge.on_timer(time.monotonic())
            assert time.monotonic() < end, f"{self.bridge.state}: {self.bridge.reason}, {self.so_far}"

    @property
    def so_far(self) -> str:
        on_bus, here = len(self.bench.frames), len(self.received)
        return f"{on_bus} of {len(self.sendable)} on the bus, {here} of {len(self.to_host)} here"

    def _all_through(self) -> bool:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.received.append(unpack(self.bench.bus.far.recv(16)))
        status, device = self.bridge.snapshot(), self.bench.device.counters
        counters = status["counters"]
        out = len(self.bench.frames) + sum(counters["tx_dropped"].values()) + device.frames_vanished
        here = len(self.received) + device.frames_lost
        with contextlib.suppress(BlockingIOError):
            while self._fed < min(len(self.to_device), out + BACKLOG):
                self.bench.send(self.to_device[self._fed])
                self._fed += 1
        while self._heard < min(len(self.to_host), here + self.family.ahead):
            self.bench.far.send(pack(self.to_host[self._heard]))
            self._heard += 1
        answered = not status["queued"]
        return out >= len(self.to_device) and here >= len(self.to_host) and answered


def can_send(remote: Remote, frame: Frame) -> bool:
    if not frame.remote or remote in {Remote.PLAIN, Remote.WITH_DIGITS}:
        return True
    return remote is Remote.NO_STANDARD and frame.extended
