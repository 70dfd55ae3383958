"""What is known of EEPROM settings that an adapter cannot be asked for, kept across starts.

EEPROM cells wear out, so a setting is written once and remembered by serial number.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import stat
from typing import TYPE_CHECKING

from bridged.daemon.directories import OTHERS_WRITE
from bridged.text import user_name

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

log = logging.getLogger(__name__)

FILE_MAX = 1 << 16  # bytes
# A root that is read-only, no directory of ours: as somebody has decided, a container's image for one.
NOT_TO_BE_HAD = {errno.EROFS, errno.EACCES}


class FileMemory:
    """One JSON file for each adapter. What cannot be written there is kept as long as this process lives.

    So a setting that cannot be asked for is written to an EEPROM once in each process at most.

    Nothing is written in a directory that another user owns or may write in: that user could have root, or
    whoever runs the bridge, write somewhere else. Its files are read nevertheless, following no link.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._not_stored: dict[str, dict[str, int]] = {}
        self._told = ""

    def recall(self, serial_number: str, setting: str) -> int | None:
        return self._known(serial_number).get(setting)

    def remember(self, serial_number: str, setting: str, value: int) -> None:
        known = self._known(serial_number)
        if known.get(setting) == value:
            return
        known[setting] = value
        try:
            self._store(serial_number, known)
        except OSError as error:
            self._not_stored[serial_number] = known
            cause = f"{error.filename or self._directory}: {error.strerror or error}"
            if cause != self._told:
                self._told = cause
                log.log(
                    logging.INFO if error.errno in NOT_TO_BE_HAD else logging.WARNING,
                    "what the adapter has stored (%s) is known until this process ends, since it cannot be "
                    "remembered in %s; another place that lasts: STATE_DIRECTORY=PATH",
                    setting, cause,
                )  # fmt: skip
        else:
            self._not_stored.pop(serial_number, None)

    def _known(self, serial_number: str) -> dict[str, int]:
        return self._load(serial_number) | self._not_stored.get(serial_number, {})

    def _load(self, serial_number: str) -> dict[str, int]:
        import json  # noqa: PLC0415 - 2 ms, when the bridge is up already

        path = self._directory / f"{_stem(serial_number)}.json"
        try:
            values = json.loads(_read(path))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError) as error:
            log.warning("cannot read what is known of adapter %s: %s: %s", serial_number, path, error)
            return {}
        if not isinstance(values, dict):
            return {}
        return {setting: value for setting, value in values.items() if type(value) is int}

    def _store(self, serial_number: str, values: dict[str, int]) -> None:
        import json  # noqa: PLC0415

        stem = _stem(serial_number)
        self._directory.mkdir(mode=0o755, parents=True, exist_ok=True)
        with _own_directory(self._directory) as directory:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(f"{stem}.new", dir_fd=directory)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
            with os.fdopen(os.open(f"{stem}.new", flags, 0o600, dir_fd=directory), "w") as file:
                json.dump(values, file)
                file.flush()
                os.fsync(file.fileno())  # or a power failure could leave an empty file
            os.replace(f"{stem}.new", f"{stem}.json", src_dir_fd=directory, dst_dir_fd=directory)


def _read(path: Path) -> bytes:
    """Of a regular file only, at most FILE_MAX bytes, without waiting and without following a link."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError("not a regular file")
        return file.read(FILE_MAX)


def _stem(serial_number: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in serial_number)


@contextlib.contextmanager
def _own_directory(path: Path) -> Iterator[int]:
    """A descriptor of the directory. PermissionError: another user owns it or may write in it."""
    directory = os.open(path, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        found = os.fstat(directory)
        if found.st_uid != os.geteuid():
            cause = f"belongs to {user_name(found.st_uid)}: run the bridge as that user, as the service does"
            raise PermissionError(0, cause, str(path))
        if found.st_mode & OTHERS_WRITE:
            raise PermissionError(0, f"other users may write there: chmod go-w {path}", str(path))
        yield directory
    finally:
        os.close(directory)
