"""What can go wrong, by who can mend it. Any other exception is a bug."""

from __future__ import annotations

from typing import Final


class BridgeError(Exception):
    """Base of all errors that this package raises on purpose; the text says what to do."""


class ConfigError(BridgeError):
    """The configuration cannot be used: `problems` holds one line each, `FILE:LINE:COLUMN: path: text`."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class PortError(BridgeError):
    """The port could not be opened, or is gone: cable pulled, no permission, host not reachable."""


class NotPermittedError(PortError):
    """The port may not be opened: perhaps not yet, udev permits it a moment after the kernel has made it."""


class AdapterError(BridgeError):
    """The device on the port did not do what its manual says: no answer, a refusal, the wrong device."""


class WrongDeviceError(AdapterError):
    """The device answers, but is not the one that the configuration means; trying again soon is no use."""


class InterfaceError(BridgeError):
    """The CAN interface on the host's side could not be opened, made or used."""


NO_CAN: Final = "this kernel has no SocketCAN"
GET_CAN: Final = (
    "try `modprobe can_raw`, install a kernel that has it (Debian: linux-image-amd64, not -cloud-amd64)"
)
