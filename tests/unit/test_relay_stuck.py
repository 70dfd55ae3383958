"""A device with a full buffer that nothing leaves; a queue that gets another size."""

import itertools
from collections.abc import Iterator

import pytest
from benches.relay import Rig, can_frame, number_of

from bridged import _relay


@pytest.fixture
def rig() -> Iterator[Rig]:
    r = Rig(deadline=0.1, stuck=0.5)
    yield r
    r.close()


def stuck(rig: Rig, refusing_ms: int, numbers: Iterator[int]) -> int:
    """How often the relay says so of a device that refuses one frame after the other for so long."""
    said = 0
    end = rig.now + refusing_ms * 1_000_000
    while rig.now < end:
        rig.bus.send(can_frame(next(numbers)))
        rig.turn(10)
        for line in rig.said():
            rig.port.send(b"V1324\r" if line == b"V" else b"\a")
        rig.turn()
        said += [kind for kind, _, _ in rig.events()].count(_relay.EVENT_STUCK)
    return said


def test_a_device_that_takes_nothing_is_stuck(rig: Rig) -> None:
    numbers = itertools.count()
    assert stuck(rig, 490, numbers) == 0
    assert stuck(rig, 60, numbers) == 1
    assert stuck(rig, 430, numbers) == 0
    assert stuck(rig, 90, numbers) == 1  # said again if nothing is done about it
    assert rig.counters()["refused"] > 20


def test_one_frame_that_it_takes_is_enough(rig: Rig) -> None:
    numbers = itertools.count()
    assert stuck(rig, 450, numbers) == 0
    taken = rig.counters()["tx_frames"]
    while rig.counters()["tx_frames"] == taken:
        rig.turn(10)
        for line in rig.said():
            rig.port.send(b"V1324\r" if line == b"V" else b"z\r")
        rig.turn()
    assert stuck(rig, 480, numbers) == 0
    assert stuck(rig, 60, numbers) == 1


def test_a_new_port_is_not_stuck(rig: Rig) -> None:
    numbers = itertools.count()
    assert stuck(rig, 450, numbers) == 0
    rig.attach()
    assert stuck(rig, 450, numbers) == 0


@pytest.mark.parametrize(("queue", "kept"), [(64, 7), (7, 7), (3, 3), (1, 1)])
def test_a_queue_of_another_size_keeps_the_oldest(rig: Rig, queue: int, kept: int) -> None:
    """Also where it began in the middle of its ring."""
    for number in range(12):
        rig.bus.send(can_frame(number))
        rig.turn()
        assert [number_of(line) for line in rig.said()] == [number]
        rig.port.send(b"z\r")
        rig.turn()
    for number in range(100, 108):
        rig.bus.send(can_frame(number))
    rig.turn()
    assert rig.counters()["queued"] == 8  # the first of them is under way
    rig.relay.set_queue(queue, 5.0, 5.0)
    counters = rig.counters()
    assert (counters["queued"], counters["queue-full"]) == (1 + kept, 7 - kept)
    rig.turn(200)  # with the new deadline they are not too old
    sent = []
    for _ in range(1 + kept):
        sent += [number_of(line) for line in rig.said()]
        rig.port.send(b"z\r")
        rig.turn()
    assert rig.counters()["queue-full"] == 7 - kept
    assert sent == list(range(100, 101 + kept))


@pytest.mark.parametrize(
    ("queue", "deadline", "stuck"), [(0, 1.0, 1.0), (1, 0.0, 1.0), (1, float("nan"), 1.0), (1, 1.0, 0.0)]
)
def test_a_queue_that_is_none_is_refused(rig: Rig, queue: int, deadline: float, stuck: float) -> None:
    with pytest.raises(ValueError, match="queue is 1 to 65536"):
        rig.relay.set_queue(queue, deadline, stuck)
