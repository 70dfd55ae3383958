"""From root to a user without any privilege: for a container that starts as root to make its interface."""

from __future__ import annotations

import contextlib
import os
import pwd
from typing import TYPE_CHECKING

from bridged.errors import BridgeError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_PR_SET_NO_NEW_PRIVS = 38  # linux/prctl.h


def become(user: str) -> None:
    """Go on as `user`, a name or a number, for good and without any capability; nothing if it is that user.

    Its groups are the account's, and those that a container engine gave root (`--group-add dialout`). For a
    number without an account it is the group of that number. BridgeError: this process may not.
    """
    account = _account(user)
    uid = account.pw_uid if account else int(user)
    if os.getresuid() == (uid, uid, uid):
        return
    gid = account.pw_gid if account else uid
    groups = set(os.getgroups()) - {0}
    if account:
        groups |= set(os.getgrouplist(account.pw_name, gid))
    try:
        os.setgroups(sorted(groups))
        os.setresgid(gid, gid, gid)
        os.setresuid(uid, uid, uid)  # the kernel takes the capabilities
        _gain_nothing_more()
    except OSError as error:
        raise BridgeError(
            f"cannot become user {user}: {error.strerror}: it takes root with the capabilities SETUID and "
            "SETGID (a container: --user 0 --cap-add SETUID --cap-add SETGID)"
        ) from error
    os.environ.pop("HOME", None)  # root's
    if account:
        os.environ["HOME"] = account.pw_dir


def _account(user: str) -> pwd.struct_passwd | None:
    try:
        return pwd.getpwuid(int(user)) if user.isdecimal() else pwd.getpwnam(user)
    except KeyError:
        if user.isdecimal():
            return None
    raise BridgeError(f"there is no user {user!r}: give a number")


def _gain_nothing_more() -> None:
    """No program that this process might run gains a privilege (prctl(2))."""
    import ctypes  # noqa: PLC0415 - 10 ms that only this way costs

    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


@contextlib.contextmanager
def acting_as_owner(path: Path) -> Iterator[None]:
    """For root without CAP_DAC_OVERRIDE, as in a container, who may not open what is another user's.

    OSError: it may not become that user either.
    """
    os.seteuid(path.stat().st_uid)
    try:
        yield
    finally:
        os.seteuid(0)
