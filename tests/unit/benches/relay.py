"""A relay of a CAN232 between two socketpairs, on a clock of the test's own."""

import contextlib
import socket
import struct
from collections.abc import Iterator
from typing import Any

from books import check_books

from bridged import _relay

MS = 1_000_000
FRAME = struct.Struct("=IB3x8s")
ERR_FLAG, EFF_FLAG = 0x20000000, 0x80000000


def can_frame(number: int) -> bytes:
    """A frame that carries its number; every other one is extended."""
    can_id = 0x100 if number % 2 else EFF_FLAG | 0x100
    return FRAME.pack(can_id, 8, number.to_bytes(8, "big"))


def number_of(line: bytes) -> int:
    return int(line[-16:], 16)


class Rig:
    """A relay between two socketpairs; `turn` lets it do what can be done at `now`."""

    def __init__(
        self, *, queue: int = 16, window: int = 1, deadline: float = 1.0, stuck: float = 1.0
    ) -> None:
        self.now = 1_000 * MS
        self.relay = _relay.Relay(
            "can232",
            queue=queue,
            window=window,
            deadline=deadline,
            stuck=stuck,
            answer_timeout=0.3,
            sync=b"V\r",
            sync_prefix=b"V",
        )
        self.port, far_port = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.bus, far_bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for s in (self.port, far_port, self.bus, far_bus):
            s.setblocking(False)
        self.far = (far_port, far_bus)
        self.relay.attach_interface(far_bus)
        self.attach()

    def attach(self) -> None:
        self.relay.attach_port(self.far[0])
        self.relay.set_gates(receiving=True, transmit=_relay.GATE_OPEN)

    def close(self) -> None:
        for s in (self.port, self.bus, *self.far):
            s.close()

    def turn(self, ms: float = 0) -> int | None:
        self.now += int(ms * MS)
        return self.relay.turn(self.now)

    def said(self) -> list[bytes]:
        """The lines that the device got since the last call."""
        try:
            return self.port.recv(1 << 16).split(b"\r")[:-1]
        except BlockingIOError:
            return []

    def frames(self) -> list[bytes]:
        """The frames that reached the bus."""
        out = []
        with contextlib.suppress(BlockingIOError):
            while True:
                out.append(self.bus.recv(128))
        return out

    def counters(self) -> dict[str, int]:
        """The counters, flat, with the invariants checked."""
        c: dict[str, Any] = self.relay.counters()
        check_books(c, c["queued"])
        tx, rx = c.pop("tx_dropped"), c.pop("rx_dropped")
        looked_at = (
            "decoded",
            "rx_frames",
            "tx_frames",
            "tx_queued",
            "tx_unconfirmed",
            "rx_overruns",
            "skipped_bytes",
        )
        tally = self.relay.tally()
        assert [getattr(tally, name) for name in looked_at] == [c[name] for name in looked_at]
        return {**c, **tx, **{f"rx {k}": v for k, v in rx.items()}}  # type: ignore[dict-item]

    def events(self) -> list[tuple[int, int, bytes]]:
        return self.relay.events()


@contextlib.contextmanager
def rig_with(**options: float) -> Iterator[Rig]:
    r = Rig(**options)  # type: ignore[arg-type]
    try:
        yield r
    finally:
        r.close()
