"""Where the files of a bridge are: status sockets (runtime), what is known of EEPROMs (state)."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from bridged.text import user_name

SYSTEM_RUNTIME = Path("/run/can-bridge")
FALLBACK_RUNTIME = "/tmp/can-bridge-{uid}"  # without XDG_RUNTIME_DIR: su, cron, containers
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def runtime_directory() -> Path:
    """Where the status sockets of this user's bridges are: /run/can-bridge for root."""
    if os.geteuid() == 0:
        return SYSTEM_RUNTIME
    if base := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(base) / "can-bridge"
    return Path(FALLBACK_RUNTIME.format(uid=os.geteuid()))


def runtime_directories() -> set[Path]:
    """Where status sockets may be that this user can ask: root's directory, and this user's if it is safe.

    For root also what XDG_RUNTIME_DIR says: a bridge that has given root up (`run --user`) follows it.
    """
    folders = {SYSTEM_RUNTIME}
    if os.geteuid() == 0 and (base := os.environ.get("XDG_RUNTIME_DIR")):
        folders.add(Path(base) / "can-bridge")
    with contextlib.suppress(OSError):
        if not distrust(runtime_directory().lstat()):
            folders.add(runtime_directory())
    return folders


def status_sockets(folder: Path) -> set[Path]:
    """Those in a runtime directory: `NAME.sock`, and `NAME/NAME.sock` of the service, whose instances have a
    directory each."""
    return {
        *folder.glob("*.sock"),
        *(path for path in folder.glob("*/*.sock") if path.stem == path.parent.name),
    }


def runtime_directory_of(socket: Path) -> Path:
    """The runtime directory that a status socket is in: see status_sockets()."""
    return socket.parent.parent if socket.parent.name == socket.stem else socket.parent


def distrust(directory: os.stat_result) -> str:
    """Why our sockets must not be in the directory; empty: they may."""
    if os.geteuid() == 0:  # it is in /run, where only root may write
        return ""
    if not stat.S_ISDIR(directory.st_mode):
        return "is no directory"
    if directory.st_uid != os.geteuid():
        return f"belongs to {user_name(directory.st_uid)}"
    return "is one that other users may write in" if directory.st_mode & OTHERS_WRITE else ""


def state_directory() -> Path:
    """systemd's StateDirectory, else /var/lib for root, else XDG_STATE_HOME (basedir specification)."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":", maxsplit=1)[0])
    if os.geteuid() == 0:
        return Path("/var/lib/can-bridge")
    if home := os.environ.get("XDG_STATE_HOME"):
        return Path(home) / "can-bridge"
    try:
        return Path("~/.local/state/can-bridge").expanduser()
    except RuntimeError:  # a user without a home
        return runtime_directory()
