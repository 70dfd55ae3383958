"""One bridge takes the place of another on the same interface: the frames in it wait meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bridged import _relay

LONGEST_S = 1.0  # for frames that were read before
LOOK_INTERVAL_S = 0.005


class HandOver:
    """Holds the frames of the interface back, in the bridge that ends and in the one that takes its place.

    Times are seconds of any clock. The owner asks may_stop() again when `next_at` has come.
    """

    def __init__(self, relay: _relay.Relay) -> None:
        self.next_at: float | None = None
        self._relay = relay
        self._stop_by: float | None = None  # frames that were read before may be sent until then
        self._awaits_adapter = False  # frames wait until the adapter of this bridge runs, or fails to

    # --- in the bridge that ends --------------------------------------------------------------

    def prepare(self, now: float, *, running: bool) -> None:
        """Another bridge is to go on: what is in the interface waits for that one."""
        self._awaits_adapter = False
        self._relay.hold_interface(True)
        if running and self._stop_by is None:
            self._stop_by = now + LONGEST_S

    def cancel(self) -> None:
        """No other bridge is to go on."""
        self._awaits_adapter = False
        self._relay.hold_interface(False)
        self._stop_by = None

    def may_stop(self, now: float, *, running: bool) -> bool:
        """Whether the bridge has sent what it had read, or cannot. If not, may_stop() is asked again."""
        waits = running and self._relay.counters()["queued"]
        if self._stop_by is not None and waits and now < self._stop_by:
            self.next_at = now + LOOK_INTERVAL_S
            return False
        self._stop_by = self.next_at = None
        return True

    # --- in the bridge that takes its place ---------------------------------------------------

    def await_adapter(self) -> None:
        """Frames wait until adapter_is_decided()."""
        self._awaits_adapter = True
        self._relay.hold_interface(True)

    def adapter_is_decided(self) -> None:
        """The adapter runs, or has failed to."""
        if self._awaits_adapter:
            self._awaits_adapter = False
            self._relay.hold_interface(False)
