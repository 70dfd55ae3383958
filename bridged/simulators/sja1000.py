"""What a host can notice of the SJA1000 CAN controller: frames, acceptance filter, bit timing, registers."""

from __future__ import annotations

from dataclasses import dataclass

CLOCK_HZ = 16_000_000
"""Crystal of the CAN232 (its manual: `s031C` is 125 kbit/s) and of the USB2CAN (its manual, III.7)."""

STUFFABLE_BITS = {False: 34, True: 54}  # start bit to CRC, without data; by extended
FIXED_BITS = 13  # CRC delimiter, acknowledge, end of frame, intermission
RANDOM_STUFFING = 31  # five equal bits in a row turn up every 31 bits of random content

# PeliCAN registers (data sheet, 6.4.1)
MOD, CMR, SR, IR, IER = range(5)
BTR0, BTR1, OCR = 6, 7, 8
ALC, ECC, EWLR, RXERR, TXERR = range(11, 16)
ACR0, AMR0 = 16, 20
RMC, RBSA, CDR = 29, 30, 31

REGISTER_NAMES = {
    MOD: "MOD", CMR: "CMR", SR: "SR", IR: "IR", IER: "IER", BTR0: "BTR0", BTR1: "BTR1", OCR: "OCR",
    ALC: "ALC", ECC: "ECC", EWLR: "EWLR", RXERR: "RXERR", TXERR: "TXERR",
    **{ACR0 + n: f"ACR{n}" for n in range(4)}, **{AMR0 + n: f"AMR{n}" for n in range(4)},
    RMC: "RMC", RBSA: "RBSA", CDR: "CDR",
}  # fmt: skip

MOD_RESET = 0x01
MOD_LISTEN_ONLY = 0x02
MOD_SINGLE_FILTER = 0x08
MOD_SLEEP = 0x10
MOD_PROTECTED = 0x0E  # written only by a write that finds the chip in reset mode (6.4.3, note 1)
CDR_PELICAN = 0x80
CDR_PROTECTED = 0xE8  # CAN mode, CBP, RXINTEN, clock off: written only in reset mode (6.5.4)
CDR_ALWAYS_0 = 0x10
RESET_MODE_ONLY = frozenset({BTR0, BTR1, OCR, EWLR, RXERR, TXERR, *range(ACR0, ACR0 + 8), RBSA})

SR_BUS_OFF = 0x80
SR_ERROR = 0x40
SR_TRANSMITTING = 0x20
SR_IN_RESET = 0x3C
SR_IDLE = 0x0C  # transmission complete, transmit buffer free
TXERR_IN_BUS_OFF = 127


@dataclass(frozen=True, slots=True)
class Frame:
    """A classic CAN frame; `dlc` 0-8, `data` holds `dlc` bytes, none if `remote`."""

    can_id: int
    extended: bool
    remote: bool
    dlc: int
    data: bytes


def _bits(extended: bool, length: int) -> int:
    stuffable = STUFFABLE_BITS[extended] + 8 * length
    return stuffable + stuffable // RANDOM_STUFFING + FIXED_BITS


_FRAME_BITS = {(extended, n): _bits(extended, n) for extended in (False, True) for n in range(9)}


def frame_bits(frame: Frame) -> int:
    """Bit times that a frame occupies the bus, intermission included; stuff bits as for random content."""
    return _FRAME_BITS[frame.extended, len(frame.data)]


def bitrate(btr0: int, btr1: int) -> float:
    """Bit rate in bit/s of the bus timing registers (SJA1000 data sheet, 6.5)."""
    prescaler = (btr0 & 0x3F) + 1
    quanta = 1 + (btr1 & 0x0F) + 1 + (btr1 >> 4 & 0x07) + 1
    return CLOCK_HZ / (2 * prescaler * quanta)


def accepts(code: bytes, mask: bytes, single: bool, frame: Frame) -> bool:
    """Whether the acceptance filter passes a frame (SJA1000 data sheet, 6.4.15, PeliCAN mode).

    `code` is ACR0..ACR3, `mask` AMR0..AMR3, a 1 in the mask is "don't care". A data byte that the frame does
    not have is not compared. Filters look at the same 32 bits whatever the frame format; what differs is
    what a frame puts there:

        single, standard   ID.28-18 RTR x4 | data 1 | data 2
        single, extended   ID.28-0 RTR x2
        dual 1, standard   ID.28-18 RTR, data 1 high nibble | x12, data 1 low nibble
        dual 2, standard   x16 | ID.28-18 RTR x4
        dual 1, extended   ID.28-13 | x16
        dual 2, extended   x16 | ID.28-13
    """
    care = int.from_bytes(mask) ^ 0xFFFFFFFF
    wanted = int.from_bytes(code)
    patterns = _single(frame) if single else _dual(frame)
    return any(not (value ^ wanted) & care & present for value, present in patterns)


def _single(frame: Frame) -> tuple[tuple[int, int], ...]:
    """What the single filter sees: bits, and which of them are there."""
    if frame.extended:
        return ((frame.can_id << 3 | frame.remote << 2, 0xFFFFFFFC),)
    head = frame.can_id << 21 | frame.remote << 20
    data = (frame.data[:2] + b"\0\0")[:2]
    present = (0xFFF00000, 0xFFF0FF00, 0xFFF0FFFF)[min(len(frame.data), 2)]
    return ((head | int.from_bytes(data), present),)


