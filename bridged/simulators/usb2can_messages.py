"""What the simulator reads in the manual of the USB2CAN: messages, modes, lengths, versions, frames, order.

`0x0F, COMMAND, LENGTH (0..16), DATA`; "Popis USB komunikace" (Španěl), chapter II, and III for the order.
"""

from __future__ import annotations

import dataclasses
import enum
import re
from typing import TYPE_CHECKING, Literal, NamedTuple

from bridged.simulators.sja1000 import ACR0, BTR0, BTR1, CDR, IER, MOD, OCR, REGISTER_NAMES, Frame

if TYPE_CHECKING:
    from collections.abc import Container

START = 0x0F
LENGTH_MAX = 16

CONFIG_MODE, BUS_OFF, ERROR, WRITE_REG, BITMOD_READ_REG, COMMAND = 2, 8, 9, 18, 22, 32
TIMESTAMP, READ_MESSAGE_TS, WRITE_MESSAGE, READ_MESSAGE = 62, 63, 64, 65

CAN_TRANSMIT, STATUS, CRITICAL_TRANSMIT, RX_OVERRUN = range(4)  # first byte of ERROR
GO, STOP, LIMITS_UNUSABLE = range(3)  # second byte of CRITICAL_TRANSMIT; the manual does not know the third

CMD_CRITICAL, CMD_READY, CMD_READ_TEC, CMD_READ_REC, CMD_BASIC, CMD_PELI, CMD_RESET, CMD_OPERATE = range(8)
CMD_BAUD_RATE, CMD_GET = 8, 128
CMD_LENGTHS = dict.fromkeys((*range(8), CMD_GET), 1) | {CMD_CRITICAL: 2, CMD_READY: 2, CMD_BAUD_RATE: 3}

DOUBLE_BUFFER, TIME_STAMPS = frozenset("35"), frozenset("56")  # firmware series


class State(enum.Enum):
    """The mode that the firmware is in."""

    BOOT = "boot"
    CONFIG = "config"
    NORMAL = "normal"
    LOOPBACK = "loopback"


MODE_NUMBERS = {state: number for number, state in enumerate(State)}


@dataclasses.dataclass(frozen=True)
class Variant:
    """How devices differ, in the words of `Usb2can`; ValueError if the version is none."""

    version: str
    tx_buffer: int
    quirks: bool
    answers_get: bool
    get_length_4: bool
    padded: bool
    stamp_order: Literal["little", "big"]

    def __post_init__(self) -> None:
        if not re.fullmatch(r"HW\d{4}FW\d{4}", self.version):
            raise ValueError(f"{self.version!r} is not of the form HWxxxxFWyzzz")

    @property
    def capacity(self) -> int:
        """Frames that the transmit buffers hold."""
        return self.tx_buffer * (2 if self.version[8] in DOUBLE_BUFFER else 1)

    @property
    def has_stamps(self) -> bool:
        """Whether received frames have time stamps."""
        return self.version[8] in TIME_STAMPS


class Rule(NamedTuple):
    """What the table of the manual says about a message from the host."""

    name: str
    modes: frozenset[State]
    lengths: Container[int]


_MODES = {state.name[0]: state for state in State}
_ANY = range(LENGTH_MAX + 1)

RULES = {
    command: Rule(name, frozenset(_MODES[letter] for letter in letters), lengths)
    for command, name, letters, lengths in (
        (0, "USB_LOOPBACK", "BCNL", (0,)),
        (1, "BOOT_MODE", "CNL", (0,)),
        (CONFIG_MODE, "CONFIG_MODE", "BCNL", (0,)),
        (3, "NORMAL_MODE", "CL", (0,)),
        (4, "LOOPBACK_MODE", "CN", (0,)),
        (6, "GET_MODE", "BCNL", (0,)),
        (16, "READ_REG", "CNL", (1,)),
        (17, "READ_REG_BLOCK", "BCNL", _ANY),
        (WRITE_REG, "WRITE_REG", "CNL", (2,)),
        (19, "WRITE_REG_BLOCK", "BCNL", _ANY),
        (20, "WRITE_READ_REG", "CNL", (2,)),
        (21, "BITMOD_REG", "CNL", (3,)),
        (BITMOD_READ_REG, "BITMOD_READ_REG", "CNL", (3,)),
        (COMMAND, "COMMAND", "CNL", range(1, LENGTH_MAX + 1)),
        (33, "FW_VERSION", "CNL", (0,)),
        (WRITE_MESSAGE, "WRITE_MESSAGE", "NL", range(3, 14)),
        (66, "WRITE_SYNC_MESSAGE", "N", _ANY),
        (67, "READ_SYNC_MESSAGE", "N", _ANY),
        (68, "SEND_SYNC_MESSAGE", "N", _ANY),
        (69, "DISABLE_SYNC_MESSAGE", "N", _ANY),
        (70, "DISABLE_ALL_SYNC", "N", _ANY),
        (71, "ENABLE_SYNC_MESSAGE", "N", _ANY),
        (72, "SET_PERIOD_SYNC_MESSAGE", "N", _ANY),
        (74, "SUPPORTED_SYNC_MESSAGE", "N", _ANY),
        (96, "READ_TEC", "N", (0,)),
        (97, "READ_REC", "N", (0,)),
        (98, "READ_RST", "N", (0,)),
        (127, "WRITE_INSTRUCTION", "BCNL", _ANY),  # in any mode it is the worst that a host can do
    )
}


