"""Names that appear in directories, by inotify: a node in /dev, also where no device events come."""

from __future__ import annotations

import ctypes
import errno
import os
import struct
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

# linux/inotify.h
_CREATE: Final = 0x100
_MOVED_TO: Final = 0x80
_Q_OVERFLOW: Final = 0x4000
_IGNORED: Final = 0x8000
_ONLYDIR: Final = 0x0100_0000
_EVENT: Final = struct.Struct("=iIII")  # watch, mask, cookie, length of the name that follows
_BUFFER: Final = 16_384
_INIT_FLAGS: Final = os.O_NONBLOCK | os.O_CLOEXEC


class Inotify:
    """A set of directories. OSError if the kernel gives no more of them to this user."""

    def __init__(self) -> None:
        # Python has no inotify; the C library, which is loaded anyway, has.
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._directories: dict[int, str] = {}  # by their watches
        self._fd = self._checked(self._libc.inotify_init1(_INIT_FLAGS))

    def fileno(self) -> int:
        """Readable when there is something to read."""
        return self._fd

    def add(self, directories: Iterable[Path]) -> bool:
        """More of them, but for those that do not exist or may not be looked into; whether any is new."""
        before = len(self._directories)
        for directory in map(os.fspath, directories):
            watch = self._libc.inotify_add_watch(
                self._fd, os.fsencode(directory), _CREATE | _MOVED_TO | _ONLYDIR
            )
            if watch >= 0:
                self._directories[watch] = directory
        return len(self._directories) > before

    def read(self) -> tuple[set[str], bool]:
        """The paths that have appeared, and whether others may have: an event was lost, or a directory."""
        paths: set[str] = set()
        others = False
        while True:
            try:
                events = os.read(self._fd, _BUFFER)
            except OSError as error:
                if error.errno == errno.EINTR:
                    continue
                return paths, others  # EAGAIN: that was all
            at = 0
            while at < len(events):
                watch, mask, _, length = _EVENT.unpack_from(events, at)
                at += _EVENT.size
                name = os.fsdecode(events[at : at + length].rstrip(b"\0"))
                at += length
                if mask & (_Q_OVERFLOW | _IGNORED):
                    self._directories.pop(watch, None)
                    others = True
                elif watch in self._directories:
                    paths.add(os.path.join(self._directories[watch], name))  # noqa: PTH118

    def close(self) -> None:
        os.close(self._fd)

    @staticmethod
    def _checked(result: int) -> int:
        if result < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        return result
