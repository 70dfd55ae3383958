"""What a host can notice of the SJA1000 CAN controller: frames, acceptance filter, bit timing."""

from __future__ import annotations

from dataclasses import dataclass

CLOCK_HZ = 16_000_000
"""Crystal of the CAN232 (its manual: `s031C` is 125 kbit/s)."""

STUFFABLE_BITS = {False: 34, True: 54}  # start bit to CRC, without data; by extended
FIXED_BITS = 13  # CRC delimiter, acknowledge, end of frame, intermission
RANDOM_STUFFING = 31  # five equal bits in a row turn up every 31 bits of random content


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
