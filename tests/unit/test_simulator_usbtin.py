"""A simulated USBtin."""

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.usbtin import Usbtin

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"V0100\r"),
        (b"v\r", b"v0104\r"),
        (b"N\r", b"NFFFF\r"),
        (b"F\r", b"F00\r"),
        (b"C\r", b"\x07"),
        (b"\r", b"\x07"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b"V0100\r"),
        (b"O\r", b"\x07"),
        (b"X1\r", b"\x07"),
        (b"U1\r", b"\x07"),
        (b"Q1\r", b"\x07"),
        (b"A\r", b"\x07"),
        (b"W0\r", b"\x07"),
        (b"Z1\r", b"\r"),
        (b"S6\r", b"\r"),
        (b"s031C0A\r", b"\r"),
        (b"M00000000\r", b"\r"),
        (b"mFFFFFFFF\r", b"\r"),
        (b"\nV\n\r", b"V0100\r"),
        (b"t1232AABB\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Usbtin()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"O\r", b"\x07"),
        (b"F\r", b"F00\r"),
        (b"S6\r", b"\x07"),
        (b"C\r", b"\r"),
        (b"t1232AABB\r", b"z\r"),
        (b"T000001232AABB\r", b"Z\r"),
        (b"r1232\r", b"z\r"),
        (b"R000001232\r", b"Z\r"),
        (b"t1239\r", b"\x07"),
        (b"t1232AAB\r", b"\x07"),
        (b"t1232AABBCC\r", b"z\r"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Usbtin(), setup=OPEN).says(sent) == answer


def test_three_frames_find_room_and_the_last_buffer_goes_first() -> None:
    talk = Talk(Usbtin(), setup=OPEN)
    answers = [talk.says(b"t00%dA" % n + b"\r", waits_s=0) for n in range(1)]
    assert answers == [b"\a"]
    answers = [talk.says(b"t00%d0\r" % n, waits_s=0) for n in range(4)]
    assert answers == [b"z\r", b"z\r", b"z\r", b"\a"]
    assert [frame.can_id for frame in talk.on_bus()] == [0, 2, 1]
    talk.books()


def test_its_buffers_outlive_close_and_open() -> None:
    talk = Talk(Usbtin(), setup=OPEN)
    talk.device.set_acknowledged(talk.now, False)
    talk.says(b"t1232AABB\r")
    assert talk.on_bus(after_s=5) == []
    talk.says(b"C\r")
    talk.says(b"O\r")
    talk.device.set_acknowledged(talk.now, True)
    assert talk.on_bus() == [FRAME]


def test_a_line_that_is_too_long_keeps_its_head() -> None:
    talk = Talk(Usbtin(), setup=OPEN)
    talk.says(b"t1232AABB" + b"V" * 200 + b"\r")
    assert talk.on_bus() == [FRAME]


def test_bytes_are_lost_inside_lines_when_the_host_does_not_read() -> None:
    device = Talk(Usbtin(), setup=OPEN).device
    for _ in range(20):
        device.bus_frame(1.0, FRAME)
    output = device.take_output(1.0)
    assert len(output) == 128
    assert output.endswith(b"t1232AABB\rt1232AAB")
    assert device.counters.frames_lost == 20 - 12


def test_listen_only_sends_nothing() -> None:
    talk = Talk(Usbtin(), setup=(b"S4\r", b"L\r"))
    assert talk.says(b"t1232AABB\r") == b"\a"
    assert talk.hears(REMOTE) == b"r1232\r"


def test_bus_off_is_bit_7_and_w_writes_a_register() -> None:
    talk = Talk(Usbtin(), setup=OPEN)
    talk.device.set_bus_off(talk.now, True)
    assert talk.says(b"F\r") == b"F80\r"
    assert talk.says(b"W2D00\r") == b"\r"
    assert talk.device.effects == ["register written"]
