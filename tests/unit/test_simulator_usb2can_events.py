"""What the simulated USB2CAN says by itself, against its manual; its faults; its time."""

import math
import sys

import pytest
from benches.usb2can_words import (
    BOOT,
    CONFIG,
    FRAME,
    FRAME_S,
    FW_VERSION,
    GET,
    GET_MODE,
    GO,
    LOOPBACK,
    NORMAL,
    OPEN,
    OVERRUN,
    READ_RST,
    RECEIVED,
    SETUP,
    STOP,
    VALUE_2,
    WRITTEN,
    ask,
    check_balance,
    hexed,
    messages,
    opened,
    reg,
)
from hypothesis import given
from hypothesis import strategies as st

from bridged.simulators.usb2can import Usb2can

# Towards the host


def test_the_receive_buffer_overflows_and_says_so_once():
    device = opened(receive_buffer=3)
    for _ in range(6):
        device.bus_frame(0, FRAME)
    assert device.take_output(0) == RECEIVED * 3 + OVERRUN
    device.bus_frame(0, FRAME)
    assert device.take_output(0) == RECEIVED
    for _ in range(4):
        device.bus_frame(0, FRAME)
    assert device.take_output(0) == RECEIVED * 3 + OVERRUN
    counters = device.counters
    assert (counters.frames_received, counters.frames_lost, counters.overruns) == (7, 4, 2)


def test_answers_find_room_even_if_frames_do_not():
    device = opened(receive_buffer=1)
    device.bus_frame(0, FRAME)
    device.bus_frame(0, FRAME)
    assert ask(device, GET_MODE) == RECEIVED + OVERRUN + bytes.fromhex("0F060102")


@pytest.mark.parametrize(("order", "stamps"), [("little", ["0100", "9F0F"]), ("big", ["0001", "0F9F"])])
def test_time_stamps(order: str, stamps: list[str]):
    device = opened(100.0, version="HW0003FW5001", stamp_order=order)
    device.bus_frame(100.00026, FRAME)
    device.bus_frame(100.9999, FRAME)
    assert messages(device.take_output(100.9999)) == [
        (63, WRITTEN[3:] + bytes.fromhex(stamp)) for stamp in stamps
    ]


def test_the_time_stamp_comes_once_a_second_in_normal_mode_only():
    device = Usb2can(100.0, version="HW0003FW6001")
    ask(device, SETUP, 100.0)
    assert device.take_output(103.5) == b""
    ask(device, NORMAL + reg(0, 0), 103.5)
    assert device.next_deadline() == 104
    device.bus_frame(104.0, FRAME)  # after the second has begun
    device.bus_frame(105.5, FRAME)
    assert messages(device.take_output(107.2)) == [
        (62, b""),
        (63, WRITTEN[3:] + b"\x00\x00"),
        (62, b""),
        (63, WRITTEN[3:] + (2000).to_bytes(2, "little")),
        (62, b""),
        (62, b""),
    ]
    ask(device, CONFIG, 107.5)
    assert device.take_output(110) == b""


@given(now=st.floats(0, 1e6), after=st.floats(0, 10))
def test_stamps_count_up_within_their_second(now: float, after: float):
    device = opened(now, version="HW0003FW5001")
    device.bus_frame(now + after, FRAME)
    output = messages(device.take_output(now + after))
    stamp = int.from_bytes(output[-1][1][-2:], "little")
    ticks = sum(command == 62 for command, _ in output)
    assert 0 <= stamp <= 3999
    assert ticks + stamp / 4000 == pytest.approx(after, abs=0.0003)


def test_loopback_has_no_stamps():
    device = Usb2can(version="HW0003FW5001")
    assert ask(device, SETUP + LOOPBACK + WRITTEN.hex()).endswith(RECEIVED)


# Errors on the bus


def test_bus_off_and_back():
    device = opened()
    device.chip.latch_error(3, 0xD9)
    ask(device, WRITTEN.hex() * 2)
    device.set_bus_off(0, True)
    assert messages(device.take_output(0)) == [(8, bytes((0xCC, 3, 0xD9, 0, 127, 0xCC)))]
    device.set_bus_off(0, True)
    device.bus_frame(1, FRAME)
    assert device.take_output(1) == b""
    assert (device.waiting, device.counters.frames_unseen) == (2, 1)
    assert hexed(device, READ_RST + "0F100102", 1) == "0F62020100" + "0F100202CC"
    device.set_bus_off(2, False)
    assert device.take_output(3) == b""
    assert len(device.take_bus_frames()) == 2
    assert hexed(device, READ_RST + "0F100102", 3) == "0F62020100" + "0F1002020C"
    assert device.violations == []


