"""Serial ports: a tty, a TCP connection to a serial server, or any other pyserial URL."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import socket
import stat
import struct
import termios
import threading
from pathlib import Path
from typing import Any, Final

import serial

from bridged.errors import BridgeError, NotPermittedError, PortError
from bridged.ports import sysfs
from bridged.ports.names import PortName
from bridged.ports.permission import explain_forbidden, explain_refused, in_container
from bridged.ports.pump import POLL_INTERVAL_S, Pump

_log = logging.getLogger(__name__)

_DEV: Final = Path("/dev")

_BAUDRATE_TOLERANCE: Final = 0.03  # an 8N1 receiver bears about 5 % between both ends
_TCGETS2: Final = 0x802C542A  # asm-generic/ioctls.h: the speed in bit/s, where termios knows named rates only
_TERMIOS2: Final = struct.Struct("=IIIIB19sII")  # ..., c_ispeed, c_ospeed (asm-generic/termbits.h)

_OWN_TERMINAL: Final = os.makedev(5, 0)  # /dev/tty: another name for the controlling terminal

_INT: Final = struct.Struct("=i")
_LINGER: Final = struct.Struct("=ii")

_CLOSE_LIMIT_S: Final = 0.5
_CONNECT_LIMIT_S: Final = 5.0
# A peer that vanishes without a word is noticed after 10 s: silence and 3 probes, or data unacknowledged.
_TCP_OPTIONS: Final = (
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 4),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 2),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
    (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 10_000),  # ms
)
_BLOCK: Final = 4096
_BACKLOG_MAX: Final = 1_000_000  # bytes of a pumped port that were not read yet: a fast line's of 2 seconds


def open_serial(name: PortName, baudrate: int) -> TtyPort | TcpPort | PumpedPort:
    """Open a path (`/dev/ttyUSB0`, a pty) or a URL (`socket://host:port`, `rfc2217://host:port`), 8N1.

    `usb-serial://SERIAL` is the path of the tty that the USB device with this serial number has now.
    `baudrate` in bit/s; socket:// has none. Raises PortError.
    """
    if name.scheme == "socket":
        return TcpPort(name)
    if name.scheme == "usb-serial":
        name = PortName(_tty_path(name))
    port = name.text
    if baudrate <= 0:
        raise PortError(f"{port}: baudrate {baudrate} must be above 0")
    if name.path:
        _refuse_terminal(port)
    try:
        # Any: the stub promises serial.Serial whatever the URL.
        device: Any = serial.serial_for_url(port, baudrate=baudrate, exclusive=True, timeout=POLL_INTERVAL_S)
    except (OSError, ValueError, OverflowError, termios.error) as error:
        raise _error(port, baudrate, error) from error
    if isinstance(device, serial.Serial):  # a path; hwgrep:// and alt:// end in a tty, too
        return TtyPort(port, baudrate, device)
    return PumpedPort(port, device)


class TtyPort:
    """A tty of this machine, locked against other programs that lock."""

    def __init__(self, description: str, baudrate: int, device: serial.Serial) -> None:
        self.description = description
        self.failure: BridgeError | None = None  # never set: read() tells
        self._device = device
        self.fd = device.fileno()
        try:
            _make_raw(self.fd)
            actual = _actual_baudrate(self.fd)
        except (OSError, termios.error) as error:
            self.close()
            raise _error(description, baudrate, error) from error
        if abs(actual - baudrate) > baudrate * _BAUDRATE_TOLERANCE:
            self.close()
            raise PortError(f"{description}: the driver cannot do {baudrate} Bd, it chose {actual} Bd")
        with contextlib.suppress(OSError, ValueError):  # most drivers do not know it
            device.set_low_latency_mode(True)
        directory = sysfs.tty_directory(self.fd)
        self.serial_number = sysfs.serial_number(directory) if directory else None
        self.product = sysfs.product(directory) if directory else None
        latency_ms = sysfs.latency_ms(directory) if directory else None
        if latency_ms is not None and latency_ms > 1:
            _log.warning("latency port=%s timer_ms=%d: each answer comes late", description, latency_ms)

    def close(self) -> None:
        if self.fd < 0:
            return
        fd, self.fd = self.fd, -1
        with contextlib.suppress(termios.error):
            termios.tcflush(fd, termios.TCIOFLUSH)
        # ftdi_sio throws no bytes away: the kernel waits for the device to take them, 30 s (closing_wait).
        # A thread that waits so ends with the process, at once.
        thread = threading.Thread(target=self._device.close, name=f"close {self.description}", daemon=True)
        thread.start()
        thread.join(_CLOSE_LIMIT_S)
        if thread.is_alive():
            _log.warning("port=%s is still being closed: its device takes no bytes", self.description)


class TcpPort:
    """A serial server's raw TCP port, `socket://host:port` as in pyserial.

    Without pyserial's own class: it hides why a connection failed, gives no way to the options of its socket
    and sleeps in close().
    """

    def __init__(self, name: PortName) -> None:
        self.description = url = name.text
        self.serial_number: str | None = None
        self.product: str | None = None
        self.failure: BridgeError | None = None  # never set: read() tells
        if name.address is None:
            raise PortError(f"{url}: not of the form socket://HOST:PORT, PORT being 1 to 65535")
        try:
            self._socket = socket.create_connection(name.address, _CONNECT_LIMIT_S)
        except OSError as error:
            raise PortError(_explain_network(url, error)) from error
        _notice_dead_peers(self._socket)
        self._socket.setblocking(False)
        self.fd = self._socket.fileno()

    def close(self) -> None:
        """What the other side has not taken yet is not sent any more."""
        if self.fd < 0:
            return
        self.fd = -1
        with contextlib.suppress(OSError):
            (unsent,) = _INT.unpack(fcntl.ioctl(self._socket, termios.TIOCOUTQ, _INT.pack(0)))
            if unsent:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(1, 0))
            else:
                self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class PumpedPort(Pump):
    """Any other pyserial URL (rfc2217://...): it has no descriptor that carries just the bytes."""

    error = PortError

    def __init__(self, url: str, device: Any) -> None:
        super().__init__(url, socket.SOCK_STREAM)
        self.serial_number: str | None = None
        self.product: str | None = None
        self._device = device
        connection = getattr(device, "_socket", None)  # pyserial has no public way to it
        if isinstance(connection, socket.socket):
            _notice_dead_peers(connection)
        self.start()

    def _inward(self) -> None:
        device = self._device
        while not self._stopping.is_set():
            if data := device.read(1):  # returns with the first byte, or after POLL_INTERVAL_S
                if (more := device.in_waiting) > _BACKLOG_MAX:  # pyserial keeps all that comes
                    raise PortError(
                        "more than 1 MB waits to be read, no serial line is so fast: wrong server?"
                    )
                if more:
                    data += device.read(more)
                self._far.sendall(data)

    def _outward(self) -> None:
        while data := self._far.recv(_BLOCK):
            self._device.write(data)

    def _release(self) -> None:
        self._device.close()


def _tty_path(name: PortName) -> str:
    """The path of the tty that usb-serial://SERIAL means; PortError if there is none, or more than one."""
    if name.serial_number is None:
        raise PortError(f"{name.text}: not of the form usb-serial://SERIAL")
    ttys = sysfs.usb_ttys_of(name.serial_number)
    devices = {tty.device: tty for tty in reversed(ttys)}  # the first line of each
    if len(devices) == 1:
        return str(_DEV / ttys[0].name)
    if ttys:
        places = " and ".join(f"{_DEV / tty.name} (USB {device})" for device, tty in sorted(devices.items()))
        raise PortError(
            f"{name.text}: {len(devices)} devices have this serial number, {places}: plug in only one, or "
            "use the path of the one that is meant, as in /dev/serial/by-path"
        )
    here = [f"{number} ({_DEV / tty.name})" for tty, number in sysfs.usb_ttys().items() if number]
    raise PortError(
        f"{name.text}: no USB device with a serial line has this serial number; those here: "
        f"{', '.join(here) or 'none'}"
    )


def _refuse_terminal(port: str) -> None:
    """PortError for the terminal that somebody works at: made raw, and typed at, it would be dead for them.

    It has perhaps just got the number of a simulator's terminal that ended.
    """
    try:
        device = os.stat(port)  # noqa: PTH116 - beside os.open
    except OSError:
        return  # opening says why not
    if not stat.S_ISCHR(device.st_mode):
        return
    if device.st_rdev == _OWN_TERMINAL:
        raise PortError(f"{port}: is the terminal that this program runs in, not an adapter")
    if users := sysfs.users_as_terminal(device.st_rdev):
        name = os.path.realpath(port)
        link = "" if name == port else f" (a link to {name})"
        hint = "; for a simulator use a name that stays: simulate --link PATH" if "/pts/" in name else ""
        raise PortError(f"{port}{link}: is the terminal of {users[0]}, not an adapter: not taken{hint}")


def _make_raw(fd: int) -> None:
    """Every byte as it is. No data is EAGAIN, 0 is a hang-up (with pyserial's VMIN=0 it is both)."""
    _, _, cflag, _, ispeed, ospeed, cc = termios.tcgetattr(fd)
    cc[termios.VMIN], cc[termios.VTIME] = 1, 0
    termios.tcsetattr(fd, termios.TCSANOW, [0, 0, cflag, 0, ispeed, ospeed, cc])
    os.set_blocking(fd, False)


def _actual_baudrate(fd: int) -> int:
    """What the driver made of the rate it was asked for, in bit/s: it chooses another rather than refuse."""
    termios2 = fcntl.ioctl(fd, _TCGETS2, bytes(_TERMIOS2.size))
    return int(_TERMIOS2.unpack(termios2)[-1])


def _notice_dead_peers(connection: socket.socket) -> None:
    for level, option, value in _TCP_OPTIONS:
        connection.setsockopt(level, option, value)


def _error(port: str, baudrate: int, error: Exception) -> PortError:
    """What is wrong and what to do. pyserial raises while it handles the error that tells more."""
    cause = error.__context__ if isinstance(error.__context__, OSError | termios.error) else error
    if PortName(port).scheme:
        return PortError(_explain_network(port, cause))
    code = cause.errno if isinstance(cause, OSError) else cause.args[0] if cause.args else None
    kind = NotPermittedError if code == errno.EACCES else PortError
    return kind(f"{port}: {_explain(port, baudrate, error, code)}")


def _explain(port: str, baudrate: int, error: Exception, code: object) -> str:
    match code:
        case errno.ENOENT:
            return _explain_missing(Path(port))
        case errno.EACCES:
            return explain_refused(Path(port))
        case errno.EPERM:
            return explain_forbidden(Path(port).resolve())
        case errno.EBUSY | errno.EAGAIN:
            users = ", ".join(sysfs.users(Path(port))) or "another program"
            return f"in use by {users}: stop that first"
        case errno.ENOTTY if _is_tty_name(port):  # another line discipline has it, as of slcand
            holders = ", ".join(sysfs.users(Path(port))) or "another program"
            return f"in use by {holders}: stop that first"
        case errno.ENOTTY | errno.EISDIR:
            return "not a serial port"
        case errno.EIO | errno.ENXIO | errno.ENODEV:
            return f"there is no device behind it, it was perhaps just unplugged ({os.strerror(code)})"
        case int():
            return f"cannot be set to {baudrate} Bd: {os.strerror(code)}"
        case _:
            return f"cannot be set to {baudrate} Bd: {error}"


def _is_tty_name(port: str) -> bool:
    path = Path(port).resolve()
    return path.name.startswith("tty") or path.parent.name == "pts"


def _explain_missing(path: Path) -> str:
    if path.is_symlink():
        return f"a link to {path.readlink()}, which does not exist: is the adapter unplugged?"
    if path.is_relative_to("/tmp") and "NOTIFY_SOCKET" in os.environ:
        return "does not exist: the service has a /tmp of its own (PrivateTmp=), use a path in /run"
    if path.parent == _DEV and sysfs.has_tty(path.name) and in_container():
        return f"there is no {path} in this container: give it the host's (--volume /dev:/dev)"
    patterns = ("serial/by-id/*", "ttyUSB*", "ttyACM*")
    present = [str(device) for pattern in patterns for device in sorted(_DEV.glob(pattern))]
    return f"does not exist; serial adapters here: {', '.join(present) or 'none'}"


def _explain_network(url: str, cause: BaseException) -> str:
    if isinstance(cause, ConnectionRefusedError):
        return f"{url}: refused, nothing listens there: is the serial server running, and free?"
    if isinstance(cause, socket.gaierror):
        return f"{url}: the host name is not known ({cause.strerror})"
    if isinstance(cause, TimeoutError):
        return f"{url}: no answer: is the host switched on, is a firewall between?"
    if "RFC2217" in str(cause):
        return f"{url}: the server does not speak RFC 2217: use socket://HOST:PORT for a raw TCP port"
    return f"{url}: {cause}"
