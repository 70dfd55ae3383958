"""What the port of an adapter may be called: a device path, or a URL."""

import re

from bridged.yaml_source import quoted

_SCHEMES = {"can232": ("socket", "rfc2217"), "usb2can": ("socket", "usb")}
_SCHEMES_OF_OTHERS = {
    "rfc2217": "rfc2217:// sets the baud rate of a serial line, and a FT245 has none; write socket://",
    "usb": "usb:// goes with type: usb2can; a CAN232 is on a serial line, such as /dev/ttyUSB0",
}

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
        return f"a device path begins with '/', such as /dev/ttyUSB0; {quoted(port)} does not"
    schemes = ("socket", "rfc2217", "usb") if adapter_type is None else _SCHEMES[adapter_type]
    if scheme not in schemes:
        if text := _SCHEMES_OF_OTHERS.get(scheme):
            return text
        wanted = " or ".join(f"{name}://" for name in schemes)
        return f"the URL of a port begins with {wanted}, not {quoted(scheme + separator)}"
    if scheme == "usb":
        if USB_DEVICE.fullmatch(rest):
            return None
        wanted = "usb://VID:PID or usb://VID:PID/SERIAL, VID and PID as 4 hex digits each, is wanted"
        return f"{wanted}, not {quoted(port)}"
    address = _ADDRESS.fullmatch(rest)
    if not address or not 1 <= int(address[1]) <= 65_535:
        return f"{scheme}://HOST:PORT with a PORT from 1 to 65535 is wanted, not {quoted(port)}"
    return None
