"""Other bridges on the same CAN interface: told, and whether frames go in a circle between them and this one.

Two bridges join the CAN buses of their adapters. If both adapters are on one bus, each bridge sends what the
other has received, for ever. Nothing in a frame tells that it has been here before. So, where many frames go
both ways for a while, and the other bridges have put as many on the interface as this one has read (nobody
else sends), some frames of each direction are compared. The frames themselves go on.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from typing import TYPE_CHECKING

from bridged.bridge.lifecycle import State
from bridged.bridge.log_limiter import LogLimiter, repeated
from bridged.daemon.directories import runtime_directory_of, status_sockets
from bridged.daemon.status import StatusError, query

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from bridged.bridge.bridge import Bridge

log = logging.getLogger(__name__)

SEARCH_INTERVAL_S = 60.0  # for bridges that were started later
LOOK_INTERVAL_S = 1.0
CIRCLE_FPS = 50.0
CIRCLE_LOOKS = 5  # so many looks in a row, with frames about as fast in one direction as in the other
LEAST_RATIO = 0.5  # of the two directions: frames go in two circles, one each way round
TOLERANCE = 0.2
GLIMPSES, GLIMPSE_INTERVAL_S = 100, 0.02
REPETITIONS = 5  # of the glimpses


class Neighbours:
    """`own`: the status socket of this process; those of the others are in the same runtime directory.

    The owner calls look() now and then, from the thread of the bridge. Others are asked in another one.
    """

    def __init__(self, own: Path) -> None:
        self._own = own
        self._bridge: Bridge | None = None
        self._asked: dict[Path, int] = {}  # inodes
        self._beside: dict[Path, str] = {}  # names of those on the same interface
        self._search_at = self._look_at = 0.0
        self._equal_looks = 0
        self._thread: threading.Thread | None = None
        self._log_limiter = LogLimiter()

    def look(self, bridge: Bridge, now: float) -> None:
        """Starts to search, or to compare frames, if it is time."""
        if bridge.state is not State.RUNNING:
            bridge.circle = ""
            return
        if now < self._look_at:
            return
        self._look_at = now + LOOK_INTERVAL_S
        if self._thread is not None and self._thread.is_alive():
            return
        if bridge is not self._bridge:  # after a reload that may have changed the interface
            self._bridge = bridge
            self._asked, self._beside, self._search_at = {}, {}, now
        if now >= self._search_at:
            self._search_at = now + SEARCH_INTERVAL_S
            if strangers := self._strangers():
                self._run(self._ask, bridge, strangers)
        elif self._is_suspect(bridge):
            self._run(self._compare, bridge)

    def _run(self, task: Callable[..., None], *arguments: object) -> None:
        self._thread = threading.Thread(target=task, args=arguments, name="neighbours", daemon=True)
        self._thread.start()

    # --- in the thread of the bridge ----------------------------------------------------------

    def _strangers(self) -> dict[Path, int]:
        """Status sockets that were not asked yet, with their inodes."""
        found = {}
        for path in sorted(status_sockets(runtime_directory_of(self._own))):
            with contextlib.suppress(OSError):  # it is just being removed
                inode = path.lstat().st_ino
                if path != self._own and self._asked.get(path) != inode:
                    found[path] = inode
        return found

    def _is_suspect(self, bridge: Bridge) -> bool:
        rates = bridge.rates()
        slower, faster = sorted((rates["rx_fps"], rates["tx_fps"]))
        equal = bool(self._beside) and slower >= max(CIRCLE_FPS, LEAST_RATIO * faster)
        self._equal_looks = self._equal_looks + 1 if equal else 0
        if not equal and bridge.circle:
            bridge.circle = ""
            self._log_limiter.recovered()
            log.info("frames no longer go in a circle")
        return self._equal_looks >= CIRCLE_LOOKS

    # --- in their own -------------------------------------------------------------------------

    def _ask(self, bridge: Bridge, strangers: dict[Path, int]) -> None:
        """Tells of those that are on the same interface."""
        ours = bridge.config.bus
        for path, inode in strangers.items():
            try:
                status = query(path)
            except StatusError:  # it ends, or is none of ours: asked again at the next search
                continue
            self._asked[path] = inode
            theirs = status.get("bus")
            if isinstance(theirs, dict) and (theirs.get("interface"), theirs.get("channel")) == (
                ours.interface,
                ours.channel,
            ):
                self._beside[path] = name = str(status.get("name"))
                log.warning(
                    "%s is also fed by bridge %r: each sends what the other's adapter receives, so these two "
                    "adapters must not be on the same CAN bus",
                    ours.channel or ours.interface,
                    name,
                )

    def _compare(self, bridge: Bridge) -> None:
        """Tells if what this bridge sends comes from the others alone, and is what it has received."""
        self._equal_looks = 0
        read = bridge.frames_read()
        others = self._received_by_others()
        came: set[bytes] = set()
        went: list[bytes] = []
        for _ in range(GLIMPSES):
            from_interface, to_interface = bridge.glimpse()
            came.add(_content(from_interface))
            went.append(_content(to_interface))
            time.sleep(GLIMPSE_INTERVAL_S)
        read = bridge.frames_read() - read
        fed = {name: n - others[name] for name, n in self._received_by_others().items() if name in others}
        nobody_else_sends = abs(read - sum(fed.values())) <= TOLERANCE * read
        if not nobody_else_sends or sum(content in came for content in went) < REPETITIONS:
            return
        names = " and ".join(repr(name) for name in (bridge.config.name, *(n for n in fed if fed[n])))
        circle = (
            f"frames go in a circle between {names}: their adapters are on the same CAN bus, and each sends "
            "what the other receives. Take one of the adapters off that bus, or give its bridge another "
            "interface (bus.channel)"
        )
        times = self._log_limiter.should_log(circle, time.monotonic())
        if times:
            log.error("%s%s", circle, repeated(times))
        bridge.circle = circle

    def _received_by_others(self) -> dict[str, int]:
        """Frames that each of them has put on the interface."""
        frames = {}
        for path, name in list(self._beside.items()):
            try:
                frames[name] = int(query(path)["counters"]["rx_frames"])
            except (StatusError, KeyError, TypeError, ValueError):
                self._beside.pop(path)  # it has ended
        return frames


def _content(frame: bytes) -> bytes:
    """Of a struct can_frame: identifier, length and data, without what is behind them."""
    return frame[:5] + frame[8 : 8 + frame[4]]
