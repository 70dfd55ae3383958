"""The two ends of a simulated adapter here: a terminal or socket for its host, a CAN socket for its bus.

None ever blocks: what an end does not take is kept up to a bound, then lost and counted.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import struct
import termios
import time
import tty
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from bridged.errors import GET_CAN, NO_CAN, InterfaceError, PortError
from bridged.simulators.sja1000 import Frame

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

HOST_BUFFER = 16_384  # characters kept for a host that does not read, beyond what the kernel holds
UNIX = "unix:"  # before the path of a socket
NOBODY_YET = (FileNotFoundError, ConnectionRefusedError, BlockingIOError)  # who listens has not begun to
PTY_SLAVES = range(136, 144)  # major numbers
BUS_BUFFER = 4096  # frames kept for a bus that does not take them
BUS_BATCH = 64  # frames read in one turn
RECEIVE_BUFFER = 8 << 20  # bytes
SO_RCVBUFFORCE = 33  # asm-generic/socket.h; Python has no names for these
SO_TIMESTAMPNS = 35

CAN_FRAME = struct.Struct("=IB3x8s")  # struct can_frame
EXTENDED = 0x80000000
REMOTE = 0x40000000
ERROR = 0x20000000
TIMESPEC = struct.Struct("@ll")


def pack(frame: Frame) -> bytes:
    """A frame as `struct can_frame`."""
    flags = EXTENDED * frame.extended | REMOTE * frame.remote
    return CAN_FRAME.pack(frame.can_id | flags, frame.dlc, frame.data)


def unpack(raw: bytes) -> Frame | None:
    """A frame from `struct can_frame`; None for error frames and anything else."""
    if len(raw) != CAN_FRAME.size:
        return None
    can_id, dlc, data = CAN_FRAME.unpack(raw)
    if can_id & ERROR or dlc > 8:
        return None
    extended = bool(can_id & EXTENDED)
    remote = bool(can_id & REMOTE)
    can_id &= 0x1FFFFFFF if extended else 0x7FF
    return Frame(can_id, extended, remote, dlc, b"" if remote else data[:dlc])


def open_can(interface: str) -> socket.socket:
    """A raw socket on a SocketCAN interface; InterfaceError if there is none."""
    try:
        bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise InterfaceError(f"{NO_CAN}: {GET_CAN}") from error
    try:
        bus.bind((interface,))
    except OSError as error:
        bus.close()
        if error.errno == errno.ENODEV:
            make = f"`ip link add dev {interface} type vcan; ip link set {interface} up` makes one"
            raise InterfaceError(f"{interface}: there is no such interface: {make}") from error
        raise InterfaceError(f"{interface}: cannot be opened as a CAN interface: {error.strerror}") from error
    try:
        bus.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER)
    except PermissionError:
        bus.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    return bus


class HeldUp:
    """How long in seconds this thread was ready to run and had no processor; 0 if the kernel does not tell.

    That, too, is the simulator's delay and not the host's (see `uart`). Call it in the thread that made it.
    """

    def __init__(self) -> None:
        self._fd = -1
        with contextlib.suppress(OSError):
            self._fd = os.open("/proc/thread-self/schedstat", os.O_RDONLY)

    def __call__(self) -> float:
        return int(os.pread(self._fd, 64, 0).split()[1]) * 1e-9 if self._fd >= 0 else 0.0

    def __del__(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)


class BusEnd:
    """A datagram socket that carries `struct can_frame`: AF_CAN, or one of a socket pair; not closed here."""

    def __init__(self, bus: socket.socket) -> None:
        self.socket = bus
        self.gone = False  # the other end of a socket pair was closed
        self.lost = 0  # frames that the bus did not take
        self.errors = 0  # of sending and receiving, other than "not now"
        self.ignored = 0  # error frames and the like
        self.waiting: deque[bytes] = deque()
        bus.setblocking(False)
        with contextlib.suppress(OSError):  # not every kind of socket has it
            bus.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def fileno(self) -> int:
        """For select()."""
        return self.socket.fileno()

    def read(self) -> Iterator[tuple[float, Frame]]:
        """What is there, at most BUS_BATCH frames; with how long ago, in seconds, if the kernel knows."""
        for _ in range(BUS_BATCH):
            try:
                raw, ancillary, _, _ = self.socket.recvmsg(CAN_FRAME.size, 64)
            except BlockingIOError:
                return
            except OSError:  # ENETDOWN once when the interface goes down
                self.errors += 1
                return
            age_s = 0.0
            for level, kind, value in ancillary:
                if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
                    seconds, nanoseconds = TIMESPEC.unpack(value)
                    age_s = max(0.0, time.time() - seconds - nanoseconds / 1e9)
            frame = unpack(raw)
            if frame is not None:
                yield age_s, frame
            elif raw:
                self.ignored += 1
            else:
                self.gone = True
                return

    def write(self, frames: Iterable[Frame]) -> None:
        """Put frames on the bus, after those that are waiting."""
        waiting = self.waiting
        waiting.extend(map(pack, frames))
        while waiting:
            try:
                self.socket.send(waiting[0])
            except BlockingIOError:
                break
            except OSError:  # ENOBUFS, ENETDOWN: nobody hears it
                self.errors += 1
                self.lost += 1
            waiting.popleft()
        while len(waiting) > BUS_BUFFER:
            waiting.pop()
            self.lost += 1


class HostEnd:
    """An open descriptor that leads to the host; -1 while there is no host."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.lost = 0  # characters for a host that did not read
        self.waiting = bytearray()
        self._fd = -1

    def fileno(self) -> int:
        """For select(), if there is a host."""
        return self._fd

    @property
    def connected(self) -> bool:
        """Whether there is a host; if not, `reconnect` may find one."""
        return self._fd >= 0

    def reconnect(self) -> bool:
        """Look once whether there is a host again."""
        return self.connected

    def read(self, limit: int) -> bytes:
        """What the host wrote, at most `limit` bytes."""
        try:
            data = os.read(self._fd, limit)
        except BlockingIOError:
            return b""
        except OSError:  # EIO of a terminal, ECONNRESET of a socket
            data = b""
        if not data:
            self._hang_up()
        return data

    def write(self, data: bytes) -> None:
        """Give the host characters, after those that are waiting."""
        waiting = self.waiting
        waiting += data
        if waiting and self.connected:
            try:
                del waiting[: os.write(self._fd, waiting)]
            except BlockingIOError:
                pass
            except OSError:
                self._hang_up()
        kept = HOST_BUFFER if self.connected else 0
        if len(waiting) > kept:
            self.lost += len(waiting) - kept
            del waiting[kept:]

    def close(self) -> None:
        """Hang up."""
        if self.connected:
            os.close(self._fd)
            self._fd = -1

    def _hang_up(self) -> None:
        """The host has gone."""
        self.lost += len(self.waiting)
        self.waiting.clear()
        HostEnd.close(self)


