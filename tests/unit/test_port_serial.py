"""Ports: real ttys (pty pairs), real TCP, real RFC 2217; closing, hang-ups, and what the errors say."""

from __future__ import annotations

import contextlib
import errno
import os
import pty
import pwd
import select
import shutil
import socket
import subprocess
import termios
import threading
import time
import tty
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import serial
from benches.machine import Machine
from serial import rfc2217

from bridged.errors import NotPermittedError, PortError
from bridged.ports import open_port, permission, sysfs
from bridged.ports import serial as ports

if TYPE_CHECKING:
    from collections.abc import Iterator

LIMIT_S = 30.0  # for what takes milliseconds


def wait_readable(fd: int) -> None:
    assert select.select([fd], [], [], LIMIT_S)[0], "nothing came"


def read_exactly(fd: int, n: int) -> bytes:
    data = b""
    while len(data) < n:
        wait_readable(fd)
        block = os.read(fd, n - len(data))
        assert block, f"end of file after {data!r}"
        data += block
    return data


@pytest.fixture
def pty_pair() -> Iterator[tuple[int, str]]:
    """Master, path of the slave. The master is raw from the start, as a real device is."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.close(slave)
    yield master, path
    with contextlib.suppress(OSError):
        os.close(master)


@contextlib.contextmanager
def terminal_session(path: str) -> Iterator[tuple[int, int]]:
    """A descriptor of the terminal, and the process whose controlling terminal it is, as of a shell."""
    slave = os.open(path, os.O_RDWR | os.O_NOCTTY)
    command = "echo; exec sleep 60"
    with subprocess.Popen(
        ["setsid", "--ctty", "sh", "-c", command], stdin=slave, stdout=subprocess.PIPE
    ) as shell:
        try:
            assert shell.stdout
            assert shell.stdout.readline()  # it has it now
            yield slave, shell.pid
        finally:
            shell.kill()
            os.close(slave)


class TestTty:
    def test_carries_every_byte_both_ways(self, pty_pair: tuple[int, str]) -> None:
        master, path = pty_pair
        everything = bytes(range(256))
        port = open_port(path, 57600)
        os.write(master, everything)
        assert read_exactly(port.fd, 256) == everything
        assert os.write(port.fd, everything) == 256
        assert read_exactly(master, 256) == everything
        port.close()

    def test_undoes_what_a_terminal_does_to_bytes(self, pty_pair: tuple[int, str]) -> None:
        master, path = pty_pair
        with open(path, "rb+", buffering=0) as slave:  # noqa: PTH123 - a descriptor of a tty
            attributes = termios.tcgetattr(slave)
            attributes[0] |= termios.IXON | termios.ICRNL | termios.BRKINT | termios.ISTRIP
            attributes[1] |= termios.OPOST | termios.ONLCR
            attributes[3] |= termios.ICANON | termios.ECHO | termios.ISIG
            termios.tcsetattr(slave, termios.TCSANOW, attributes)
            port = open_port(path, 57600)
        os.write(master, b"\r\x13\x03\xff")
        assert read_exactly(port.fd, 4) == b"\r\x13\x03\xff"
        os.write(port.fd, b"\n")
        assert read_exactly(master, 1) == b"\n"
        port.close()

    def test_no_data_is_eagain_and_a_hang_up_is_end_of_file(self, pty_pair: tuple[int, str]) -> None:
        master, path = pty_pair
        port = open_port(path, 57600)
        with pytest.raises(BlockingIOError):
            os.read(port.fd, 1)
        os.close(master)
        wait_readable(port.fd)
        assert os.read(port.fd, 1) == b""
        port.close()

    def test_drops_what_came_before(self, pty_pair: tuple[int, str]) -> None:
        master, path = pty_pair
        keeper = os.open(path, os.O_RDWR | os.O_NOCTTY)
        os.write(master, b"t1230\r")
        wait_readable(keeper)
        port = open_port(path, 57600)
        with pytest.raises(BlockingIOError):
            os.read(port.fd, 1)
        port.close()
        os.close(keeper)

    def test_close_does_not_wait_for_unsent_output(self, pty_pair: tuple[int, str]) -> None:
        master, path = pty_pair
        port = open_port(path, 57600)
        written = 0
        with contextlib.suppress(BlockingIOError):
            while True:
                written += os.write(port.fd, bytes(1024))
        start = time.monotonic()
        port.close()
        port.close()
        assert time.monotonic() - start < 15.0  # it does not hang; how fast it is, is no matter for a test
        assert port.fd == -1
        # A pty's close() waits for nothing, a UART's until its queue is empty: so see that it was emptied.
        arrived = 0
        with contextlib.suppress(OSError):  # EIO: the slave is closed
            while block := os.read(master, 4096):
                arrived += len(block)
        assert arrived <= 4096 < written  # 4096 the master has

    def test_close_does_not_wait_for_a_driver_that_waits(
        self, pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        _, path = pty_pair
        port = open_port(path, 57600)
        assert isinstance(port, ports.TtyPort)
        device, taken = port._device, threading.Event()

        def close() -> None:
            taken.wait(LIMIT_S)
            serial.Serial.close(device)

        monkeypatch.setattr(device, "close", close)
        monkeypatch.setattr(ports, "_CLOSE_LIMIT_S", 0.001)
        port.close()
        assert "is still being closed: its device takes no bytes" in caplog.text
        assert device.is_open
        taken.set()
        for thread in threading.enumerate():
            if thread.name.startswith("close "):
                thread.join(LIMIT_S)
        assert not device.is_open

    def test_close_after_a_hang_up(self, pty_pair: tuple[int, str]) -> None:
        master, path = pty_pair
        port = open_port(path, 57600)
        os.close(master)
        port.close()

    def test_opens_a_link_and_opens_it_again(self, pty_pair: tuple[int, str], tmp_path: Path) -> None:
        link = tmp_path / "can232"
        link.symlink_to(pty_pair[1])
        for _ in range(3):
            port = open_port(str(link), 57600)
            assert port.description == str(link)
            assert port.failure is None
            port.close()

    @pytest.mark.parametrize("baudrate", [2400, 57600, 115200, 230400, 3_000_000, 1_234_567])
    def test_baudrate_reaches_the_driver(self, pty_pair: tuple[int, str], baudrate: int) -> None:
        port = open_port(pty_pair[1], baudrate)
        assert ports._actual_baudrate(port.fd) == baudrate
        assert (
            termios.tcgetattr(port.fd)[2] & (termios.CSIZE | termios.PARENB | termios.CSTOPB) == termios.CS8
        )
        port.close()

    def test_leaks_no_descriptor(self, pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
        before = os.listdir("/proc/self/fd")  # noqa: PTH208 - names, not paths
        open_port(pty_pair[1], 57600).close()
        monkeypatch.setattr(ports, "_actual_baudrate", lambda _: 9600)
        with pytest.raises(PortError):
            open_port(pty_pair[1], 57600)
        assert os.listdir("/proc/self/fd") == before  # noqa: PTH208


@contextlib.contextmanager
def as_nobody() -> Iterator[None]:
    groups, gid, uid = os.getgroups(), os.getegid(), os.geteuid()
    nobody = pwd.getpwnam("nobody")
    os.setgroups([])
    os.setegid(nobody.pw_gid)
    os.seteuid(nobody.pw_uid)
    try:
        yield
    finally:
        os.seteuid(uid)
        os.setegid(gid)
        os.setgroups(groups)


class TestTtyErrors:
    def test_missing_names_what_is_there(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(ports, "_DEV", tmp_path)
        missing = tmp_path / "ttyUSB0"
        with pytest.raises(
            PortError, match=r"ttyUSB0: does not exist; serial adapters here: none$"
        ) as caught:
            open_port(str(missing), 57600)
        assert isinstance(caught.value.__cause__, OSError)
        (tmp_path / "serial/by-id").mkdir(parents=True)
        for name in ("ttyUSB1", "ttyACM0", "tty1", "serial/by-id/usb-FTDI_A123-if00-port0"):
            (tmp_path / name).touch()
        names = f"{tmp_path}/serial/by-id/usb-FTDI_A123-if00-port0, {tmp_path}/ttyUSB1, {tmp_path}/ttyACM0"
        with pytest.raises(PortError, match=f"here: {names}$"):
            open_port(str(missing), 57600)

    def test_a_service_has_its_own_tmp(self, monkeypatch: pytest.MonkeyPatch) -> None:
        path = "/tmp/is-nothing/can232"
        with pytest.raises(PortError, match="does not exist; serial adapters here"):
            open_port(path, 57600)
        monkeypatch.setenv("NOTIFY_SOCKET", "/run/x")
        with pytest.raises(PortError, match=r"does not exist: the service has a /tmp of its own"):
            open_port(path, 57600)

    def test_link_to_nothing(self, tmp_path: Path) -> None:
        (tmp_path / "link").symlink_to("/dev/pts/nothing")
        with pytest.raises(PortError, match="a link to /dev/pts/nothing, which does not exist"):
            open_port(str(tmp_path / "link"), 57600)

    def test_second_open_is_refused_and_names_the_first(
        self, pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        port = open_port(pty_pair[1], 57600)
        monkeypatch.setattr(sysfs, "_made_terminal", lambda *_: False)  # it is this process
        name = f"in use by .* .process {os.getpid()}."
        with pytest.raises(PortError, match=name):
            open_port(pty_pair[1], 57600)
        port.close()
        open_port(pty_pair[1], 57600).close()

    @pytest.mark.parametrize("by_link", [False, True])
    def test_somebody_s_terminal_is_not_taken(
        self, pty_pair: tuple[int, str], tmp_path: Path, by_link: bool
    ) -> None:
        """Neither opened, which would make it raw and type at it, nor locked."""
        path = pty_pair[1]
        link = tmp_path / "can232"
        link.symlink_to(path)
        with terminal_session(path) as (slave, shell):
            before = termios.tcgetattr(slave)
            before[3] |= termios.ICANON | termios.ECHO | termios.ISIG
            termios.tcsetattr(slave, termios.TCSANOW, before)
            before = termios.tcgetattr(slave)
            said = rf"{f'a link to {path}' if by_link else path}\)?: is the terminal of .* .process {shell}."
            with pytest.raises(PortError, match=rf"{said}.*not taken.*simulate --link"):
                open_port(str(link) if by_link else path, 57600)
            assert termios.tcgetattr(slave) == before
        open_port(path, 57600).close()  # nobody's any more

    def test_the_own_terminal_is_not_taken(self) -> None:
        with pytest.raises(PortError, match="/dev/tty: is the terminal that this program runs in"):
            open_port("/dev/tty", 57600)

    def test_program_that_excludes_others(
        self, pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """TIOCEXCL: open() itself gives EBUSY, but not to root, so that the kernel's part is played here."""

        def busy(*_: object, **__: object) -> int:
            raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))

        monkeypatch.setattr(sysfs, "users_as_terminal", lambda _: [])
        monkeypatch.setattr(os, "open", busy)
        with pytest.raises(PortError, match="in use by another program"):
            open_port(pty_pair[1], 57600)

    @pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a device that others may not open")
    @pytest.mark.parametrize(
        ("mode", "text"),
        [
            (
                0o620,
                r"user nobody has no permission \(crw--w----, group tty\): check the udev rule that",
            ),
            (0o660, r"user nobody has no permission: add it to group tty \(`usermod -aG tty nobody`\)"),
        ],
    )
    def test_no_permission(
        self, pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch, mode: int, text: str
    ) -> None:
        monkeypatch.setattr(permission, "in_container", lambda: False)
        path = pty_pair[1]
        shutil.chown(path, "root", "tty")
        Path(path).chmod(mode)
        with as_nobody(), pytest.raises(NotPermittedError, match=text):
            open_port(path, 57600)

    def test_not_in_the_device_cgroup(
        self, pty_pair: tuple[int, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The error names the rule; its device is the one behind a link."""
        link = tmp_path / "adapter"
        link.symlink_to(pty_pair[1])

        def forbid(*_: object, **__: object) -> int:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

        major = os.major(link.stat().st_rdev)
        monkeypatch.setattr(permission, "_in_service", lambda: False)
        monkeypatch.setattr(os, "open", forbid)
        monkeypatch.setattr(ports, "_refuse_terminal", lambda _: None)
        with pytest.raises(PortError) as caught:
            open_port(str(link), 57600)
        assert type(caught.value) is PortError
        assert str(caught.value).startswith(f"{link}: {pty_pair[1]} is none of the devices")
        assert f'--device-cgroup-rule="c {major}:* rmw"' in str(caught.value)

    def test_not_a_tty(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        for path in ("/dev/null", str(tmp_path), str(tmp_path / "file")):
            with pytest.raises(PortError, match="not a serial port"):
                open_port(path, 57600)

    def test_unplugged_at_the_wrong_moment(self) -> None:
        master, slave = pty.openpty()
        path = os.ttyname(slave)
        keeper = os.dup(slave)
        os.close(slave)
        os.close(master)
        with pytest.raises(PortError, match=r"no device behind it|does not exist"):
            open_port(path, 57600)
        os.close(keeper)

    def test_unplugged_while_it_is_opened(
        self, pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def gone(_: int) -> None:
            raise termios.error(errno.EIO, "Input/output error")

        with monkeypatch.context() as patch:
            patch.setattr(ports, "_make_raw", gone)
            with pytest.raises(PortError, match="no device behind it") as caught:
                open_port(pty_pair[1], 57600)
        open_port(pty_pair[1], 57600).close()  # the lock is not kept, even while the error is looked at
        assert isinstance(caught.value.__cause__, termios.error)

    def test_driver_that_cannot_do_the_rate(
        self, pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A pty does every rate; a 16550 asked for 3 MBd stays silently at 9600."""
        monkeypatch.setattr(ports, "_actual_baudrate", lambda _: 9600)
        with pytest.raises(PortError) as caught:
            open_port(pty_pair[1], 3_000_000)
        monkeypatch.setattr(ports, "_actual_baudrate", lambda _: 113_636)  # 1.4 % off: bears it
        open_port(pty_pair[1], 115_200).close()
        assert str(caught.value).endswith("the driver cannot do 3000000 Bd, it chose 9600 Bd")

    @pytest.mark.parametrize("baudrate", [0, -1, 1 << 40])
    def test_impossible_baudrate(self, pty_pair: tuple[int, str], baudrate: int) -> None:
        with pytest.raises(PortError, match=str(baudrate)):
            open_port(pty_pair[1], baudrate)


class TestTtyOfUsbDevice:
    """usb-serial://SERIAL"""

    @pytest.fixture
    def machine(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
        return Machine(tmp_path, monkeypatch)

    def test_opens_what_has_the_serial_number(self, machine: Machine, pty_pair: tuple[int, str]) -> None:
        machine.plug("ttyUSB0", "B2")
        node = machine.plug("ttyUSB1", "A1")
        node.unlink()
        node.symlink_to(pty_pair[1])
        port = open_port("usb-serial://A1", 57600)
        assert port.description == str(node)
        port.close()

    def test_missing_names_what_is_there(self, machine: Machine) -> None:
        text = "^usb-serial://A1: no USB device with a serial line has this serial number; those here: "
        with pytest.raises(PortError, match=f"{text}none$"):
            open_port("usb-serial://A1", 57600)
        machine.plug("ttyUSB1", "B2")
        machine.plug("ttyUSB0")  # of a device without serial number
        with pytest.raises(PortError, match=rf"{text}B2 \({machine.dev}/ttyUSB1\)$"):
            open_port("usb-serial://A1", 57600)

    def test_a_container_without_its_node(self, machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
        node = machine.plug("ttyUSB1", "A1")
        node.unlink()
        monkeypatch.setattr(permission, "_CONTAINER_MARKS", (machine.dev,))
        with pytest.raises(PortError, match=f"there is no {node} in this container: .*--volume /dev:/dev"):
            open_port("usb-serial://A1", 57600)

    def test_two_devices_alike_are_both_named(self, machine: Machine) -> None:
        machine.plug("ttyUSB0", "A1")
        machine.plug("ttyACM0", "A1")
        with pytest.raises(PortError) as caught:
            open_port("usb-serial://A1", 57600)
        for text in ("2 devices have", f"{machine.dev}/ttyUSB0 (", f"{machine.dev}/ttyACM0 (", "by-path"):
            assert text in str(caught.value)

    def test_malformed(self) -> None:
        with pytest.raises(PortError, match="not of the form usb-serial://SERIAL"):
            open_port("usb-serial://", 57600)


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(LIMIT_S)
        yield server


def url(scheme: str, server: socket.socket) -> str:
    return f"{scheme}://127.0.0.1:{server.getsockname()[1]}"


class TestTcp:
    def test_both_ways_and_hang_up(self, listener: socket.socket) -> None:
        port = open_port(url("socket", listener), 57600)
        peer, _ = listener.accept()
        with pytest.raises(BlockingIOError):
            os.read(port.fd, 1)
        peer.sendall(b"V1013\r")
        assert read_exactly(port.fd, 6) == b"V1013\r"
        os.write(port.fd, b"V\r")
        assert peer.recv(16) == b"V\r"
        peer.close()
        wait_readable(port.fd)
        assert os.read(port.fd, 1) == b""
        port.close()
        port.close()
        assert port.fd == -1

    def test_what_was_written_arrives_in_spite_of_close(self, listener: socket.socket) -> None:
        port = open_port(url("socket", listener), 57600)
        peer, _ = listener.accept()
        os.write(port.fd, b"C\r")
        port.close()
        assert peer.recv(16) == b"C\r"
        assert peer.recv(16) == b""
        peer.close()

    def test_close_does_not_wait_for_a_peer_that_does_not_read(self, listener: socket.socket) -> None:
        port = open_port(url("socket", listener), 57600)
        peer, _ = listener.accept()
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(port.fd, bytes(65536))
        start = time.monotonic()
        port.close()
        assert time.monotonic() - start < 15.0  # it does not hang; how fast it is, is no matter for a test
        peer.close()

    def test_notices_dead_peers_and_sends_at_once(self, listener: socket.socket) -> None:
        port = open_port(url("socket", listener), 57600)
        with socket.socket(fileno=os.dup(port.fd)) as twin:
            for level, option, value in ports._TCP_OPTIONS:
                assert twin.getsockopt(level, option) == value
        port.close()

    def test_nothing_listens(self, listener: socket.socket) -> None:
        addresses = [url(scheme, listener) for scheme in ("socket", "rfc2217")]
        listener.close()
        for address in addresses:
            with pytest.raises(PortError, match=f"{address}: refused, nothing listens there") as caught:
                open_port(address, 57600)
            assert isinstance(caught.value.__cause__, OSError)

    @pytest.mark.parametrize(
        ("error", "text"),
        [
            (socket.gaierror(-2, "Name or service not known"), "host name is not known"),
            (TimeoutError("timed out"), "no answer: is the host switched on"),
            (OSError(errno.ENETUNREACH, "Network is unreachable"), "Network is unreachable"),
        ],
    )
    def test_not_reachable(self, error: OSError, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
        def fail(*_: object, **__: object) -> socket.socket:
            raise error

        monkeypatch.setattr(socket, "create_connection", fail)
        for scheme in ("socket", "rfc2217"):
            with pytest.raises(PortError, match=text):
                open_port(f"{scheme}://gateway:4001", 57600)

    @pytest.mark.parametrize(
        "bad", ["socket://", "socket://host", "socket://host:0", "socket://h:99999", "socket://h:x"]
    )
    def test_malformed(self, bad: str) -> None:
        with pytest.raises(PortError, match="not of the form socket://HOST:PORT"):
            open_port(bad, 57600)

    def test_unknown_scheme(self) -> None:
        with pytest.raises(PortError, match="'telepathy' not known"):
            open_port("telepathy://device", 57600)


class SerialServer:
    """An RFC 2217 server as in pyserial's examples; its serial port is looped back: it returns every byte."""

    def __init__(self, listener: socket.socket) -> None:
        self.listener = listener
        self.device = serial.serial_for_url("loop://", timeout=0.01)
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self) -> None:
        self.connection, _ = self.listener.accept()
        self.connection.settimeout(0.01)
        manager = rfc2217.PortManager(self.device, self)  # type: ignore[arg-type]
        with self.connection, contextlib.suppress(OSError):
            while True:
                with contextlib.suppress(TimeoutError):
                    data = self.connection.recv(1024)
                    if not data:
                        return
                    self.device.write(b"".join(manager.filter(data)))
                self.write(b"".join(manager.escape(self.device.read(self.device.in_waiting))))

    def write(self, data: bytes) -> None:
        self.connection.sendall(data)

    def hang_up(self) -> None:
        self.connection.shutdown(socket.SHUT_RDWR)


@pytest.mark.filterwarnings("ignore:setDaemon:DeprecationWarning", "ignore:setName:DeprecationWarning")
class TestRfc2217:
    @pytest.fixture
    def server(self, listener: socket.socket) -> Iterator[SerialServer]:
        server = SerialServer(listener)
        yield server
        server.thread.join(LIMIT_S)
        assert not server.thread.is_alive()
        server.device.close()

    def test_both_ways(self, server: SerialServer) -> None:
        port = open_port(url("rfc2217", server.listener), 57600)
        assert server.device.baudrate == 57600
        with pytest.raises(BlockingIOError):
            os.read(port.fd, 1)
        everything = bytes(range(256)) * 8  # with 0xFF, telnet's escape
        os.write(port.fd, everything)
        assert read_exactly(port.fd, len(everything)) == everything
        port.close()
        port.close()
        assert port.failure is None

    def test_hang_up_ends_the_descriptor_and_says_why(self, server: SerialServer) -> None:
        port = open_port(url("rfc2217", server.listener), 57600)
        server.hang_up()
        wait_readable(port.fd)
        assert os.read(port.fd, 1) == b""
        assert isinstance(port.failure, PortError)
        assert isinstance(port.failure.__cause__, OSError)
        assert "connection failed" in str(port.failure)
        start = time.monotonic()
        port.close()
        assert time.monotonic() - start < 15.0  # it does not hang; how fast it is, is no matter for a test

    def test_a_flood_ends_it_before_the_memory(self) -> None:
        class Flooding:
            """What pyserial's rfc2217:// is when its server sends faster than bytes come out of its queue."""

            in_waiting = 0

            def read(self, size: int) -> bytes:
                self.in_waiting = 2 * self.in_waiting + 1000
                return bytes(size)

            def close(self) -> None:
                self.closed = True

        device = Flooding()
        port = ports.PumpedPort("rfc2217://h:1", device)
        received = 0
        while True:
            wait_readable(port.fd)
            if not (data := os.read(port.fd, 1 << 20)):
                break
            received += len(data)
        assert received < 1_100_000
        assert str(port.failure).startswith("rfc2217://h:1: more than 1 MB waits to be read")
        port.close()
        assert device.closed

    def test_notices_dead_peers(self, server: SerialServer) -> None:
        port = open_port(url("rfc2217", server.listener), 57600)
        connection = port._device._socket  # type: ignore[attr-defined]
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 10_000
        port.close()

    def test_server_that_speaks_no_rfc2217(self, listener: socket.socket) -> None:
        with pytest.raises(PortError, match="does not speak RFC 2217: use socket://HOST:PORT"):
            open_port(url("rfc2217", listener) + "?timeout=0.01", 57600)
