"""Where frames go on the host."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridged.interfaces.base import OpenInterface


def open_interface(
    interface: str, channel: str, *, create: bool, options: Mapping[str, object]
) -> OpenInterface:
    """Open `channel` of a python-can interface name; `socketcan` is the kernel's own and needs no python-can.

    `create` is for socketcan alone, `options` for the others. InterfaceError says what to do.
    """
    if interface == "socketcan":
        from bridged.interfaces.socketcan import open_socketcan  # noqa: PLC0415 - only the kind that is used

        return open_socketcan(channel, create)
    from bridged.interfaces.python_can import open_python_can  # noqa: PLC0415 - python-can costs 85 ms and 19 MB

    return open_python_can(interface, channel, options)
