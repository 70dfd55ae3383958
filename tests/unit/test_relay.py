"""The relay on a clock of the test's own: accounting, order, deadlines, missing and wrong answers."""

import random
import select
import socket
from collections.abc import Iterator

import pytest
from benches.relay import ERR_FLAG, FRAME, MS, Rig, can_frame, number_of, rig_with
from hypothesis import given, settings
from hypothesis import strategies as st

from bridged import _relay


@pytest.fixture
def rig() -> Iterator[Rig]:
    r = Rig()
    yield r
    r.close()


def test_device_to_bus_in_order_with_noise_between(rig: Rig) -> None:
    rig.port.send(b"\x00\xfft1232AABB\rt12\rT0000010018112233445566778\rr1003\rT1FFFFFFF0EA5F\r")
    rig.turn()
    assert rig.frames() == [
        FRAME.pack(0x123, 2, b"\xaa\xbb"),
        FRAME.pack(0x40000100, 3, b""),
        FRAME.pack(0x9FFFFFFF, 0, b""),
    ]
    c = rig.counters()
    assert (c["rx_frames"], c["skipped_messages"], c["rx_stamped"]) == (3, 3, 1)
    assert [e[0] for e in rig.events()] == [_relay.EVENT_STAMPED]


def test_window_waits_for_each_answer(rig: Rig) -> None:
    for n in range(3):
        rig.bus.send(can_frame(n))
    rig.turn()
    for n in range(3):
        (line,) = rig.said()
        assert number_of(line) == n
        rig.port.send(b"Z\r" if line[:1] == b"T" else b"z\r")
        rig.turn()
    assert rig.said() == []
    assert rig.counters()["tx_frames"] == 3


def test_what_cannot_be_sent_is_counted_by_kind(rig: Rig) -> None:
    rig.bus.send(FRAME.pack(ERR_FLAG | 4, 8, b""))
    rig.bus.send(bytes(72))
    rig.bus.send(b"short")
    rig.bus.send(FRAME.pack(0x7FF, 9, b""))
    rig.turn()
    c = rig.counters()
    assert rig.said() == []
    assert (c["error-frame"], c["fd-frame"], c["malformed"], c["queued"]) == (1, 1, 2, 0)


def test_refused_frame_is_sent_again_until_its_deadline(rig: Rig) -> None:
    rig.bus.send(can_frame(1))
    rig.turn()
    tries = 0
    while True:
        for line in rig.said():
            if line == b"V":  # is the refusal one?
                rig.port.send(b"V1324\r")
            else:
                tries += 1
                assert number_of(line) == 1
                rig.port.send(b"\a")
            rig.turn()
        due = rig.turn()
        if due is None:
            break
        if not select.select([rig.port], (), (), 0)[0]:  # nothing said: time goes on
            rig.now = due
            rig.turn()
    c = rig.counters()
    assert c["refused"] == 1
    assert c["tx_retries"] == tries - 1
    assert tries > 50  # for a second, at most 16 ms apart
    assert [e[0] for e in rig.events()].count(_relay.EVENT_FRAME_REFUSED) >= 1


def test_refused_frame_is_not_sent_after_a_later_one_was_taken() -> None:
    with rig_with(window=2) as rig:
        for n in range(4):
            rig.bus.send(can_frame(n))
        rig.turn()
        assert [number_of(x) for x in rig.said()] == [0, 1]
        rig.port.send(b"\az\r")  # 0 refused, 1 taken
        rig.turn()
        assert rig.said() == [b"V"]
        rig.port.send(b"V1324\r")
        rig.turn(20)
        assert [number_of(x) for x in rig.said()] == [2, 3]
        rig.port.send(b"\a\a")
        rig.turn()
        assert rig.said() == [b"V"]
        rig.port.send(b"V1324\r")
        for n in (2, 3):  # one at a time now, in order
            rig.turn(20)
            assert [number_of(x) for x in rig.said()] == [n]
            rig.port.send(b"z\r")
        rig.turn()
        c = rig.counters()
        assert (c["tx_frames"], c["overtaken"], c["tx_retries"]) == (3, 1, 2)


