"""A socketcan interface without CAN in the kernel; with it: tests/system/test_interface_socketcan.py."""

from __future__ import annotations

import errno
import socket
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from bridged.errors import InterfaceError
from bridged.interfaces import open_interface, socketcan

if TYPE_CHECKING:
    pass


def has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


class TestSocketcan:
    @pytest.mark.skipif(has_can(), reason="this kernel has CAN")
    def test_kernel_without_can(self) -> None:
        with pytest.raises(InterfaceError, match=r"no SocketCAN: try `modprobe can_raw`") as caught:
            open_interface("socketcan", "vcan0", create=True, options={})
        assert isinstance(caught.value.__cause__, OSError)

    @pytest.mark.parametrize("name", ["", "a/b", "0123456789abcdef", "vcan 0", "vcan0\n"])
    def test_names_that_no_interface_can_have(self, name: str) -> None:
        with pytest.raises(InterfaceError, match="is no name of an interface"):
            open_interface("socketcan", name, create=True, options={})

    @pytest.mark.parametrize(
        ("code", "advice"),
        [
            (
                errno.EPERM,
                r"`can-bridge interface vcan0` as root, in a container as uid 0 with --cap-add NET_ADMIN",
            ),
            (errno.EOPNOTSUPP, "this kernel has no vcan: try `modprobe vcan`"),
            (errno.ENOMEM, "cannot be made: Cannot allocate memory"),
        ],
    )
    def test_interface_that_cannot_be_made(
        self, code: int, advice: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(socketcan, "_request_link", lambda *_: code)
        with pytest.raises(InterfaceError, match=f"^vcan0: .*{advice}") as caught:
            socketcan._create_vcan("vcan0")
        assert isinstance(caught.value.__cause__, OSError)

    def test_the_service_has_another_unit_for_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("NOTIFY_SOCKET", "/run/systemd/notify")
        monkeypatch.setattr(socketcan, "_request_link", lambda *_: errno.EPERM)
        with pytest.raises(InterfaceError, match="`systemctl start can-bridge-interface@NAME` makes it now"):
            socketcan._create_vcan("vcan0")

    def test_the_sysctl_file_allows_the_buffer(self) -> None:
        text = (Path(__file__).parents[2] / "systemd/can-bridge.sysctl").read_text()
        for limit in ("rmem_max", "wmem_max"):
            assert f"\nnet.core.{limit} = {socketcan._BUFFER_BYTES}\n" in text

    def test_somebody_else_made_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(socketcan, "_request_link", lambda *_: errno.EEXIST)
        socketcan._create_vcan("vcan0")

    def test_kernel_understands_the_request(self) -> None:
        """The request itself: a kind that no kernel has is refused as such, and not as malformed."""
        assert socketcan._request_link("bridgetest", b"nonsense") in {errno.EOPNOTSUPP, errno.EPERM}