def _dual(frame: Frame) -> tuple[tuple[int, int], ...]:
    """What each of the two filters sees: bits, and which of them are there."""
    if frame.extended:
        head = frame.can_id >> 13
        return ((head << 16, 0xFFFF0000), (head, 0x0000FFFF))
    head = frame.can_id << 5 | frame.remote << 4
    first = frame.data[0] if frame.data else 0
    present = 0xFFFF000F if frame.data else 0xFFF00000
    return ((head << 16 | (first >> 4) << 16 | first & 0x0F, present), (head, 0x0000FFF0))


class Sja1000:
    """The registers in PeliCAN mode (data sheet, 6.4), as a processor beside the chip reads and writes them.

    Left out: BasicCAN mode, in which only CDR is modelled; the transmit and receive buffers at 16-28 in
    operating mode and the RAM from 32, which read 0 and swallow what is written; interrupts (IR reads 0).
    """

    def __init__(self) -> None:
        self._registers = bytearray(CDR + 1)
        self._registers[MOD] = MOD_RESET
        self._registers[EWLR] = 96
        self._registers[CDR] = CDR_PELICAN  # the firmware chooses PeliCAN before a host can see it
        self.bus_off = False
        self.transmitting = False
        self._look()

    def _look(self) -> None:
        """What the registers mean."""
        registers = self._registers
        mode = registers[MOD]
        self.in_reset = bool(mode & MOD_RESET)
        self.listen_only = bool(mode & MOD_LISTEN_ONLY)
        self.single_filter = bool(mode & MOD_SINGLE_FILTER)
        self.pelican = bool(registers[CDR] & CDR_PELICAN)
        self.bitrate = bitrate(registers[BTR0], registers[BTR1])
        self.code = bytes(registers[ACR0 : ACR0 + 4])
        self.mask = bytes(registers[AMR0 : AMR0 + 4])

    @property
    def rec(self) -> int:
        """Receive error counter."""
        return self._registers[RXERR]

    @property
    def tec(self) -> int:
        """Transmit error counter."""
        return self._registers[TXERR]

    @property
    def error_status(self) -> bool:
        """Whether an error counter has reached the warning limit."""
        return self.bus_off or max(self.rec, self.tec) >= self._registers[EWLR]

    def count_errors(self, tec: int, rec: int) -> None:
        """What errors on the bus make of the counters; 0-255."""
        self._registers[TXERR], self._registers[RXERR] = tec, rec

    def latch_error(self, alc: int, ecc: int) -> None:
        """Where arbitration was last lost, and what the last bus error was."""
        self._registers[ALC], self._registers[ECC] = alc, ecc

    def force_listen_only(self, listen_only: bool) -> None:
        """Into listen-only mode or out of it, which no write can do outside of reset mode: a fault."""
        mode = self._registers[MOD] & ~MOD_LISTEN_ONLY
        self._registers[MOD] = mode | MOD_LISTEN_ONLY * listen_only
        self._look()

    def set_bus_off(self, bus_off: bool) -> None:
        """Into bus-off (6.4.11, 6.4.12: RXERR 0, TXERR 127), or recovered from it."""
        self.bus_off = bus_off
        self.count_errors(TXERR_IN_BUS_OFF if bus_off else 0, 0)

    def read(self, address: int) -> int:
        """A register's value; what is not there reads 0."""
        if address == SR:
            status = SR_TRANSMITTING if self.transmitting else SR_IDLE
            if self.in_reset:
                status = SR_IN_RESET
            return status | SR_BUS_OFF * self.bus_off | SR_ERROR * self.error_status
        if address > CDR or (ACR0 <= address < ACR0 + 8 and not self.in_reset):
            return 0
        return self._registers[address]

    def write(self, address: int, value: int) -> bool:
        """Write a register; False if the chip did not take all of it in the mode it is in.

        The mode register keeps bits 1-3 unless this very write finds the chip in reset mode.
        """
        registers = self._registers
        taken = True
        if address == MOD:
            old = registers[MOD]
            value &= 0x1F
            if not self.in_reset:
                # A request for reset mode is no attempt to change the other bits.
                taken = bool(value & MOD_RESET) or not (value ^ old) & MOD_PROTECTED
                value = value & ~MOD_PROTECTED | old & MOD_PROTECTED
            if value & MOD_RESET:
                value &= ~MOD_SLEEP  # sleep cannot be entered in reset mode
            registers[MOD] = value
        elif address == CDR:
            value &= ~CDR_ALWAYS_0
            if not self.in_reset:
                old = registers[CDR]
                taken = not (value ^ old) & CDR_PROTECTED
                value = value & ~CDR_PROTECTED | old & CDR_PROTECTED
            registers[CDR] = value
        elif address == IER or (address in RESET_MODE_ONLY and self.in_reset):
            registers[address] = value
        else:
            taken = address == CMR  # its bits act at once and read 0
        self._look()
        return taken
