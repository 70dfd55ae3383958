"""The pump between a descriptor and a driver: it ends quickly, also when the driver is stuck."""

from __future__ import annotations

import errno
import os
import select
import socket
import threading
import time

import pytest

from bridged.errors import PortError
from bridged.ports import open_port
from bridged.ports.pump import Pump

LIMIT_S = 30.0  # for what takes milliseconds


class StuckPump(Pump):
    """A driver that hangs in every call."""

    error = PortError

    def __init__(self) -> None:
        super().__init__("stuck", socket.SOCK_STREAM)
        self.freed = threading.Event()
        self.start()

    def _inward(self) -> None:
        self.freed.wait()

    _outward = _release = _inward


class TalkativePump(Pump):
    """A device that sends more than anybody reads."""

    error = PortError

    def __init__(self) -> None:
        super().__init__("talkative", socket.SOCK_STREAM)
        self.start()

    def _inward(self) -> None:
        self._far.sendall(bytes(1 << 24))

    def _outward(self) -> None:
        self._far.recv(1)

    def _release(self) -> None:
        pass


class TestPump:
    def test_close_while_nobody_reads(self) -> None:
        pump = TalkativePump()
        assert select.select([pump.fd], [], [], LIMIT_S)[0]
        start = time.monotonic()
        pump.close()
        assert time.monotonic() - start < 15.0  # it does not hang; how fast it is, is no matter for a test
        assert not any(thread.is_alive() for thread in pump._threads)
        assert pump.failure is None

    def test_close_gives_up_on_a_stuck_driver(
        self, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        monkeypatch.setattr("bridged.ports.pump.JOIN_LIMIT_S", 0.02)
        stuck = StuckPump()
        far = stuck._far.fileno()
        start = time.monotonic()
        stuck.close()
        assert time.monotonic() - start < 15.0  # it does not hang; how fast it is, is no matter for a test
        assert "stuck pump=stuck threads=" in caplog.text
        os.fstat(far)  # still its own: a thread in a driver may yet write to that number
        stuck.freed.set()
        for thread in stuck._threads:
            thread.join(LIMIT_S)
        stuck._far.close()

    def test_device_that_fails_to_close_is_only_logged(self, caplog: pytest.LogCaptureFixture) -> None:
        port = open_port("loop://", 57600)

        def fail() -> None:
            raise OSError(errno.EIO, "Input/output error")

        device = port._device  # type: ignore[attr-defined]
        device.close = fail
        port.close()
        type(device).close(device)
        assert "close-failed pump=loop:// error=[Errno 5]" in caplog.text
