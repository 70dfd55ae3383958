"""The status of a running bridge over a local socket: one JSON object for each connection.

version (of can-bridge), name, state, reason, channel_open (None: the adapter was never asked; true also where
it did not say), bus_state, tec, rec (None: not known), rates {rx_fps, tx_fps: frames a second},
answer_time_ms {min, median, max: of the adapter's last answers to questions about its CAN bus},
adapter {type, port, opened: what that is now, as /dev/ttyUSB1 (None: it is not open), version, serial_number,
firmware: the name of its profile, sent_means: what it vouches for when a frame counts as sent (None: not
known)}, bus {interface, channel, open, up: it is open and carries frames},
counters {rx_frames: frames put on the interface; tx_frames: frames the adapter vouches for; tx_queued: frames
of which it says no more than that they are in its buffer; tx_unconfirmed: frames of which it says nothing;
tx_late: of all these, those that may leave its buffer late;
rx_errors: pieces of noise from the adapter; tx_retries: frames sent once more; tx_returned: frames the
adapter handed back; tx_stops, rx_overruns: how often it said "stop", "I lost frames"; reconnects: how often
it ran again; bus_off_restarts; tx_full, rx_overflow, arbitration_lost, bus_error: how often it said so (those
that it ever said); error_frames, error_frames_lost: those on the interface, and those that it did not take;
error_frames_left_out: those that came too quickly one after the other, where the last one says it all;
tx_discarded: of tx_frames, those that did not leave the adapter's own buffer for so long that it was emptied;
tx_dropped, rx_dropped: {reason: frames}, by the reasons of relay/counters.h; …}, queued, uptime_s.
At any moment bus_read = tx_frames + tx_queued + tx_unconfirmed + queued + tx_dropped (but for
LOST_BEFORE_READ).
"""

from __future__ import annotations

import contextlib
import errno
import grp
import os
import socket
import stat
import time
from typing import TYPE_CHECKING, Any

from bridged.daemon import directories
from bridged.errors import BridgeError
from bridged.text import user_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

ANSWER_TIMEOUT_S = 5.0
ANSWER_MAX = 1 << 20
GROUP = "can-bridge"  # systemd/can-bridge.sysusers


class StatusError(BridgeError):
    """The status socket could not be made, or what answers on it is no status."""


class NoAnswerError(StatusError):
    """The bridge behind the status socket does not answer."""


class NotRunningError(NoAnswerError):
    """There is none."""


def own_socket_path(name: str) -> Path:
    """Where this user's bridge `name` makes its status socket; the directory is made if it is missing.

    StatusError: somebody else owns the directory or may write in it (anybody can make the one in /tmp first),
    and could put another socket in the place of ours.
    """
    directory = directories.runtime_directory()
    try:
        directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise StatusError(_cannot_make(directory / f"{name}.sock", error)) from error
    if distrust := directories.distrust(found):
        raise StatusError(f"{directory} {distrust}: set XDG_RUNTIME_DIR, or give --socket PATH")
    return directory / f"{name}.sock"


def running_sockets() -> list[Path]:
    """The status sockets there are, of this user's bridges and of root's."""
    folders = directories.runtime_directories()
    return sorted({path for folder in folders for path in directories.status_sockets(folder)})


class StatusServer:
    """Listens on a Unix socket; on_readable() answers everybody who waits, without ever waiting itself.

    Root may be asked to listen in a directory of another user, who can exchange the socket for a link at any
    moment. So its mode and group come from the process when it is made, and what is done by its name later is
    done relative to the open directory and follows no link.
    """

    def __init__(self, path: Path, snapshot: Callable[[], dict[str, Any]]) -> None:
        """StatusError: another bridge listens there, or the socket cannot be made."""
        self.path = path
        self._snapshot = snapshot
        self._directory = -1
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
            self._directory = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
            self._clear_away()
            self._refuse_a_second_one()
            with _for_owner_and_group():
                self._socket.bind(str(path))
            self._inode = self._lstat().st_ino
            self._socket.listen(16)
        except OSError as error:
            self._release()
            raise StatusError(_cannot_make(path, error)) from error
        except StatusError:
            self._release()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def on_readable(self) -> None:
        import json  # noqa: PLC0415 - a bridge that nobody asks does without

        for connection in self._waiting():
            with connection, contextlib.suppress(OSError):  # who hangs up early gets nothing
                connection.setblocking(False)
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 18)
                connection.sendall(json.dumps(self._snapshot()).encode() + b"\n")

    def _waiting(self) -> Iterator[socket.socket]:
        while True:
            try:
                yield self._socket.accept()[0]
            except OSError:
                return

    def close(self) -> None:
        with contextlib.suppress(OSError):
            if self._lstat().st_ino == self._inode:
                self._unlink()
        self._release()

    def _release(self) -> None:
        self._socket.close()
        if self._directory >= 0:
            os.close(self._directory)
            self._directory = -1

    def _lstat(self) -> os.stat_result:
        return os.stat(self.path.name, dir_fd=self._directory, follow_symlinks=False)

    def _unlink(self) -> None:
        os.unlink(self.path.name, dir_fd=self._directory)

    def _clear_away(self) -> None:
        """Removes the socket that a dead bridge left; StatusError for anything else that is there."""
        try:
            if not stat.S_ISSOCK(self._lstat().st_mode):
                msg = f"{self.path} exists and is no socket: --socket PATH wants a place of its own"
                raise StatusError(msg)
        except FileNotFoundError:
            return
        if _somebody_listens(self.path):
            raise StatusError(_runs_already(self.path))
        self._unlink()

    def _refuse_a_second_one(self) -> None:
        """StatusError: there is a bridge of this name in another directory: the service's, or one by hand."""
        for path in directories.status_sockets(directories.runtime_directory_of(self.path)) - {self.path}:
            with contextlib.suppress(OSError):  # gone meanwhile, or not ours to ask
                if path.stem == self.path.stem and _somebody_listens(path):
                    raise StatusError(_runs_already(path))


