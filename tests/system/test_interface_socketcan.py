"""The socketcan bus on a real kernel: vcan made and brought up, what comes in and what does not."""

from __future__ import annotations

import contextlib
import os
import pwd
import re
import select
import socket
import struct
import subprocess
import time
from typing import TYPE_CHECKING

import pytest

from bridged.errors import InterfaceError
from bridged.interfaces import open_interface

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bridged.interfaces.base import OpenInterface

LIMIT_S = 5.0
NAME = "bridgetest0"
EFF, RTR, ERR = 0x80000000, 0x40000000, 0x20000000


def missing() -> str:
    """What the tests need and this machine has not."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return f"no CAN in this kernel: {error.strerror}"
    return "" if os.geteuid() == 0 else "not root"


pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


def ip(*arguments: str) -> str:
    return subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True).stdout


@pytest.fixture
def absent() -> Iterator[str]:
    """A name that no interface has, whatever the test makes of it."""

    def remove() -> None:
        with contextlib.suppress(subprocess.CalledProcessError):
            ip("link", "del", NAME)

    remove()
    yield NAME
    remove()


@pytest.fixture
def vcan(absent: str) -> str:
    ip("link", "add", "dev", absent, "type", "vcan")
    ip("link", "set", absent, "up")
    return absent


def open_socketcan(channel: str, *, create: bool = False) -> OpenInterface:
    return open_interface("socketcan", channel, create=create, options={})


def other(channel: str) -> socket.socket:
    """Another program on the same bus."""
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    sock.settimeout(LIMIT_S)
    sock.bind((channel,))
    return sock


def frame(can_id: int, data: bytes = b"") -> bytes:
    return struct.pack("=IB3x8s", can_id, len(data), data)


def receive(bus: OpenInterface) -> bytes:
    assert select.select([bus.fd], [], [], LIMIT_S)[0], "nothing came"
    return os.read(bus.fd, 128)


class TestFrames:
    def test_both_ways(self, vcan: str) -> None:
        bus = open_socketcan(vcan)
        frames = [frame(0x123, b"12345678"), frame(EFF | 0x1FFFFFFF, b"\0"), frame(RTR | 0x7FF), frame(0)]
        with other(vcan) as program:
            for packet in frames:
                os.write(bus.fd, packet)
                assert program.recv(128) == packet  # loopback is on: others on this host see ours
            for packet in frames:
                program.send(packet)
                assert receive(bus) == packet  # and none of its own before
        with pytest.raises(BlockingIOError):
            os.read(bus.fd, 128)
        assert (bus.description, bus.warning, bus.failure) == (f"socketcan {vcan}", "", None)
        assert bus.dropped() == {"socket-overflow": 0}
        bus.close()
        bus.close()
        assert bus.fd == -1

    def test_what_is_not_forwarded_comes_in_to_be_counted(self, vcan: str) -> None:
        bus = open_socketcan(vcan)
        with other(vcan) as program:
            fd_frame = struct.pack("=IBB2x64s", 0x123, 64, 0x01, bytes(range(64)))
            program.send(fd_frame)
            got = receive(bus)
            assert (len(got), got[:5], got[8:]) == (72, fd_frame[:5], fd_frame[8:])
            for error_class in (1 << bit for bit in range(10)):
                program.send(frame(ERR | error_class, bytes(8)))
                assert receive(bus) == frame(ERR | error_class, bytes(8))
        bus.close()

    def test_own_error_frames_reach_others_only(self, vcan: str) -> None:
        bus = open_socketcan(vcan)
        with other(vcan) as program:
            program.setsockopt(socket.SOL_CAN_RAW, 2, 0x1FFFFFFF)  # CAN_RAW_ERR_FILTER
            os.write(bus.fd, frame(ERR | 0x40, bytes(8)))
            assert program.recv(128) == frame(ERR | 0x40, bytes(8))
        with pytest.raises(BlockingIOError):
            os.read(bus.fd, 128)
        bus.close()

    def test_time_stamp_and_lost_frames_come_along(self, vcan: str) -> None:
        bus = open_socketcan(vcan)
        with other(vcan) as program, socket.socket(fileno=os.dup(bus.fd)) as twin:
            before = time.time()
            program.send(frame(1))
            _, control, _, _ = twin.recvmsg(128, 256)
            after = time.time()
            stamps = [data for level, kind, data in control if (level, kind) == (socket.SOL_SOCKET, 35)]
            seconds, nanoseconds = struct.unpack("@ll", stamps[0])
            assert before <= seconds + nanoseconds * 1e-9 <= after
            # 4 MiB asked for, doubled by the kernel; then one frame more than fits
            assert twin.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == 8 << 20
            assert twin.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) == 8 << 20
            sent = 0
            while sent < 100_000:
                program.send(frame(sent))
                sent += 1
            received = 0
            with contextlib.suppress(BlockingIOError):
                while True:
                    twin.recv(128)
                    received += 1
            lost = bus.dropped()["socket-overflow"]
            print(f"receive buffer: {received} frames")
            assert received >= 8000
            assert received + lost == sent
        bus.close()


class TestInterface:
    def test_missing(self, absent: str) -> None:
        text = f"{absent}: there is no such interface .* `ip link add dev {absent} type vcan`"
        with pytest.raises(InterfaceError, match=text):
            open_socketcan(absent)
        ip("link", "add", "dev", absent, "type", "vcan")
        with pytest.raises(InterfaceError, match=rf"vcan99: .*CAN interfaces here: .*{absent}"):
            open_socketcan("vcan99")

    def test_create(self, absent: str) -> None:
        bus = open_socketcan(absent, create=True)
        assert bus.warning == ""
        details = ip("-details", "link", "show", absent)
        assert re.search(r"<NOARP,UP,LOWER_UP", details)
        assert "vcan" in details
        with other(absent) as program:
            program.send(frame(1))
            assert receive(bus) == frame(1)
        bus.close()
        assert absent in ip("link", "show")  # others may use it: it stays
        open_socketcan(absent, create=True).close()

    @pytest.mark.parametrize("name", ["bt0", "bt00", "bt000", "bt0000", "bridgetest00015"])
    def test_create_with_a_name_of_any_length(self, name: str) -> None:
        """Netlink pads names to 4 bytes."""
        try:
            open_socketcan(name, create=True).close()
        finally:
            ip("link", "del", name)

    def test_down(self, vcan: str) -> None:
        ip("link", "set", vcan, "down")
        bus = open_socketcan(vcan)
        assert f"{vcan} is down: ip link set {vcan} up" in bus.warning
        with pytest.raises(OSError, match="Network is down"):
            os.read(bus.fd, 128)  # said once, then there is just no frame
        with pytest.raises(BlockingIOError):
            os.read(bus.fd, 128)
        with pytest.raises(OSError, match="Network is down"):
            os.write(bus.fd, frame(1))
        ip("link", "set", vcan, "up")
        with other(vcan) as program:
            program.send(frame(1))
            assert receive(bus) == frame(1)  # it heals without being opened again
        bus.close()

    def test_down_with_create_comes_up(self, vcan: str) -> None:
        ip("link", "set", vcan, "down")
        bus = open_socketcan(vcan, create=True)
        assert bus.warning == ""
        os.write(bus.fd, frame(1))
        bus.close()

    @pytest.mark.parametrize("create", [False, True])
    def test_not_can(self, create: bool) -> None:
        with pytest.raises(InterfaceError, match=r"^lo: not a CAN interface \(CAN interfaces here: "):
            open_socketcan("lo", create=create)

    def test_leaks_no_socket(self, absent: str) -> None:
        before = sorted(os.listdir("/proc/self/fd"))  # noqa: PTH208 - names, not paths
        for name in (absent, "lo"):
            with pytest.raises(InterfaceError):
                open_socketcan(name)
        assert sorted(os.listdir("/proc/self/fd")) == before  # noqa: PTH208


class TestWithoutPrivileges:
    @pytest.fixture
    def nobody(self) -> Iterator[None]:
        uid = os.geteuid()
        os.seteuid(pwd.getpwnam("nobody").pw_uid)
        yield
        os.seteuid(uid)

    @pytest.fixture
    def down(self, vcan: str) -> str:
        ip("link", "set", vcan, "down")
        return vcan

    @pytest.mark.usefixtures("nobody")
    def test_create(self) -> None:
        with pytest.raises(InterfaceError, match="creating it needs CAP_NET_ADMIN: `can-bridge interface"):
            open_socketcan("bridgetest1", create=True)

    def test_bring_up(self, down: str, nobody: None) -> None:  # noqa: ARG002 - in this order
        with pytest.raises(InterfaceError, match=f"CAP_NET_ADMIN: `ip link set {down} up` as root"):
            open_socketcan(down, create=True)

    def test_open(self, vcan: str, nobody: None) -> None:  # noqa: ARG002 - in this order
        """No privilege is needed for an interface that is there; the buffers are as large as is allowed."""
        bus = open_socketcan(vcan, create=True)
        os.write(bus.fd, frame(1))
        bus.close()
