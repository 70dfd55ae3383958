"""A port that stays open between two tries, as long as its device may stand in the middle of a frame.

Some devices know the end of a message by its length only. One that stops reading in the middle of a frame,
and reads on after its port was opened anew, would fill that frame with the bytes of our first command, and
put it on its CAN bus. What the kernel and the FTDI chip hold is thrown away when a port is closed and opened,
and nobody can tell how much that was: so the rest of the frame is not known then. An open port keeps it, and
the device gets the frame whole, if late.
"""

from __future__ import annotations

import fcntl
import logging
import select
import struct
import termios
import time
from typing import TYPE_CHECKING, Final

from bridged.bridge.log_limiter import LogLimiter, repeated

if TYPE_CHECKING:
    from bridged import _relay
    from bridged.ports import Port

log = logging.getLogger(__name__)

# Tries on a port in which no byte waits. An FT245 takes 128 bytes from the kernel that the device may not yet
# have read; each try sends 47. So where no byte waits after these tries, the device has read the frame.
TRIES: Final = 3

_INT: Final = struct.Struct("=i")
_GONE: Final = select.POLLHUP | select.POLLRDHUP | select.POLLERR | select.POLLNVAL


class KeptPort:
    """Closes the port of a bridge, or keeps it for the next try; what is kept is closed by close()."""

    def __init__(self, relay: _relay.Relay) -> None:
        self._relay = relay
        self._port: Port | None = None
        self._message, self._taken = b"", 0  # what the port took a part of
        self._unread = False  # frames, since the adapter ran last
        self._tries = 0
        self._log_limiter = LogLimiter()

    def release(self, port: Port) -> None:
        """After the relay's detach_port()."""
        unread, self._message, self._taken = self._relay.cut()
        self._unread = self._unread or unread
        if not self._unread:
            port.close()
            return
        self._port = port
        self._tries += 1
        if _is_gone(port):
            self._give_up("its port was lost")
        elif self._message or _holds_bytes(port):
            self._tell(
                "the adapter reads no more: its port stays open, and it gets the rest of its frame first"
            )
        elif self._tries > TRIES:
            self._give_up("it does not answer, though it seems to read")

    def take(self) -> Port | None:
        """The port, for the next try; None: it has to be opened."""
        if self._port is not None and _is_gone(self._port):
            self._give_up("it was away meanwhile")
        port, self._port = self._port, None
        return port

    def put_back(self, port: Port) -> None:
        """Where attach_port() failed: closes the port, or keeps it as it was for the next try."""
        if self._unread:
            self._port = port
        else:
            port.close()

    def resume(self) -> None:
        """After the relay's attach_port()."""
        if self._message:
            self._relay.resume(self._message, self._taken)

    def runs(self) -> None:
        """The adapter has read and answered everything."""
        self._message, self._taken = b"", 0
        self._unread = False
        self._tries = 0
        self._log_limiter.recovered()

    def take_over(self, other: KeptPort) -> None:
        """Takes over what another bridge has kept."""
        self._port, other._port = other._port, None
        self._message, self._taken = other._message, other._taken
        self._unread, self._tries = other._unread, other._tries

    def close(self) -> None:
        """Idempotent. Nobody can give the device the rest after this, so the user is told what to do."""
        if self._port is not None:
            self._tell(
                "the adapter may not have read its last frames whole (counted as unanswered): unplug it and "
                "plug it in again before it is used anew, or it may send one of them with other bytes in it"
            )
            self._drop()

    def _give_up(self, why: str) -> None:
        self._tell(f"it is not known whether the adapter sent its last frames (counted as unanswered): {why}")
        self._drop()
        self.runs()

    def _drop(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    def _tell(self, text: str) -> None:
        times = self._log_limiter.should_log(text, time.monotonic())
        if times:
            log.warning("%s%s", text, repeated(times))


def _is_gone(port: Port) -> bool:
    poll = select.poll()
    poll.register(port.fd, select.POLLRDHUP)
    return any(events & _GONE for _, events in poll.poll(0))


def _holds_bytes(port: Port) -> bool:
    """Whether bytes wait in the kernel that the device, or the thread of a pump, has not taken."""
    try:
        (waiting,) = _INT.unpack(fcntl.ioctl(port.fd, termios.TIOCOUTQ, _INT.pack(0)))
    except OSError:
        return False
    return bool(waiting)
