"""What went wrong once: floods of text, stuck ports, late answers, polls that crowd out frames."""

import os
import pty
import socket
import termios
import tty
from collections.abc import Iterator

import pytest
from benches.relay import MS, Rig, can_frame

from bridged import _relay


@pytest.fixture
def rig() -> Iterator[Rig]:
    r = Rig(deadline=0.1)
    yield r
    r.close()


@pytest.fixture
def stuck(rig: Rig) -> Iterator[int]:
    """The relay's port is a terminal that takes nothing until tcflow(TCOON); its far end."""
    far, near = pty.openpty()
    tty.setraw(near)
    for fd in (far, near):
        os.set_blocking(fd, False)
    termios.tcflow(near, termios.TCOOFF)
    rig.relay.attach_port(near)
    rig.terminal = near  # type: ignore[attr-defined]
    yield far
    os.close(far)
    os.close(near)


def kinds(rig: Rig) -> list[int]:
    return [event[0] for event in rig.events()]


def test_a_frame_that_waits_in_a_stuck_port_does_not_go_out_late(rig: Rig, stuck: int) -> None:
    rig.relay.set_gates(receiving=True, transmit=_relay.GATE_OPEN)
    rig.bus.send(can_frame(1))
    rig.turn()
    rig.now += 3_600_000 * MS  # the process was stopped for an hour
    termios.tcflow(rig.terminal, termios.TCOON)  # type: ignore[attr-defined]
    rig.turn()
    with pytest.raises(BlockingIOError):
        os.read(stuck, 100)
    assert _relay.EVENT_PORT_LOST in kinds(rig)
    assert rig.counters()["unanswered"] == 1


def test_a_stuck_port_neither_spins_nor_keeps_a_command_for_ever(rig: Rig, stuck: int) -> None:
    assert stuck
    rig.relay.set_gates(receiving=True, transmit=_relay.GATE_LISTEN_ONLY)
    rig.relay.set_polling(b"A\r", b"A", 0.01)
    rig.relay.command(5, b"C\r", _relay.ACCEPT_OK, b"", 0.3)
    due = rig.turn()
    for _ in range(100):
        if due is None:
            break
        assert due > rig.now
        rig.now = due
        due = rig.turn()
    assert due is None
    assert (_relay.EVENT_TIMEOUT, 5) in [event[:2] for event in rig.events()]


def test_polling_a_busy_bus_leaves_room_for_frames(rig: Rig) -> None:
    rig.relay.set_polling(b"A\r", b"A", 0.01)
    for n in range(20):
        rig.bus.send(can_frame(n))
        for _ in range(4):
            for line in rig.said():
                rig.port.send(b"t1000\rA\r" if line == b"A" else b"z\r")
            rig.turn(1)
    assert rig.counters()["tx_frames"] >= 19


def test_a_late_answer_of_the_initialisation_refuses_no_frame(rig: Rig) -> None:
    rig.relay.set_gates(receiving=False, transmit=_relay.GATE_AWAY)
    rig.relay.command(1, b"A\r", _relay.ACCEPT_REFUSED, b"A", 0.3)
    rig.turn()
    rig.turn(300)
    rig.relay.set_gates(receiving=True, transmit=_relay.GATE_OPEN)
    rig.bus.send(can_frame(1))
    rig.turn()
    assert rig.said() == [b"A", b"V"]  # first that answer is waited out
    rig.port.send(b"\aV1324\r")
    rig.turn()
    assert len(rig.said()) == 1
    rig.port.send(b"z\r")
    rig.turn(50)
    assert rig.said() == []
    assert rig.counters()["tx_retries"] == 0


def test_a_flood_of_text_crowds_out_neither_answers_nor_the_end(rig: Rig) -> None:
    rig.relay.command(1, b"F\r", _relay.ACCEPT_REFUSED, b"F", 0.3)
    rig.turn()
    rig.port.send(b"x\r" * 600 + b"F00\r")
    rig.port.shutdown(socket.SHUT_WR)
    rig.turn()
    rig.turn()
    events = [event[:2] for event in rig.events()]
    assert (_relay.EVENT_TEXT, 1) in events
    assert (_relay.EVENT_PORT_LOST, 0) in events
    assert rig.counters()["events_lost"] > 0


def test_listening_by_polls_notices_a_dead_adapter(rig: Rig) -> None:
    rig.relay.set_gates(receiving=True, transmit=_relay.GATE_LISTEN_ONLY)
    rig.relay.set_polling(b"A\r", b"A", 0.01)
    for _ in range(10):
        rig.turn(300)
    assert _relay.EVENT_SILENT in kinds(rig)


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan"), float("inf"), 9.3e9])
def test_times_that_are_none_are_refused(rig: Rig, seconds: float) -> None:
    with pytest.raises(ValueError, match="seconds"):
        rig.relay.command(1, b"F\r", 0, b"F", seconds)
    with pytest.raises(ValueError, match="seconds"):
        rig.relay.set_polling(b"A\r", b"A", seconds)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param(b"\x8fx\r\a", b"V1324\r", id="noise before the BELL: the answer may be in it"),
        pytest.param(b"\a", b"\x8fz\x01\rV1324\r", id="noise after it"),
    ],
)
def test_a_bell_amid_noise_is_not_believed(rig: Rig, before: bytes, after: bytes) -> None:
    rig.bus.send(can_frame(1))
    rig.turn()
    assert len(rig.said()) == 1
    rig.port.send(before)
    rig.turn()
    rig.port.send(after)
    rig.turn()
    rig.turn(50)
    assert [line for line in rig.said() if line != b"V"] == []
    c = rig.counters()
    assert (c["unanswered"], c["queued"], c["tx_retries"]) == (1, 0, 0)


@pytest.mark.parametrize("noise", [b"", b"\x8fq\r"])
def test_a_bell_that_could_not_be_checked(rig: Rig, noise: bytes) -> None:
    """With noise since, nobody knows whether the frame was taken."""
    rig.bus.send(can_frame(1))
    rig.turn()
    rig.port.send(b"\a")
    rig.turn()
    rig.port.send(noise)
    rig.turn(200)
    c = rig.counters()
    assert (c["unanswered"], c["refused"], c["queued"]) == (
        0,
        0,
        1,
    )  # too old, but who knows what became of it
    rig.turn(200)
    rig.port.send(b"V1324\r")
    rig.turn()
    rig.turn()
    c = rig.counters()
    assert (c["unanswered"], c["refused"], c["queued"]) == (bool(noise), not noise, 0)
    assert [line for line in rig.said() if line != b"V"][1:] == []
