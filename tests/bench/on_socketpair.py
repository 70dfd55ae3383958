"""can-bridge where the kernel has no CAN, its bus an end of a socketpair: on_socketpair.py FD ARGUMENT…"""

import socket
import sys

from bridged.cli import main
from bridged.interfaces import socketcan


class SocketpairBus:
    warning = ""
    failure = None
    description = "socketpair"

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)
        self._socket.setblocking(False)
        self.fd = fd

    def dropped(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        self.fd = -1
        self._socket.close()


if __name__ == "__main__":
    end = SocketpairBus(int(sys.argv.pop(1)))
    socketcan.open_socketcan = lambda *_args, **_options: end  # type: ignore[assignment]
    socketcan.is_up = lambda _channel: True
    sys.exit(main())
