"""A relay and a simulated USB2CAN behind a latency, on one clock of the test's own."""

import contextlib
import math
import socket
import struct
from collections import deque
from collections.abc import Iterator
from typing import Any

from books import check_books

from bridged import _relay
from bridged.adapters.base import Answer, Reply, Steps
from bridged.adapters.usb2can import Usb2can as Adapter
from bridged.adapters.usb2can import Usb2canConfig
from bridged.can import BitTiming
from bridged.errors import AdapterError
from bridged.settings import ChannelConfig
from bridged.simulators.sja1000 import Frame
from bridged.simulators.usb2can import Usb2can

US, MS, S = 1_000, 1_000_000, 1_000_000_000
FRAME = struct.Struct("=IB3x8s")
EFF, RTR = 0x80000000, 0x40000000
LATENCY_NS = 700 * US  # each way: USB
STEP_NS = 125 * US
STOP = bytes.fromhex("0F 09 02 02 01")


def packed(frame: Frame) -> bytes:
    flags = EFF * frame.extended | RTR * frame.remote
    return FRAME.pack(frame.can_id | flags, frame.dlc, frame.data)


def numbered(number: int, can_id: int | None = None) -> Frame:
    """A frame that carries its number."""
    return Frame(number % 0x800 if can_id is None else can_id, False, False, 8, number.to_bytes(8))


