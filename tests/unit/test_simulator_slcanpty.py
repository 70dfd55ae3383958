"""A simulated slcanpty."""

import dataclasses

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.slcanpty import Slcanpty

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"V1013\r"),
        (b"N\r", b"N4242\r"),
        (b"F\r", b"F00\r"),
        (b"C\r", b"\r"),
        (b"X1\r", b"\r"),
        (b"X0\r", b"\x07"),
        (b"P\r", b"\x07"),
        (b"A\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Slcanpty()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"t1232AABB\r", b"\r"),
        (b"r1232\r", b"\r\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Slcanpty(), setup=OPEN).says(sent) == answer


def test_a_remote_frame_has_no_dlc() -> None:
    talk = Talk(Slcanpty(), setup=OPEN)
    talk.says(b"t1232AABB\r")
    talk.says(b"r1232\r")
    assert talk.on_bus() == [FRAME, dataclasses.replace(REMOTE, dlc=0)]
