"""A simulated ESP32 with esp32-slcan."""

import pytest
from benches.clones import REMOTE, Talk

from bridged.simulators.esp32 import Esp32
from bridged.simulators.sja1000 import Frame
from bridged.simulators.uart import Uart

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"V\r", b"V1234\r"),
        (b"N\r", b"N2233\r"),
        (b"F\r", b"F00\r"),
        (b"C\r", b""),
        (b"O\r", b"\r"),
        (b"Z2\r", b""),
        (b"\r", b"\x07"),
        (b"v\r", b"\x07"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b"V1234\r"),
        (b"S0\r", b"\x07"),
        (b"S3\r", b"\r"),
        (b"s031C\r", b"\x07"),
        (b"M00000000\r", b"\r"),
        (b"W2D00\r", b"\x07"),
        (b"L\r", b"\x07"),
        (b"t1232AABB\r", b"\r"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Esp32()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"O\r", b""),
        (b"C\r", b"\r"),
        (b"F\r", b"F00\r"),
        (b"t1232AABB\r", b"\r"),
        (b"r1232\r", b"\r"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Esp32(), setup=OPEN).says(sent) == answer


def test_a_standard_remote_frame_goes_out_as_an_extended_one() -> None:
    talk = Talk(Esp32(), setup=OPEN)
    talk.says(b"r1232\r")
    assert talk.on_bus() == [Frame(0x123, True, True, 2, b"")]
    assert talk.hears(REMOTE) == b"r12320000\r"


def test_frames_without_room_vanish_and_are_answered_all_the_same() -> None:
    talk = Talk(Esp32(), setup=OPEN)
    assert [talk.says(b"t1230\r", waits_s=0) for _ in range(8)] == [b"\r"] * 8
    assert len(talk.on_bus()) == 5
    assert talk.device.counters.frames_vanished == 3
    talk.books()


def test_too_few_digits_are_a_frame() -> None:
    talk = Talk(Esp32(), setup=OPEN)
    talk.says(b"t12V\r")
    assert [frame.can_id for frame in talk.on_bus()] == [0x12]


def test_it_is_deaf_for_a_second_after_power_on() -> None:
    talk = Talk(Esp32())
    talk.device.power_cycle(talk.now)
    assert talk.says(b"V\r", waits_s=1) == b""
    assert talk.says(b"V\r") == b"V1234\r"


def test_its_line_is_paced_by_its_uart() -> None:
    talk = Talk(Esp32(uart=Uart(500_000)))
    assert talk.says(b"V\r", waits_s=30e-6) == b""
    assert talk.says(b"", waits_s=0.001) == b"V1234\r"
