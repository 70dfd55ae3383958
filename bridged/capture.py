r"""Every byte between a bridge and its adapter in a file, for bug reports: text to be read and mailed.

    # can-bridge-capture version=0.1.0 type=TYPE bitrate=125000 listen_only=no window=1 masked=no …
    # 0.012345 opened
    0.012811 > V\r
    0.014902 < V1013\r
    # 7.310022 lost: Input/output error
    # 7.312904 closed

Seconds since the start; `>` to the adapter, `<` from it; bytes as Python writes them, a space as \x20. A last
line without a line feed was not finished: the bridge was killed.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import threading
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from msgspec.structs import asdict

from bridged import VERSION
from bridged.adapters.masks import MASKS, MaskedIds
from bridged.errors import PortError
from bridged.ports import open_port as open_any_port
from bridged.ports.pump import POLL_INTERVAL_S, Pump

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from bridged.ports import Port
    from bridged.settings import Config

TO_ADAPTER: Final = ">"
FROM_ADAPTER: Final = "<"
LIMIT_MB: Final = 16
MB: Final = 1_000_000
_LINE: Final = 128  # bytes of the adapter in one line of the file: mail programs cut those of 998 characters
_BLOCK: Final = 4096
_POLL_INTERVAL_MS: Final = round(POLL_INTERVAL_S * 1000)
# What waits between the relay and the port grows old: room for some twenty small writes.
_SEND_BUFFER: Final = 8192
_PRIVATE: Final = ("type", "port", "serial_number")  # of section adapter: where it is, and which one

log = logging.getLogger(__name__)


def escaped(data: bytes) -> str:
    r"""`t123\r` for these five bytes."""
    return "".join(_ESCAPED[byte] for byte in data)


_ESCAPED: Final = [
    chr(byte) if 0x20 < byte < 0x7F and chr(byte) != "\\" else repr(bytes((byte,)))[2:-1]
    for byte in range(256)
]
_ESCAPED[0x20] = "\\x20"  # mail programs cut spaces off


def _settings(config: Config) -> str:
    """What of the configuration shows on the line."""
    timing = config.channel.timing
    found: dict[str, object] = {"type": config.adapter.type}
    found |= {key: value for key, value in asdict(config.adapter).items() if key not in _PRIVATE}
    found["bitrate"] = timing.bitrate
    if timing.registers:
        found |= dict(zip(("btr0", "btr1"), timing.registers, strict=True))
    found["listen_only"] = "yes" if config.channel.listen_only else "no"
    found["window"] = config.transmit.window
    return " ".join(
        f"{key}={escaped(str(value).encode())}" for key, value in found.items() if value is not None
    )


class Capture:
    """A capture file, made anew, for all ports that one process opens one after the other.

    `masked`: identifiers and data become others, see adapters/masks.py. When the file has `limit` bytes, or
    cannot be written, the capture ends, and nothing else. PortError if there is such a file, or it cannot be
    made.
    """

    def __init__(
        self,
        path: Path,
        config: Config,
        *,
        masked: bool = False,
        limit: int = LIMIT_MB * MB,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.ids = MaskedIds() if masked else None
        self.lock = (
            threading.RLock()
        )  # held from a write until it is noted: no answer stands before its question
        self._path = path
        self._left = limit
        self._clock = clock
        self._started = clock()
        self._settings = _settings(config)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        try:
            self._fd = os.open(path, flags, 0o600)
        except FileExistsError:
            raise PortError(f"{path}: there is such a file: choose another name for the capture") from None
        except OSError as error:
            raise PortError(f"{path}: the capture cannot be written there: {error.strerror}") from error
        started = datetime.now(UTC).isoformat(timespec="seconds")
        mask = "yes" if masked else "no"
        self._write(
            f"# can-bridge-capture version={VERSION} {self._settings} masked={mask} started={started}\n"
        )

    def opener(
        self, config: Config, open_port: Callable[[str, int], Port] = open_any_port
    ) -> Callable[[str, int], Port]:
        """As `open_port`, for the bridge of `config`; what goes through that port is in the file."""

        def open_captured(name: str, baudrate: int) -> Port:
            port = open_port(name, baudrate)
            with self.lock:
                settings = _settings(config)
                if settings != self._settings:  # the configuration was reloaded
                    self._settings = settings
                    self.event(f"settings {settings}")
                self.event(f"opened product={escaped(port.product.encode())}" if port.product else "opened")
            return CapturedPort(port, self, config.adapter.type)

        return open_captured

    def event(self, text: str) -> None:
        """What befell the port."""
        with self.lock:
            self._write(f"# {self._elapsed()} {text}\n")

    def note(self, way: str, data: bytes) -> None:
        """Bytes TO_ADAPTER or FROM_ADAPTER."""
        with self.lock:
            elapsed = self._elapsed()
            pieces = (data[at : at + _LINE] for at in range(0, len(data), _LINE))
            self._write("".join(f"{elapsed} {way} {escaped(piece)}\n" for piece in pieces))

    def close(self) -> None:
        """Idempotent."""
        with self.lock:
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1

    def _elapsed(self) -> str:
        return f"{self._clock() - self._started:.6f}"

    def _write(self, text: str) -> None:
        """At once, so that the file can be used whenever the bridge is killed."""
        if self._fd < 0:
            return
        self._left -= len(text)
        if self._left < 0:
            text = f"# {self._elapsed()} the file has reached its limit\n"
            log.warning("capture %s has reached its limit and ends; the bridge goes on", self._path)
        try:
            if os.write(self._fd, text.encode()) < len(text):
                self._left = -1
                log.warning("capture %s ends, its disk is full; the bridge goes on", self._path)
        except OSError as error:
            self._left = -1
            log.warning("capture %s ends: %s; the bridge goes on", self._path, error.strerror)
        if self._left < 0:
            self.close()


class CapturedPort(Pump):
    """A port whose bytes are noted on their way between its descriptor and the one that the relay gets."""

    error = PortError

    def __init__(self, port: Port, capture: Capture, type_: str) -> None:
        super().__init__(port.description, socket.SOCK_STREAM)
        self.serial_number = port.serial_number
        self.product = port.product
        self._port = port
        self._line = _Line(capture, type_)
        self._near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self.start()

    def _inward(self) -> None:
        fd = self._port.fd
        ready = select.poll()
        ready.register(fd, select.POLLIN)
        while not self._stopping.is_set():
            if not ready.poll(_POLL_INTERVAL_MS):
                continue
            try:
                data = os.read(fd, _BLOCK)
            except BlockingIOError:
                continue
            except OSError as error:
                self._lose(error)
                return
            if not data:
                self._lose(None)
                return
            self._line.note(FROM_ADAPTER, data)
            self._far.sendall(data)

    def _outward(self) -> None:
        """What the port does not take stays in the socket pair, where others can see that it waits."""
        fd = self._port.fd
        ready = select.poll()
        ready.register(fd, select.POLLOUT)
        while data := self._far.recv(_BLOCK, socket.MSG_PEEK):
            if not ready.poll(_POLL_INTERVAL_MS):
                if self._stopping.is_set():
                    return
                continue
            try:
                taken = self._line.move(fd, data)
            except OSError as error:
                self._lose(error)
                return
            if taken:
                self._far.recv(taken)

    def _lose(self, error: OSError | None) -> None:
        """As the relay would say it of the port itself."""
        if self._stopping.is_set() or self.failure is not None:
            return
        self.failure = self._port.failure
        if self.failure is None and error is not None:
            self.failure = PortError(error.strerror)
            self.failure.__cause__ = error
        self._line.event(f"lost: {self.failure or 'end of file'}")

    def _release(self) -> None:
        self._port.close()
        self._line.event("closed")


class _Line:
    """Both directions of one port, masked if the capture is."""

    def __init__(self, capture: Capture, type_: str) -> None:
        self._capture = capture
        ids = capture.ids
        self._masks = {way: MASKS[type_](ids) for way in (TO_ADAPTER, FROM_ADAPTER)} if ids else {}

    def note(self, way: str, data: bytes) -> None:
        mask = self._masks.get(way)
        self._capture.note(way, mask.feed(data) if mask else data)

    def move(self, fd: int, data: bytes) -> int:
        """Writes to the port, which does not block; how many bytes it took."""
        with self._capture.lock:
            try:
                taken = os.write(fd, data)
            except BlockingIOError:
                return 0
            self.note(TO_ADAPTER, data[:taken])
            return taken

    def event(self, text: str) -> None:
        with self._capture.lock:
            for way, mask in self._masks.items():
                self._capture.note(way, mask.flush())
            self._capture.event(text)
