"""A CAN interface of the kernel: raw socket, and the vcan made on request."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import socket
import struct
from typing import Final

from bridged.errors import GET_CAN, NO_CAN, BridgeError, InterfaceError

# Not in Python's socket module: asm-generic/socket.h, linux/sockios.h, net/if.h, net/if_arp.h, linux/can/*.h
_SO_SNDBUFFORCE: Final = 32
_SO_RCVBUFFORCE: Final = 33
_SO_TIMESTAMPNS: Final = 35
_SO_MEMINFO: Final = 55
_SIOCGIFFLAGS: Final = 0x8913
_SIOCSIFFLAGS: Final = 0x8914
_SIOCGIFHWADDR: Final = 0x8927
_IFF_UP: Final = 0x1
_ARPHRD_CAN: Final = 280
_CAN_RAW_ERR_FILTER: Final = 2
_CAN_ERR_MASK: Final = 0x1FFFFFFF

_SK_MEMINFO_DROPS: Final = 8  # linux/sock_diag.h
_OVERFLOW: Final = "socket-overflow"  # interface -> device: the relay did not come to read in time

_IFREQ: Final = struct.Struct("=16sH22x")  # name, then flags or the family of the hardware address
_NAME_MAX: Final = 15
_BUFFER_BYTES: Final = 4 << 20  # the kernel doubles it and charges 768 a frame: 10,900 frames

# linux/netlink.h, linux/rtnetlink.h, linux/if_link.h
_RTM_NEWLINK: Final = 16
_NLM_F_REQUEST: Final = 0x001
_NLM_F_ACK: Final = 0x004
_NLM_F_EXCL: Final = 0x200
_NLM_F_CREATE: Final = 0x400
_IFLA_IFNAME: Final = 3
_IFLA_LINKINFO: Final = 18
_IFLA_INFO_KIND: Final = 1
_NLMSGHDR: Final = struct.Struct("=IHHII")  # length, type, flags, sequence, port
_IFINFOMSG: Final = struct.Struct("=BxHiII")  # family, type, index, flags, mask of the flags to change
_NLMSGERR: Final = struct.Struct("=i")  # 0 or -errno, behind the header of the answer


class SocketcanInterface:
    """A non-blocking CAN_RAW socket that gets all frames of the interface but those it sent itself."""

    def __init__(self, channel: str, sock: socket.socket, warning: str) -> None:
        self.description = f"socketcan {channel}"
        self.warning = warning
        self.failure: BridgeError | None = None  # never set: the socket's own errors tell
        self._socket = sock
        self.fd = sock.fileno()

    def dropped(self) -> dict[str, int]:
        """What SO_RXQ_OVFL counts, asked for instead of told with a later frame: exact at any time."""
        if self.fd < 0:
            return {}
        words = struct.unpack("=9I", self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))
        return {_OVERFLOW: words[_SK_MEMINFO_DROPS]}

    def close(self) -> None:
        self.fd = -1
        self._socket.close()


def open_socketcan(channel: str, create: bool) -> SocketcanInterface:
    """Open the interface `channel`; `create` makes it as a vcan if it is missing and brings it up.

    An interface that is down opens (frames are lost until it is up, `warning` says so).
    Raises InterfaceError.
    """
    if not 0 < len(channel.encode()) <= _NAME_MAX or "/" in channel or channel.split() != [channel]:
        raise InterfaceError(
            f"{channel!r} is no name of an interface: 1 to {_NAME_MAX} characters, no '/', no space"
        )
    sock = _raw_socket()
    try:
        flags = _prepare_interface(sock, channel, create)
        _set_options(sock)
        sock.bind((channel,))
    except OSError as error:
        sock.close()
        raise InterfaceError(f"{channel}: cannot be opened: {error.strerror}") from error
    except InterfaceError:
        sock.close()
        raise
    warning = "" if flags & _IFF_UP else f"{channel} is down: ip link set {channel} up (or `create: true`)"
    return SocketcanInterface(channel, sock, warning)


def make_interface(channel: str) -> bool:
    """Make the vcan `channel` if there is none and bring it up; False: it was up before. InterfaceError."""
    was_up = is_up(channel)
    open_socketcan(channel, create=True).close()
    return not was_up


def is_up(channel: str) -> bool:
    """Whether there is such an interface, and it is up."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as any_socket:  # netdevice(7): any will do
        try:
            return bool(_ifreq(any_socket, _SIOCGIFFLAGS, channel)[1] & _IFF_UP)
        except OSError:
            return False


def _raw_socket() -> socket.socket:
    try:
        return socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW)
    except OSError as error:
        if error.errno not in {errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT}:
            raise InterfaceError(f"no CAN socket: {error.strerror}") from error
        service = "allow AF_CAN in RestrictAddressFamilies=, " if "NOTIFY_SOCKET" in os.environ else ""
        other = "or use another python-can interface (`interface: udp_multicast`)"
        raise InterfaceError(f"{NO_CAN}: {GET_CAN}, {service}{other}") from error