def test_bus_off_is_noticed_on_the_bus_only():
    device = Usb2can()
    device.set_bus_off(0, True)
    assert device.take_output(0) == b""
    assert messages(ask(device, OPEN)[2:])[-2:] == [(8, bytes((0xCC, 0, 0, 0, 127, 0xCC))), (18, b"\0")]
    ask(device, OPEN)
    assert hexed(device, READ_RST) == "0F62020200"
    device.restarts = 0x1FF
    assert hexed(device, READ_RST) == "0F6202FF01"  # little endian


def test_error_status_when_a_counter_reaches_96():
    device = opened()
    for tec, rec, told in ((95, 0, False), (96, 0, True), (128, 128, False), (0, 0, False), (0, 96, True)):
        device.set_error_counters(0, tec, rec)
        expected = [(9, bytes((1, 0, 0, rec, tec, 0x4C)))] if told else []
        assert messages(device.take_output(0)) == expected
    device.set_bus_off(0, True)
    device.set_error_counters(0, 0, 0)
    assert device.chip.tec == 127


# Faults


def test_silence_carries_commands_out():
    device = opened()
    device.silent = True
    device.bus_frame(0, FRAME)
    assert ask(device, GET_MODE + WRITTEN.hex() * 20) == b""
    assert device.take_output(1) == b""
    assert len(device.take_bus_frames()) == 20
    device.silent = False
    assert hexed(device, GET_MODE, 1) == "0F060102"
    assert device.counters.frames_received == 1


def test_dropped_answers():
    device = opened()
    device.drop_answers = 2
    assert hexed(device, reg(4, 3) + WRITTEN.hex() + GET_MODE + FW_VERSION[:0] + GET) == "0F2005800F070100"
    assert (device.counters.answers_dropped, device.drop_answers) == (2, 0)


def test_refusals():
    device = opened()
    device.refusals = 2
    assert messages(ask(device, WRITTEN.hex() * 3)) == [(9, b"\0" + WRITTEN[3:])] * 2
    assert device.waiting == 1
    device.refusals = sys.maxsize
    assert len(messages(ask(device, WRITTEN.hex() * 30))) == 30
    assert device.waiting == 1


def test_a_lost_go():
    device = opened(stop_grace_s=0.5)
    device.lose_go = 1
    assert ask(device, WRITTEN.hex() * 16) == STOP
    assert device.take_output(1) == b""
    assert (device.counters.gos, device.counters.gos_lost, device.lose_go) == (1, 1, 0)
    assert ask(device, WRITTEN.hex() * 16, 2) == STOP
    assert device.take_output(3) == GO
    assert device.violations == []


def test_value_2_noise_and_overrun():
    device = opened()
    device.value_2_burst(0, 3)
    device.garbage(0, b"\x00\x0f\x41")
    device.overrun(0)
    assert device.take_output(0) == VALUE_2 * 3 + b"\x00\x0f\x41" + OVERRUN
    assert (device.counters.frames_lost, device.counters.overruns) == (1, 1)