class Rig:
    """A relay and a simulated USB2CAN, initialised, on one clock; `run` lets both live on."""

    def __init__(
        self, *, bitrate: int = 1_000_000, window: int = 16, deadline: float = 60.0, **device: Any
    ) -> None:
        self.now = S
        stop_grace_s = (
            3 * (LATENCY_NS + STEP_NS) / S
        )  # a stop takes its time to the host, frames to the device
        self.device = Usb2can(1.0, stop_grace_s=stop_grace_s, **device)
        adapter = Usb2canConfig(type="usb2can", port="/dev/sim")
        self.adapter = Adapter(adapter, ChannelConfig(timing=BitTiming(bitrate)))
        self.relay = _relay.Relay(
            "usb2can",
            queue=4096,
            window=window,
            deadline=deadline,
            stuck=max(deadline, 0.5),
            answer_timeout=self.adapter.answer_timeout_s,
            sync=self.adapter.sync.request,
            sync_prefix=self.adapter.sync.prefix,
        )
        self._unplugged: list[socket.socket] = []
        self.port, self.near_port = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.bus, self._near_bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for s in (self.port, self.near_port, self.bus, self._near_bus):
            s.setblocking(False)
        self.down: deque[tuple[int, bytes]] = deque()  # to the device: when it arrives
        self.reads: int | None = None  # how many bytes the device reads before it stalls; None: all
        self._up: deque[tuple[int, bytes]] = deque()
        self._relay_next: int | None = None
        self.damage = (b"", 0)  # the message that begins so loses this byte
        self.corrupt = False  # what the device says next loses a byte
        self._stop_lost = False  # it may have been "stop"
        self.sent: list[Frame] = []  # by the device, on its bus
        self.received: list[bytes] = []  # from the relay, on the host's bus
        self.events: list[tuple[int, int, bytes]] = []
        self.relay.attach_interface(self._near_bus)
        self.relay.attach_port(self.near_port)
        self.perform(self.adapter.init_steps(None))
        self.open()

    def open(self) -> None:
        flow = self.adapter.flow
        assert flow is not None
        self.relay.set_level_window(
            flow.request, flow.prefix, capacity=flow.capacity, critical=flow.critical, ready=flow.ready
        )
        self.relay.set_gates(receiving=True, transmit=_relay.GATE_OPEN)
        self._relay_next = self.now

    def perform(self, steps: Steps) -> None:
        """What bridge.py does with them."""
        accept = {Reply.OK: _relay.ACCEPT_OK, Reply.REFUSED: _relay.ACCEPT_REFUSED}
        answer: Answer | None = None
        while True:
            try:
                exchange = steps.send(answer) if answer else next(steps)
            except StopIteration:
                return
            accepted = sum(accept.get(reply, 0) for reply in set(exchange.accept + exchange.reject))
            self._relay_next = self.now
            if not exchange.request:
                self.run(exchange.timeout_s)
                answer = Answer(Reply.NONE)
                continue
            self.relay.command(1, exchange.request, accepted, exchange.prefix, exchange.timeout_s)
            answer = None
            while answer is None:
                self.run(0.000125)
                for kind, token, text in self.take_events():
                    if token == 1 and kind in {_relay.EVENT_TEXT, _relay.EVENT_TIMEOUT}:
                        answer = Answer(Reply.TEXT if kind == _relay.EVENT_TEXT else Reply.NONE, text)
            if answer.reply not in exchange.accept:
                raise AdapterError(f"did not answer the request to {exchange.purpose}")

    def run(self, seconds: float) -> None:
        end = self.now + round(seconds * S)
        while self.now < end:
            self.now = min(end, max(self.now + STEP_NS, self._next()))
            self._step()

    def _next(self) -> int:
        """When something happens that nobody has to be told of."""
        device = self.device.next_deadline()
        pipes = (self._up, self.down if self.reads != 0 else ())
        times = [self._relay_next, *(pipe[0][0] for pipe in pipes if pipe)]
        times.append(math.ceil(device * S) if device < math.inf else None)
        return min((time for time in times if time is not None), default=1 << 62)

    def run_until_done(self, limit_s: float = 60.0) -> dict[str, int]:
        """Until nothing is queued and the device has sent everything."""
        end = self.now + round(limit_s * S)
        while self.relay.counters()["queued"] or self.device.report()["waiting"]:  # type: ignore[index]
            assert self.now < end, (self.counters(), self.device.report())
            self.run(0.001)
        self.run(0.01)
        return self.counters()

    def _step(self) -> None:
        now_s = self.now / S
        while self._up and self._up[0][0] <= self.now:
            self.port.send(self._up.popleft()[1])
        self.turn()
        while self.down and self.down[0][0] <= self.now and self.reads != 0:
            at, data = self.down.popleft()
            read = data[: self.reads]
            if self.reads is not None:
                self.reads -= len(read)
            if len(read) < len(data):
                self.down.appendleft((at, data[len(read) :]))
            self.device.host_writes(now_s, read)
        if output := self.device.take_output(now_s):
            head, at = self.damage
            if head and head in output:
                at += output.index(head)
                output, self.damage = output[:at] + output[at + 1 :], (b"", 0)
            if self.corrupt:
                self.corrupt = False
                self._stop_lost = True
                output = output[:1] + output[2:]
            self._up.append((self.now + LATENCY_NS, output))
        self.sent += self.device.take_bus_frames()
        with contextlib.suppress(BlockingIOError):
            while True:
                self.received.append(self.bus.recv(128))
        self.events += self.relay.events()

    def _carry(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self.down.append((self.now + LATENCY_NS, self.port.recv(1 << 16)))

    def take_events(self) -> list[tuple[int, int, bytes]]:
        events, self.events = self.events, []
        return events

    def send(self, *frames: Frame) -> None:
        for frame in frames:
            self.bus.send(packed(frame))
            self.turn()

    def unplug(self) -> None:
        """The port comes to its end, and all that was under way is lost; there is a new one."""
        self.port.close()
        self._unplugged.append(self.near_port)
        self.port, self.near_port = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        for s in (self.port, self.near_port):
            s.setblocking(False)
        self.down.clear()
        self._up.clear()

    def turn(self) -> None:
        self._relay_next = self.relay.turn(self.now)
        self._carry()

    def counters(self) -> dict[str, int]:
        """The counters, flat, with the books checked."""
        c: dict[str, Any] = self.relay.counters()
        check_books(c, c["queued"])
        tx = c.pop("tx_dropped")
        del c["rx_dropped"]
        looked_at = (
            "decoded",
            "rx_frames",
            "tx_frames",
            "tx_queued",
            "tx_unconfirmed",
            "rx_overruns",
            "skipped_bytes",
        )
        tally = self.relay.tally()
        assert [getattr(tally, name) for name in looked_at] == [c[name] for name in looked_at]
        return {**c, **tx, "tx_dropped": sum(tx.values())}  # type: ignore[dict-item]

    def close(self) -> None:
        for s in (self.port, self.near_port, self.bus, self._near_bus, *self._unplugged):
            s.close()
        assert not [
            text for text in self.device.violations if not (self._stop_lost and "after a STOP" in text)
        ]


@contextlib.contextmanager
def rig_with(**options: Any) -> Iterator[Rig]:
    rig = Rig(**options)
    try:
        yield rig
    finally:
        rig.close()


def assert_in_order(rig: Rig, frames: list[Frame]) -> None:
    assert rig.sent == frames, next(
        (i, a, b) for i, (a, b) in enumerate(zip(rig.sent, frames, strict=False)) if a != b
    )
