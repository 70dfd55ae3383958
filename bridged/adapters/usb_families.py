"""What a USB device may be, by its ids and what it calls itself. A hint: many devices share an id."""

from __future__ import annotations

import re
from typing import Final, NamedTuple


class Family(NamedTuple):
    """Devices that look alike. `type` is that of an adapter; None: they are none, or nobody can tell."""

    title: str  # completes "may be …"
    type: str | None = None


_UNKNOWN_FTDI: Final = "a USB2CAN, a CAN232 on a cable with an FTDI chip, or anything else with such a chip"

# Vendor and product id, a pattern of the product's own name (whole); None: any. The first that fits is taken.
_KNOWN: Final[tuple[tuple[tuple[int, int] | None, str | None, Family], ...]] = (
    ((0x0403, 0xFFA8), None, Family("a LAWICEL CANUSB, which is a CAN232 with a USB plug", "can232")),
    ((0x0403, 0x6001), "(?i).*USB2CAN.*", Family("a CANLAB USB2CAN", "usb2can")),
    (None, "CANtact.*", Family("a CANtact: its firmware cannot be used safely (README, Clones)")),
    # As 8ca5d39 in "CANable 8ca5d39 github.com/normaldotcom/canable-fw.git": the firmware's version.
    (None, "CANable2 .*", Family("a CANable 2.0 with its slcan firmware, a clone of the CAN232", "can232")),
    (None, "CANable .*", Family("a CANable with its slcan firmware, a clone of the CAN232", "can232")),
    (None, "(?i)WeAct.*", Family("a WeAct USB2CAN with slcan firmware, a clone of the CAN232", "can232")),
    (None, "USBtin.*", Family("a USBtin, a clone of the CAN232", "can232")),
    ((0xAD50, 0x60C4), None, Family("a CANable or a CANtact: see README, Clones", "can232")),
    ((0x16D0, 0x117E), None, Family("a CANable or the like, a clone of the CAN232", "can232")),
    (
        (0x04D8, 0x000A),
        None,
        Family("a USBtin, a clone of the CAN232, or another Microchip device", "can232"),
    ),
    (
        (0x1D50, 0x606F),
        None,
        Family("an adapter with candleLight firmware, which is a CAN interface itself (driver gs_usb)"),
    ),
    (
        (0x1A86, 0x7523),
        None,
        Family(
            "an Arduino or ESP32 board, perhaps with slcan firmware; or a USB-CAN Analyzer, which speaks "
            "another protocol and cannot be used"
        ),
    ),
    ((0x0403, 0x6001), None, Family(_UNKNOWN_FTDI)),
)


def family_of(usb_id: tuple[int, int], product: str | None) -> Family | None:
    """The family of the device with these ids, vendor and product, and this name; None: an unknown one."""
    for known_id, pattern, family in _KNOWN:
        if known_id in (None, usb_id) and (pattern is None or re.fullmatch(pattern, product or "")):
            return family
    return None
