"""A fake FT245 (0403:6001) behind the kernel's vhci-hcd: like a real one it sends status bytes when idle.

The kernel enumerates it as a USB device and makes a ttyUSB of it; libusb sees it, too. It speaks the protocol
of USB/IP (Documentation/usb/usbip_protocol.rst) on one end of a socketpair, whose other end the kernel has.
Everything that a host sends is in `received`; what `send` was given goes to the host.
"""

import math
import os
import select
import shutil
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path

VHCI = Path("/sys/devices/platform/vhci_hcd.0")
# A real chip is idle for 1 ms at least; a machine that is emulated would do nothing else than to hear of it.
MIN_LATENCY_S = 0.004

# struct usbip_header: command, sequence number, device, direction, endpoint; then 28 bytes by command.
SUBMIT = struct.Struct(">IIIII Iiiii8s")  # flags, length, …, setup packet
RESULT = struct.Struct(">IIIII iiiii8x")  # status, length, …
CMD_SUBMIT, CMD_UNLINK, RET_SUBMIT, RET_UNLINK = 1, 2, 3, 4
DIRECTION_IN = 1
STALL, UNLINKED = -32, -104  # EPIPE, ECONNRESET
SPEED_FULL = 2
FREE = "004"  # VDEV_ST_NULL

PACKET = 64
STATUS = b"\x01\x60"
FIFO = 128  # bytes from the host that the device has not read
GET_DESCRIPTOR = (0x80, 6)
GET_CONFIGURATION = (0x80, 8)
RESET, PURGE_FROM_HOST = (0x40, 0), (0, 1)  # all, or what came from the host and was not read
SET_LATENCY = (0x40, 9)
GET_LATENCY = (0xC0, 10)


def load_driver() -> bool:
    """Whether this kernel has vhci-hcd, and lets us use it."""
    if not VHCI.exists() and shutil.which("modprobe"):
        subprocess.run(["modprobe", "-q", "vhci-hcd"], check=False)
    return os.access(VHCI / "attach", os.W_OK)


def string_descriptor(text: str) -> bytes:
    coded = text.encode("utf-16-le")
    return bytes([len(coded) + 2, 3]) + coded


