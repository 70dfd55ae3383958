"""CAN terms as values: bit timing and acceptance filter of an SJA1000, the controller in these adapters; the
state of a controller; CAN error frames.

A change of state becomes a CAN error frame as the kernel's drivers make them (linux/can/error.h and
can_change_state in drivers/net/can/dev): error counters in data[6] and data[7], and the direction that the
state comes from, if the counters are known. Without CAN_ERR_CNT, which says that there are counters: it is
as new as Linux 6.0, and can-utils of before (Debian 12's) refuse to decode a frame that has it.
"""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple

STANDARD_REGISTERS = {
    10_000: (0x31, 0x1C),
    20_000: (0x18, 0x1C),
    50_000: (0x09, 0x1C),
    100_000: (0x04, 0x1C),
    125_000: (0x03, 0x1C),
    250_000: (0x01, 0x1C),
    500_000: (0x00, 0x1C),
    800_000: (0x00, 0x16),
    1_000_000: (0x00, 0x14),
}
"""bit/s → BTR0 and BTR1 of the same bit rates for a crystal of 16 MHz (CiA's table)."""

MAX_BITRATE = 1_000_000
"""bit/s, the limit of classic CAN (ISO 11898-1)."""

SAMPLE_POINT = 0.875
"""Where a bit is sampled unless the user says otherwise, as a fraction of the bit time (CiA 301)."""

SAMPLE_POINT_TOLERANCE = 0.05
"""How far the sample point may be from the one that was asked for, as a fraction of the bit time."""

CLOCK_HZ = 16_000_000
"""The crystal. The controller's bit timing runs on half of it (SJA1000 data sheet 6.5.1)."""


class BitTiming(NamedTuple):
    """The bit rate of a channel and, where the adapter's own table is not enough, the registers that make it.

    `bitrate` in bit/s, to the nearest whole one.
    `registers` are BTR0 and BTR1; None means one of the bit rates that the adapter has a command for.
    """

    bitrate: int
    registers: tuple[int, int] | None = None

    @property
    def description(self) -> str:
        """`125000 bit/s`, or `125000 bit/s by BTR0 0x03, BTR1 0x1C`."""
        if self.registers is None:
            return f"{self.bitrate} bit/s"
        return f"{self.bitrate} bit/s by BTR0 0x{self.registers[0]:02X}, BTR1 0x{self.registers[1]:02X}"

    @property
    def register_pair(self) -> tuple[int, int]:
        """BTR0 and BTR1, also of a bit rate that some adapters have a command for: (0x03, 0x1C)."""
        return self.registers or STANDARD_REGISTERS[self.bitrate]

    @classmethod
    def from_registers(cls, btr0: int, btr1: int, clock_hz: int = CLOCK_HZ) -> BitTiming:
        """What BTR0 = 0x03 and BTR1 = 0x1C mean: 125000 bit/s; ValueError above 1 Mbit/s."""
        prescaler = (btr0 & 0x3F) + 1
        quanta = 1 + ((btr1 & 0x0F) + 1) + ((btr1 >> 4 & 0x07) + 1)
        bitrate = round(clock_hz / 2 / (prescaler * quanta))
        if bitrate > MAX_BITRATE:
            raise ValueError(
                f"btr0 0x{btr0:02X} with btr1 0x{btr1:02X} makes {bitrate} bit/s; CAN ends at {MAX_BITRATE}"
            )
        return cls(bitrate, (btr0, btr1))


class AcceptanceFilter(NamedTuple):
    """Acceptance code and mask, AC0 and AM0 in the top byte; a mask bit of 1 means "don't care"."""

    code: int
    mask: int
    single: bool = False

    @property
    def mode(self) -> str:
        """`single`: one filter of 32 bits; `dual`: two of 16, of which either lets a frame pass."""
        return "single" if self.single else "dual"

    @property
    def passes_all(self) -> bool:
        """True if no frame is held back, whatever the code."""
        return self.mask == 0xFFFFFFFF


