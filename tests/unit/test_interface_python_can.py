"""Buses: the pump to real python-can interfaces, and what of socketcan needs no CAN in the kernel."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import select
import socket
import struct
import threading
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING

import can
import pytest
from can.interfaces import udp_multicast, virtual

from bridged.errors import InterfaceError
from bridged.interfaces import open_interface, python_can
from bridged.interfaces.base import LOST_ERROR_FRAMES
from bridged.interfaces.python_can import PythonCanInterface, pack_message, unpack_frame

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bridged.interfaces.base import OpenInterface

LIMIT_S = 30.0  # for what takes milliseconds
EFF, RTR, ERR = 0x80000000, 0x40000000, 0x20000000


def frame(can_id: int, data: bytes = b"", length: int | None = None, len8_dlc: int = 0) -> bytes:
    """`struct can_frame` of linux/can.h, written down once more."""
    length = len(data) if length is None else length
    return can_id.to_bytes(4, "little") + bytes([length, 0, 0, len8_dlc]) + data.ljust(8, b"\0")


def canfd_frame(can_id: int, flags: int, data: bytes) -> bytes:
    return can_id.to_bytes(4, "little") + bytes([len(data), flags, 0, 0]) + data.ljust(64, b"\0")


def classic(can_id: int, *, extended: bool = False, **fields: object) -> dict[str, object]:
    return {"arbitration_id": can_id, "is_extended_id": extended, **fields}


CLASSIC = [
    (frame(0x123, b"\x01\x02"), classic(0x123, data=b"\x01\x02")),
    (frame(0x000), classic(0)),
    (frame(0x7FF, b"12345678"), classic(0x7FF, data=b"12345678")),
    (frame(EFF | 0x1FFFFFFF, b"\xff"), classic(0x1FFFFFFF, extended=True, data=b"\xff")),
    (frame(EFF | 0x12), classic(0x12, extended=True)),
    (frame(RTR | 0x55, length=8), classic(0x55, is_remote_frame=True, dlc=8)),
    (frame(RTR | EFF | 0x55), classic(0x55, extended=True, is_remote_frame=True)),
    (frame(ERR | 0x40, bytes(8)), classic(0x40, is_error_frame=True, data=bytes(8))),
]


class TestFormat:
    @pytest.mark.parametrize(("packet", "fields"), CLASSIC)
    def test_classic_both_ways(self, packet: bytes, fields: dict[str, object]) -> None:
        message = can.Message(**fields)  # type: ignore[arg-type]
        assert pack_message(message) == packet
        assert unpack_frame(packet).equals(message, timestamp_delta=None)

    @pytest.mark.parametrize("dlc", range(9, 16))
    def test_dlc_above_8_is_8_bytes(self, dlc: int) -> None:
        packet = frame(0x100, b"12345678", len8_dlc=dlc)
        message = can.Message(arbitration_id=0x100, is_extended_id=False, dlc=dlc, data=b"12345678")
        assert pack_message(message) == packet
        assert unpack_frame(packet).dlc == 8
        remote = can.Message(arbitration_id=0x100, is_extended_id=False, is_remote_frame=True, dlc=dlc)
        assert pack_message(remote) == frame(RTR | 0x100, length=8)

    def test_can_fd(self) -> None:
        message = can.Message(arbitration_id=0x1ABCDEF0, is_fd=True, data=bytes(range(48)))
        assert pack_message(message) == canfd_frame(EFF | 0x1ABCDEF0, 0x04, bytes(range(48)))
        message = can.Message(
            arbitration_id=1,
            is_extended_id=False,
            is_fd=True,
            data=bytes(64),
            bitrate_switch=True,
            error_state_indicator=True,
        )
        assert pack_message(message) == canfd_frame(1, 0x07, bytes(64))
        assert len(pack_message(message)) == 72

    def test_driver_that_contradicts_itself(self) -> None:
        message = can.Message(arbitration_id=0xFFFFFFFF, is_extended_id=False, dlc=8, data=b"abc")
        assert pack_message(message) == frame(0x1FFFFFFF, b"abc", length=8)


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def assert_arrives(peer: can.BusABC, fields: dict[str, object]) -> None:
    message = peer.recv(LIMIT_S)
    assert message is not None, "nothing came"
    message.channel = None  # python-can 4.1 has no equals(check_channel=False)
    assert message.equals(can.Message(**fields), timestamp_delta=None)  # type: ignore[arg-type]


def receive(bus: OpenInterface) -> bytes:
    assert select.select([bus.fd], [], [], LIMIT_S)[0], "nothing came"
    return os.read(bus.fd, 128)


@pytest.fixture
def pair() -> Iterator[tuple[PythonCanInterface, can.BusABC]]:
    channel = f"test {uuid.uuid4()}"
    bus = open_interface("virtual", channel, create=False, options={})
    assert isinstance(bus, PythonCanInterface)
    with can.Bus(interface="virtual", channel=channel) as peer:
        yield bus, peer
        bus.close()


class TestVirtual:
    def test_every_kind_of_frame_to_the_bus(self, pair: tuple[PythonCanInterface, can.BusABC]) -> None:
        bus, peer = pair
        for packet, _ in CLASSIC:
            os.write(bus.fd, packet)
        for _, fields in CLASSIC:
            assert_arrives(peer, fields)

    def test_every_kind_of_frame_from_the_bus(self, pair: tuple[PythonCanInterface, can.BusABC]) -> None:
        bus, peer = pair
        for _, fields in CLASSIC:
            peer.send(can.Message(**fields))  # type: ignore[arg-type]
        peer.send(can.Message(arbitration_id=5, is_extended_id=False, is_fd=True, data=bytes(12)))
        for packet, _ in CLASSIC:
            assert receive(bus) == packet
        assert receive(bus) == canfd_frame(5, 0x04, bytes(12))
        assert bus.dropped() == {}

    def test_nothing_comes_back(self, pair: tuple[PythonCanInterface, can.BusABC]) -> None:
        bus, peer = pair
        os.write(bus.fd, frame(0x123, b"own"))
        assert peer.recv(LIMIT_S) is not None
        peer.send(can.Message(arbitration_id=0x321, is_extended_id=False))
        assert receive(bus) == frame(0x321)  # the first to come, though ours was on the bus before
        with pytest.raises(BlockingIOError):
            os.read(bus.fd, 128)

    def test_each_frame_has_a_time_stamp(self, pair: tuple[PythonCanInterface, can.BusABC]) -> None:
        bus, peer = pair
        peer.send(can.Message(arbitration_id=1))
        assert select.select([bus.fd], [], [], LIMIT_S)[0]
        with socket.socket(fileno=os.dup(bus.fd)) as twin:
            _, [(level, kind, stamp)], _, _ = twin.recvmsg(128, 128)
        assert (level, kind) == (socket.SOL_SOCKET, 35)  # SCM_TIMESTAMPNS
        seconds, nanoseconds = struct.unpack("@ll", stamp)
        assert abs(time.time() - (seconds + nanoseconds * 1e-9)) < LIMIT_S

    def test_burst_keeps_its_order(self, pair: tuple[PythonCanInterface, can.BusABC]) -> None:
        bus, peer = pair
        poll = select.poll()
        poll.register(bus.fd, select.POLLOUT)
        for number in range(2000):
            assert poll.poll(LIMIT_S * 1000)
            os.write(bus.fd, frame(EFF | number))
        for number in range(2000):
            message = peer.recv(LIMIT_S)
            assert message is not None
            assert message.arbitration_id == number

    def test_close_is_quick_and_lets_go(self) -> None:
        channel = f"test {uuid.uuid4()}"
        threads = threading.active_count()
        before = open_files()
        bus = open_interface("virtual", channel, create=False, options={})
        assert channel in virtual.channels
        start = time.monotonic()
        bus.close()
        bus.close()
        assert time.monotonic() - start < 15.0  # it does not hang; how fast it is, is no matter for a test
        assert channel not in virtual.channels
        assert threading.active_count() == threads
        assert open_files() == before
        assert (bus.fd, bus.failure) == (-1, None)


@pytest.fixture
def multicast() -> dict[str, object]:
    """Options of a udp_multicast bus of our own; skips where there is no multicast."""
    pytest.importorskip("msgpack")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    try:
        can.Bus(interface="udp_multicast", channel="239.74.163.2", port=port).shutdown()
    except can.CanInitializationError as error:
        pytest.skip(f"no multicast here: {error}")
    return {"port": port}


class TestUdpMulticast:
    def test_both_ways_and_nothing_comes_back(self, multicast: dict[str, object]) -> None:
        """It gives a sender its own frames, unmarked: the one interface that needs care of its own."""
        bus = open_interface("udp_multicast", "239.74.163.2", create=False, options=multicast)
        with can.Bus(interface="udp_multicast", channel="239.74.163.2", **multicast) as peer:  # type: ignore[arg-type]
            for packet, fields in CLASSIC:
                os.write(bus.fd, packet)
                assert_arrives(peer, fields)
            for packet, fields in reversed(CLASSIC):  # so that none is what was sent before in its place
                peer.send(can.Message(**fields))  # type: ignore[arg-type]
                assert receive(bus) == packet
        bus.close()


class FaultyBus(can.BusABC):
    """A driver that does what the test says."""

    def __init__(self, **script: object) -> None:
        super().__init__(channel="")
        self.sent: list[can.Message] = []
        self.incoming: list[can.Message | Exception] = list(script.get("incoming", ()))  # type: ignore[call-overload]
        self.send_error = script.get("send_error")
        self.drained = threading.Event()  # and what came before is forwarded or dropped
        self.let_go = threading.Event()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.incoming:
            item = self.incoming.pop(0)
            if isinstance(item, Exception):
                raise item
            return item
        self.drained.set()
        self.let_go.wait(timeout)
        return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002 - its signature
        if isinstance(self.send_error, Exception):
            raise self.send_error
        self.sent.append(msg)

    def shutdown(self) -> None:
        self.let_go.set()
        super().shutdown()


@pytest.fixture
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(python_can, "_RECV_PAUSE_S", 0)


def wait_until_sent(bus: PythonCanInterface) -> None:
    """The outward thread has taken everything that was written: its end of the pair ends, then it."""
    bus._near.shutdown(socket.SHUT_WR)
    bus._threads[1].join(LIMIT_S)
    assert not bus._threads[1].is_alive()


@pytest.mark.usefixtures("no_pause")
class TestFaults:
    def test_bad_message_is_data(self) -> None:
        good = can.Message(arbitration_id=7, is_extended_id=False)
        bad: list[can.Message | Exception] = [ValueError("bad bytes"), can.CanOperationError("noise")]
        bus = PythonCanInterface("slcan", "x", FaultyBus(incoming=[*bad * 4, good, *bad * 4, good]))
        assert receive(bus) == frame(7)
        assert receive(bus) == frame(7)
        assert bus.dropped() == {"bus-recv-failed": 16}
        assert bus.failure is None
        bus.close()

    def test_ten_in_a_row_end_the_descriptor_and_say_why(self) -> None:
        good = can.Message(arbitration_id=7, is_extended_id=False)
        gone = OSError(errno.ENODEV, "No such device")
        bus = PythonCanInterface("gs_usb", "0", FaultyBus(incoming=[good, *[gone] * 10]))
        assert receive(bus) == frame(7)
        assert receive(bus) == b""
        assert isinstance(bus.failure, InterfaceError)
        assert str(bus.failure) == "gs_usb 0: [Errno 19] No such device"
        assert bus.failure.__cause__ is gone
        with pytest.raises(BrokenPipeError):
            os.write(bus.fd, frame(1))
        bus.close()

    def test_what_does_not_fit_is_counted(self, caplog: pytest.LogCaptureFixture) -> None:
        sent = 20_000
        driver = FaultyBus(incoming=[can.Message(arbitration_id=number) for number in range(sent)])
        bus = PythonCanInterface("virtual", "x", driver)
        assert driver.drained.wait(LIMIT_S)  # nobody reads the while
        received = []
        with contextlib.suppress(BlockingIOError):
            while True:
                received.append(os.read(bus.fd, 128))
        assert received == [frame(EFF | number) for number in range(len(received))]
        assert len(received) >= 100
        assert bus.dropped() == {"bus-pump-overflow": sent - len(received)}
        assert len(caplog.records) <= 5  # the 1st, 10th, 100th, ...
        assert "dropped reason=bus-pump-overflow bus=virtual x count=10 error=" in caplog.text
        bus.close()

    def test_refused_frames_are_counted(self, caplog: pytest.LogCaptureFixture) -> None:
        bus = PythonCanInterface("pcan", "x", FaultyBus(send_error=can.CanOperationError("queue full")))
        for _ in range(25):
            os.write(bus.fd, frame(1))
        wait_until_sent(bus)
        assert bus.dropped() == {"bus-send-failed": 25}
        counts = [record.getMessage() for record in caplog.records]
        assert counts == [
            f"dropped reason=bus-send-failed bus=pcan x count={count} error=queue full" for count in (1, 10)
        ]
        bus.close()

    def test_error_frames_go_to_software_buses_only(self) -> None:
        driver = FaultyBus()
        bus = PythonCanInterface("slcan", "x", driver)
        os.write(bus.fd, frame(ERR | 0x40, bytes(8)))
        os.write(bus.fd, frame(0x40))
        wait_until_sent(bus)
        assert [message.is_error_frame for message in driver.sent] == [False]
        assert bus.dropped() == {LOST_ERROR_FRAMES: 1}
        bus.close()

    def test_echoes_of_the_driver_are_left_out(self) -> None:
        echo = can.Message(arbitration_id=1, is_extended_id=False, is_rx=False)
        other = can.Message(arbitration_id=2, is_extended_id=False)
        bus = PythonCanInterface("gs_usb", "0", FaultyBus(incoming=[echo, other]))
        assert receive(bus) == frame(2)
        bus.close()


class TestOpenErrors:
    def test_unknown_interface(self) -> None:
        with pytest.raises(InterfaceError, match=r"knows no interface 'telepathy'; it knows .*pcan.*virtual"):
            open_interface("telepathy", "x", create=False, options={})

    def test_own_messages(self) -> None:
        with pytest.raises(InterfaceError, match="receive_own_messages would send every frame back"):
            open_interface("virtual", "x", create=False, options={"receive_own_messages": True})

    def test_a_driver_that_fails_half_way_leaves_nothing_behind(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        """Tried each second, it would complain each second, and keep what it had opened."""

        def refuse(*_arguments: object) -> None:
            raise OSError(errno.EADDRINUSE, "Address already in use")

        monkeypatch.setattr(udp_multicast.bus, "GeneralPurposeUdpMulticastBus", refuse)
        for _ in range(3):
            with pytest.raises(InterfaceError, match="already in use"):
                open_interface("udp_multicast", "239.74.163.2", create=False, options={})
        gc.collect()
        assert caplog.messages == []

    def test_driver_that_does_not_open(self) -> None:
        with pytest.raises(InterfaceError, match=r"^serial /dev/nothing: ") as caught:
            open_interface("serial", "/dev/nothing", create=False, options={})
        assert caught.value.__cause__ is not None

    def test_options_go_to_the_interface(self) -> None:
        bus = open_interface(
            "virtual", str(uuid.uuid4()), create=False, options={"rx_queue_size": 3, "bitrate": 125000}
        )
        assert isinstance(bus, PythonCanInterface)
        assert bus._bus.queue.maxsize == 3  # type: ignore[attr-defined]
        bus.close()