def _prepare_interface(sock: socket.socket, channel: str, create: bool) -> int:
    """Make sure that it is there, is CAN and, with `create`, up; its flags."""
    try:
        _, family = _ifreq(sock, _SIOCGIFHWADDR, channel)
    except OSError as error:
        if error.errno != errno.ENODEV:
            raise
        if not create:
            raise InterfaceError(
                f"{channel}: there is no such interface ({_present(sock)}); `ip link add dev {channel} "
                f"type vcan` and `ip link set {channel} up` make a virtual one, and so does `create: true`"
            ) from error
        _create_vcan(channel)
        _, family = _ifreq(sock, _SIOCGIFHWADDR, channel)
    if family != _ARPHRD_CAN:
        raise InterfaceError(f"{channel}: not a CAN interface ({_present(sock)})")
    _, flags = _ifreq(sock, _SIOCGIFFLAGS, channel)
    if create and not flags & _IFF_UP:
        flags |= _IFF_UP
        _bring_up(sock, channel, flags)
    return flags


def _set_options(sock: socket.socket) -> None:
    """Loopback stays on, own frames stay off (both the kernel's default): others see ours, we do not."""
    # CAN FD and error frames are not forwarded; they come in so that they are counted.
    sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _CAN_ERR_MASK)
    receive_stamped(sock)
    set_buffers(sock)


def receive_stamped(sock: socket.socket) -> None:
    """Each datagram comes with the time when it was queued (SCM_TIMESTAMPNS), so its age is known."""
    sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def set_buffers(sock: socket.socket) -> None:
    """Ask for _BUFFER_BYTES both ways; without CAP_NET_ADMIN it is net.core.rmem_max and wmem_max at most."""
    for force, ask in ((_SO_RCVBUFFORCE, socket.SO_RCVBUF), (_SO_SNDBUFFORCE, socket.SO_SNDBUF)):
        try:
            sock.setsockopt(socket.SOL_SOCKET, force, _BUFFER_BYTES)
        except PermissionError:
            sock.setsockopt(socket.SOL_SOCKET, ask, _BUFFER_BYTES)


def _ifreq(sock: socket.socket, request: int, channel: str, value: int = 0) -> tuple[bytes, int]:
    answer = fcntl.ioctl(sock, request, _IFREQ.pack(channel.encode(), value))
    return _IFREQ.unpack(answer)


def _present(sock: socket.socket) -> str:
    names = []
    for _, name in socket.if_nameindex():
        with contextlib.suppress(OSError):  # gone in the meantime
            if _ifreq(sock, _SIOCGIFHWADDR, name)[1] == _ARPHRD_CAN:
                names.append(name)
    return f"CAN interfaces here: {', '.join(names) or 'none'}"


def _bring_up(sock: socket.socket, channel: str, flags: int) -> None:
    try:
        _ifreq(sock, _SIOCSIFFLAGS, channel, flags)
    except PermissionError as error:
        raise InterfaceError(
            f"{channel}: is down, and to bring it up takes CAP_NET_ADMIN: `ip link set {channel} up` as root"
        ) from error
    except OSError as error:
        raise InterfaceError(
            f"{channel}: is down and does not come up ({error.strerror}); a real CAN controller needs its "
            f"bit rate first: `ip link set {channel} up type can bitrate 125000`"
        ) from error


def _create_vcan(channel: str) -> None:
    """What `ip link add dev vcan0 type vcan` does; the kernel loads its module by itself."""
    code = _request_link(channel, b"vcan")
    if code in {0, errno.EEXIST}:  # somebody else was faster: as good
        return
    cause = OSError(code, os.strerror(code))
    if code in {errno.EPERM, errno.EACCES}:
        raise InterfaceError(
            f"{channel}: creating it needs CAP_NET_ADMIN: {_who_may_create(channel)}"
        ) from cause
    if code == errno.EOPNOTSUPP:
        raise InterfaceError(
            f"{channel}: cannot be made, this kernel has no vcan: try `modprobe vcan` (Ubuntu: package "
            "linux-modules-extra-$(uname -r))"
        ) from cause
    raise InterfaceError(f"{channel}: cannot be made: {cause.strerror}") from cause


def _who_may_create(channel: str) -> str:
    if (
        "NOTIFY_SOCKET" in os.environ
    ):  # deleted since the start, another one after a reload, an old installation
        return (
            "can-bridge-interface@.service has it, `systemctl start can-bridge-interface@NAME` makes it now; "
            "the bridge itself may with create.conf (systemd/README.md)"
        )
    return f"`can-bridge interface {channel}` as root, in a container as uid 0 with --cap-add NET_ADMIN"


def _request_link(channel: str, kind: bytes) -> int:
    """Ask the kernel for a new interface (rtnetlink(7), RTM_NEWLINK); 0 or its errno."""
    body = (
        _IFINFOMSG.pack(socket.AF_UNSPEC, 0, 0, 0, 0)
        + _attribute(_IFLA_IFNAME, channel.encode() + b"\0")
        + _attribute(_IFLA_LINKINFO, _attribute(_IFLA_INFO_KIND, kind))
    )
    flags = _NLM_F_REQUEST | _NLM_F_ACK | _NLM_F_CREATE | _NLM_F_EXCL
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.send(_NLMSGHDR.pack(_NLMSGHDR.size + len(body), _RTM_NEWLINK, flags, 1, 0) + body)
        answer = netlink.recv(4096)
    return -int(_NLMSGERR.unpack_from(answer, _NLMSGHDR.size)[0])


def _attribute(kind: int, payload: bytes) -> bytes:
    """Length without the padding, type, payload, padding to 4 bytes."""
    return struct.pack("=HH", 4 + len(payload), kind) + payload + bytes(-len(payload) % 4)
