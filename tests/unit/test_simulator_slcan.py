"""What all simulated clones share: their line, their transmit buffer, their controller."""

from benches.clones import FRAME, Talk

from bridged.simulators.nakakiyo import Nakakiyo
from bridged.simulators.slcan import Slcan

OPEN = (b"S4\r", b"O\r")


class Sized(Nakakiyo):
    longest = 10


def test_what_becomes_of_a_line_that_is_too_long() -> None:
    answers = {}
    for overflow in ("anew", "BELL", "last byte", "lost"):
        kind: type[Slcan] = type("Kind", (Sized,), {"overflow": overflow})
        answers[overflow] = Talk(kind()).says(b"V" * 10 + b"V\r")
    assert answers == {"anew": b"VL2K4\r", "BELL": b"\aVL2K4\r", "last byte": b"\a", "lost": b"\a"}


def test_frames_leave_at_the_bit_rate() -> None:
    talk = Talk(Nakakiyo(), setup=OPEN)
    for _ in range(10):
        talk.says(b"t1232AABB\r", waits_s=0)
    assert 3 <= len(talk.on_bus(after_s=0.002)) <= 4
    assert talk.device.next_deadline() > talk.now
    assert talk.device.set_bus_off(talk.now, True) is None
    assert talk.on_bus(after_s=1) == []
    talk.device.set_bus_off(talk.now, False)
    assert 6 <= len(talk.on_bus(after_s=1)) <= 7
    talk.books()


def test_what_is_lost_because_the_host_does_not_read() -> None:
    device = Talk(Nakakiyo(), setup=OPEN).device
    for _ in range(2000):
        device.bus_frame(1.0, FRAME)
    assert device.counters.frames_received + device.counters.frames_lost == 2000
    assert device.take_output(1.0).count(b"\r") == device.counters.frames_received == 12288 // 10
    assert device.take_output(1.0) == b""
    device.host_writes(1.0, b"F\rF\r")
    assert device.take_output(1.0) == b"F08\rF00\r"


def test_faults_of_single_answers_and_frames() -> None:
    talk = Talk(Nakakiyo(), setup=OPEN)
    talk.device.drop_answers = 1
    assert [talk.says(b"F\r") for _ in range(2)] == [b"", b"F00\r"]
    talk.device.refusals = 1
    assert [talk.says(b"t1230\r") for _ in range(2)] == [b"\a", b"z\r"]
    talk.device.set_error_counters(talk.now, 130, 0)
    assert talk.says(b"F\r") == b"F24\r"
    talk.device.silent = True
    assert talk.says(b"F\r") == b""


def test_power_off_forgets_everything() -> None:
    talk = Talk(Nakakiyo(), setup=OPEN)
    talk.device.set_acknowledged(talk.now, False)
    talk.says(b"t1230\r")
    talk.device.power_cycle(talk.now)
    talk.device.set_acknowledged(talk.now, True)
    assert talk.on_bus(after_s=1) == []
    assert talk.says(b"O\r") == b"\a"
    talk.books()
