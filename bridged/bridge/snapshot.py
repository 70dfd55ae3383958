"""The counters of one bridge, and of those that it took the place of, in the form that the status has."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, Any

from bridged.interfaces.base import LOST_BEFORE_READ

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridged.adapters.base import Adapter, Identity

log = logging.getLogger(__name__)


class History:
    """What goes on when one bridge takes the place of another: its counters and its age."""

    def __init__(self) -> None:
        self.starts = 0  # how often the adapter of this bridge began to run
        self._began_at = time.monotonic()
        self._counted_before: dict[str, Any] = {}  # by the bridges of this process before this one
        self._identity: Identity | None = None  # that is in the log

    def continue_from(self, before: History, counters: dict[str, Any]) -> None:
        """Of a bridge that ended, with the last counters in its snapshot."""
        self._counted_before = counters
        self._began_at = before._began_at

    def adapter_runs(self, adapter: Adapter) -> None:
        """Tells once who it is, and what it cannot promise."""
        self.starts += 1
        identity = adapter.identity
        if identity != self._identity:
            self._identity = identity
            firmware = f" firmware={identity.firmware}" if identity.firmware else ""
            log.info(
                "adapter version=%s serial_number=%s%s", identity.version, identity.serial_number, firmware
            )
            log.info("%s", adapter.sent_means)
            for caution in adapter.cautions:
                log.warning("of this adapter: %s", caution)

    def total(self, counters: dict[str, Any]) -> dict[str, Any]:
        """With those of the bridges before."""
        return _sum(self._counted_before, counters)

    def uptime_s(self) -> float:
        return round(time.monotonic() - self._began_at, 3)


def settle(counters: dict[str, Any], lost: Mapping[str, int]) -> None:
    """Adds to the relay's counters the frames that were `lost` between it and the interface, by reason."""
    for reason, n in lost.items():
        if reason in LOST_BEFORE_READ:
            counters["tx_dropped"][reason] = n
        else:  # the relay took it for delivered
            counters["rx_dropped"][reason] = n
            counters["rx_frames"] -= n


def _sum(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Of counters, some of them by reason."""
    total = dict(now)
    for name, n in before.items():
        total[name] = _sum(n, now.get(name, {})) if isinstance(n, dict) else n + now.get(name, 0)
    return total
