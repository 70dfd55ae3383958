"""The books of a bridge, as every test checks them: each frame is somewhere, and no counter is negative."""

from collections.abc import Mapping
from typing import Any

from bridged.interfaces.base import LOST_BEFORE_READ


def check_books(counters: Mapping[str, Any], queued: int) -> None:
    """`counters` of a relay or of a status. Sums alone would not see a -1 beside a +1."""
    tx, rx = counters["tx_dropped"], counters["rx_dropped"]
    plain = {name: n for name, n in counters.items() if not isinstance(n, Mapping)}
    negative = {name: n for name, n in (plain | {"queued": queued} | tx | rx).items() if n < 0}
    assert not negative, negative
    read = [n for reason, n in tx.items() if reason not in LOST_BEFORE_READ]
    given = counters["tx_frames"] + counters["tx_queued"] + counters["tx_unconfirmed"]
    assert counters["bus_read"] == given + queued + sum(read)
    assert counters["decoded"] == counters["rx_frames"] + counters["rx_pending"] + sum(rx.values())
