"""A simulated CANable with Elmue's firmware."""

import pytest
from benches.clones import FRAME, REMOTE, Talk

from bridged.simulators.elmue import Elmue

OPEN = (b"S4\r", b"O\r")


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"v\r", b"\x07"),
        (b"N\r", b"\x07"),
        (b"F\r", b"\r"),
        (b"C\r", b""),
        (b"\r", b"\r"),
        (b"VVVVVVVVVVVVVVVVVVVVVVVVVV\r", b"\x07"),
        (b"O\r", b"\x07"),
        (b"S4\r", b"\r"),
        (b"M00000000\r", b"\r"),
        (b"m00000000\r", b"\x07"),
        (b"X1\r", b"\x07"),
        (b"L\r", b"\x07"),
        (b"A1\r", b"\r"),
        (b"MF\r", b"#0\r"),
        (b"t1232AABB\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_closed(sent: bytes, answer: bytes) -> None:
    assert Talk(Elmue()).says(sent) == answer


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"F\r", b"\r"),
        (b"O\r", b"\x07"),
        (b"C\r", b""),
        (b"t1232AABB\r", b"\r"),
        (b"t1232AABBC\r", b"\x07"),
        (b"t1239\r", b"\x07"),
        (b"t8000\r", b"\x07"),
    ],
)
def test_what_it_answers_while_the_channel_is_open(sent: bytes, answer: bytes) -> None:
    assert Talk(Elmue(), setup=OPEN).says(sent) == answer


def test_its_version_is_one_long_line_with_tabs() -> None:
    answer = Talk(Elmue()).says(b"V\r")
    assert answer.startswith(b"+Board: ")
    assert answer.count(b"\t") == 10


def test_c_forgets_the_bit_rate() -> None:
    talk = Talk(Elmue(), setup=(*OPEN, b"C\r"))
    assert talk.says(b"O\r") == b"\a"


def test_after_half_a_second_without_acknowledgement_all_is_thrown_away() -> None:
    talk = Talk(Elmue(), setup=OPEN)
    talk.device.set_acknowledged(talk.now, False)
    talk.says(b"t1232AABB\r", waits_s=0.3)
    talk.says(b"t1232AABB\r", waits_s=0.3)
    talk.device.set_acknowledged(talk.now, True)
    assert talk.on_bus() == []
    assert talk.device.counters.frames_discarded == 2


def test_too_few_digits_are_a_frame() -> None:
    talk = Talk(Elmue(), setup=OPEN)
    assert talk.says(b"t1232AA\r") == b"\r"
    assert talk.on_bus() != []
    assert talk.hears(REMOTE) == b"r1232\r"


def test_silent_by_m1_or_os() -> None:
    for setup in ((b"S4\r", b"M1\r", b"O\r"), (b"S4\r", b"OS\r")):
        talk = Talk(Elmue(), setup=setup)
        assert talk.says(b"t1232AABB\r") == b"\a"
        assert talk.hears(FRAME) == b"t1232AABB\r"