def _somebody_listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return False
        except TimeoutError:
            pass
    return True


def _runs_already(path: Path) -> str:
    return f"a bridge named {path.stem!r} is running already (it answers on {path})"


@contextlib.contextmanager
def _for_owner_and_group() -> Iterator[None]:
    """What is made meanwhile is for its owner and a group, root's for that of the service if there is one."""
    mask, group = os.umask(0o117), os.getegid()
    try:
        if os.geteuid() == 0:
            with contextlib.suppress(
                KeyError, OSError
            ):  # no such group: not installed as a service; a container
                os.setegid(grp.getgrnam(GROUP).gr_gid)
        yield
    finally:
        os.umask(mask)
        if os.getegid() != group:  # the service's sandbox refuses the call, also where it changes nothing
            os.setegid(group)


def _cannot_make(path: Path, error: OSError) -> str:
    return f"cannot make the status socket {path}: {error.strerror or error}; --socket PATH puts it elsewhere"


def query(path: Path) -> dict[str, Any]:
    """The status of the bridge behind `path`. StatusError: none is running there, or it may not be asked.

    Anybody may listen there: what answers is given ANSWER_TIMEOUT_S and ANSWER_MAX bytes, no more.
    """
    import json  # noqa: PLC0415 - as above

    try:
        status = json.loads(_read_answer(path))
    except PermissionError as error:
        raise StatusError(f"no permission for {path}: {_who_may(path)}") from error
    except TimeoutError as error:
        msg = f"the bridge behind {path} does not answer within {ANSWER_TIMEOUT_S:g} s: is it stopped?"
        raise NoAnswerError(msg) from error
    except OSError as error:
        msg = f"no bridge answers on {path}: {error.strerror or error}"
        raise NotRunningError(msg) from error
    except (ValueError, RecursionError):
        status = None
    if not isinstance(status, dict) or not isinstance(status.get("counters"), dict):
        raise StatusError(f"what answers on {path} is no bridge")
    return status


def _read_answer(path: Path) -> bytes:
    deadline = time.monotonic() + ANSWER_TIMEOUT_S
    data = bytearray()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(ANSWER_TIMEOUT_S)
        client.connect(str(path))
        while len(data) <= ANSWER_MAX:
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                raise TimeoutError
            client.settimeout(remaining_s)
            chunk = client.recv(65536)
            if not chunk:
                break
            data += chunk
    if not data:
        raise ConnectionResetError(errno.ECONNRESET, "it ended meanwhile")
    return bytes(data)


def _who_may(path: Path) -> str:
    """What somebody can do who has no permission for a status socket."""
    try:
        found = path.stat()
        group = grp.getgrgid(found.st_gid).gr_name
    except (OSError, KeyError):
        return "ask as the user who started the bridge, or as root (sudo)"
    if group == GROUP:
        return f"usermod -aG {GROUP} USER, then log in again; or ask as root (sudo)"
    advice = (
        "ask as root (sudo)" if found.st_uid == 0 else f"ask as {user_name(found.st_uid)} or as root (sudo)"
    )
    if directories.runtime_directory_of(path) == directories.SYSTEM_RUNTIME:
        advice += f"; to do without, install systemd/can-bridge.sysusers and join group {GROUP}"
    return f"it is the bridge of {user_name(found.st_uid)}: {advice}"


def is_started(status: dict[str, Any]) -> bool:
    """Whether the interface is up, so that programs can use it, adapter or not."""
    bus = status.get("bus")
    return isinstance(bus, dict) and bool(bus.get("up"))


def is_running(status: dict[str, Any]) -> bool:
    """Whether frames go between the adapter and an open interface."""
    bus = status.get("bus")
    return status.get("state") == "running" and isinstance(bus, dict) and bool(bus.get("open"))
