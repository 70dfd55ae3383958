"""Simulated CANables with canable-fw and canable2-fw, and a CANtact."""

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.canable1 import Canable1
from bridged.simulators.canable2 import Canable2
from bridged.simulators.cantact import Cantact

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"8ca5d39 https://github.com/normaldotcom/canable-fw.git\r"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b"8ca5d39 https://github.com/normaldotcom/canable-fw.git\r"),
        (b"N\r", b""),
        (b"F\r", b""),
        (b"C\r", b""),
        (b"S4\r", b""),
        (b"X1\r", b""),
        (b"L\r", b""),
        (b"O\r", b""),
        (b"q\r", b""),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Canable1()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"t1232AABB\r", b""),
        (b"r1232\r", b""),
        (b"F\r", b""),
        (b"C\r", b""),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Canable1(), setup=OPEN).says(sent) == answer


def test_what_it_gets_while_it_is_closed_goes_out_at_the_next_open() -> None:
    talk = Talk(Canable1(), setup=(b"S4\r", b"t1232AABB\r"))
    assert talk.on_bus() == []
    talk.says(b"O\r")
    assert talk.on_bus() == [FRAME]
    talk = Talk(Canable2(), setup=(b"S4\r", b"t1232AABB\r", b"O\r"))
    assert talk.on_bus() == []


def test_a_lone_cr_sends_the_last_frame_again() -> None:
    talk = Talk(Canable1(), setup=(*OPEN, b"t1232AABB\r", b"\r"))
    frames = talk.on_bus()
    assert frames[0] == FRAME
    assert len(frames) == 2


def test_27_frames_outlive_close_and_open_and_what_finds_no_room_vanishes() -> None:
    talk = Talk(Canable1(), setup=OPEN)
    talk.device.set_acknowledged(talk.now, False)
    for _ in range(40):
        talk.says(b"t1232AABB\r", waits_s=0)
    assert talk.device.counters.frames_vanished == 10
    talk.says(b"C\r")
    talk.says(b"O\r")
    talk.device.set_acknowledged(talk.now, True)
    assert len(talk.on_bus()) == 27
    talk.books()


def test_there_is_no_listen_only() -> None:
    talk = Talk(Canable1(), setup=(b"S4\r", b"M1\r", b"O\r", b"t1232AABB\r"))
    assert talk.on_bus() == [FRAME]


def test_a_received_frame_is_lost_while_the_host_is_busy() -> None:
    device = Talk(Canable1(), setup=OPEN).device
    device.bus_frame(1.0, REMOTE)
    device.bus_frame(1.0, FRAME)
    assert device.take_output(1.0) == b"r12320000\r"
    assert device.counters.frames_lost == 1
    device = Talk(Canable2(), setup=OPEN).device
    device.bus_frame(1.0, REMOTE)
    device.bus_frame(1.0, FRAME)
    assert device.take_output(1.0) == b"r12320000\rt1232AABB\r"


def test_s7_is_another_rate_than_a_can232s() -> None:
    assert Talk(Canable1(), setup=(b"S7\r",)).device.bitrate == 750_000
    assert round(Talk(Canable2(), setup=(b"S7\r",)).device.bitrate) == 1_428_571


def test_too_few_digits_take_those_of_an_earlier_command() -> None:
    talk = Talk(Canable2(), setup=(*OPEN, b"t1232AABB\r"))
    assert talk.on_bus() == [FRAME]
    talk.says(b"t1\r")
    assert len(talk.on_bus()) == 1
    talk.says(b"X\r")
    assert talk.device.effects == ["frame of the bytes behind X"]
    assert talk.says(b"E\r") == b"0"


def test_a_cantact_is_harmed_by_a_flush_and_has_no_v() -> None:
    talk = Talk(Cantact())
    assert talk.says(b"V\r") == b""
    assert talk.device.effects == []
    talk.says(b"V" * 31)
    assert talk.device.effects == ["memory overwritten by a line"]
    talk.says(b"V" * 33)
    assert "memory overwritten by a packet" in talk.device.effects
    talk = Talk(Cantact())
    talk.says(b"F\r")
    assert talk.device.effects == ["filter set"]
