"""What the port of an adapter may be called: a device path, or a URL. The only grammar of these names."""

from __future__ import annotations

import os
import re
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from bridged.text import quoted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SCHEMES: Final = ("socket", "rfc2217", "usb", "usb-serial")

_SCHEME_WITHOUT_SLASHES: Final = re.compile(rf"({'|'.join(SCHEMES)}):/?([!-~]+)", re.ASCII)

_LABEL: Final = "[A-Za-z0-9_-]{1,63}"
_ADDRESS: Final = re.compile(
    rf"({_LABEL}(?:\.{_LABEL})*\.?|\[[0-9A-Fa-f:.]+(?:%[\w.-]+)?\]):([0-9]{{1,5}})/?(?:\?\S*)?", re.ASCII
)
"""HOST:PORT, [IPv6]:PORT, with pyserial's options: nas.local:4001, [fe80::1%eth0]:4001, h:1?logging=debug."""

_USB_DEVICE: Final = re.compile(r"([0-9A-Fa-f]{4}):([0-9A-Fa-f]{4})(?:/([!-~]{1,32}))?")
"""VID:PID or VID:PID/SERIAL: 0403:6001, 0403:6001/A6008isP."""

_SERIAL_NUMBER: Final = re.compile("[!-~]{1,32}")


class PortName:
    """The parts of a name; those that it has not, or that do not keep to the grammar, are empty.

    `/dev/ttyUSB0` has a `path`, `socket://nas:4001` an `address` (host, TCP port), `usb://0403:6001/A1` a
    `usb_id` (vendor, product) and perhaps a `serial_number`. `usb-serial://A1` has only that: it is the tty
    of the USB device with this serial number. `scheme` is whatever stands before `://`.
    """

    __slots__ = ("address", "path", "scheme", "serial_number", "text", "usb_id")

    def __init__(self, text: str) -> None:
        scheme, separator, rest = text.partition("://")
        self.text = text
        self.scheme = scheme if separator else ""
        self.path = "" if separator else text
        self.address: tuple[str, int] | None = None
        self.usb_id: tuple[int, int] | None = None
        self.serial_number: str | None = None
        if self.scheme == "usb":
            if device := _USB_DEVICE.fullmatch(rest):
                self.usb_id = int(device[1], 16), int(device[2], 16)
                self.serial_number = device[3]
        elif self.scheme == "usb-serial":
            if _SERIAL_NUMBER.fullmatch(rest):
                self.serial_number = rest
        elif separator and (address := _ADDRESS.fullmatch(rest)) and 1 <= int(address[2]) <= 65_535:
            self.address = address[1].strip("[]"), int(address[2])

    @property
    def is_numbered_terminal(self) -> bool:
        """Whether it is /dev/pts/N itself, and no link to it: a name that the kernel uses again and again."""
        return re.fullmatch(r"//?dev/pts/\d+", os.path.normpath(self.path)) is not None

    @property
    def is_tty_of_usb_device(self) -> bool:
        """Whether it is usb-serial://SERIAL."""
        return self.scheme == "usb-serial" and self.serial_number is not None

    def problem(
        self, schemes: Sequence[str] = SCHEMES, refused: Mapping[str, str] = MappingProxyType({})
    ) -> str | None:
        """What is wrong with the name where only these schemes are taken; `refused`: why others are not."""
        if not self.scheme:
            return self._path_problem()
        rest = self.text.partition("://")[2]
        if self.scheme not in schemes:
            if self.scheme == "tcp":
                return f"a raw TCP port is written {quoted(f'socket://{rest}')}"
            if text := refused.get(self.scheme):
                return text
            *most, last = (f"{name}://" for name in schemes)
            wanted = f"{', '.join(most)} or {last}" if most else last
            return f"the URL of a port begins with {wanted}, not {quoted(f'{self.scheme}://')}"
        if self.usb_id or self.address or self.is_tty_of_usb_device:
            return None
        if self.scheme == "usb":
            wanted = "usb://VID:PID or usb://VID:PID/SERIAL, VID and PID as 4 hex digits each"
        elif self.scheme == "usb-serial":
            wanted = "usb-serial://SERIAL, the serial number of a USB device, without spaces"
        else:
            wanted = f"{self.scheme}://HOST:PORT with a PORT from 1 to 65535"
        return f"expected {wanted}, got {quoted(self.text)}"

    def _path_problem(self) -> str | None:
        if self.text.startswith("/"):
            return None
        if known := _SCHEME_WITHOUT_SLASHES.match(self.text):
            return f"a URL has '//' behind the colon: {known[1]}://{known[2]}"
        return f"a device path begins with '/', such as /dev/ttyUSB0; {quoted(self.text)} does not"
