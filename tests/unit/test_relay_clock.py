"""How old a frame from the bus is: its time stamp is believed as far as it can be true.

Time stamps are the kernel's and real; the relay's two clocks are the test's, set so that they fit.
"""

import socket
import struct
import time
from collections.abc import Iterator

import pytest
from benches.relay import MS, Rig, can_frame, number_of

from bridged import _relay

S = 1_000 * MS
START = (
    _relay.clock() // 2
)  # another time than the real one, which the relay may know from when it was attached
DEADLINE_MS = 500
TIMESTAMPNS = 35  # SO_ and SCM_
HOUR_MS = 3_600_000


class ClockRig(Rig):
    """Times are milliseconds after START."""

    def __init__(self) -> None:
        super().__init__(window=2, deadline=DEADLINE_MS / 1000)
        self.stamp(True)

    def stamp(self, on: bool) -> None:
        self.far[1].setsockopt(socket.SOL_SOCKET, TIMESTAMPNS, on)

    def oldest_stamp(self) -> int:
        """The time stamp of the first frame that waits."""
        _, [(_, _, stamp)], _, _ = self.far[1].recvmsg(128, 128, socket.MSG_PEEK)
        seconds, nanoseconds = struct.unpack("@ll", stamp)
        return seconds * S + nanoseconds

    def turn_at(self, ms: int, wall: int) -> None:
        self.relay.turn(START + ms * MS, wall)

    def sent(self) -> list[int]:
        """The numbers of the frames that the device got."""
        return [number_of(line) for line in self.said()]

    def frame_is_sent(self, *, born: int, read: int, step: int = 0, lie: int = 0) -> bool:
        """Whether a frame is; the wall clock was set by `step` meanwhile, its own stamp is off by `lie`."""
        self.turn_at(0, time.time_ns() - (born + lie) * MS)  # the socket is empty, and the clock right
        self.bus.send(can_frame(1))
        self.turn_at(read, self.oldest_stamp() + (read - born - lie + step) * MS)
        c = self.counters()
        assert (c["queued"], c["stale"]) in {(1, 0), (0, 1)}
        return self.sent() == [1]


@pytest.fixture
def rig() -> Iterator[ClockRig]:
    r = ClockRig()
    yield r
    r.close()


@pytest.mark.parametrize("step", [0, -300, -2_000, -10_000, -HOUR_MS, 300, 2_000, HOUR_MS])
@pytest.mark.parametrize("born", [0, 1_000, 1_200])
def test_a_late_relay_sends_no_old_frame_whatever_was_done_to_the_clock(
    rig: ClockRig, born: int, step: int
) -> None:
    assert not rig.frame_is_sent(born=born, read=2_000, step=step)


@pytest.mark.parametrize("step", [0, -300, -10_000, -HOUR_MS, 300, HOUR_MS])
def test_a_relay_in_time_sends_a_frame_whatever_was_done_to_the_clock(rig: ClockRig, step: int) -> None:
    assert rig.frame_is_sent(born=240, read=250, step=step)


def test_a_late_relay_sends_the_frames_that_are_young(rig: ClockRig) -> None:
    assert rig.frame_is_sent(born=1_900, read=2_000)


@pytest.mark.parametrize("lie", [-HOUR_MS, -10_000, -800, 800, 40_000, HOUR_MS])
class TestMadeUpStamps:
    def test_a_relay_in_time_sends_the_frame(self, rig: ClockRig, lie: int) -> None:
        assert rig.frame_is_sent(born=200, read=300, lie=lie)

    def test_a_late_relay_does_not(self, rig: ClockRig, lie: int) -> None:
        assert not rig.frame_is_sent(born=100, read=700, lie=lie)


class TestFirst:
    """Frames wait in the socket when it is attached: since when is not known."""

    @pytest.mark.parametrize(("age", "sent"), [(400, True), (600, False), (-1, False), (-HOUR_MS, False)])
    def test_stamps_count_and_nothing_may_come_from_the_future(
        self, rig: ClockRig, age: int, sent: bool
    ) -> None:
        rig.bus.send(can_frame(1))
        rig.relay.attach_interface(rig.far[1])
        rig.turn_at(0, rig.oldest_stamp() + age * MS)
        assert rig.sent() == [1] * sent
        assert rig.counters()["stale"] == (not sent)

    def test_the_clock_is_set_back_before_the_first_look(self, rig: ClockRig) -> None:
        rig.bus.send(can_frame(1))
        rig.relay.attach_interface(rig.far[1])
        rig.relay.turn(_relay.clock() + 700 * MS, rig.oldest_stamp() + 400 * MS)
        assert rig.counters()["stale"] == 1

    def test_what_was_known_of_the_socket_before_is_forgotten(self, rig: ClockRig) -> None:
        rig.turn_at(0, time.time_ns() - 5 * S)
        rig.bus.send(can_frame(1))
        rig.relay.attach_interface(rig.far[1])
        rig.turn_at(100, rig.oldest_stamp() + 600 * MS)
        assert rig.counters()["stale"] == 1


def test_an_old_frame_behind_a_young_one_is_not_sent(rig: ClockRig) -> None:
    rig.relay.attach_interface(rig.far[1])
    rig.stamp(False)
    rig.bus.send(can_frame(1))
    rig.stamp(True)
    rig.bus.send(can_frame(2))
    rig.turn_at(0, rig.oldest_stamp() + DEADLINE_MS * MS)  # the first is only stamped now, by this look at it
    assert rig.sent() == [1]
    assert rig.counters()["stale"] == 1
