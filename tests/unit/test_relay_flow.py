"""The window of a USB2CAN, against the simulated device behind a latency, on a clock of the test's own."""

from collections import Counter, defaultdict
from typing import Any

import pytest
from benches.usb2can_relay import STOP, US, S, assert_in_order, numbered, packed, rig_with
from hypothesis import given, settings
from hypothesis import strategies as st

from bridged import _relay

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


@pytest.mark.parametrize("lose_go", [0, 1])
def test_a_stop_lasts_as_long_as_the_level_is_not_below_ready(lose_go: int) -> None:
    with rig_with(deadline=60.0) as rig:
        rig.device.lose_go = lose_go
        rig.device.set_bus_off(rig.now / S, True)
        rig.send(*(numbered(n) for n in range(40)))
        rig.run(0.1)
        assert rig.counters()["tx_stops"] == 1
        taken = rig.device.counters.frames_taken
        rig.run(10.0)
        assert rig.device.counters.frames_taken == taken
        rig.device.set_bus_off(rig.now / S, False)
        rig.run_until_done(2.0)
        assert_in_order(rig, [numbered(n) for n in range(40)])


def test_a_stop_that_never_ends_is_noticed_and_nothing_goes_late() -> None:
    with rig_with(deadline=0.5) as rig:
        rig.device.set_bus_off(rig.now / S, True)
        rig.send(*(numbered(n) for n in range(40)))
        rig.run(2.0)
        (frames,) = [token for kind, token, _ in rig.take_events() if kind == _relay.EVENT_STUCK]
        c = rig.counters()
        assert (frames, c["tx_frames"], c["stale"], c["queued"]) == (frames, frames, 40 - frames, 0)
        rig.relay.set_gates(receiving=True, transmit=_relay.GATE_AWAY)  # as bridge.py does when it is stuck
        rig.perform(rig.adapter.close_steps(drain=False))
        rig.device.set_bus_off(rig.now / S, False)
        rig.relay.detach_port()
        rig.relay.attach_port(rig.near_port)
        rig.perform(rig.adapter.init_steps(None))
        rig.open()
        rig.send(numbered(100))
        rig.run_until_done()
        assert rig.sent == [numbered(100)]
        assert rig.device.counters.frames_discarded == frames


def test_a_stop_without_start_is_tried_with_one_frame_where_no_level_is_told() -> None:
    with rig_with(answers_get=False, bitrate=10_000) as rig:
        rig.send(numbered(0))
        rig.run_until_done()
        rig.device.garbage(rig.now / S, STOP)
        rig.run(0.01)
        taken = rig.device.counters.frames_taken
        rig.send(*(numbered(n) for n in range(1, 10)))
        rig.run(0.48)
        assert rig.device.counters.frames_taken == taken
        while rig.device.counters.frames_taken == taken:
            rig.run(0.000125)
        rig.run(0.0005)
        assert rig.device.counters.frames_taken == taken + 1
        rig.run_until_done()
        assert_in_order(rig, [numbered(n) for n in range(10)])


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


@pytest.mark.parametrize("lost", range(5, 14))
def test_a_frame_handed_back_and_damaged_on_the_way_is_not_taken_for_sent(lost: int) -> None:
    """The codec mends what follows, so that nothing is skipped; only the frame is none of ours."""
    with rig_with() as rig:
        rig.send(numbered(0))
        rig.run_until_done()
        rig.device.refusals = 1
        rig.damage = (bytes.fromhex("0F 09 0C 00"), lost)
        rig.send(numbered(1))
        c = rig.run_until_done()
        assert (c["tx_frames"], c["unanswered"], c["tx_dropped"]) == (1, 1, 1)
        assert rig.sent == [numbered(0)]


def test_of_equal_frames_the_newest_is_handed_back() -> None:
    with rig_with(tx_buffer=2, bitrate=10_000) as rig:
        on, off = numbered(1, 0x100), numbered(0, 0x100)
        rig.send(numbered(7))
        rig.run_until_done()
        for frame in (on, off, on):
            rig.bus.send(packed(frame))
        rig.turn()
        rig.run_until_done()
        assert rig.sent == [numbered(7), on, off, on]
        assert rig.counters()["tx_returned"] >= 1


