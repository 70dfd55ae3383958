"""A simulated WeAct USB2CANFDV1."""

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.weact import Weact

OPEN = (b"S4\r", b"A1\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"WeAct Studio V1.0.0.8_20250401\r"),
        (b"v\r", b"\x07"),
        (b"N\r", b"\x07"),
        (b"F\r", b"\x07"),
        (b"C\r", b"\r"),
        (b"\r", b""),
        (b"\r\r", b"\x07"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b"\x07"),
        (b"O\r", b"\r"),
        (b"S4\r", b"\r"),
        (b"SA\r", b"\r"),
        (b"M1\r", b"\r"),
        (b"M00000000\r", b"\x07"),
        (b"m00000000\r", b"\x07"),
        (b"A1\r", b"\r"),
        (b"L\r", b"\x07"),
        (b"t1232AABB\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Weact()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"F\r", b"\x07"),
        (b"S4\r", b"\r"),
        (b"A1\r", b"\x07"),
        (b"X1\r", b"\x07"),
        (b"t1232AAB\r", b"\x07"),
        (b"C\r", b"\r"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Weact(), setup=OPEN).says(sent) == answer


def test_a_frame_is_answered_when_it_has_been_on_the_bus() -> None:
    talk = Talk(Weact(), setup=OPEN)
    assert talk.says(b"t1232AABB\r", waits_s=0) == b""
    assert talk.says(b"", waits_s=0.002) == b"\r"
    assert talk.on_bus() == [FRAME]
    assert talk.hears(REMOTE) == b"r1232\r"


def test_one_shot_loses_what_nobody_acknowledges() -> None:
    talk = Talk(Weact(), setup=(b"S4\r", b"O\r"))
    talk.device.set_acknowledged(talk.now, False)
    assert talk.says(b"t1232AABB\r") == b"\a"
    talk.books()


def test_with_16_frames_that_nobody_acknowledges_it_refuses_everything() -> None:
    talk = Talk(Weact(), setup=OPEN)
    talk.device.set_acknowledged(talk.now, False)
    assert [talk.says(b"t1232AABB\r") for _ in range(16)] == [b""] * 16
    assert [talk.says(line) for line in (b"t1232AABB\r", b"V\r", b"C\r")] == [b"\a"] * 3
    talk.device.set_acknowledged(talk.now, True)
    assert len(talk.on_bus()) == 16
    assert talk.says(b"V\r").startswith(b"\r" * 16 + b"WeAct")


def test_half_a_command_is_forgotten_after_10_ms() -> None:
    talk = Talk(Weact(), setup=OPEN)
    talk.says(b"t1232AAB", waits_s=0.011)
    assert talk.says(b"B\r") == b"\a"
    assert talk.says(b"X\r") == b"\a"
    talk.says(b"C\r")
    talk.says(b"X\r")
    assert talk.device.effects == ["bootloader"]


def test_output_that_nobody_reads_is_thrown_away() -> None:
    device = Talk(Weact(), setup=OPEN).device
    device.bus_frame(1.0, FRAME)
    device.bus_frame(1.2, REMOTE)
    assert device.take_output(1.2) == b"r1232\r"
