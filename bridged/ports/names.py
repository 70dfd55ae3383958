"""What the port of an adapter may be called: a device path, or a URL."""

import os
import re

from bridged.text import quoted

_SCHEMES = {"can232": ("socket", "rfc2217"), "usb2can": ("socket", "usb")}
_SCHEMES_OF_OTHERS = {
    "rfc2217": "rfc2217:// sets the baud rate of a serial line, and a USB2CAN has none; write socket://",
    "usb": "usb:// goes with type: usb2can; a CAN232 is on a serial line, such as /dev/ttyUSB0",
}

_SCHEME_WITHOUT_SLASHES = re.compile(r"(usb|socket|rfc2217):/?([!-~]+)", re.ASCII)

_LABEL = "[A-Za-z0-9_-]{1,63}"
_ADDRESS = re.compile(
    rf"(?:{_LABEL}(?:\.{_LABEL})*\.?|\[[0-9A-Fa-f:.]+(?:%[\w.-]+)?\]):([0-9]{{1,5}})/?(?:\?\S*)?", re.ASCII
)
"""HOST:PORT, [IPv6]:PORT, with pyserial's options: nas.local:4001, [fe80::1%eth0]:4001, h:1?logging=debug."""

USB_DEVICE = re.compile(r"[0-9A-Fa-f]{4}:[0-9A-Fa-f]{4}(?:/([!-~]{1,32}))?")
"""VID:PID or VID:PID/SERIAL: 0403:6001, 0403:6001/A6008isP."""


def port_problem(port: str, adapter_type: str | None) -> str | None:
    """What is wrong with a port for this type of adapter; None as the type: for any."""
    scheme, separator, rest = port.partition("://")
    if not separator:
        if port.startswith("/"):
            return None
        if known := _SCHEME_WITHOUT_SLASHES.match(port):
            return f"a URL has '//' behind the colon: {known[1]}://{known[2]}"
        return f"a device path begins with '/', such as /dev/ttyUSB0; {quoted(port)} does not"
    schemes = ("socket", "rfc2217", "usb") if adapter_type is None else _SCHEMES[adapter_type]
    if scheme not in schemes:
        if scheme == "tcp":
            return f"a raw TCP port is written {quoted(f'socket://{rest}')}"
        if text := _SCHEMES_OF_OTHERS.get(scheme):
            return text
        wanted = " or ".join(f"{name}://" for name in schemes)
        return f"the URL of a port begins with {wanted}, not {quoted(scheme + separator)}"
    if scheme == "usb":
        if USB_DEVICE.fullmatch(rest):
            return None
        wanted = "expected usb://VID:PID or usb://VID:PID/SERIAL, VID and PID as 4 hex digits each"
        return f"{wanted}, got {quoted(port)}"
    address = _ADDRESS.fullmatch(rest)
    if not address or not 1 <= int(address[1]) <= 65_535:
        return f"expected {scheme}://HOST:PORT with a PORT from 1 to 65535, got {quoted(port)}"
    return None


def is_numbered_terminal(port: str) -> bool:
    """Whether it is /dev/pts/N itself, and no link to it: a name that the kernel uses again and again."""
    return re.fullmatch(r"/dev/pts/\d+", os.path.normpath(port)) is not None
