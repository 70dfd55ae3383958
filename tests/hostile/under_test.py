"""The bridge under test, in a process of its own: runs, and looks at its own books all the time.

    python under_test.py CONFIGURATION DESCRIPTOR

The descriptor is its end of the bus. Says what happens on standard output, one JSON object in a line; reads
"stop" and "queue N" from standard input. Any exception ends it with a status that is not 0.
"""

import gc
import json
import logging
import os
import select
import socket
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from bridged.bridge.bridge import Bridge
from bridged.bridge.lifecycle import State
from bridged.config import load
from bridged.daemon.eeprom_store import FileMemory
from bridged.interfaces.socketcan import receive_stamped

LOOK_S = 0.02
STOP_LIMIT_S = 5.0


class Bus:
    warning = ""
    failure = None
    description = "pair"

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)
        self._socket.setblocking(False)
        receive_stamped(self._socket)
        self.fd = fd

    def dropped(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        self._socket.close()


def say(**what: Any) -> None:
    print(json.dumps(what), flush=True)


class CountLines(logging.Handler):
    """Passes them on to standard error, not too many."""

    def __init__(self) -> None:
        super().__init__()
        self.lines = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.lines += 1
        if self.lines < 2000:
            print(
                f"{time.monotonic():.3f} {record.levelname} {record.getMessage()}",
                file=sys.stderr,
                flush=True,
            )
            if record.exc_info:
                print(self.formatException(record), file=sys.stderr, flush=True)

    def formatException(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's style
        return logging.Formatter().formatException(record.exc_info) if record.exc_info else ""


def numbers(counters: dict[str, Any]) -> list[tuple[str, int]]:
    found = []
    for name, value in counters.items():
        if isinstance(value, dict):
            found += [(f"{name}.{inner}", n) for inner, n in numbers(value)]
        else:
            found.append((name, value))
    return found


class Books:
    """Each look: nothing negative, nothing that is counted shrinks, everything read is somewhere."""

    STATES = ("rx_pending",)  # not sums over time

    def __init__(self) -> None:
        self._before: dict[str, int] = {}
        self.looks = 0

    def look(self, bridge: Bridge) -> dict[str, Any]:
        self.looks += 1
        status = bridge.snapshot()
        counters = status["counters"]
        flat = dict(numbers(counters))
        negative = {name: n for name, n in flat.items() if n < 0}
        assert not negative, f"negative counters: {negative}"
        assert status["queued"] >= 0
        shrunk = {
            name: (self._before.get(name, 0), n) for name, n in flat.items() if n < self._before.get(name, 0)
        }
        assert not {name for name in shrunk if name not in self.STATES}, f"counters shrink: {shrunk}"
        self._before = flat
        read, sent, queued = counters["bus_read"], counters["tx_frames"], status["queued"]
        dropped = sum(counters["tx_dropped"].values())
        assert read == sent + queued + dropped, (
            f"read {read}, sent {sent}, queued {queued}, dropped {counters['tx_dropped']}"
        )
        decoded, delivered, lost = (
            counters["decoded"],
            counters["rx_frames"],
            sum(counters["rx_dropped"].values()),
        )
        assert decoded == delivered + counters["rx_pending"] + lost, f"decoded {decoded}: {counters}"
        return status


def resources() -> dict[str, int]:
    status = Path("/proc/self/status").read_text()
    resident = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return {
        "resident_kb": int(resident.split()[1]),
        "descriptors": len(os.listdir("/proc/self/fd")),  # noqa: PTH208 - its own is among them, always
        "threads": threading.active_count(),
    }


def main() -> int:
    logging.getLogger().setLevel(logging.INFO)
    lines = CountLines()
    logging.getLogger().addHandler(lines)
    bus = Bus(int(sys.argv[2]))
    path = Path(sys.argv[1])
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    bridge = Bridge(
        load(path), FileMemory(path.parent / "state"), open_interface=lambda *_arguments, **_options: bus
    )
    books = Books()
    bridge.start()
    look_at = longest = 0.0
    state: State | None = None
    stop_at: float | None = None
    orders = b""
    looked = time.monotonic()
    while not bridge.finished:
        now = time.monotonic()
        longest, looked = max(longest, now - looked), now
        if now >= look_at:
            look_at = now + LOOK_S
            books.look(bridge)
        if bridge.state is not state:
            state = bridge.state
            say(state=state.value, reason=bridge.reason, lines=lines.lines, **resources())
        if stop_at is not None:
            assert now < stop_at + STOP_LIMIT_S, f"it does not stop: {bridge.state}"
        timer = bridge.next_timer()
        wait = max(0.0, min(look_at, look_at if timer is None else timer) - time.monotonic())
        ready = select.select([*bridge.filenos(), *([0] if stop_at is None else [])], (), (), wait)[0]
        if 0 in ready:
            orders += os.read(0, 4096)
            *whole, orders = orders.split(b"\n")
            for order in whole:
                match order.split():
                    case [b"stop"]:
                        stop_at = time.monotonic()
                        bridge.stop()
                    case [b"queue", length]:
                        transmit = replace(bridge.config.transmit, queue=int(length))
                        assert bridge.reconfigure(replace(bridge.config, transmit=transmit))
        if [fd for fd in ready if fd != 0]:
            bridge.on_readable()
        bridge.on_timer(time.monotonic())
    assert stop_at is not None
    stopped_s = time.monotonic() - stop_at
    assert "relay" not in {thread.name for thread in threading.enumerate()}
    status = books.look(bridge)
    end = time.monotonic() + STOP_LIMIT_S
    while not bridge.settled and time.monotonic() < end:
        time.sleep(0.01)
        bridge.on_readable()
    bridge.close()
    while threading.active_count() > 1 and time.monotonic() < end:
        time.sleep(0.01)
    assert threading.active_count() == 1, threading.enumerate()
    del bridge
    gc.collect()
    after = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    # The bus is closed with the bridge, which was open before.
    say(stopped_s=stopped_s, status=status, looks=books.looks, lines=lines.lines, longest_loop_s=longest,
        descriptors_kept=after - before + 1, resident_kb=resources()["resident_kb"])  # fmt: skip
    return 0


if __name__ == "__main__":
    try:
        status = main()
    except BaseException:  # noqa: BLE001 - the relay's thread would not let the process end
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    if status:
        os._exit(status)
