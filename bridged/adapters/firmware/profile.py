"""What a firmware profile is: how a device that speaks LAWICEL's protocol is driven, what it cannot do."""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - msgspec looks at the annotations
from typing import NamedTuple

from msgspec import Struct

from bridged.adapters.base import Confirms, Reply, Sending

LONGEST_COMMAND = "T1FFFFFFF81122334455667788"


class Command(NamedTuple):
    """One of the commands that open the channel, without its CR."""

    text: str
    purpose: str  # completes "the adapter refused to …"
    may_be_refused: bool = False


OPEN = Command("O", "open the channel")
LISTEN_ONLY = Command("L", "open the channel in listen-only mode")
RETRANSMIT = Command("A1", "send a frame again until it is acknowledged")

SLOW_BITRATES = {10_000: "S0", 20_000: "S1", 50_000: "S2", 100_000: "S3", 125_000: "S4", 250_000: "S5"}
BITRATES = {**SLOW_BITRATES, 500_000: "S6", 800_000: "S7", 1_000_000: "S8"}
"""bit/s → command, as the CAN232 manual has them (`Sn`)."""


class Profile(Struct, frozen=True, kw_only=True):
    """One firmware. A command that its profile does not know is never sent to it.

    `bitrates` are the true ones: what the controller runs at, also where the command promises another rate.
    """

    name: str  # of `adapter.firmware`
    title: str  # "CANable with …": who it is, for messages

    # --- identity and start
    gentle_flush: bool = False  # 26 V at most: more would harm it
    serial_number: bool = False  # N tells a number that no other device has
    answers: bool | None = True  # S, O and the like: CR when done, BELL when refused. None: not known
    close_answers: tuple[Reply, ...]  # what C can be answered with, whether the channel was open or not
    bitrates: Mapping[int, str]
    registers: bool = False  # `sxxyy` sets BTR0 and BTR1 as on a CAN232
    passes_all: bool = False  # M00000000 and mFFFFFFFF let every frame pass (else neither may be sent)
    acceptance: bool = False  # M, m and W mean what they do on a CAN232
    open: tuple[Command, ...] = (OPEN,)
    listen_only: tuple[Command, ...] | None = (LISTEN_ONLY,)  # None: it has no such mode
    polls: bool = False  # A asks for frames, X1 makes it send them unasked; X, W, Z are kept in an EEPROM

    # --- frames
    sending: Sending
    paced: bool = False  # frames go no faster than its bus takes them: `sending.paced_bitrate`
    buffer: int  # frames that the device holds
    in_order: bool = True  # and sends in the order in which it got them
    remote_digits: bool = False  # a received remote frame carries digits of data
    stamp_digits: tuple[int, ...] = ()  # of the time stamps that it can add to received frames
    longest_line: int  # characters before CR

    # --- health
    flags: bool = (
        False  # F tells the flags of the CAN232 manual, on an open channel. False: V is asked instead
    )
    full_flag: bool = False  # bit 1 of them says whether the transmit buffer was full
    bus_off_flag: int | None = None  # the bit that says bus-off

    # --- end
    stops: bool = True  # C takes the controller off its bus
    warnings: tuple[str, ...] = ()  # what its user must know, said at each start
    listen_only_warning: str = ""  # the same with channel.listen_only

    @property
    def article_title(self) -> str:
        """`a USBtin`, `an ESP32 with …`."""
        return f"{'an' if self.title[0] in 'AEIOU' and not self.title.startswith('US') else 'a'} {self.title}"

    @property
    def cautions(self) -> tuple[str, ...]:
        """All that its user must know, whatever the mode."""
        if self.sending.confirms not in {Confirms.ALWAYS, Confirms.NOTHING}:
            return self.warnings
        unseen = (
            "nothing tells the bridge when no other node acknowledges its frames: "
            f"up to {self.buffer} wait in its buffer then, however long, and more are lost"
        )
        return (*self.warnings, unseen)