class FakeFt245:
    """The chip; `idle_s` is how long at least it says nothing while it has nothing to say.

    What is wired to it overrides `_work_at`, `_work` and `_arrived`, which are called in its thread.
    """

    def __init__(self, serial_number: str, idle_s: float = MIN_LATENCY_S) -> None:
        self.serial_number = serial_number
        self._idle_s = idle_s
        self.requests: list[tuple[int, int, int, int]] = []  # FTDI's: type, request, value, index
        self.idle_packets = 0  # that carried no data
        self.latency_ms = 16
        self.heard_all_at = 0.0  # time.time(); what `_arrived` is given has come since, however busy we were
        self._received = bytearray()
        self._to_send = bytearray()
        self._reads: list[tuple[int, int, float]] = []  # sequence number, length, when it is answered at last
        self.may_read: int | None = None  # so many bytes more the device reads; None: all that come
        self._fifo = b""
        self._writes: list[
            tuple[int, bytes, int]
        ] = []  # sequence number, what is not in the FIFO yet, length
        self._lock = threading.Lock()
        self._port = -1
        endpoints = struct.pack("<BBBBHB", 7, 5, 0x81, 2, PACKET, 0) + struct.pack(
            "<BBBBHB", 7, 5, 2, 2, PACKET, 0
        )
        interface = struct.pack("<9B", 9, 4, 0, 0, 2, 0xFF, 0xFF, 0xFF, 2) + endpoints
        self._descriptors = {
            0x100: struct.pack(
                "<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0, 0, 0, 8, 0x0403, 0x6001, 0x0400, 1, 2, 3, 1
            ),
            0x200: struct.pack("<BBHBBBBB", 9, 2, 9 + len(interface), 1, 1, 0, 0xA0, 45) + interface,
            0x300: b"\x04\x03\x09\x04",
            0x301: string_descriptor("FTDI"),
            0x302: string_descriptor("fake FT245"),
            0x303: string_descriptor(serial_number),
        }

    @property
    def received(self) -> bytes:
        with self._lock:
            return bytes(self._received)

    def send(self, data: bytes) -> None:
        with self._lock:
            self._to_send += data
        self._awake()

    def _awake(self) -> None:
        if self._port >= 0:
            os.write(self._wake[1], b"x")

    def plug(self) -> None:
        self._reads.clear()
        self._writes.clear()
        self._fifo, self.may_read = b"", None
        self._to_send.clear()
        self.heard_all_at = time.time()
        ours, theirs = socket.socketpair()
        self._wake = os.pipe()
        rows = (line.split() for line in (VHCI / "status").read_text().splitlines())
        self._port = next(int(row[1]) for row in rows if row[0] == "hs" and row[2] == FREE)
        with theirs:
            (VHCI / "attach").write_text(f"{self._port} {theirs.fileno()} {self._port + 2} {SPEED_FULL}")
        self._thread = threading.Thread(target=self._serve, args=(ours,), daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Idempotent."""
        if self._port < 0:
            return
        (VHCI / "detach").write_text(str(self._port))
        self._port = -1
        self._thread.join(60)
        for fd in self._wake:
            os.close(fd)

    def _work_at(self) -> float:
        """When `_work` has something to do (time.monotonic()); math.inf if that is not known."""
        return math.inf

    def _work(self) -> None:
        """What is due behind the chip; called in every turn."""

    def _arrived(self, data: bytes) -> None:
        """The host has sent this."""
        with self._lock:
            self._received += data

    def _serve(self, line: socket.socket) -> None:
        ends = [line.fileno(), self._wake[0]]
        while True:
            now = time.time()
            ready, _, _ = select.select(ends, [], [], 0)
            if not ready:
                self.heard_all_at = now
                until = min(self._work_at(), self._reads[0][2] if self._reads else math.inf)
                wait_s = None if until == math.inf else max(0.0, until - time.monotonic())
                ready, _, _ = select.select(ends, [], [], wait_s)
            if self._wake[0] in ready:
                os.read(self._wake[0], 4096)
            if line.fileno() in ready and not self._take(line):
                break
            self._work()
            if not self._accept_writes(line) or not self._answer_reads(line):
                break
        line.close()

    def _answer_reads(self, line: socket.socket) -> bool:
        """Data, or none after a while; False: unplugged."""
        while self._reads and (self._to_send or self._reads[0][2] <= time.monotonic()):
            sequence, length, _ = self._reads.pop(0)
            if not self._reply(line, sequence, self._packets(length)):
                return False
            later = self._idle_until()
            self._reads = [(other, size, later) for other, size, _ in self._reads]
        return True

    def reads(self, more: int | None) -> None:
        """The device reads so many bytes more from now on; None: all that come."""
        self.may_read = more
        self._awake()

    def _accept_writes(self, line: socket.socket) -> bool:
        """What the host writes goes on as far as there is room, packet by packet; False: unplugged."""
        self._device_reads()
        while self._writes and len(self._fifo) + min(PACKET, len(self._writes[0][1])) <= FIFO:
            sequence, data, length = self._writes.pop(0)
            self._fifo += data[:PACKET]
            self._device_reads()
            if data[PACKET:]:
                self._writes.insert(0, (sequence, data[PACKET:], length))
            elif not self._reply(line, sequence, length=length):
                return False
        return True

    def _device_reads(self) -> None:
        read = self._fifo if self.may_read is None else self._fifo[: self.may_read]
        self._fifo = self._fifo[len(read) :]
        if self.may_read is not None:
            self.may_read -= len(read)
        if read:
            self._arrived(read)

    def _idle_until(self) -> float:
        return time.monotonic() + max(self.latency_ms / 1000, self._idle_s)

    def _take(self, line: socket.socket) -> bool:
        """One request of the kernel's; False: unplugged."""
        header = receive(line, SUBMIT.size)
        if header is None:
            return False
        command, sequence, _, direction, endpoint, flags, length, *_, setup = SUBMIT.unpack(header)
        if command == CMD_UNLINK:  # in its place of the flags is which one
            waiting = len(self._reads) + len(self._writes)
            begun = [write for write in self._writes if write[0] == flags and len(write[1]) < write[2]]
            self._reads = [read for read in self._reads if read[0] != flags]
            self._writes = [write for write in self._writes if write[0] != flags]
            status = UNLINKED if len(self._reads) + len(self._writes) < waiting else 0
            for _, rest, size in begun:  # it has ended, then: only so the host hears how many bytes went
                status = 0
                if not self._reply(line, flags, length=size - len(rest)):
                    return False
            return send(line, RESULT.pack(RET_UNLINK, sequence, 0, 0, 0, status, 0, 0, 0, 0))
        data = receive(line, length) if direction != DIRECTION_IN else b""
        if data is None:
            return False
        if endpoint == 0:
            answer = self._control(setup)
            if answer is None:
                return self._reply(line, sequence, status=STALL)
            if direction == DIRECTION_IN:
                return self._reply(line, sequence, answer)
            return self._reply(line, sequence, length=length)
        if direction == DIRECTION_IN:
            self._reads.append((sequence, length, self._idle_until()))
            return True
        self._writes.append((sequence, data, length))
        return True

    @staticmethod
    def _reply(
        line: socket.socket, sequence: int, data: bytes = b"", *, status: int = 0, length: int | None = None
    ) -> bool:
        size = len(data) if length is None else length
        return send(line, RESULT.pack(RET_SUBMIT, sequence, 0, 0, 0, status, size, 0, 0, 0) + data)

    def _packets(self, length: int) -> bytes:
        """At most `length` bytes: packets of two status bytes and up to 62 of data, until one is not full."""
        packets = b""
        with self._lock:
            while len(packets) + PACKET <= length:
                data = bytes(self._to_send[: PACKET - len(STATUS)])
                del self._to_send[: len(data)]
                packets += STATUS + data
                self.idle_packets += not data
                if len(data) < PACKET - len(STATUS):
                    break
        return packets

    def _control(self, setup: bytes) -> bytes | None:
        """The answer to a control request; None: a stall, the chip does not know it."""
        kind, request, value, index, length = struct.unpack("<BBHHH", setup)
        if (kind, request) == GET_DESCRIPTOR:
            descriptor = self._descriptors.get(value)
            return None if descriptor is None else descriptor[:length]
        if (kind, request) == GET_CONFIGURATION:
            return b"\x01"
        if kind & 0x60 == 0:  # standard
            return bytes(length) if kind & 0x80 else b""
        if kind & 0x80 == 0:
            self.requests.append((kind, request, value, index))
        if (kind, request) == RESET and value in PURGE_FROM_HOST:
            self._fifo = b""
        if (kind, request) == SET_LATENCY:
            self.latency_ms = value & 0xFF
        return (
            bytes([self.latency_ms])
            if (kind, request) == GET_LATENCY
            else STATUS[:length].ljust(length, b"\0")
        )


def send(line: socket.socket, data: bytes) -> bool:
    """False: the kernel has closed its end, the chip is unplugged."""
    try:
        line.sendall(data)
    except OSError:
        return False
    return True


def receive(line: socket.socket, n: int) -> bytes | None:
    """So many bytes; None: the chip is unplugged."""
    data = b""
    while len(data) < n:
        try:
            block = line.recv(n - len(data))
        except OSError:
            return None
        if not block:
            return None
        data += block
    return data