@pytest.mark.parametrize("first", [b"\a", b"\r\a"])
def test_a_bell_that_is_no_answer_does_not_send_a_frame_twice(rig: Rig, first: bytes) -> None:
    """Noise, or slcanpty's second answer to a remote frame: the frame's own answer comes after it."""
    for n in range(2):
        rig.bus.send(can_frame(n))
    rig.turn()
    rig.port.send(first)
    rig.turn()
    lines = rig.said()
    assert [number_of(x) for x in lines if x != b"V"] == ([0] if first == b"\a" else [0, 1])
    if lines[-1] != b"V":
        rig.turn()
        lines += rig.said()
    rig.port.send(b"z\rV1324\r")
    rig.turn(50)
    if first == b"\a":
        assert [number_of(x) for x in rig.said()] == [1]
        rig.port.send(b"z\r")
        rig.turn(50)
    assert rig.said() == []
    c = rig.counters()
    assert (c["tx_frames"], c["tx_retries"], c["queued"]) == (2, 0, 0)


def test_stale_frames_are_dropped_not_sent(rig: Rig) -> None:
    for n in range(3):
        rig.bus.send(can_frame(n))
    rig.turn()
    assert len(rig.said()) == 1
    rig.turn(250)
    rig.bus.send(can_frame(3))
    rig.turn()
    rig.port.send(b"z\r")
    rig.turn(760)  # 0 was confirmed late; 1 and 2 are older than 1 s, 3 is not
    assert [number_of(x) for x in rig.said() if x[:1] in b"tT"] == [3]
    assert rig.counters()["stale"] == 2


def test_lost_answer_resynchronises_and_never_sends_twice(rig: Rig) -> None:
    for n in range(2):
        rig.bus.send(can_frame(n))
    rig.turn()
    rig.said()
    rig.turn(299)
    assert rig.said() == []
    rig.turn(1)
    assert rig.said() == [b"V"]  # nothing else until this is answered
    rig.port.send(b"V1324\r")
    rig.turn()
    assert [number_of(x) for x in rig.said()] == [1]
    rig.port.send(b"z\r")
    rig.turn()
    c = rig.counters()
    assert (c["tx_frames"], c["unanswered"], c["resyncs"]) == (1, 1, 1)


def test_late_answer_during_resynchronisation_still_counts(rig: Rig) -> None:
    rig.bus.send(can_frame(1))
    rig.turn()
    rig.turn(300)
    rig.port.send(b"z\rV1324\r")
    rig.turn()
    c = rig.counters()
    assert (c["tx_frames"], c["unanswered"], c["stray_answers"]) == (1, 0, 0)


def test_silent_adapter_is_reported_after_three_tries(rig: Rig) -> None:
    rig.bus.send(can_frame(1))
    rig.turn()
    for _ in range(4):
        rig.turn(300)
    assert [x for x in rig.said() if x == b"V"] == [b"V"] * 3
    rig.bus.send(can_frame(2))
    rig.turn()
    assert rig.said() == []
    assert [e[0] for e in rig.events()] == [_relay.EVENT_UNANSWERED, _relay.EVENT_SILENT]
    c = rig.counters()
    assert (c["unanswered"], c["queued"]) == (1, 1)


def test_command_goes_between_frames_and_is_answered_in_order(rig: Rig) -> None:
    rig.bus.send(can_frame(1))
    rig.turn()
    rig.bus.send(can_frame(3))
    rig.relay.command(7, b"F\r", _relay.ACCEPT_REFUSED, b"F", 0.5)
    rig.turn()
    assert len(rig.said()) == 1
    rig.port.send(b"z\r")
    rig.turn()
    assert rig.said() == [b"F"]
    rig.port.send(b"t1000\rF04\r")
    rig.turn()
    assert rig.events() == [(_relay.EVENT_TEXT, 7, b"F04")]
    assert number_of(rig.said()[0]) == 3
    assert len(rig.frames()) == 1


def test_text_answer_proves_that_earlier_answers_are_lost() -> None:
    with rig_with(window=2) as rig:
        rig.bus.send(can_frame(1))
        rig.turn()
        rig.relay.command(7, b"F\r", _relay.ACCEPT_REFUSED, b"F", 0.5)
        rig.turn()
        rig.port.send(b"F00\r")
        rig.turn()
        assert rig.events() == [(_relay.EVENT_TEXT, 7, b"F00")]
        assert rig.counters()["unanswered"] == 1


def test_port_loss_ends_what_was_in_flight_and_keeps_the_queue(rig: Rig) -> None:
    for n in range(2):
        rig.bus.send(can_frame(n))
    rig.relay.command(9, b"F\r", _relay.ACCEPT_REFUSED, b"F", 0.5)
    rig.port.send(b"t12")
    rig.turn()
    rig.port.shutdown(socket.SHUT_WR)
    rig.turn()
    rig.bus.send(can_frame(2))
    rig.turn()
    assert [e[:2] for e in rig.events()] == [(_relay.EVENT_PORT_LOST, 0), (_relay.EVENT_TIMEOUT, 9)]
    c = rig.counters()
    assert (c["adapter-away"], c["queued"], c["skipped_bytes"]) == (1, 2, 3)


