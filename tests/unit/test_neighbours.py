"""Bridges on one interface: told, and a circle is found where there is one and nowhere else.

The bridges, relays, status sockets and simulated adapters are real; python-can's `virtual` is the interface
and a socketpair the CAN bus that joins two adapters.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from typing import TYPE_CHECKING

import can
import pytest
from benches.bridge import LIMIT_S

from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import State
from bridged.config import load
from bridged.daemon import neighbours
from bridged.daemon.eeprom_store import FileMemory
from bridged.daemon.neighbours import Neighbours
from bridged.daemon.status import StatusServer
from bridged.simulators.can232 import Can232
from bridged.simulators.ends import pack
from bridged.simulators.serve import Simulator
from bridged.simulators.sja1000 import Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


class Member:
    """A bridge with a status socket, and its simulated adapter, which is on the CAN bus `wire`."""

    def __init__(self, folder: Path, name: str, wire: socket.socket) -> None:
        link = folder / name
        self._simulator = Simulator(Can232(time.monotonic()), link=link, bus=wire)
        self._thread = threading.Thread(target=self._simulator.run)
        self._thread.start()
        file = folder / f"{name}.yaml"
        file.write_text(
            f"adapter: {{type: can232, port: {link}, baudrate: 115200}}\nchannel: {{bitrate: 125000}}\n"
            f"bus: {{interface: virtual, channel: '{folder}'}}\nhealth: {{interval: 0.1}}\n"
        )
        while not link.exists():
            time.sleep(0)
        self.bridge = Bridge(load(file), FileMemory(folder))
        own = (
            folder / "run" / (f"{name}.sock" if name == "a" else f"{name}/{name}.sock")
        )  # by hand; a service
        self.status = StatusServer(own, self.bridge.snapshot)
        self.neighbours = Neighbours(own)
        self.bridge.start()

    def turn(self, readable: list[object]) -> None:
        if self.status in readable:
            self.status.on_readable()
        if any(fd in readable for fd in self.bridge.filenos()):
            self.bridge.on_readable()
        self.bridge.on_timer(time.monotonic())
        self.neighbours.look(self.bridge, time.monotonic())

    def close(self) -> None:
        self.bridge.abort()
        self.bridge.close()
        self.status.close()
        self.unplug()

    def unplug(self) -> None:
        self._simulator.stop()
        self._thread.join()


class World:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.members: list[Member] = []
        self.program = can.Bus(interface="virtual", channel=str(folder))
        self._sockets: list[socket.socket] = []

    def wire(self) -> tuple[socket.socket, socket.socket]:
        """The two ends of a CAN bus."""
        ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._sockets += ends
        return ends

    def add(self, name: str, wire: socket.socket) -> Member:
        self.members.append(Member(self.folder, name, wire))
        return self.members[-1]

    def run_until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + LIMIT_S
        while not condition():
            fds = [fd for member in self.members for fd in (*member.bridge.filenos(), member.status)]
            readable: list[object] = [*select.select(fds, (), (), 0.005)[0]]
            for member in self.members:
                member.turn(readable)
            assert time.monotonic() < end

    def all_run(self) -> bool:
        return all(member.bridge.state is State.RUNNING for member in self.members)

    def send(self, number: int) -> None:
        self.program.send(can.Message(arbitration_id=number, data=b"same", is_extended_id=False))

    def close(self) -> None:
        for member in self.members:
            member.close()
        self.program.shutdown()
        for end in self._sockets:
            end.close()


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    monkeypatch.setattr(neighbours, "SEARCH_INTERVAL_S", 0.2)
    monkeypatch.setattr(neighbours, "LOOK_INTERVAL_S", 0.05)
    monkeypatch.setattr(neighbours, "GLIMPSE_INTERVAL_S", 0.005)
    with contextlib.closing(World(tmp_path)) as made:
        yield made


def test_a_circle_is_found_and_its_end(world: World, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    first, second = world.wire()
    a = world.add("a", first)
    world.run_until(world.all_run)
    b = world.add("b", second)
    world.run_until(world.all_run)
    # Each is told of the other, whichever came first.
    world.run_until(lambda: sum("is also fed by bridge" in message for message in caplog.messages) == 2)
    for number in range(3):
        world.send(number)
    world.run_until(lambda: a.bridge.circle and b.bridge.circle)
    assert "in a circle between 'a' and 'b'" in a.bridge.snapshot()["reason"]
    assert sum("in a circle between" in message for message in caplog.messages) == 2
    assert a.bridge.rates()["rx_fps"] > 0  # it only tells
    b.unplug()
    world.run_until(lambda: not a.bridge.circle and not b.bridge.circle)


def device(wire: socket.socket, *, echoes: bool) -> None:
    with contextlib.suppress(OSError):
        while frame := wire.recv(64):
            if echoes:
                wire.send(frame)


@pytest.mark.parametrize("case", ["one bridge, echo", "two bridges, echo", "two buses are joined"])
def test_there_is_no_circle(world: World, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    """Frames that repeat themselves 100 times a second, in both directions."""
    wires = []
    for name in "a" if case.startswith("one") else "ab":
        near, far = world.wire()
        world.add(name, near)
        wires.append(far)
        echoes = name == "a" and case.endswith("echo")
        threading.Thread(target=device, args=(far,), kwargs={"echoes": echoes}, daemon=True).start()
    world.run_until(world.all_run)
    compared: list[Bridge] = []
    compare = Neighbours._compare

    def comparing(self: Neighbours, bridge: Bridge) -> None:
        compare(self, bridge)
        compared.append(bridge)

    monkeypatch.setattr(Neighbours, "_compare", comparing)
    began, sent = time.monotonic(), 0

    def traffic() -> bool:
        nonlocal sent
        while time.monotonic() - began >= sent / 100:
            sent += 1
            if case.endswith("echo"):
                world.send(0x123)
                continue
            for number, wire in enumerate(wires):
                wire.send(pack(Frame(number, False, False, 1, b"\x01")))
        return sent > 250 or len(compared) >= 2

    world.run_until(traffic)
    assert not any(member.bridge.circle for member in world.members)
    assert bool(compared) == (len(wires) > 1)
