"""A simulated CANable 2 with Nakakiyo092's firmware."""

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.nakakiyo import Nakakiyo

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"VL2K4\r"),
        (b"v\r", b'v: hardware="CANable2.0", software="L2K4"\r'),
        (b"N\r", b"\x07"),
        (b"F\r", b"\x07"),
        (b"C\r", b"\x07"),
        (b"\r", b"\r"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b"\x07"),
        (b"O\r", b"\x07"),
        (b"S9\r", b"\x07"),
        (b"S4\r", b"\r"),
        (b"M00000000\r", b"\r"),
        (b"W2\r", b"\r"),
        (b"W1\r", b"\x07"),
        (b"X1\r", b"\x07"),
        (b"Z2\r", b"\r"),
        (b"t1232AABB\r", b"\x07"),
        (b"q\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Nakakiyo()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"O\r", b"\x07"),
        (b"F\r", b"F00\r"),
        (b"S4\r", b"\x07"),
        (b"t1232AABB\r", b"z\r"),
        (b"T000001232AABB\r", b"Z\r"),
        (b"r1232\r", b"z\r"),
        (b"t1232AAB\r", b"\x07"),
        (b"t1232AABBC\r", b"\x07"),
        (b"t8002AABB\r", b"z\r"),
        (b"Z1\r", b"\x07"),
        (b"C\r", b"\r"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Nakakiyo(), setup=OPEN).says(sent) == answer


def test_64_frames_find_room_and_c_empties_it() -> None:
    talk = Talk(Nakakiyo(), setup=OPEN)
    talk.device.set_acknowledged(talk.now, False)
    assert [talk.says(b"t1232AABB\r", waits_s=0) for _ in range(65)] == [b"z\r"] * 64 + [b"\a"]
    talk.says(b"C\r")
    talk.says(b"O\r")
    talk.device.set_acknowledged(talk.now, True)
    assert talk.on_bus() == []
    talk.books()


def test_time_stamps_of_four_and_of_eight_digits() -> None:
    talk = Talk(Nakakiyo(), setup=(b"S4\r", b"Z1\r", b"O\r"))
    talk.now = 1.5
    assert talk.hears(REMOTE) == b"r123205DC\r"
    talk = Talk(Nakakiyo(), setup=(b"S4\r", b"Z2\r", b"O\r"))
    talk.now = 1.5
    assert talk.hears(FRAME) == b"t1232AABB0016E360\r"


def test_what_writes_the_flash_and_starts_the_bootloader() -> None:
    talk = Talk(Nakakiyo(), setup=(b"N1234\r", *OPEN, b"Q1\r"))
    assert talk.device.effects == ["flash written by N", "flash written by Q"]
    talk.device.version = b"VW1K2"
    assert talk.says(b"X1\r") == b""
    assert talk.device.effects[2:] == ["bootloader"]