def test_nothing_queued_before_an_absence_is_sent_late(rig: Rig) -> None:
    for n in range(3):
        rig.bus.send(can_frame(n))
    rig.turn()
    rig.relay.detach_port()
    rig.turn(1001)
    rig.attach()
    rig.said()
    rig.turn()
    assert rig.said() == []
    c = rig.counters()
    assert (c["unanswered"], c["stale"], c["queued"]) == (1, 2, 0)


def test_full_queue_drops_the_newest() -> None:
    with rig_with(queue=4) as rig:
        for n in range(8):
            rig.bus.send(can_frame(n))
        rig.turn()
        c = rig.counters()
        assert (c["queued"], c["queue-full"]) == (4, 4)
        rig.turn(1001)  # the queue is stale: it makes room
        rig.said()
        rig.bus.send(can_frame(9))
        rig.turn()
        assert rig.counters()["queue-full"] == 4


@pytest.mark.parametrize(
    ("gate", "reason"), [(_relay.GATE_LISTEN_ONLY, "listen-only"), (_relay.GATE_STOPPED, "stopped")]
)
def test_closed_gate_says_why(rig: Rig, gate: int, reason: str) -> None:
    for n in range(3):
        rig.bus.send(can_frame(n))
    rig.turn()
    rig.relay.set_gates(receiving=True, transmit=gate)
    rig.bus.send(can_frame(4))
    rig.turn()
    c = rig.counters()
    assert (c[reason], c["queued"]) == (3, 1)  # one was in flight: its answer is still awaited


def test_frames_before_the_gate_opens_are_not_relayed(rig: Rig) -> None:
    rig.relay.set_gates(receiving=False, transmit=_relay.GATE_AWAY)
    rig.port.send(b"t1000\r")
    rig.bus.send(can_frame(1))
    rig.turn()
    c = rig.counters()
    assert (c["rx not-running"], c["adapter-away"]) == (1, 1)
    assert rig.frames() == []


def test_polling_asks_again_at_once_while_there_are_frames(rig: Rig) -> None:
    rig.relay.set_polling(b"A\r", b"A", 0.01)
    rig.turn()
    assert rig.said() == [b"A"]
    rig.port.send(b"t1000\rt1010\rA\r")
    rig.turn()
    assert rig.said() == [b"A"]
    assert len(rig.frames()) == 2
    rig.port.send(b"A\r")
    due = rig.turn()
    assert due == rig.now + 10 * MS
    assert rig.said() == []
    rig.turn(10)
    assert rig.said() == [b"A"]


def test_full_bus_queue_waits_then_drops_with_a_reason(rig: Rig) -> None:
    rig.far[1].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    rig.port.send(b"t10081122334455667788\r" * 400)
    for _ in range(3):
        rig.turn(1)
    c = rig.counters()
    assert c["rx_pending"] > 0
    got = len(rig.frames())
    rig.turn(1)
    more = len(rig.frames())
    assert more > 0
    rig.turn(1)
    rig.turn(200)
    for _ in range(300):
        rig.turn(1)
    got += more + len(rig.frames())
    c = rig.counters()
    assert c["rx_frames"] == got
    assert c["rx bus-queue-full"] > 0
    assert c["rx_pending"] == 0


def test_bus_end_of_file_is_an_event_and_frames_are_counted(rig: Rig) -> None:
    rig.bus.shutdown(socket.SHUT_RDWR)
    rig.turn()
    rig.port.send(b"t1000\r")
    rig.turn()
    assert (_relay.EVENT_INTERFACE_LOST, 0, b"") in rig.events()
    assert rig.counters()["rx bus-lost"] == 1


def test_idle_relay_has_no_deadline(rig: Rig) -> None:
    assert rig.turn() is None
    rig.bus.send(can_frame(1))
    rig.turn()
    rig.port.send(b"z\r")
    assert rig.turn() is None