def test_power():
    device = opened(junk=b"\x8a\x00")
    ask(device, WRITTEN.hex() * 3 + GET_MODE[:4])
    device.power_off(0)
    assert device.next_deadline() == math.inf
    assert ask(device, OPEN, 1) == b""
    device.bus_frame(1, FRAME)
    device.garbage(1, b"x")
    device.value_2_burst(1, 1)
    assert (device.counters.host_lost, device.counters.frames_unseen) == (len(OPEN) // 2, 1)
    device.power_on(2)
    assert hexed(device, GET_MODE, 2) == "8A00" + "0F060100"
    assert ask(device, "00" + OPEN, 2)[:2] == b"\xff\xff"  # half a message was forgotten
    assert device.counters.frames_discarded == 3
    assert device.violations == []
    check_balance(device)


def test_a_host_cannot_know_of_a_power_failure_until_it_begins_anew():
    device = opened()
    device.power_cycle(1)
    assert hexed(device, WRITTEN.hex() + READ_RST + reg(0, 0) + NORMAL, 1) == ""
    assert device.violations == []
    ask(device, CONFIG + WRITTEN.hex(), 1)
    assert device.violations == ["WRITE_MESSAGE 02 24 60 11 33: in CONFIG mode"]


def test_a_stop_that_was_never_sent_binds_nobody():
    device = opened()
    device.silent = True
    assert ask(device, WRITTEN.hex() * 16) == b""
    device.silent = False
    assert ask(device, GET_MODE) != b""
    device.host_writes(FRAME_S, WRITTEN)
    device.power_cycle(FRAME_S)
    assert device.violations == []


def test_unusable_limits_end_a_stop():
    device = opened(stop_grace_s=0.001)
    assert ask(device, WRITTEN.hex() * 16) == STOP
    assert ask(device, "0F20020007") == VALUE_2  # 7 and 7
    device.host_writes(0.0012, WRITTEN)
    assert device.violations == ["limits: critical 7, ready 7"]
    ask(device, "0F20020008" + CONFIG, 0.0012)
    assert device.take_output(1) == b""


# Time


def test_commands_take_their_time_one_after_the_other():
    device = Usb2can(processing_s=0.01)
    device.host_writes(1, bytes.fromhex(CONFIG + GET_MODE))
    assert device.next_deadline() == pytest.approx(1.01)
    assert device.take_output(1.009) == b""
    assert device.take_output(1.011) == b"\xff\xff"
    device.host_writes(1.015, bytes.fromhex(GET_MODE))
    assert device.take_output(1.0299).hex() == "0f060101"
    assert device.take_output(1.0301).hex() == "0f060101"


def test_a_deadline_is_never_missed_and_never_without_effect():
    """Waking at next_deadline only gives the same as looking all the time."""
    outcomes = []
    for step in (None, FRAME_S / 7):
        device = opened(version="HW0003FW5001")
        device.processing_s = 0.0001
        device.host_writes(0.1, WRITTEN * 25 + bytes.fromhex(GET_MODE + "0F2002010F"))
        device.bus_frame(0.1001, FRAME)
        now, output, frames, wakes = 0.1001, b"", 0, 0
        while now < 2.5:
            deadline = device.next_deadline()
            assert deadline < math.inf
            now = min(2.5, max(now, deadline)) if step is None else now + step
            before = len(output), frames, device.counters.commands.total()
            output += device.take_output(now)
            frames += len(device.take_bus_frames())
            assert step or now == 2.5 or (len(output), frames, device.counters.commands.total()) != before
            wakes += 1
        outcomes.append((output, frames, device.report()))
        assert step or wakes < 80
    assert outcomes[0] == outcomes[1]


def test_what_is_due_happens_before_a_fault_does():
    for fault, then in (
        (lambda device: device.garbage(1, b"x"), b"x"),
        (lambda device: device.value_2_burst(1, 1), VALUE_2),
        (lambda device: device.overrun(1), OVERRUN),
        (lambda device: device.set_error_counters(1, 0, 96), b"\x0f\x09\x06\x01\0\0\x60\0\x4c"),
        (lambda device: device.set_bus_off(1, True), b"\x0f\x08\x06\xcc\0\0\0\x7f\xcc"),
        (lambda device: device.bus_frame(1, FRAME), RECEIVED),
    ):
        device = opened()
        device.processing_s = 0.5
        device.host_writes(0, bytes.fromhex(GET_MODE))
        fault(device)
        assert device.take_output(1) == bytes.fromhex("0F060102") + then


def test_what_is_due_happens_before_the_power_fails():
    device = opened()
    device.host_writes(0, WRITTEN * 2)
    device.power_off(1.5 * FRAME_S)
    assert (device.counters.frames_sent, device.counters.frames_discarded) == (1, 1)


def test_the_power_failure_takes_with_it_what_is_on_its_way():
    device = opened()
    device.processing_s = 1
    device.bus_frame(0, FRAME)
    device.host_writes(0, bytes.fromhex(GET_MODE))
    device.power_off(0.5)
    assert device.take_output(0.5) == b""
    device.power_on(0.6)
    assert device.take_output(5) == b""


def test_seconds_count_from_power_on():
    device = opened(version="HW0003FW5001")
    device.power_off(1)
    device.power_on(5.25)
    ask(device, OPEN, 5.5)
    assert device.next_deadline() == 6.25
    device.bus_frame(6, FRAME)
    assert messages(device.take_output(6)) == [(63, WRITTEN[3:] + (3000).to_bytes(2, "little"))]


def test_64_frames_wait_for_the_host():
    device = opened()
    for _ in range(65):
        device.bus_frame(0, FRAME)
    assert device.take_output(0) == RECEIVED * 64 + OVERRUN


def test_after_boot_mode_there_is_no_bus():
    device = opened()
    ask(device, BOOT)
    device.bus_frame(0, FRAME)
    assert (device.take_output(1), device.counters.frames_unseen) == (b"", 1)
