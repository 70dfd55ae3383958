"""Where a simulated adapter ends: on a terminal or socket that is there, on a CAN interface."""

import errno
import os
import socket
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from benches.simulating import (
    TIMEOUT_S,
    ask,
    by_hand,
    count_calls,
    read,
    running,
    until,
)

from bridged.errors import InterfaceError, PortError
from bridged.simulators.can232 import Can232
from bridged.simulators.ends import LineEnd, open_can
from bridged.simulators.serve import Simulator


@pytest.mark.parametrize(
    ("at", "code", "text"),
    [
        ("__init__", errno.EAFNOSUPPORT, r"has no SocketCAN: try `modprobe can_raw`"),
        (
            "bind",
            errno.ENODEV,
            "vcan7: there is no such interface: `ip link add dev vcan7 type vcan; ip link set",
        ),
        ("bind", errno.EPERM, "vcan7: cannot be opened as a CAN interface: Operation not permitted"),
    ],
)
def test_a_bus_that_cannot_be_had(monkeypatch: pytest.MonkeyPatch, at: str, code: int, text: str):
    class Refusing:
        def __init__(self, *_: object) -> None:
            self.bind = self.close = lambda *_: None
            if at == "__init__":
                raise OSError(code, os.strerror(code))
            self.bind = self.refuse

        def refuse(self, _: object) -> None:
            raise OSError(code, os.strerror(code))

    monkeypatch.setattr(socket, "socket", Refusing)
    with pytest.raises(InterfaceError, match=text):
        open_can("vcan7")


def test_a_terminal_that_is_there_is_the_line(tmp_path: Path):
    path = tmp_path / "line"
    masters = []
    for _ in range(2):
        master, slave = os.openpty()
        tty.setraw(slave)
        masters.append((master, slave, os.ttyname(slave)))
    (master, slave, name), (other_master, other_slave, other_name) = masters
    path.symlink_to(name)
    simulator = Simulator(Can232(time.monotonic()), line=str(path))
    os.close(slave)
    turns, looks = count_calls(simulator, "_turn"), count_calls(simulator._host, "reconnect")
    with running(simulator):
        ask(master, b"S4\r", b"\r")
        os.close(master)
        until(lambda: len(looks) > 3)
        assert len(turns) < 100  # neither spins nor crashes
        new_master, new_slave = os.openpty()
        assert os.ttyname(new_slave) != name  # so nobody else's terminal is taken for the line
        path.unlink()
        path.symlink_to(other_name)
        ask(other_master, b"O\r", b"\r")  # what has come before we look is not lost
    for fd in (other_master, other_slave, new_master, new_slave):
        os.close(fd)


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as ours:
        ours.bind(f"{tmp_path}/socket")
        ours.settimeout(TIMEOUT_S)
        yield ours


def test_a_socket_is_connected_to_as_often_as_it_has_to(listener: socket.socket):
    simulator, clock = by_hand(None, "unplug@1+1", line=f"unix:{listener.getsockname()}")
    looks = count_calls(simulator._host, "reconnect")
    with running(simulator):
        until(lambda: looks)  # nobody has listened yet
        listener.listen()
        clock.set(0.5)
        with listener.accept()[0] as first:
            ask(first.fileno(), b"S4\r", b"\r")
        with listener.accept()[0] as second:
            ask(second.fileno(), b"O\r", b"\r")  # the device kept its bit rate
            clock.set(1)
            assert read(second.fileno(), 1) == b""  # unplugged
        clock.set(2)
        with listener.accept()[0] as third:
            ask(third.fileno(), b"O\rV\r", b"\aV1324\r")  # it had no power


def test_no_line_is_an_error(tmp_path: Path):
    (tmp_path / "file").touch()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"{tmp_path}/socket")
        for line in ("nothing", "file", "socket"):
            with pytest.raises(PortError, match=line):
                Simulator(Can232(), line=f"{tmp_path}/{line}")
    with pytest.raises(PortError, match="too long"):
        LineEnd(f"unix:/{'long' * 50}").open()
