"""The model of the line: when characters are there, and what a late simulator must not change."""

import random

import pytest

from bridged.simulators.can232 import Can232
from bridged.simulators.can232_memory import Eeprom
from bridged.simulators.uart import Uart

CHAR_S = 10 / 115_200
COMMAND = b"t10081122334455667788\r"


def drive(commands: int, window: int, reaction_s: float, late: random.Random | None) -> tuple[float, Can232]:
    """A host with so many commands unanswered, reacting so fast, on a simulator that wakes late by chance.

    Returns the seconds until the last answer, by the host's clock.
    """
    device = Can232(uart=Uart(115_200), eeprom=Eeprom(auto_poll=True))
    device.host_writes(0, b"S8\rO\r")
    assert device.take_output(1) == b"\r\r"
    now = start = 2.0
    writes = [now] * window
    written = answered = 0
    while answered < commands:
        deadline = device.next_deadline()
        wake = deadline + (late.uniform(0, 0.0015) if late else 0)
        if writes and writes[0] <= wake:
            now = writes.pop(0)
            written += 1
            device.host_writes(now, COMMAND)
            continue
        now = max(now, wake)
        answers = device.take_output(now).count(b"z\r")
        if answers:
            device.uart.delivered(now)
        answered += answers
        writes += [now + reaction_s] * min(answers, commands - written - len(writes))
    assert device.counters.rs232_lost == 0
    assert device.counters.frames_taken == commands
    return now - start, device


def test_a_command_arrives_when_its_last_character_does():
    device = Can232(uart=Uart(115_200))
    device.host_writes(5.0, b"V\r")
    assert device.take_output(5.0 + 7.99 * CHAR_S) == b""
    assert device.take_output(5.0 + 8.01 * CHAR_S) == b"V1324\r"  # two characters in, six out


def test_messages_come_whole_and_never_early():
    uart = Uart(9600)
    char_s = 10 / 9600
    assert uart.transmit(1.0, b"z\r") == pytest.approx(1 + 2 * char_s)
    assert uart.transmit(1.0, b"t1000\r") == pytest.approx(1 + 8 * char_s)
    assert uart.deliver(1 + 1.9 * char_s) == b""
    assert uart.deliver(1 + 7.9 * char_s) == b"z\r"
    assert uart.deliver(1 + 8.1 * char_s) == b"t1000\r"
    assert (uart.device_chars, uart.device_busy_s) == (8, pytest.approx(8 * char_s))


def test_waiting_for_each_answer_takes_24_characters_per_frame():
    elapsed, _ = drive(1000, 1, 0, None)
    assert elapsed == pytest.approx(1000 * 24 * CHAR_S)


def test_two_unanswered_commands_fill_the_line():
    elapsed, device = drive(1000, 2, 0, None)
    assert elapsed == pytest.approx((1000 * 22 + 2) * CHAR_S)
    assert 1000 / elapsed == pytest.approx(523.6, abs=0.1)
    assert device.uart.host_busy_s == pytest.approx((1000 * 22 + 5) * CHAR_S)


@pytest.mark.parametrize(("window", "characters"), [(1, 24), (2, 22)])
def test_a_late_simulator_does_not_slow_the_line(window: int, characters: int):
    """Its own delays of up to 1.5 ms are not on the time line of the wire; the host's are."""
    reaction_s = 50e-6
    elapsed, device = drive(2000, window, reaction_s, random.Random(1))
    each = characters * CHAR_S + (reaction_s if window == 1 else 0)
    assert elapsed == pytest.approx(2000 * each, rel=0.002)
    assert 0.0014 < device.uart.late_max_s < 0.0016


def test_a_simulator_that_was_stopped_does_not_change_the_past():
    """Commands written after a delay that cannot be made up for still come one after the other."""
    device = Can232(uart=Uart(115_200))
    device.host_writes(0, b"S8\rO\r")
    assert device.take_output(10) == b"\r\r"
    device.uart.delivered(10)
    device.host_writes(10.0001, COMMAND * 4)  # nobody could write these ten seconds ago
    device.advance(10.0001)
    assert device.counters.frames_taken == 1
    device.advance(10.0001 + 3 * 22 * CHAR_S)
    assert (device.counters.frames_taken, device.counters.rs232_lost) == (4, 0)
    assert device.uart.stalled_s == pytest.approx(10 - 22 * CHAR_S, abs=0.001)


def test_no_reaction_before_its_cause():
    """However far back the caller thinks it was: a message delivered is what the host reacts to."""
    uart = Uart(115_200)
    end = uart.transmit(5.0, b"z\r")
    assert uart.deliver(5.1) == b"z\r"
    uart.delivered(5.1)
    uart.host_writes(5.05, COMMAND, 5.0)
    assert uart.arrival == pytest.approx(end + 22 * CHAR_S)


def test_a_rate_holds_for_what_comes_after():
    uart = Uart(2400)
    uart.host_writes(0, b"\r", 0)
    assert uart.arrival == pytest.approx(10 / 2400)
    uart.take_arrived()
    uart.baud = 9600
    uart.host_writes(1, b"\r", 0)
    assert uart.arrival == pytest.approx(1 + 10 / 9600)
