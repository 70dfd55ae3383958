"""The window of a USB2CAN, against the simulated device behind a latency, on a clock of the test's own."""

import contextlib
import math
import socket
import struct
from collections import Counter, defaultdict, deque
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridged import _relay
from bridged.adapters.base import Answer, Reply, Steps
from bridged.adapters.usb2can import Usb2can as Adapter
from bridged.can import BitTiming
from bridged.config import ChannelConfig, Usb2canConfig
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
            answer_timeout=self.adapter.answer_timeout_s,
            sync=self.adapter.sync.request,
            sync_prefix=self.adapter.sync.prefix,
        )
        self.port, self._near_port = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.bus, self._near_bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for s in (self.port, self._near_port, self.bus, self._near_bus):
            s.setblocking(False)
        self._down: deque[tuple[int, bytes]] = deque()  # to the device: when it arrives
        self._up: deque[tuple[int, bytes]] = deque()
        self._relay_next: int | None = None
        self.corrupt = False  # what the device says next loses a byte
        self.sent: list[Frame] = []  # by the device, on its bus
        self.received: list[bytes] = []  # from the relay, on the host's bus
        self.events: list[tuple[int, int, bytes]] = []
        self.relay.attach_bus(self._near_bus)
        self.relay.attach_port(self._near_port)
        self.perform(self.adapter.init_steps(None))
        self.open()

    def open(self) -> None:
        flow = self.adapter.flow
        assert flow is not None
        self.relay.set_flow(
            flow.request, flow.prefix, capacity=flow.capacity, critical=flow.critical, ready=flow.ready
        )
        self.relay.set_gates(receiving=True, transmit=_relay.GATE_OPEN)

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
            self.relay.command(1, exchange.request, accepted, exchange.prefix, exchange.timeout_s)
            answer = None
            while answer is None:
                self.run(0.000125)
                for kind, token, text in self.take_events():
                    if token == 1 and kind in {_relay.EVENT_TEXT, _relay.EVENT_TIMEOUT}:
                        answer = Answer(Reply.TEXT if kind == _relay.EVENT_TEXT else Reply.NONE, text)
            assert answer.reply in exchange.accept

    def run(self, seconds: float) -> None:
        end = self.now + round(seconds * S)
        while self.now < end:
            self.now = min(end, max(self.now + STEP_NS, self._next()))
            self._step()

    def _next(self) -> int:
        """When something happens that nobody has to be told of."""
        device = self.device.next_deadline()
        times = [self._relay_next, *(pipe[0][0] for pipe in (self._up, self._down) if pipe)]
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
        self._relay_next = self.relay.turn(self.now)
        with contextlib.suppress(BlockingIOError):
            self._down.append((self.now + LATENCY_NS, self.port.recv(1 << 16)))
        while self._down and self._down[0][0] <= self.now:
            self.device.host_writes(now_s, self._down.popleft()[1])
        if output := self.device.take_output(now_s):
            if self.corrupt:
                self.corrupt = False
                output = output[:1] + output[2:]
            self._up.append((self.now + LATENCY_NS, output))
        self.sent += self.device.take_bus_frames()
        with contextlib.suppress(BlockingIOError):
            while True:
                self.received.append(self.bus.recv(128))
        self.events += self.relay.events()

    def take_events(self) -> list[tuple[int, int, bytes]]:
        events, self.events = self.events, []
        return events

    def send(self, *frames: Frame) -> None:
        for frame in frames:
            self.bus.send(packed(frame))
            self._relay_next = self.relay.turn(self.now)

    def counters(self) -> dict[str, int]:
        """The counters, flat, with the books checked."""
        c = self.relay.counters()
        tx, rx = c.pop("tx_dropped"), c.pop("rx_dropped")
        assert isinstance(tx, dict)
        assert isinstance(rx, dict)
        assert c["bus_read"] == c["tx_frames"] + c["queued"] + sum(tx.values())
        assert c["decoded"] == c["rx_frames"] + c["rx_pending"] + sum(rx.values())
        return {**c, **tx, "tx_dropped": sum(tx.values())}  # type: ignore[dict-item]

    def close(self) -> None:
        for s in (self.port, self._near_port, self.bus, self._near_bus):
            s.close()
        assert self.device.violations == []


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


FIRMWARE = pytest.mark.parametrize(
    "device",
    [{}, {"answers_get": False}, {"get_length_4": True}, {"version": "HW0003FW5001", "padded": True}],
    ids=["levels", "no levels", "levels of 4 bytes", "double buffer"],
)


@FIRMWARE
@pytest.mark.parametrize("bitrate", [50_000, 1_000_000])
def test_more_frames_than_the_bus_carries_go_in_order_and_none_comes_back(
    device: dict[str, Any], bitrate: int
) -> None:
    with rig_with(bitrate=bitrate, **device) as rig:
        frames = [numbered(n) for n in range(400)]
        rig.send(*frames)
        c = rig.run_until_done()
        assert_in_order(rig, frames)
        assert (c["tx_frames"], c["tx_returned"], c["tx_dropped"]) == (400, 0, 0)


