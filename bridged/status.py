"""The status of a running bridge over a local socket: one JSON object for each connection.

name, state, reason, bus_state, tec, rec (None: not known), rates {rx_fps, tx_fps: frames a second},
answer_time_ms {min, median, max: of the adapter's last answers to questions about its bus},
adapter {type, port, version, serial_number}, bus {interface, channel, open},
counters {rx_frames: frames put on the bus; tx_frames: frames the adapter took; rx_errors: pieces of noise
from the adapter; tx_retries: frames sent once more; tx_returned: frames the adapter handed back; tx_stops,
rx_overruns: how often it said "stop", "I lost frames"; reconnects: how often it ran again;
bus_off_restarts; tx_full, rx_overflow, arbitration_lost, bus_error: how often it said so (those that it ever
said); error_frames: put on the bus;
tx_discarded: of tx_frames, those that did not leave the adapter's own buffer for so long that it was emptied;
tx_dropped, rx_dropped: {reason: frames}; …}, queued, uptime_s.
At any moment bus_read = tx_frames + queued + tx_dropped (but for LOST_BEFORE_READ).
"""

from __future__ import annotations

import contextlib
import grp
import os
import socket
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bridged.errors import BridgeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

ANSWER_TIMEOUT_S = 5.0
SYSTEM_DIRECTORY = Path("/run/can-bridge")
GROUP = "can-bridge"  # systemd/can-bridge.sysusers
# Reasons in tx_dropped for frames that were lost before the relay could read them.
LOST_BEFORE_READ = ("socket-overflow", "bus-pump-overflow", "bus-recv-failed")


class StatusError(BridgeError):
    """The status socket could not be made, or nobody answers on it."""


def runtime_directory() -> Path:
    """/run/can-bridge for root, below XDG_RUNTIME_DIR for anybody else."""
    if os.geteuid() == 0:
        return SYSTEM_DIRECTORY
    base = os.environ.get("XDG_RUNTIME_DIR") or f"/tmp/can-bridge-{os.geteuid()}"
    return Path(base) / "can-bridge"


def socket_path(name: str) -> Path:
    return runtime_directory() / f"{name}.sock"


def running_sockets() -> list[Path]:
    """The status sockets there are, of this user's bridges and of root's."""
    folders = {runtime_directory(), SYSTEM_DIRECTORY}
    return sorted(path for folder in folders for path in folder.glob("*.sock"))


class StatusServer:
    """Listens on a Unix socket; on_readable() answers everybody who waits, without ever waiting itself."""

    def __init__(self, path: Path, snapshot: Callable[[], dict[str, Any]]) -> None:
        """StatusError: another bridge listens there, or the socket cannot be made."""
        self.path = path
        self._snapshot = snapshot
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
            _clear_away(path)
            self._socket.bind(str(path))
            _admit_group(path)
            self._inode = path.stat().st_ino
            self._socket.listen(16)
        except OSError as error:
            self._socket.close()
            cause = error.strerror or error
            msg = f"cannot make the status socket {path}: {cause}; --socket PATH puts it elsewhere"
            raise StatusError(msg) from error
        except StatusError:
            self._socket.close()
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
        self._socket.close()
        with contextlib.suppress(OSError):
            if self.path.lstat().st_ino == self._inode:
                self.path.unlink()


def _admit_group(path: Path) -> None:
    """For the owner and the service's group, if there is one, or the owner's."""
    if os.geteuid() == 0:
        with contextlib.suppress(KeyError, OSError):  # no such group: not installed as a service; a container
            os.chown(path, -1, grp.getgrnam(GROUP).gr_gid)
    path.chmod(0o660)


def _clear_away(path: Path) -> None:
    """Removes the socket that a dead bridge left; StatusError for anything else that is there."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            msg = f"{path} exists and is no socket: --socket PATH wants a place of its own"
            raise StatusError(msg)
    except FileNotFoundError:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except TimeoutError:
            pass
    msg = f"a bridge named {path.stem!r} is running already (it answers on {path})"
    raise StatusError(msg)


def query(path: Path) -> dict[str, Any]:
    """The status of the bridge behind `path`. StatusError: none is running there."""
    import json  # noqa: PLC0415 - as above

    data = b""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(ANSWER_TIMEOUT_S)
            client.connect(str(path))
            while chunk := client.recv(65536):
                data += chunk
        status = json.loads(data)
    except PermissionError as error:
        group = _group_name(path.stat().st_gid)
        msg = f"no permission for {path}: usermod -aG {group} USER, then log in again; or be root"
        raise StatusError(msg) from error
    except (OSError, ValueError) as error:
        msg = f"no bridge answers on {path}: {error}"
        raise StatusError(msg) from error
    if not isinstance(status, dict) or "counters" not in status:
        msg = f"what answers on {path} is no bridge"
        raise StatusError(msg)
    return status


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def _reasons(dropped: dict[str, int]) -> str:
    return ", ".join(f"{reason} {n}" for reason, n in dropped.items() if n) or "none"


def _bus_state(status: dict[str, Any]) -> str:
    counters = "" if status["tec"] is None else f", TEC {status['tec']}, REC {status['rec']}"
    times = status["answer_time_ms"]
    answers = f", answers in {times['median']:.1f} ms" if times else ""
    return f"{status['bus_state'] or 'not known'}{counters}{answers}"


def render(status: dict[str, Any]) -> str:
    """The status for a human."""
    adapter, counters, bus, rates = status["adapter"], status["counters"], status["bus"], status["rates"]
    reason = f" ({status['reason']})" if status["reason"] else ""
    identity = f"version {adapter['version'] or '?'}, serial number {adapter['serial_number'] or '?'}"
    to_bus = (
        f"{counters['rx_frames']} frames, {rates['rx_fps']:.0f}/s, "
        f"{counters['rx_errors']} errors on the line, {counters['rx_overruns']} overruns of the adapter"
    )
    to_adapter = (
        f"{counters['tx_frames']} frames, {rates['tx_fps']:.0f}/s, {counters['tx_retries']} retries, "
        f"{status['queued']} queued"
    )
    lines = {
        "adapter": f"{adapter['type']} on {adapter['port']}, {identity}",
        "CAN bus": _bus_state(status),
        "interface": f"{bus['interface']} {bus['channel']}{'' if bus['open'] else ', NOT OPEN'}",
        "to bus": f"{to_bus}\n  dropped     {_reasons(counters['rx_dropped'])}",
        "to adapter": f"{to_adapter}\n  dropped     {_reasons(counters['tx_dropped'])}",
    }
    head = f"{status['name']}: {status['state']}{reason}, up {status['uptime_s']:.0f} s"
    return "\n".join([head, *(f"  {name:<10}  {text}" for name, text in lines.items())])
