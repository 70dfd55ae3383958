"""A simulated Arduino with slcanuino."""

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.slcanuino import Slcanuino

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"V1234\r"),
        (b"N\r", b"N1234\r"),
        (b"F\r", b"F12\r"),
        (b"C\r", b"\r"),
        (b"O\r", b"\r"),
        (b"\r", b"\x07"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b"V1234\r"),
        (b"S0\r", b"\x07"),
        (b"S7\r", b"\x07"),
        (b"S4\r", b"\r"),
        (b"s031C\r", b"\x07"),
        (b"M00000000\r", b"\r"),
        (b"Z2\r", b"\x07\r"),
        (b"L\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Slcanuino()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"t1232AABB\r", b"\r"),
        (b"t1232AAB\r", b"\r"),
        (b"r1232\r", b"\r"),
        (b"C\r", b"\r"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Slcanuino(), setup=OPEN).says(sent) == answer


def test_it_is_on_the_bus_from_power_on_and_after_c() -> None:
    talk = Talk(Slcanuino())
    talk.says(b"t1232AABB\r")
    talk.says(b"C\r")
    talk.says(b"t1232AABB\r")
    assert talk.on_bus() == [FRAME, FRAME]
    assert talk.hears(REMOTE) == b"r12320000\r"


def test_a_remote_frame_without_digits_is_not_sent() -> None:
    talk = Talk(Slcanuino(), setup=OPEN)
    talk.says(b"r1232\r")
    assert talk.on_bus() == []
    talk.says(b"r12320000\r")
    assert talk.on_bus() == [REMOTE]
    talk.books()


def test_without_acknowledgement_it_reads_nothing_any_more() -> None:
    talk = Talk(Slcanuino(), setup=OPEN)
    talk.device.set_acknowledged(talk.now, False)
    assert [talk.says(b"t1230\r") for _ in range(4)] == [b"\r"] * 3 + [b""]
    assert talk.says(b"V\r") == b""
    talk.device.set_acknowledged(talk.now, True)
    assert len(talk.on_bus()) == 4
    assert talk.says(b"") == b"\rV1234\r"
    talk.says(b"Z1\r")
    assert talk.hears(FRAME)[-5:] == b"0001\r"  # a counter
