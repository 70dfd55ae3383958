"""What a simulated CAN232 keeps: its EEPROM, and the simulator's counters."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from typing import TYPE_CHECKING

from bridged.errors import PortError

if TYPE_CHECKING:
    from pathlib import Path


@dataclasses.dataclass
class Eeprom:
    """What survives power-off; `writes` counts every write of a cell, also of the value it had."""

    auto_poll: bool = False  # X
    time_stamps: bool = False  # Z
    single_filter: bool = False  # W
    uart: int = 2  # U, index into UART_RATES
    auto_start: int = 0  # Q: 0 no, 1 normal, 2 listen-only
    bitrate: float = 0.0  # bit/s, saved by Q as are the filters
    code: str = "00000000"
    mask: str = "FFFFFFFF"
    writes: int = 0


def load_eeprom(path: Path | None) -> Eeprom:
    """What a Simulator kept in a file, a new EEPROM if there is none; PortError if it is something else."""
    if path is None or not path.exists():
        return Eeprom()
    try:
        return Eeprom(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise PortError(f"{path}: not an EEPROM file of this simulator: {error}") from error


@dataclasses.dataclass
class Counters:
    """What happened since the simulator began; `frames_taken` = sent + discarded + still in the FIFO."""

    commands: Counter[str] = dataclasses.field(default_factory=Counter)  # by letter, carried out or not
    refused: int = 0  # commands answered BELL
    refused_full: int = 0  # of these, frames for which the transmit FIFO had no room
    answers_dropped: int = 0  # by a fault: carried out, but the host did not hear of it
    frames_taken: int = 0  # from the host into the transmit FIFO
    frames_sent: int = 0  # put on the bus
    frames_discarded: int = 0  # in the transmit FIFO when the channel was closed
    frames_received: int = 0  # from the bus into the receive FIFO
    frames_lost: int = 0  # from the bus, receive FIFO full
    frames_filtered: int = 0  # from the bus, not accepted
    frames_unseen: int = 0  # on the bus while the channel was closed
    rs232_lost: int = 0  # characters from the host that found no line buffer
