"""What a CAN232 keeps in its EEPROM: cells wear out and cannot be read, so only what differs is written."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from bridged.adapters.base import Exchange, Reply

if TYPE_CHECKING:
    from bridged.adapters.base import Identity, Memory, Steps
    from bridged.can import AcceptanceFilter

log = logging.getLogger(__name__)

OK, REFUSED, NONE = Reply.OK, Reply.REFUSED, Reply.NONE

AUTO_POLL_SINCE = "1220"  # hhss of the first firmware with X (manual 2.0, P and A)

# What to ask of the adapter, and what it is good for; each value's name.
PURPOSES = {
    "X": ("send frames by itself", "it now sends received frames unasked"),
    "Z": ("leave out time stamps", "received frames now take less of its line"),
    "W": ("set the filter mode", "it now reads code and mask as channel.acceptance means them"),
}
NAMES = {
    "X1": "auto poll",
    "Z0": "no time stamps",
    "W0": "filter mode dual",
    "W1": "filter mode single",
}


def may_be_stored(acceptance: AcceptanceFilter | None) -> str:
    """Everything that may be written for this filter: `X1 (auto poll), Z0 (no time stamps)`."""
    stored = ["X1", "Z0"]
    if acceptance is not None and not acceptance.passes_all:
        stored.append(f"W{acceptance.single:d}")
    return ", ".join(f"{request} ({NAMES[request]})" for request in stored)


class Eeprom:
    """Of one adapter: what is known of it is remembered by its serial number."""

    def __init__(self, memory: Memory, timeout_s: float) -> None:
        self._memory = memory
        self._timeout_s = timeout_s
        self._stamped = False  # frames with time stamps came
        self.identity: Identity | None = None  # of the adapter; None: there is none yet

    def _recall(self, setting: str) -> int | None:
        serial = self.identity and self.identity.serial_number
        return None if serial is None else self._memory.recall(serial, setting)

    def _remember(self, setting: str, value: int) -> None:
        if self.identity is not None and self.identity.serial_number is not None:
            self._memory.remember(self.identity.serial_number, setting, value)

    def differences(self, acceptance: AcceptanceFilter | None, auto_poll: bool) -> list[tuple[str, int]]:
        """What must be written. X is known from A, Z from frames that came, W only from what we wrote.

        With X as it left the factory W is taken to be so too: whoever sets one sets the other.
        """
        version = (self.identity and self.identity.version) or ""
        found = []
        if not auto_poll and version[1:] >= AUTO_POLL_SINCE:
            found.append(("X", 1))
        if self._stamped or self._recall("Z") == 1:
            found.append(("Z", 0))
        known = self._recall("W")
        if known is None and not auto_poll:
            known = 0
            self._remember("W", known)
        if acceptance is not None and not acceptance.passes_all and known != acceptance.single:
            found.append(("W", int(acceptance.single)))
        return found

    def write(self, setting: str, value: int) -> Steps:
        """A firmware that refuses X is polled, one that refuses Z says nothing wrong; a filter must hold."""
        purpose, effect = PURPOSES[setting]
        accept = (OK,) if setting == "W" else (OK, REFUSED)
        reject = tuple(reply for reply in (REFUSED, NONE) if reply not in accept)
        request = f"{setting}{value}"
        answer = yield Exchange(
            f"{request}\r".encode(), f"{purpose} ({request})", accept, reject, timeout_s=self._timeout_s
        )
        if answer.reply is OK:
            log.info("stored '%s' (%s) in the adapter's EEPROM: %s", NAMES[request], request, effect)
            self._remember(setting, value)
        self._stamped = self._stamped and setting != "Z"

    def saw_time_stamps(self) -> None:
        """Frames with time stamps came."""
        if self._stamped:
            return
        self._stamped = True
        self._remember("Z", 1)
        log.warning("adapter sends time stamps (Z1), a sixth of its line; switched off at the next start")
