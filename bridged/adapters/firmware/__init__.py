"""Firmware that speaks LAWICEL's protocol: by what answers each is recognised.

How to drive one is in its profile: a module of this package, loaded only where it is needed.
"""

from __future__ import annotations

import importlib
import re
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bridged.adapters.firmware.profile import Profile

BELL, CR, SILENCE = "BELL", "an empty line", "silence"
"""What a device can answer beside a text."""


class Signature(NamedTuple):
    """Patterns of the whole answers to questions that change nothing in any known firmware.

    None: that question is not needed. `flags`, `details` and `malformed` are asked with the channel closed.
    """

    version: str  # V; its groups `version` and `number` are the identity, if there are any
    number: str | None = None  # N, which other firmware than a CAN232's answers alike in all its devices
    details: str | None = None  # v
    flags: str | None = None  # F
    malformed: str | None = None  # VV

    def fits(self, seen: Seen) -> bool:
        """Whether nothing that the device has answered so far speaks against it."""
        pairs = zip(self, seen, strict=True)
        return all(
            pattern is None or answer is None or re.fullmatch(pattern, answer) for pattern, answer in pairs
        )


class Seen(NamedTuple):
    """What a device has answered; None: not asked yet. Fields as of Signature."""

    version: str
    number: str | None = None
    details: str | None = None
    flags: str | None = None
    malformed: str | None = None

    def fitting(self, signatures: Mapping[str, Signature]) -> dict[str, Signature]:
        """Those that nothing seen speaks against."""
        return {name: signature for name, signature in signatures.items() if signature.fits(self)}

    @property
    def description(self) -> str:
        """`V with 'V1234', N with 'N2233', v with BELL`."""
        questions = {"V": self.version, "N": self.number, "v": self.details, "F": self.flags}
        questions["VV"] = self.malformed
        return ", ".join(f"{q} with {shown(answer)}" for q, answer in questions.items() if answer is not None)


LONGEST_SHOWN = 120


def shown(answer: str) -> str:
    from bridged.text import printable  # noqa: PLC0415 - only for messages

    if answer in {BELL, CR, SILENCE}:
        return answer
    text = printable(answer)
    return f"'{text}'" if len(text) <= LONGEST_SHOWN else f"'{text[:LONGEST_SHOWN]}…'"


HEX4: Final = r"V[0-9A-F]{4}"
"""How a CAN232 answers V: `Vhhss`, its hardware and its software."""

# V says it all.
BY_VERSION: Final = {
    "canable2": Signature(r".*\bcanable2\b.*"),
    "canable1": Signature(r"(?!.*canable2).*\b(?:canable|cantact)\b.*"),
    "nakakiyo": Signature(r"V(?:L2K|W1K)\w*"),
    "weact": Signature(r"WeAct .*"),
    "elmue": Signature(
        r"\+Board: .*?\tFirmware: (?P<version>\w+)\t.*?(?:\tSerial: (?P<number>\w+).*)?",
    ),
}

# V and N are the same in all of them, so they are a name. What answers these and something else to the other
# questions is nothing that is known.
BY_CONSTANTS: Final = {
    "usbtin": Signature("V0100", "NFFFF", details=r"v01\d\d", flags="F[0-9A-F]{2}"),
    "esp32": Signature("V1234", "N2233", details=BELL, flags="F00"),
    "slcanuino": Signature("V1234", "N1234", details=BELL, flags="F12"),
    "slcanpty": Signature("V1013", "N4242"),
    "latonita": Signature("V1013", "NA123"),
}

# A CAN232, and what answers V and N as one of them might. Who builds a device with catompiler's library
# chooses what it answers to V and N, so only its silence tells.
BY_ALL_ANSWERS: Final = {
    "can232": Signature(HEX4, details=BELL, flags=BELL, malformed=f"{BELL}|{HEX4}"),
    "catompiler": Signature(HEX4, details=BELL, flags=BELL, malformed=SILENCE),
    "uccb": Signature(HEX4, details="v0401"),
    "gdramos": Signature("V1020", flags=r"[0-9A-F]{2}"),
}

SIGNATURES: Final = {**BY_VERSION, **BY_CONSTANTS, **BY_ALL_ANSWERS}

WITHOUT_PROFILE: Final = {
    "latonita": "an Arduino with the firmware of latonita",
    "uccb": "a UCCB",
    "gdramos": "a PIC 26K80 with the firmware of gdramos",
}
"""Known by name, but not well enough to drive them."""

NAMES: Final = (*sorted(name for name in SIGNATURES if name not in WITHOUT_PROFILE), "generic")
"""All profiles: values of `adapter.firmware`."""


def load(name: str) -> Profile:
    """The profile of this name."""
    module = importlib.import_module(f"bridged.adapters.firmware.{name}")
    found: Profile = module.PROFILE
    return found