class PtyEnd(HostEnd):
    """A raw pty, with a symbolic link to it if wanted.

    Its slave is held open, so that a host may come and go. PortError if it cannot be made.
    """

    def __init__(self) -> None:
        try:
            master, self._slave = os.openpty()
        except OSError as error:
            raise PortError(f"no pseudo terminal: {error.strerror}") from error
        super().__init__(os.ttyname(self._slave))
        self._fd = master
        tty.setraw(self._slave)
        os.set_blocking(master, False)
        self._link: Path | None = None

    def link(self, link: Path) -> None:
        """Point a symbolic link to the terminal, atomically; PortError if something else is in its place."""
        try:
            if link.exists() and not link.is_symlink():
                raise PortError(f"{link} exists and is no symbolic link: choose another --link")
            new = link.with_name(f".{link.name}.{os.getpid()}")
            new.symlink_to(self.name)
            new.replace(link)
        except OSError as error:
            raise PortError(f"{link}: cannot be made: {error.strerror}") from error
        self._link = link

    def close(self) -> None:
        """Hang up, and remove the link if it is still ours."""
        if self._link:
            with contextlib.suppress(OSError):
                if str(self._link.readlink()) == self.name:
                    self._link.unlink()
        os.close(self._slave)
        super().close()


class LineEnd(HostEnd):
    """A line that somebody else has made: a character device, or `unix:PATH`, a stream socket that listens.

    Not open at first. For one who hangs up and comes again, or who begins to listen later, use `reconnect`.
    """

    def __init__(self, line: str) -> None:
        super().__init__(line)
        self._held = -1

    def open(self) -> None:
        """The first time; PortError if this cannot be a line, whoever is at its other end."""
        line = self.name
        try:
            self._open()
        except NOBODY_YET as error:
            if not line.startswith(UNIX):
                raise PortError(f"{line}: {error.strerror}") from error
        except OSError as error:
            raise PortError(f"{line}: cannot be used as a line: {error.strerror or error}") from error

    def reconnect(self) -> bool:
        """Look once whether the other end is there again."""
        if not self.connected:
            with contextlib.suppress(OSError):
                self._open()
        return self.connected

    def close(self) -> None:
        """Hang up."""
        super().close()
        self._let_go()

    def _open(self) -> None:
        if self.name.startswith(UNIX):
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
                line.setblocking(False)
                line.connect(self.name.removeprefix(UNIX))
                self._fd = line.detach()
        else:
            self._fd = _open_terminal(self.name)
        self._let_go()

    def _hang_up(self) -> None:
        if os.major(os.fstat(self._fd).st_rdev) in PTY_SLAVES:
            # Until it is closed, no other terminal gets its name, which we might open in its place.
            self._held = os.dup(self._fd)
        super()._hang_up()

    def _let_go(self) -> None:
        if self._held >= 0:
            os.close(self._held)
            self._held = -1


def _open_terminal(path: str) -> int:
    """A character device; if it is a terminal, raw, with the rate that it has. OSError if it is none."""
    if not stat.S_ISCHR(Path(path).stat().st_mode):
        raise OSError(errno.ENODEV, f"no character device; for a socket write {UNIX}{path}")
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if os.isatty(fd):
            tty.setraw(fd, termios.TCSANOW)  # drops nothing that has come, and does not wait
            attributes = termios.tcgetattr(fd)
            attributes[2] |= termios.CLOCAL | termios.CREAD
            termios.tcsetattr(fd, termios.TCSANOW, attributes)
    except termios.error as error:
        os.close(fd)
        raise OSError(*error.args) from error
    return fd
