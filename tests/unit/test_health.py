"""What observations make of the bus state, and the error frames for them, on a clock of the test's own."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridged.adapters.base import Happened, Observation
from bridged.bridge.health import Health, Stall
from bridged.can import BusState, error_frame, state_of

ACTIVE, WARNING, PASSIVE, BUS_OFF = BusState
CRTL, BUSOFF, RESTARTED = 0x004, 0x040, 0x100


def counted(tec: int, rec: int) -> Observation:
    return Observation("", state_of(tec, rec), tec=tec, rec=rec)


def test_states_by_error_counters() -> None:
    limits = {0: ACTIVE, 95: ACTIVE, 96: WARNING, 127: WARNING, 128: PASSIVE, 255: PASSIVE}
    for count, state in limits.items():
        assert state_of(count, 0) == state_of(0, count) == state


# The bytes of a candump of the kernel's own drivers (can_change_state): class in the identifier, CRTL in
# data[1], TEC and REC in data[6] and data[7].
@pytest.mark.parametrize(
    ("tec", "rec", "can_id", "data"),
    [
        (96, 0, 0x20000004, "0008000000006000"),  # tx-error-warning
        (0, 97, 0x20000004, "0004000000000061"),  # rx-error-warning
        (127, 127, 0x20000004, "000C000000007F7F"),
        (136, 5, 0x20000004, "0020000000008805"),  # tx-error-passive
        (5, 128, 0x20000004, "0010000000000580"),  # rx-error-passive
    ],
)
def test_error_frames_are_those_of_the_kernels_drivers(tec: int, rec: int, can_id: int, data: str) -> None:
    (frame,) = Health().observe(counted(tec, rec), 0.0)
    assert int.from_bytes(frame[:4], "little") == can_id
    assert frame[4] == 8
    assert frame[8:] == bytes.fromhex(data)


def test_back_to_error_active() -> None:
    health = Health()
    assert health.observe(counted(0, 0), 0.0) == []
    assert len(health.observe(counted(100, 0), 1.0)) == 1
    assert health.observe(counted(101, 0), 2.0) == []
    assert health.observe(counted(3, 2), 3.0) == [error_frame(CRTL, crtl=0x40, tec=3, rec=2)]


def test_bus_off_and_restart() -> None:
    health = Health()
    assert health.observe(Observation("", BUS_OFF, tec=127, rec=0), 0.0) == [error_frame(BUSOFF)]
    assert health.observe(Observation("", BUS_OFF, tec=127, rec=0), 1.0) == []
    restarted = Observation("", ACTIVE, tec=0, rec=0, happened=Happened.RESTARTED)
    assert health.observe(restarted, 2.0) == [error_frame(RESTARTED), error_frame(CRTL, crtl=0x40)]
    assert (health.state, health.restarts) == (ACTIVE, 1)


def test_what_only_happened_is_over_when_nothing_has_happened_for_a_second() -> None:
    health = Health()

    def flags(state: BusState, now_s: float) -> list[bytes]:
        return health.observe(Observation("", state, lasting=False), now_s)

    assert flags(WARNING, 0.0) == [error_frame(CRTL, crtl=0x0C)]
    assert flags(PASSIVE, 0.25) == [error_frame(CRTL, crtl=0x30)]
    assert flags(ACTIVE, 0.5) == []
    assert flags(WARNING, 0.75) == []
    assert health.state == PASSIVE
    assert flags(ACTIVE, 1.25) == [error_frame(CRTL, crtl=0x40)]
    assert health.state == ACTIVE


def test_what_happened_is_told_and_counted() -> None:
    health = Health()
    everything = Happened.RX_OVERFLOW | Happened.ARBITRATION_LOST | Happened.BUS_ERROR
    assert health.observe(Observation("", happened=everything), 0.0) == [
        error_frame(0x004 | 0x002 | 0x008 | 0x080, crtl=0x01)
    ]
    assert health.happened == {"rx_overflow": 1, "arbitration_lost": 1, "bus_error": 1}
    assert health.state is None


def test_an_adapter_that_is_away_has_no_state() -> None:
    health = Health()
    health.observe(counted(100, 0), 0.0)
    health.forget()
    assert (health.state, health.tec, health.rec) == (None, None, None)
    assert health.observe(counted(100, 0), 1.0) == []  # the bus knows
    health.forget()
    assert len(health.observe(counted(0, 0), 2.0)) == 1


PASSIVE_SEEN = Observation("", PASSIVE, lasting=False)
NOTHING_SEEN = Observation("", ACTIVE, lasting=False)
Look = tuple[Observation, int, int]  # frames received, taken


def stalls(*looks: Look) -> bool:
    """One each quarter of a second, the first at the start."""
    stall = Stall(0.5, 5, 7)
    return any(
        stall.observe(seen, 0.25 * at, rx_frames, tx_frames)
        for at, (seen, rx_frames, tx_frames) in enumerate(looks)
    )


@pytest.mark.parametrize(
    "looks",
    [
        [(NOTHING_SEEN, 5, 7), (PASSIVE_SEEN, 5, 8), *[(PASSIVE_SEEN, 5, 8)] * 2],
        [(PASSIVE_SEEN, 5, 8), *[(NOTHING_SEEN, 5, 8)] * 2],  # the flag is that of an interrupt
        [(NOTHING_SEEN, 5, 8), (PASSIVE_SEEN, 5, 8), *[(NOTHING_SEEN, 5, 8)] * 2],  # taken just before a look
        [(NOTHING_SEEN, 5, 7), (PASSIVE_SEEN, 9, 8), *[(NOTHING_SEEN, 9, 8)] * 2],  # received before
        [(PASSIVE_SEEN, 5, 7), *[(NOTHING_SEEN, 5, 7)] * 9, (NOTHING_SEEN, 5, 8)],  # taken long after
    ],
)
def test_frames_that_may_not_leave_the_adapter(looks: list[Look]) -> None:
    assert stalls(*looks)
    assert not stalls(*looks[:-1])


@pytest.mark.parametrize(
    ("looks", "why"),
    [
        ([(PASSIVE_SEEN, 5, 7), *[(NOTHING_SEEN, 5, 7)] * 9], "it took no frame"),
        ([(PASSIVE_SEEN, 5, 8), (NOTHING_SEEN, 6, 8), *[(NOTHING_SEEN, 6, 8)] * 9], "frames are received"),
        ([(NOTHING_SEEN, 5, 8)] * 9, "it never was error-passive"),
        (
            [(NOTHING_SEEN, 5, 7), (PASSIVE_SEEN, 5, 8), (NOTHING_SEEN, 5, 90), *[(NOTHING_SEEN, 5, 90)] * 9],
            "it took more than it has room for",
        ),
    ],
)
def test_frames_that_do_leave_the_adapter(looks: list[Look], why: str) -> None:
    assert not stalls(*looks), why


@given(st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), max_size=30))
def test_one_frame_for_each_change_and_none_without(counters: list[tuple[int, int]]) -> None:
    health = Health()
    before = ACTIVE
    for at, (tec, rec) in enumerate(counters):
        frames = health.observe(counted(tec, rec), float(at))
        assert len(frames) == (state_of(tec, rec) != before)
        before = state_of(tec, rec)