def test_how_far_a_full_bus_is_filled() -> None:
    """At 1 Mbit/s: 18 frames of buffer last 2.3 ms, and what is known of them is 1.5 ms old."""
    with rig_with() as rig:
        frames = [numbered(n) for n in range(1000)]
        rig.send(*frames)
        start = rig.now
        while len(rig.sent) < 1000:
            rig.run(0.001)
        assert rig.now - start < 1000 * 130 * US / 0.7  # 130 bits a frame


@pytest.mark.parametrize("device", [{}, {"answers_get": False}], ids=["levels", "no levels"])
def test_a_stop_without_start_ends(device: dict[str, Any]) -> None:
    with rig_with(**device) as rig:
        rig.device.garbage(rig.now / S, STOP)
        rig.run(0.01)
        assert rig.counters()["tx_stops"] == 1
        frames = [numbered(n) for n in range(40)]
        rig.send(*frames)
        rig.run(0.002)
        assert rig.sent == []
        c = rig.run_until_done(2.0)
        assert_in_order(rig, frames)
        assert (c["tx_frames"], c["tx_dropped"]) == (40, 0)


@FIRMWARE
@pytest.mark.parametrize("burst", [1, 3, 16, 50])
def test_frames_handed_back_go_again_in_their_place(device: dict[str, Any], burst: int) -> None:
    """None lost, none doubled; in order, as far as the device did not take later ones meanwhile."""
    with rig_with(window=1 if burst < 16 else 16, **device) as rig:
        frames = [numbered(n) for n in range(200)]
        rig.send(*frames[:100])
        rig.run(0.004)
        rig.device.refusals = burst
        rig.send(*frames[100:])
        c = rig.run_until_done()
        assert_in_order(rig, frames)
        assert (c["tx_returned"], c["tx_retries"], c["tx_frames"]) == (burst, burst, 200)


def test_a_frame_whose_successor_was_taken_is_not_sent_after_it() -> None:
    with rig_with() as rig:
        rig.device.refusals = 2
        first, other, second = numbered(1, 0x100), numbered(2, 0x200), numbered(3, 0x100)
        rig.send(first, other, second)
        c = rig.run_until_done()
        assert rig.sent == [second, other]
        assert (c["overtaken"], c["tx_returned"], c["tx_retries"]) == (1, 2, 1)


def test_a_buffer_smaller_than_any_known_loses_nothing() -> None:
    with rig_with(tx_buffer=4, bitrate=125_000) as rig:
        frames = [numbered(n) for n in range(300)]
        rig.send(*frames)
        c = rig.run_until_done()
        assert Counter(rig.sent) == Counter(frames)
        assert c["tx_returned"] > 0
        assert c["tx_dropped"] == 0


def test_a_value_that_is_neither_stop_nor_start_changes_nothing() -> None:
    with rig_with() as rig:
        before = rig.counters()
        frames = [numbered(n) for n in range(60)]
        for frame in frames:
            rig.device.value_2_burst(rig.now / S, 20)
            rig.send(frame)
            rig.run(0.0005)
        rig.run_until_done()
        assert_in_order(rig, frames)
        after = rig.counters()
        assert [after[key] - before[key] for key in ("tx_stops", "skipped_bytes", "stray_answers")] == [
            0,
            0,
            0,
        ]


def test_a_frame_that_is_not_ours_is_not_put_on_the_bus() -> None:
    with rig_with() as rig:
        rig.device.garbage(rig.now / S, bytes.fromhex("0F 09 07 00 03 24 60 01 02 03"))
        rig.send(numbered(1))
        c = rig.run_until_done()
        assert rig.sent == [numbered(1)]
        assert (c["stray_answers"], c["tx_returned"]) == (1, 0)


def test_what_an_answer_lost_may_have_said_is_counted() -> None:
    with rig_with() as rig:
        rig.send(numbered(0))
        rig.run_until_done()
        rig.corrupt = True  # the answer to the question after the frames
        rig.send(*(numbered(n) for n in range(1, 5)))
        rig.run(0.005)
        c = rig.run_until_done()
        assert (c["unanswered"], c["tx_frames"], c["resyncs"]) == (4, 1, 1)
        rig.send(numbered(5))
        assert rig.run_until_done()["tx_frames"] == 2
        assert rig.sent == [numbered(n) for n in range(6)]


