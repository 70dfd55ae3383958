"""What the relay does with descriptors and numbers that its caller should not have given it."""

import errno
import os
import resource
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from benches.relay import FRAME, Rig

from bridged import _relay


@pytest.fixture
def rig() -> Iterator[Rig]:
    r = Rig()
    yield r
    r.close()


def hung_up(far: socket.socket) -> bool:
    """Whether nobody has the other end open any more."""
    try:
        return far.recv(100) == b""
    except BlockingIOError:
        return False


class TestDescriptors:
    def test_a_number_that_is_another_files_now_changes_nothing(self, rig: Rig) -> None:
        """The relay keeps a duplicate of its own: it reads what was attached, not what has its number."""
        stranger, far_stranger = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with stranger, far_stranger:
            for near in rig.far:
                os.dup2(far_stranger.fileno(), near.fileno())
            stranger.send(b"t7770\r")
            rig.port.send(b"t1232AABB\r")
            rig.turn()
            rig.turn()
            assert rig.frames() == [FRAME.pack(0x123, 2, b"\xaa\xbb")]
            assert far_stranger.recv(100) == b"t7770\r"

    @pytest.mark.parametrize("end", ["detach", "attach another", "lost", "del"])
    def test_each_duplicate_is_closed(self, rig: Rig, end: str) -> None:
        for near in rig.far:
            near.close()
        assert not hung_up(rig.port)
        assert not hung_up(rig.bus)
        if end == "detach":
            rig.relay.detach_port()
            rig.relay.detach_interface()
        elif end == "attach another":
            others = socket.socketpair()
            for attach, near in zip((rig.relay.attach_port, rig.relay.attach_interface), others, strict=True):
                attach(near)
                near.close()
        elif end == "lost":
            for far in (rig.port, rig.bus):
                far.shutdown(socket.SHUT_WR)
            rig.turn()
            rig.turn()
        else:
            del rig.relay
        assert hung_up(rig.port)
        assert hung_up(rig.bus)

    @pytest.mark.parametrize("attach", ["attach_port", "attach_interface"])
    def test_what_cannot_be_used_is_an_error_and_leaves_none_attached(
        self, rig: Rig, attach: str, tmp_path: Path
    ) -> None:
        call = getattr(rig.relay, attach)
        with pytest.raises(ValueError, match="negative"):
            call(-1)
        with pytest.raises(OSError, match=os.strerror(errno.EBADF)):
            call(99_999)
        before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - names, not paths
        with (tmp_path / "file").open("w") as file, pytest.raises(PermissionError):
            call(file)  # epoll waits for no file
        assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
        try:
            with pytest.raises(OSError, match=os.strerror(errno.EMFILE)):
                call(rig.far[0])
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        rig.bus.send(bytes(16))
        rig.port.send(b"t1230\r")
        rig.turn()
        assert rig.counters()["bus_read"] == (attach == "attach_port")
        assert rig.counters()["rx_frames"] == 0

    def test_a_descriptor_closed_while_the_relay_runs(self, rig: Rig) -> None:
        """A blocking socket gets its number: a read() of that would never end, with the lock held."""
        thread = threading.Thread(target=rig.relay.run)
        thread.start()
        stranger, far_stranger = socket.socketpair()  # blocking
        with stranger, far_stranger:
            os.dup2(far_stranger.fileno(), rig.far[0].fileno())
            rig.port.send(b"t1230\r")
            for _ in range(100):
                rig.relay.wake()
                rig.relay.counters()
            rig.relay.stop()
            thread.join()


COMMAND = (1, b"F\r", 0, b"F", 0.3)
FLOW = {"capacity": 18, "critical": 15, "ready": 7}
RELAY = {
    "queue": 16,
    "window": 1,
    "deadline": 1.0,
    "stuck": 1.0,
    "answer_timeout": 0.3,
    "sync": b"V\r",
    "sync_prefix": b"V",
}


def relay_with(**options: object) -> Callable[[Rig], object]:
    return lambda _: _relay.Relay("can232", **(RELAY | options))  # type: ignore[arg-type]


def flow_with(**options: int) -> Callable[[Rig], object]:
    return lambda rig: rig.relay.set_level_window(b"\x0f", b"\x20", **(FLOW | options))


def command_with(**options: object) -> Callable[[Rig], object]:
    names = ("token", "data", "accept", "prefix", "timeout")
    arguments = dict(zip(names, COMMAND, strict=True)) | options
    return lambda rig: rig.relay.command(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "call",
    [
        *(relay_with(queue=n) for n in (-1, 0, 65_537, 2**32 - 1, 2**32 + 1, 2**64 + 1)),
        *(relay_with(window=n) for n in (-1, 0, 33, 2**32 + 1, 2**64 + 1)),
        *(relay_with(deadline=s) for s in (-1.0, 0.0, 1e6, 1e300, float("nan"))),
        *(relay_with(stuck=s) for s in (-1.0, 0.0, 1e6, 1e300, float("nan"))),
        *(relay_with(answer_timeout=s) for s in (-1.0, 0.0, 1e6, 1e300, float("nan"))),
        *(lambda rig, n=n: rig.relay.set_queue(n, 1.0, 1.0) for n in (-1, 0, 65_537, 2**32 + 1)),
        *(flow_with(**{name: n}) for name in FLOW for n in (-1, 2**32 + 7, 2**64 + 7)),
        *(command_with(accept=n) for n in (-1, 4, 256, 300, 2**31)),
        *(command_with(token=n) for n in (-1, 2**32, 2**64)),
        *(lambda rig, n=n: rig.relay.turn(n) for n in (-1, 2**62 + 1, 2**63 - 1, 2**63)),
        *(lambda rig, n=n: rig.relay.turn(0, n) for n in (-1, 2**62 + 1, 2**63 - 1, 2**63)),
    ],
)
def test_numbers_out_of_range_are_refused(rig: Rig, call: Callable[[Rig], object]) -> None:
    with pytest.raises((ValueError, OverflowError)):
        call(rig)


def test_the_largest_numbers_are_taken(rig: Rig) -> None:
    with pytest.raises(TypeError):
        relay_with(queue=1.5)(rig)
    relay_with(queue=65_536, window=32, deadline=999_999.0, stuck=999_999.0, answer_timeout=999_999.0)(rig)
    command_with(token=2**32 - 1, accept=3)(rig)
    flow_with(capacity=255, critical=255, ready=254)(rig)


@pytest.mark.parametrize("codec", ["can232", "usb2can"])
def test_a_relay_at_the_end_of_time(codec: str) -> None:
    """Under UBSan no time overflows, and a turn never waits."""
    relay = _relay.Relay(codec, **RELAY)  # type: ignore[arg-type]
    (port, near_port), (bus, near_bus) = socket.socketpair(), socket.socketpair(type=socket.SOCK_SEQPACKET)
    with port, near_port, bus, near_bus:
        for s in (near_port, near_bus):
            s.setblocking(False)
        relay.attach_port(near_port)
        relay.attach_interface(near_bus)
        if codec == "usb2can":
            relay.set_level_window(b"\x0f\x20\x01\x02", b"\x20", **FLOW)
        else:
            relay.set_polling(b"A\r", b"A", 999_999.0)
        relay.set_gates(receiving=True, transmit=_relay.GATE_OPEN)
        for now in (0, 2**62, 0, 2**62 - 1, 2**62):
            bus.send(FRAME.pack(0x123, 1, b"1"))
            port.send(b"\a")
            relay.turn(now, 2**62 - now)
        counters = relay.counters()
        assert counters["bus_read"] == 5