@settings(max_examples=400)
@given(
    seed=st.integers(0, 2**32),
    window=st.integers(1, 4),
    lossy=st.booleans(),
    steps=st.integers(10, 120),
)
def test_random_device_never_sees_a_frame_twice_late_or_out_of_order(
    seed: int, window: int, lossy: bool, steps: int
) -> None:
    """The device takes, refuses, and (lossy) loses commands and answers; the books always balance."""
    rng = random.Random(seed)
    with rig_with(queue=8, window=window, deadline=0.4) as rig:
        taken: list[int] = []
        born: dict[int, int] = {}
        sent = 0
        answers: list[bytes] = []
        detached = 0

        def device(line: bytes) -> None:
            lost_answer = lossy and rng.random() < 0.05
            if lossy and rng.random() < 0.05:
                return
            if line == b"V":
                answer = b"V1324\r"
            elif rng.random() < 0.2:
                answer = b"\a"
            else:
                n = number_of(line)
                assert rig.now - born[n] <= 400 * MS
                taken.append(n)
                answer = b"z\r"
            if not lost_answer:
                answers.append(answer)

        for _ in range(steps):
            for _ in range(rng.randrange(4)):
                born[sent] = rig.now
                rig.bus.send(can_frame(sent))
                sent += 1
            rig.turn()
            while answers and rng.random() < 0.7:
                rig.port.send(answers.pop(0))
            if lossy and rng.random() < 0.01:
                rig.relay.detach_port()
                rig.turn()
                rig.said()
                answers.clear()
                detached += 1
                rig.attach()
            rig.turn(rng.choice([0, 0, 1, 5, 40]))
            for line in rig.said():
                device(line)
            rig.counters()
        c = rig.counters()
        assert taken == sorted(set(taken))
        assert c["tx_frames"] <= len(taken) <= c["tx_frames"] + c["unanswered"] + c["queued"]
        assert c["bus_read"] == sent


def test_what_waits_grows_too_old_while_the_port_is_away() -> None:
    rig = Rig(deadline=0.1)
    for number in range(3):
        rig.bus.send(can_frame(number))
    rig.turn()
    born = rig.now
    rig.relay.detach_port()
    assert rig.turn() == born + 100 * MS + 1
    rig.turn(101)
    assert rig.counters()["stale"] == 2
    assert rig.counters()["queued"] == 0
    rig.close()


def test_a_queue_full_of_old_frames_has_room_for_a_new_one() -> None:
    rig = Rig(queue=2, deadline=0.1)
    for number in range(3):
        rig.bus.send(can_frame(number))
        rig.turn()
    assert rig.counters()["queued"] == 3  # one of them in flight
    rig.bus.send(can_frame(3))
    rig.turn(101)
    assert (rig.counters()["stale"], rig.counters()["queue-full"]) == (2, 0)
    rig.close()


def test_time_stamps_are_told_again_of_a_new_port(rig: Rig) -> None:
    for _ in range(2):
        rig.port.send(b"t12311155AA\r" * 2)
        rig.turn()
        assert [kind for kind, _, _ in rig.events()].count(_relay.EVENT_STAMPED) == 1
        rig.attach()


def test_after_a_resynchronisation_a_refusal_before_it_needs_no_check_of_its_own() -> None:
    with rig_with(window=2) as rig:
        for n in range(2):
            rig.bus.send(can_frame(n))
        rig.turn()
        assert len(rig.said()) == 2
        rig.port.send(b"\a")
        rig.turn()
        rig.turn(301)  # the other is not answered
        assert rig.said() == [b"V"]
        rig.bus.send(can_frame(2))
        rig.port.send(b"V1324\r")
        rig.turn()
        assert [number_of(line) for line in rig.said()] == [2]
        c = rig.counters()
        assert (c["unanswered"], c["resyncs"]) == (2, 1)


def test_a_line_that_a_port_did_not_end_does_not_go_on_at_the_next_port(rig: Rig) -> None:
    rig.port.send(b"x" * 1000)
    rig.turn()
    rig.relay.detach_port()
    rig.attach()
    rig.port.send(b"t1230\r")
    rig.turn()
    assert rig.frames() == [FRAME.pack(0x123, 0, b"")]


def test_an_interface_that_takes_little_by_little_loses_nothing(rig: Rig) -> None:
    """Only one that takes nothing at all for 0.1 s does."""
    rig.far[1].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    frames = [FRAME.pack(n, 0, b"") for n in range(64)]
    rig.port.send(b"".join(b"t%03X0\r" % n for n in range(64)))
    rig.turn()
    got = []
    while len(got) < len(frames):
        rig.turn(40)
        got.append(rig.bus.recv(128))
    assert got == frames
    rig.counters()
