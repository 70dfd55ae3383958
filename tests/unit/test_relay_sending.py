"""How a device wants its frames, and what its answers to them mean: Relay.set_sending()."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from benches.relay import EFF_FLAG, FRAME, MS, Rig, can_frame

from bridged import _relay
from bridged.adapters.base import Confirms, Remote, Sending
from bridged.bridge.loop import set_sending

GIVEN = ("tx_frames", "tx_queued", "tx_unconfirmed")
COUNTER = {
    Confirms.TAKEN: "tx_frames",
    Confirms.SENT: "tx_frames",
    Confirms.QUEUED: "tx_queued",
    Confirms.ALWAYS: "tx_unconfirmed",
    Confirms.NOTHING: "tx_unconfirmed",
}


@pytest.fixture
def rig() -> Iterator[Rig]:
    r = Rig()
    yield r
    r.close()


@pytest.mark.parametrize("confirms", set(Confirms) - {Confirms.NOTHING})
def test_each_confirmation_has_its_counter(rig: Rig, confirms: Confirms) -> None:
    set_sending(rig.relay, Sending(confirms))
    rig.bus.send(can_frame(1))
    rig.turn()
    assert rig.counters()["queued"] == 1
    rig.port.send(b"z\r")
    rig.turn()
    counters = rig.counters()
    assert {name: counters[name] for name in GIVEN} == {**dict.fromkeys(GIVEN, 0), COUNTER[confirms]: 1}


def test_another_port_is_that_of_a_can232_again(rig: Rig) -> None:
    set_sending(rig.relay, Sending(Confirms.QUEUED, window=3))
    rig.attach()
    for number in range(2):
        rig.bus.send(can_frame(number))
    rig.turn()
    assert len(rig.said()) == 1
    rig.port.send(b"z\r")
    rig.turn()
    assert (rig.counters()["tx_frames"], rig.counters()["tx_queued"]) == (1, 0)


def test_a_window_of_the_devices_own(rig: Rig) -> None:
    set_sending(rig.relay, Sending(Confirms.QUEUED, window=3))
    for number in range(5):
        rig.bus.send(can_frame(number))
    rig.turn()
    assert len(rig.said()) == 3


@pytest.mark.parametrize(
    ("confirms", "remote", "numbers", "why"),
    [
        ("never", "plain", {}, "no confirmation is named 'never'"),
        ("taken", "some", {}, "no way to send remote frames is named 'some'"),
        ("taken", "plain", {"window": _relay.WINDOW_MAX + 1}, f"window is 1 to {_relay.WINDOW_MAX}"),
        ("taken", "plain", {"bitrate": 999}, "a bit rate is 1000 bit/s or more"),
        ("taken", "plain", {"bitrate": 1000, "depth": 129}, "depth 1 to 128"),
        ("nothing", "plain", {}, "frames that are not answered go by the bit rate"),
    ],
)
def test_what_is_no_setting_is_refused(
    rig: Rig, confirms: str, remote: str, numbers: dict[str, int], why: str
) -> None:
    plain: Any = {"window": 0, "bitrate": 0, "depth": 1, "retries": True, "long_stamps": False}
    with pytest.raises(ValueError, match=why):
        rig.relay.set_sending(confirms, remote, **{**plain, **numbers})


@pytest.mark.parametrize("remote", Remote)
@pytest.mark.parametrize("confirms", Confirms)
def test_adapters_and_relay_have_the_same_words(rig: Rig, confirms: Confirms, remote: Remote) -> None:
    set_sending(rig.relay, Sending(confirms, remote, paced_bitrate=500_000))


@pytest.mark.parametrize("window", [1, 4])
def test_a_refused_frame_that_may_have_been_on_the_bus_is_not_sent_again(rig: Rig, window: int) -> None:
    """WeAct refuses for each error on the bus, and goes on trying: CR may come after it."""
    set_sending(rig.relay, Sending(Confirms.SENT, window=window, retries=False))
    sent = []
    for number in range(8):
        rig.bus.send(can_frame(number))
        rig.turn()
    for answer in (b"\r", b"\a", b"\a", b"\r", b"\r", b"\a", b"\r", b"\r", b"\r"):
        sent += rig.said()
        rig.port.send(answer)
        rig.turn(30)
    counters = rig.counters()
    assert len(sent) == len(set(sent)) == 8
    assert b"V" not in sent
    assert (counters["tx_frames"], counters["refused"], counters["tx_retries"]) == (5, 3, 0)
    assert counters["stray_answers"] == 1
    assert [kind for kind, _, _ in rig.events()] == [_relay.EVENT_FRAME_REFUSED]


def test_a_device_that_refuses_all_for_good_is_stuck(rig: Rig) -> None:
    set_sending(rig.relay, Sending(Confirms.SENT, retries=False))
    for number in range(30):
        rig.bus.send(can_frame(number))
        rig.turn(40)
        rig.port.send(b"\a")
        rig.turn()
    assert [kind for kind, _, _ in rig.events()].count(_relay.EVENT_STUCK) == 1


REMOTE = [(0x123, 0), (0x123, 1), (0x123, 8), (EFF_FLAG | 0x123, 0), (EFF_FLAG | 0x123, 4)]


@pytest.mark.parametrize(
    ("remote", "lines", "dropped"),
    [
        (Remote.PLAIN, [b"r1230", b"r1231", b"r1238", b"R000001230", b"R000001234"], 0),
        (
            Remote.WITH_DIGITS,
            [b"r1230", b"r123100", b"r1238" + b"0" * 16, b"R000001230", b"R00000123400000000"],
            0,
        ),
        (Remote.NO_STANDARD, [b"R000001230", b"R000001234"], 3),
        (Remote.NONE, [], 5),
    ],
)
def test_remote_frames_as_the_device_wants_them(
    rig: Rig, remote: Remote, lines: list[bytes], dropped: int
) -> None:
    set_sending(rig.relay, Sending(Confirms.ALWAYS, remote, window=32))
    rig.bus.send(FRAME.pack(0x123, 1, b"\x55"))
    for can_id, dlc in REMOTE:
        rig.bus.send(FRAME.pack(0x40000000 | can_id, dlc, b""))
        rig.turn()
    assert rig.said() == [b"t123155", *lines]
    rig.port.send(b"\r" * 6)
    rig.turn()
    counters = rig.counters()
    assert (counters["remote-frame"], counters["malformed"], counters["queued"]) == (dropped, 0, 0)
    assert counters["tx_unconfirmed"] == 1 + len(lines)


def test_what_no_protocol_can_say_is_no_remote_frame(rig: Rig) -> None:
    set_sending(rig.relay, Sending(Confirms.ALWAYS, Remote.NO_STANDARD))
    rig.bus.send(FRAME.pack(0x40000123, 9, b""))
    rig.turn()
    assert (rig.counters()["malformed"], rig.counters()["remote-frame"]) == (1, 0)


@pytest.mark.parametrize("line", [b"t1232AABB", b"r1233", b"r1233000000", b"T000001231AA", b"R000001231"])
@pytest.mark.parametrize(("digits", "longer"), [(0, False), (4, False), (8, True)])
def test_time_stamps_as_the_device_has_them(rig: Rig, line: bytes, digits: int, longer: bool) -> None:
    """Eight digits where none can be are a broken line: a DLC of 4 that was 8 looks like that."""
    for long_stamps in (False, True):
        set_sending(rig.relay, Sending(long_stamps=long_stamps))
        rig.port.send(line + b"0001E240"[:digits] + b"\r")
        rig.turn()
        understood = long_stamps or not longer
        assert len(rig.frames()) == understood
    assert rig.counters()["skipped_messages"] == longer


def test_the_sync_command_of_a_device_that_has_said_who_it_is(rig: Rig) -> None:
    rig.relay.set_sync(b"V\r", b"WeAc")
    rig.bus.send(can_frame(0))
    rig.turn()
    rig.turn(301)  # no answer
    assert rig.said()[1:] == [b"V"]
    rig.port.send(b"WeAct Studio\r")
    rig.bus.send(can_frame(1))
    rig.turn()
    assert len(rig.said()) == 1
    assert rig.counters()["resyncs"] == 1


class TestAnswersThatComeLater:
    """WeAct: CR when the frame was on the bus, V answered at once; each health question overtakes frames."""

    @pytest.fixture(autouse=True)
    def _sent(self, rig: Rig) -> None:
        set_sending(rig.relay, Sending(Confirms.SENT, window=3, retries=False))
        for number in range(4):
            rig.bus.send(can_frame(number))
            rig.turn()

    def ask(self, rig: Rig, token: int) -> None:
        rig.relay.command(token, b"V\r", 0, b"WeAc", 0.3)
        rig.turn()

    def test_a_question_goes_though_the_window_is_full_and_costs_no_frame(self, rig: Rig) -> None:
        self.ask(rig, 7)
        assert [line[:1] for line in rig.said()] == [b"T", b"t", b"T", b"V"]
        rig.port.send(b"WeAct Studio\r")
        rig.turn()
        assert rig.events() == [(_relay.EVENT_TEXT, 7, b"WeAct Studio")]
        rig.port.send(b"\r\r\r")
        rig.turn()
        rig.port.send(b"\r")
        rig.turn()
        counters = rig.counters()
        assert (counters["tx_frames"], counters["unanswered"], counters["queued"]) == (4, 0, 0)

    def test_an_answer_to_a_frame_is_not_one_to_the_question_before_it(self, rig: Rig) -> None:
        rig.port.send(b"\r\r\r")
        rig.turn()
        rig.port.send(b"\r")
        rig.turn()
        self.ask(rig, 7)
        rig.bus.send(can_frame(4))
        rig.turn()
        rig.port.send(b"\r")
        rig.turn()
        rig.port.send(b"WeAct Studio\r")
        rig.turn()
        assert rig.events() == [(_relay.EVENT_TEXT, 7, b"WeAct Studio")]
        assert (rig.counters()["tx_frames"], rig.counters()["stray_answers"]) == (5, 0)

    def test_a_bus_that_nobody_acknowledges_loses_no_answer(self, rig: Rig) -> None:
        """No resynchronisation: the frames are in the device, until Python closes it."""
        self.ask(rig, 7)
        due = rig.turn()
        while due is not None and due <= 4_000 * MS:
            assert due > rig.now
            rig.now = due
            due = rig.turn()
        kinds = [kind for kind, _, _ in rig.events()]
        assert kinds == [_relay.EVENT_TIMEOUT] + [_relay.EVENT_STUCK] * 3
        counters = rig.counters()
        assert (counters["resyncs"], counters["queued"], counters["stale"]) == (0, 3, 1)

    @pytest.mark.parametrize("ms", [0, 900])
    def test_the_answer_to_the_closing_counts_for_no_frame(self, rig: Rig, ms: int) -> None:
        rig.turn(ms)
        rig.relay.set_gates(receiving=False, transmit=_relay.GATE_AWAY)
        rig.relay.command(8, b"C\r", _relay.ACCEPT_OK, b"", 0.3)
        rig.turn()
        assert rig.said()[-1] == b"C"
        rig.port.send(b"\r")
        rig.turn()
        assert rig.events() == [(_relay.EVENT_OK, 8, b"")]
        counters = rig.counters()
        assert (counters["unanswered"], counters["tx_frames"], counters["resyncs"]) == (3, 0, 0)


def test_frames_that_may_be_late_are_the_last_ones_and_counted_once(rig: Rig) -> None:
    late = []
    for taken in (5, 0, 1, 3, 9):
        for number in range(taken):
            rig.bus.send(can_frame(number))
            rig.turn()
            rig.port.send(b"z\r")
            rig.turn()
        rig.relay.count_late(3)
        rig.attach()
        late.append(rig.counters()["tx_late"])
    assert late == [3, 3, 4, 7, 10]