def describe(command: int, data: bytes) -> str:
    """A message from the host in words: `WRITE_REG 0 0x01`, `COMMAND 0 15`, `READ_TEC`."""
    words = [RULES[command].name]
    if 16 <= command <= BITMOD_READ_REG:
        words += [f"{value}" if n == 0 else f"0x{value:02X}" for n, value in enumerate(data)]
    elif command == COMMAND:
        words += [f"{value}" for value in data]
    elif data:
        words.append(data.hex(" ").upper())
    return " ".join(words)


def message(command: int, data: bytes = b"") -> bytes:
    """The bytes of a message."""
    return bytes((START, command, len(data))) + data


def frame_in_transmit_buffer(data: bytes) -> Frame | None:
    """The frame of a WRITE_MESSAGE; None if its length does not fit its frame information."""
    info = data[0]
    extended = info >= 0x80
    remote = bool(info & 0x40)
    dlc = info & 0x0F
    head = 5 if extended else 3
    if dlc > 8 or len(data) != (head if remote else head + dlc):
        return None
    can_id = int.from_bytes(data[1:5]) >> 3 if extended else data[1] << 3 | data[2] >> 5
    return Frame(can_id, extended, remote, dlc, data[head:])


def receive_buffer_of(frame: Frame) -> bytes:
    """How the chip shows a received frame: as in the transmit buffer, and RTR also after the identifier."""
    remote = frame.remote
    if frame.extended:
        identifier = (frame.can_id << 3 | remote << 2).to_bytes(4)
    else:
        identifier = (frame.can_id << 5 | remote << 4).to_bytes(2)
    return bytes((frame.extended << 7 | remote << 6 | frame.dlc,)) + identifier + frame.data


LIMIT = 256  # + CMD_CRITICAL or CMD_READY: a limit as a thing to set up, besides the registers
_STEPS: dict[int, tuple[int, ...]] = {  # of chapter III; each ends before the next begins
    2: (MOD,),
    3: (CDR,),
    4: tuple(range(ACR0, ACR0 + 8)),
    5: (OCR,),
    6: (IER,),
    7: (BTR0, BTR1),
    8: (LIMIT + CMD_CRITICAL, LIMIT + CMD_READY),
}
_STEP_OF = {item: step for step, items in _STEPS.items() for item in items}
MODE_BITS = 0x0A  # of MOD: listen-only, single filter; they may be there already
_WANTED = {MOD: 0x01, CDR: 0xC0, OCR: 0xDA, IER: 0x03}
_NAMES = REGISTER_NAMES | {LIMIT + CMD_CRITICAL: "critical limit", LIMIT + CMD_READY: "ready limit"}


class Setup:
    """Watches steps 2-8 of the initialisation, from a CONFIG_MODE on; step 2 may begin them anew."""

    def __init__(self) -> None:
        self._done: set[int] = set()
        self._step = 1
        self._fault = ""

    def did(self, item: int, value: int) -> None:
        """The host wrote a register, or set a limit, in CONFIG mode."""
        step = _STEP_OF.get(item)
        if step is None:
            return
        if item == MOD:
            self._done, self._fault = set(), ""
        elif not self._fault:
            if step < self._step:
                self._fault = f"{_NAMES[item]} (step {step}) after step {self._step}"
            else:
                self._fault = self._missing(step)
        compared = value & ~MODE_BITS if item == MOD else value
        if not self._fault and compared != _WANTED.get(item, compared):
            self._fault = f"{_NAMES[item]} = 0x{value:02X}, not 0x{_WANTED[item]:02X} (step {step})"
        self._step = step
        self._done.add(item)

    def missing(self) -> str:
        """What is wrong for NORMAL_MODE, "" if nothing is."""
        return self._fault or self._missing(9)

    def _missing(self, step: int) -> str:
        """What should have been done before `step`, but was not."""
        for earlier in range(2, step):
            for item in _STEPS[earlier]:
                if item not in self._done:
                    return f"no {_NAMES[item]} (step {earlier}) before step {step}"
        return ""
