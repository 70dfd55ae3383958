"""A simulated device with catompiler's slave library."""

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.catompiler import Catompiler

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"V0103\r"),
        (b"N\r", b"N1234\r"),
        (b"F\r", b"\x07"),
        (b"C\r", b"\x07"),
        (b"\r", b"\x07"),
        (b"v\r", b"\x07"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b""),
        (b"S9\r", b""),
        (b"S4\r", b"\r"),
        (b"s031C\r", b"\r"),
        (b"Z2\r", b""),
        (b"Z1\r", b"\r"),
        (b"X1\r", b"\r"),
        (b"M00000000\r", b"\r"),
        (b"t1232AABB\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Catompiler()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"O\r", b"\x07"),
        (b"F\r", b"F00\r"),
        (b"A\r", b"A\r"),
        (b"C\r", b"\r"),
        (b"t1232AABB\r", b"\r"),
        (b"t1232AAB\r", b""),
        (b"t1239\r", b""),
        (b"X1\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Catompiler(), setup=OPEN).says(sent) == answer


def test_its_fifo_of_32_outlives_close_and_open() -> None:
    talk = Talk(Catompiler(), setup=(b"S4\r", b"X1\r", b"O\r"))
    talk.device.set_acknowledged(talk.now, False)
    assert [talk.says(b"t1232AABB\r", waits_s=0) for _ in range(33)] == [b"z\r"] * 32 + [b"\a"]
    talk.says(b"C\r")
    talk.says(b"O\r")
    talk.device.set_acknowledged(talk.now, True)
    assert talk.on_bus() == [FRAME] * 32
    assert talk.hears(REMOTE) == b"r1232\r"


def test_once_silent_it_is_silent_for_good() -> None:
    talk = Talk(Catompiler(), setup=(b"S4\r", b"L\r", b"C\r", b"O\r"))
    assert talk.says(b"t1232AABB\r") == b"\r"
    assert talk.on_bus(after_s=9) == []
    talk.books()