def test_a_device_that_was_reset_is_noticed_by_its_mode() -> None:
    with rig_with() as rig:
        rig.send(numbered(0))
        rig.run_until_done()
        rig.device.power_cycle(rig.now / S)
        rig.send(numbered(1))
        rig.run(3.0)
        kinds = [kind for kind, _, _ in rig.take_events()]
        assert _relay.EVENT_SILENT in kinds
        assert kinds.index(_relay.EVENT_UNASKED) < kinds.index(_relay.EVENT_SILENT)
        assert rig.counters()["unanswered"] == 1
        assert rig.sent == [numbered(0)]
        rig.device.violations.clear()  # a frame to a device in mode BOOT: nobody could know


def test_nothing_goes_late_that_the_bus_did_not_take() -> None:
    with rig_with(deadline=0.5) as rig:
        rig.device.set_bus_off(rig.now / S, True)
        rig.send(*(numbered(n) for n in range(100)))
        rig.run(1.0)
        c = rig.counters()
        assert (c["queued"], c["stale"] + c["tx_frames"]) == (0, 100)
        assert c["tx_frames"] <= 20  # in its buffer
        rig.device.set_bus_off(rig.now / S, False)
        rig.run(1.0)
        assert len(rig.sent) == c["tx_frames"]


def test_a_message_cut_short_does_not_become_one_with_a_later_one() -> None:
    with rig_with() as rig:
        frame = numbered(7)
        message = b"\x0f\x41\x0b\x08" + (frame.can_id << 5).to_bytes(2) + frame.data
        before = rig.counters()["skipped_bytes"]
        rig.device.garbage(rig.now / S, message[:-3])
        rig.run(2.0)
        rig.device.garbage(rig.now / S, message)
        rig.run(0.1)
        assert rig.received == [packed(frame)]
        assert rig.counters()["skipped_bytes"] - before == len(message) - 3


def test_a_frame_after_noise_waits_for_what_confirms_it_but_not_for_ever() -> None:
    with rig_with() as rig:
        frame = numbered(7)
        message = b"\x0f\x41\x0b\x08" + (frame.can_id << 5).to_bytes(2) + frame.data
        rig.device.garbage(rig.now / S, b"\x55" + message)
        rig.run(0.01)
        assert rig.received == []
        rig.run(0.1)
        assert rig.received == [packed(frame)]


def test_overruns_are_counted() -> None:
    with rig_with() as rig:
        rig.device.overrun(rig.now / S)
        rig.run(0.01)
        assert rig.counters()["rx_overruns"] == 1


def test_full_bus_both_ways() -> None:
    with rig_with() as rig:
        down = [numbered(n) for n in range(300)]
        up = [numbered(1000 + n) for n in range(300)]
        rig.send(*down)
        for frame in up:
            rig.device.bus_frame(rig.now / S, frame)
            rig.run(0.000125)
        rig.run_until_done()
        assert_in_order(rig, down)
        assert rig.received == [packed(frame) for frame in up]


FAULTS = st.sampled_from(
    ["nothing", "refusals", "lose_go", "stop", "value 2", "corrupt", "drop", "silence", "garbage", "bus-off"]
)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(FAULTS, st.integers(0, 30), st.integers(0, 40)), max_size=12),
    st.sampled_from([{}, {"answers_get": False}, {"tx_buffer": 3}]),
    st.integers(1, 32),
)
def test_whatever_happens_the_books_are_right_and_no_frame_is_doubled(
    story: list[tuple[str, int, int]], device: dict[str, Any], window: int
) -> None:
    with rig_with(window=window, deadline=1.0, bitrate=500_000, **device) as rig:
        number = 0
        for fault, amount, frames in story:
            now = rig.now / S
            match fault:
                case "refusals":
                    rig.device.refusals += amount
                case "lose_go":
                    rig.device.lose_go += 1
                case "stop":
                    rig.device.garbage(now, STOP)
                case "value 2":
                    rig.device.value_2_burst(now, amount)
                case "corrupt":
                    rig.corrupt = True
                case "drop":
                    rig.device.drop_answers += 1
                case "silence":
                    rig.device.silent = not rig.device.silent
                case "garbage":
                    rig.device.garbage(now, bytes((0x0F, 9, 2, 1, 0x41, 0)) * amount)
                case "bus-off":
                    rig.device.set_bus_off(now, not rig.device.bus_off)
            for _ in range(frames):
                rig.send(numbered(number, 0x100 + number % 3))
                number += 1
            rig.run(amount / 1000)
            rig.counters()
        rig.device.silent = False
        rig.device.refusals = 0
        rig.device.set_bus_off(rig.now / S, False)
        rig.run(4.0)
        c = rig.counters()
        assert c["queued"] == 0
        assert not [frame for frame, times in Counter(rig.sent).items() if times > 1]
        by_id = defaultdict(list)
        for frame in rig.sent:
            by_id[frame.can_id].append(frame.data)
        assert all(data == sorted(data) for data in by_id.values())
        discarded = len(rig.sent) - c["tx_frames"]
        assert 0 <= discarded <= c["unanswered"]
