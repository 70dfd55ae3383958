"""A device that answers no frame gets them as its bus takes them, and never more than it has room for."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
from benches.paced import Queued, S, Silent, bits_of
from benches.relay import FRAME, MS, Rig, can_frame, rig_with
from hypothesis import given
from hypothesis import strategies as st

from bridged import _relay
from bridged.adapters.base import Confirms, Sending
from bridged.bridge.loop import set_sending

EFF_FLAG, RTR_FLAG = 0x80000000, 0x40000000
LATENCY_NS = 2 * MS

identifiers = st.integers(0, 0x7FF) | st.integers(0, 0x1FFFFFFF).map(lambda i: i | EFF_FLAG)
data_frames = st.builds(lambda i, data: FRAME.pack(i, len(data), data), identifiers, st.binary(max_size=8))
remote_frames = st.builds(lambda i, dlc: FRAME.pack(i | RTR_FLAG, dlc, b""), identifiers, st.integers(0, 8))


@contextlib.contextmanager
def silent(**options: float) -> Iterator[Silent]:
    rig = Silent(**options)  # type: ignore[arg-type]
    try:
        yield rig
    finally:
        rig.close()


@given(data_frames | remote_frames)
def test_the_next_frame_goes_when_the_bus_has_taken_the_one_before(frame: bytes) -> None:
    """To the bit, stuff bits included; and a hundredth, since clocks differ."""
    with rig_with() as rig:
        set_sending(rig.relay, Sending(Confirms.NOTHING, paced_bitrate=1_000_000, depth=1))
        rig.bus.send(frame)
        rig.bus.send(can_frame(1))
        due = rig.turn()
        assert due is not None
        assert (due - rig.now - LATENCY_NS) / 1010 == bits_of(frame)
        assert len(rig.said()) == 1
        rig.now = due - 1
        assert (rig.turn(), rig.said()) == (due, [])
        rig.now = due
        assert (rig.turn(), len(rig.said())) == (None, 1)
        assert rig.counters()["tx_unconfirmed"] == 2


@pytest.mark.parametrize("bitrate", [10_000, 125_000, 500_000, 1_000_000])
@pytest.mark.parametrize("load", [0.0, 0.3, 0.8])
def test_no_frame_is_lost_in_the_device_and_the_bus_is_used(bitrate: int, load: float) -> None:
    """Its clock is half a percent slower, frames come in gusts, others have the bus for some time."""
    frames = 600
    with silent(bitrate=bitrate, room=27, depth=18, slow=0.005, link_ns=2 * MS, seed=bitrate) as rig:
        begin = rig.now
        other = FRAME.pack(0x055, 8, bytes(8))
        other_ns = bits_of(other) * S / bitrate
        end = begin + int(frames * 135 * S / bitrate / (1 - load) * 1.1) + 50 * MS
        if load:
            rig.others.extend(
                (begin + int(i * other_ns / load), other) for i in range(int((end - begin) * load / other_ns))
            )
        for number in range(frames):
            rig.bus.send(can_frame(number))
            rig.turn_and_link()
        rig.run(end)
        assert rig.lost == 0
        assert rig.sent == [can_frame(number) for number in range(frames)]
        counters = rig.counters()
        assert (counters["tx_unconfirmed"], counters["tx_frames"], counters["tx_queued"]) == (frames, 0, 0)
        if not load:
            bus_ns = sum(bits_of(frame) for frame in rig.sent) * S / bitrate
            assert rig.busy_ns - begin < 1.02 * bus_ns + 3 * LATENCY_NS


@pytest.mark.parametrize("load", [0.0, 0.3])
def test_a_device_on_usb_that_answers_each_frame_gets_3000_a_second(load: float) -> None:
    """Nakakiyo, Elmue: 64 in their buffer, 1 ms each way. All arrive, in order, and none is ever refused."""
    frames, bitrate = 3000, 1_000_000
    sending = Sending(Confirms.QUEUED, window=32, paced_bitrate=bitrate, depth=56)
    rig = Queued(sending=sending, bitrate=bitrate, room=64, slow=0.005, link_ns=1 * MS)
    try:
        begin = rig.now
        other = FRAME.pack(0x055, 8, bytes(8))
        between_ns = bits_of(other) * S / bitrate / load if load else 0
        rig.others.extend(
            (begin + int(i * between_ns), other) for i in range(int(S / between_ns) if load else 0)
        )
        for number in range(frames):
            rig.bus.send(can_frame(number))
            rig.turn_and_link()
        rig.run(begin + S)
        counters = rig.counters()
        assert rig.sent == [can_frame(number) for number in range(frames)]
        assert (counters["tx_queued"], counters["tx_retries"], rig.lost) == (frames, 0, 0)
    finally:
        rig.close()


@pytest.mark.parametrize("stall_ms", [3, 8, 30])
def test_a_link_that_stalls_does_not_fill_the_device(stall_ms: int) -> None:
    """What was held up on its way arrives at once: it counts from then on, and nothing is ever refused."""
    frames, bitrate = 3000, 1_000_000
    sending = Sending(Confirms.QUEUED, window=32, paced_bitrate=bitrate, depth=56)
    rig = Queued(sending=sending, bitrate=bitrate, room=64, slow=0.005, link_ns=1 * MS)
    try:
        begin = rig.now
        for at in range(20, 400, 70):
            rig.stalls.append((begin + at * MS, begin + (at + stall_ms) * MS))
        for number in range(frames):
            rig.bus.send(can_frame(number))
            rig.turn_and_link()
        rig.run(begin + S)
        counters = rig.counters()
        assert rig.sent == [can_frame(number) for number in range(frames)]
        assert (counters["tx_queued"], counters["tx_retries"], rig.lost) == (frames, 0, 0)
    finally:
        rig.close()


def test_the_loop_wakes_for_several_frames_at_once() -> None:
    with silent(bitrate=500_000, room=27, depth=20) as rig:
        for number in range(100):
            rig.bus.send(can_frame(number))
            wakes = [rig.turn()]
        while wakes[-1] is not None:
            rig.now = wakes[-1]
            wakes.append(rig.turn())
        assert rig.counters()["tx_unconfirmed"] == 100
        assert len(wakes) < 100 / 5 + 2


def test_a_silent_device_is_no_missing_answer(rig: Rig) -> None:
    set_sending(rig.relay, Sending(Confirms.NOTHING, paced_bitrate=500_000, depth=4))
    for number in range(40):
        rig.bus.send(can_frame(number))
        rig.relay.command(number, b"V\r", 0, b"V", 0.3)  # is not answered either, and keeps no frame waiting
        rig.turn(50)
    lines = rig.said()
    assert [len(lines), lines.count(b"V")] == [80, 40]
    rig.turn(1000)
    counters = rig.counters()
    assert (counters["tx_unconfirmed"], counters["resyncs"], counters["queued"]) == (40, 0, 0)
    assert [kind for kind, _, _ in rig.events()] == [_relay.EVENT_TIMEOUT] * 40


def test_a_command_that_timed_out_before_is_no_reason_to_resynchronise(rig: Rig) -> None:
    rig.relay.set_gates(receiving=False, transmit=_relay.GATE_AWAY)
    rig.relay.command(1, b"O\r", _relay.ACCEPT_OK, b"", 0.1)
    rig.turn()
    rig.turn(101)
    set_sending(rig.relay, Sending(Confirms.NOTHING, paced_bitrate=500_000, depth=4))
    rig.relay.set_gates(receiving=True, transmit=_relay.GATE_OPEN)
    rig.bus.send(can_frame(1))
    rig.turn()
    assert [line[:1] for line in rig.said()] == [b"O", b"t"]
    assert rig.counters()["resyncs"] == 0


def test_a_health_question_is_answered_between_the_frames(rig: Rig) -> None:
    set_sending(rig.relay, Sending(Confirms.NOTHING, paced_bitrate=500_000, depth=4))
    rig.bus.send(can_frame(1))
    rig.relay.command(7, b"V\r", 0, b"8ca5", 0.3)
    rig.turn()
    rig.port.send(b"\r8ca5d39 https://example\r\a")
    rig.turn()
    assert rig.events() == [(_relay.EVENT_TEXT, 7, b"8ca5d39 https://example")]
    assert (rig.counters()["stray_answers"], rig.counters()["tx_unconfirmed"]) == (2, 1)


def test_a_frame_that_the_port_does_not_take_is_not_counted_as_given(rig: Rig) -> None:
    set_sending(rig.relay, Sending(Confirms.NOTHING, paced_bitrate=500_000, depth=128))
    with contextlib.suppress(BlockingIOError):
        while True:
            rig.far[0].send(bytes(4096))  # the port is full
    rig.bus.send(can_frame(1))
    rig.turn()
    assert (rig.counters()["tx_unconfirmed"], rig.counters()["queued"]) == (0, 1)
    rig.relay.detach_port()
    assert (rig.counters()["tx_unconfirmed"], rig.counters()["unanswered"]) == (0, 1)


def test_a_frame_that_would_leave_the_device_too_late_is_not_sent() -> None:
    """Sixteen take 0.2 s at 10 kbit/s: those for which the deadline is shorter do not go."""
    with rig_with(deadline=0.1) as rig:
        set_sending(rig.relay, Sending(Confirms.NOTHING, paced_bitrate=10_000, depth=64))
        for number in range(16):
            rig.bus.send(can_frame(number))
        rig.turn()
        counters = rig.counters()
        assert counters["tx_unconfirmed"] + counters["stale"] == 16
        assert 6 <= counters["tx_unconfirmed"] <= 9


def test_what_was_sent_before_a_new_start_counts_still(rig: Rig) -> None:
    """Some devices keep their buffer."""
    sending = Sending(Confirms.NOTHING, paced_bitrate=10_000, depth=3)
    for _ in range(2):
        set_sending(rig.relay, sending)
        for number in range(3):
            rig.bus.send(can_frame(number))
        rig.turn()
        rig.attach()
    assert len(rig.said()) == 3


def test_one_at_a_time_for_a_buffer_without_order(rig: Rig) -> None:
    """USBtin answers when the frame is in one of three buffers; the next waits until the bus had time."""
    set_sending(rig.relay, Sending(Confirms.QUEUED, window=1, paced_bitrate=100_000, depth=1))
    for number in range(2):
        rig.bus.send(can_frame(number))
    rig.turn()
    assert len(rig.said()) == 1
    rig.port.send(b"Z\r")
    due = rig.turn()
    assert due == rig.now + bits_of(can_frame(0)) * 10100
    assert rig.said() == []
    rig.now = due
    rig.turn()
    assert len(rig.said()) == 1


def test_a_refused_frame_waits_for_its_time_too(rig: Rig) -> None:
    """And the loop sleeps until then."""
    set_sending(rig.relay, Sending(Confirms.QUEUED, window=1, paced_bitrate=10_000, depth=1))
    rig.bus.send(can_frame(0))
    rig.turn()
    rig.port.send(b"\a")
    rig.turn()
    rig.port.send(b"V1013\r")
    rig.said()
    due = rig.turn(2)
    assert due == rig.now - 2 * MS + bits_of(can_frame(0)) * 101000
    rig.now = due
    rig.turn()
    assert len(rig.said()) == 1


@pytest.fixture
def rig() -> Iterator[Rig]:
    r = Rig()
    yield r
    r.close()