def test_no_order_is_reversed_across_a_reconnect() -> None:
    """What may have been taken before the port went is not followed by what was handed back before it."""
    with rig_with() as rig:
        rig.send(numbered(0))
        rig.run_until_done()
        rig.device.refusals = 1
        rig.device.drop_answers = 1
        first, second = numbered(1, 0x100), numbered(2, 0x100)
        for frame in (first, second):
            rig.bus.send(packed(frame))
        rig.turn()
        rig.run(0.01)
        assert rig.counters()["tx_returned"] == 1
        rig.relay.detach_port()
        rig.relay.attach_port(rig.near_port)
        rig.open()
        c = rig.run_until_done(3.0)
        assert rig.sent == [numbered(0), second]
        assert (c["unanswered"], c["overtaken"]) == (1, 1)


def test_what_was_handed_back_while_the_device_was_mute_is_not_taken_for_sent() -> None:
    with rig_with() as rig:
        rig.send(numbered(0))
        rig.run_until_done()
        rig.device.refusals = 9
        rig.device.silent = True
        rig.send(*(numbered(n) for n in range(1, 10)))
        rig.run(0.003)
        rig.device.silent = False
        c = rig.run_until_done()
        assert (c["tx_frames"], c["unanswered"]) == (1, 9)
        assert rig.sent == [numbered(0)]


def test_a_device_that_dies_while_it_is_closed_is_not_asked_for_mode_normal() -> None:
    """A resynchronisation could not succeed any more, and would cost a second of the time to stop."""
    with rig_with() as rig:
        rig.send(numbered(0))
        rig.run_until_done()
        rig.device.silent = True
        rig.send(numbered(1))
        rig.relay.set_gates(receiving=True, transmit=_relay.GATE_STOPPED)
        begin = rig.now
        rig.perform(rig.adapter.close_steps(drain=True))
        assert rig.now - begin < 1.6 * S
        c = rig.counters()
        assert (c["resyncs"], c["unanswered"], c["queued"]) == (0, 1, 0)
        rig.device.violations.clear()


def test_frames_that_do_not_leave_the_device_are_noticed() -> None:
    """They would be sent whenever the bus lets them, however old."""
    with rig_with(deadline=0.5) as rig:
        rig.device.set_bus_off(rig.now / S, True)
        rig.send(*(numbered(n) for n in range(3)))
        rig.run(0.4)
        assert _relay.EVENT_STUCK not in [kind for kind, _, _ in rig.events]
        rig.run(0.4)
        assert [(kind, token) for kind, token, _ in rig.events if kind == _relay.EVENT_STUCK] == [
            (_relay.EVENT_STUCK, 3)
        ]
        rig.run(5.0)
        assert [kind for kind, _, _ in rig.events].count(_relay.EVENT_STUCK) == 1


def test_frames_that_leave_slowly_are_not_stuck() -> None:
    with rig_with(deadline=0.5, bitrate=10_000) as rig:
        for n in range(60):
            rig.send(numbered(n))
            rig.run(0.015)
        rig.run_until_done()
        assert _relay.EVENT_STUCK not in [kind for kind, _, _ in rig.events]
        rig.run(0.2)
        assert rig.relay.turn(rig.now) is None  # and nothing is asked any more


def test_a_stop_said_again_and_again_ends() -> None:
    with rig_with(answers_get=False) as rig:
        rig.send(numbered(1))
        for _ in range(20):
            rig.device.garbage(rig.now / S, STOP)
            rig.run(0.1)
        assert rig.sent == [numbered(1)]


FAULTS = st.sampled_from(
    ["nothing", "refusals", "lose_go", "stop", "value 2", "corrupt", "drop", "silence", "garbage", "bus-off"]
)


@settings(max_examples=150)
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
