"""Device events, as the kernel and udev write them."""

from __future__ import annotations

import contextlib
import select
import socket

import pytest
from benches.machine import kernel_event, udev_event

from bridged.ports.uevents import Uevents, open_socket


def read(*events: bytes) -> tuple[list[dict[str, str]], bool]:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setblocking(False)
    with far, contextlib.closing(Uevents(near)) as uevents:
        for event in events:
            far.send(event)
        return uevents.read()


def test_both_senders() -> None:
    wanted = {"ACTION": "add", "DEVPATH": "/d", "X": "a=b", "EMPTY": ""}
    assert read(kernel_event(**wanted), udev_event(**wanted)) == ([wanted, wanted], False)
    assert read() == ([], False)


@pytest.mark.parametrize(
    "junk",
    [
        b"\0\0",
        b"libudev\0",
        b"libudev\0" + bytes(16),
        b"libudev\0" + b"\xff" * 40,
        b"\xff",
    ],
)
def test_junk_has_no_properties(junk: bytes) -> None:
    assert read(junk) == ([{}], False)


def test_a_real_socket_is_silent_unless_it_listens() -> None:
    events = open_socket()
    if events is None:
        pytest.skip("no AF_NETLINK here")
    with contextlib.closing(Uevents(events)) as uevents:
        uevents.listen(True)
        uevents.listen(True)
        uevents.read()
        uevents.listen(False)
        uevents.read()
        assert not select.select([uevents], [], [], 0)[0]