def require_bitrate(bitrate: int, clock_hz: int = CLOCK_HZ) -> int:
    """Return the clock divider that makes this bit rate (bit/s); ValueError names the nearest one there is.

    A divider is prescaler times quanta per bit, 1 to 32 and 8 to 25: what python-can keeps to, as what
    ISO 11898-1 demands of any controller. A rate that is no whole number is written rounded: 83333.
    """
    clock = clock_hz // 2
    dividers = {prescaler * quanta for prescaler in range(1, 33) for quanta in range(8, 26)}
    nearest = min(dividers, key=lambda divider: abs(clock / divider - bitrate))
    if abs(clock / nearest - bitrate) >= 1:
        raise ValueError(
            f"{bitrate} bit/s cannot be reached with the adapter's {clock_hz // 1_000_000} MHz clock; "
            f"nearest is {round(clock / nearest)} bit/s; or give btr0 and btr1"
        )
    return nearest


def bit_timing(bitrate: int, sample_point: float | None = None, clock_hz: int = CLOCK_HZ) -> tuple[int, int]:
    """Return BTR0 and BTR1 for a bit rate (bit/s), exact, and a sample point (0 to 1), within 0.05.

    Without a sample point the one nearest to 0.875 is taken, however near that is.
    ValueError says what can be had instead. The arithmetic is python-can's, which costs 0.1 s to import.
    """
    divider = require_bitrate(bitrate, clock_hz)
    from can import BitTiming as Calculator  # noqa: PLC0415 - see above

    if not hasattr(Calculator, "iterate_from_sample_point"):
        raise ValueError(
            f"the bit timing for {bitrate} bit/s takes python-can 4.3 or newer; or give btr0 and btr1"
        )
    clock = clock_hz // 2
    wanted = 100.0 * (SAMPLE_POINT if sample_point is None else sample_point)
    # python-can gives one timing per prescaler, the nearest to the sample point, if the registers can hold
    # it; its own choice among them may be 0.4 % off the bit rate. Hence: all of them, and only exact ones.
    # It truncates the quanta per bit: a bit rate rounded up would miss, `clock // divider` does not.
    exact = [
        timing
        for percent in (wanted, *range(50, 96))
        for timing in Calculator.iterate_from_sample_point(clock, clock // divider, percent)
        if timing.brp * timing.nbt == divider
    ]
    best = min(exact, key=lambda timing: (abs(timing.sample_point - wanted), timing.brp))
    if sample_point is not None and abs(best.sample_point / 100 - sample_point) > SAMPLE_POINT_TOLERANCE:
        raise ValueError(
            f"{sample_point} cannot be had at {bitrate} bit/s; "
            f"nearest is {best.sample_point / 100:.3g}; or give btr0 and btr1"
        )
    return best.btr0, best.btr1


# --- The state of a controller, and error frames ---------------------------------------------------

WARNING_LIMIT = 96
PASSIVE_LIMIT = 128

CAN_ERR_FLAG = 0x20000000
CAN_ERR_LOSTARB, CAN_ERR_CRTL, CAN_ERR_PROT = 0x002, 0x004, 0x008
CAN_ERR_BUSOFF, CAN_ERR_BUSERROR, CAN_ERR_RESTARTED = 0x040, 0x080, 0x100
CRTL_RX_OVERFLOW, CRTL_ACTIVE = 0x01, 0x40
CRTL_RX_WARNING, CRTL_TX_WARNING, CRTL_RX_PASSIVE, CRTL_TX_PASSIVE = 0x04, 0x08, 0x10, 0x20

FRAME = struct.Struct("=IB3x8s")  # struct can_frame


class BusState(enum.IntEnum):
    """Of a CAN controller (ISO 11898-1); ordered."""

    ERROR_ACTIVE = 0
    ERROR_WARNING = 1
    ERROR_PASSIVE = 2
    BUS_OFF = 3

    @property
    def text(self) -> str:
        return self.name.lower().replace("_", "-")


def state_of(tec: int, rec: int) -> BusState:
    """The state that these error counters mean; bus-off cannot be told by them."""
    worst = max(tec, rec)
    if worst >= PASSIVE_LIMIT:
        return BusState.ERROR_PASSIVE
    return BusState.ERROR_WARNING if worst >= WARNING_LIMIT else BusState.ERROR_ACTIVE


def error_frame(classes: int, *, crtl: int = 0, tec: int = 0, rec: int = 0) -> bytes:
    """A `struct can_frame` of these error classes (linux/can/error.h)."""
    return FRAME.pack(CAN_ERR_FLAG | classes, 8, bytes((0, crtl, 0, 0, 0, 0, tec, rec)))
