"""Frames that vouch for themselves: each carries its number, when it was born, and a check over all of it.

So whoever reads one knows without any table whether somebody sent it, when, and whether it was changed.
No byte of one is FILLER, in either protocol: that is what a device uses to fill its own line.
"""

import itertools
import struct
import zlib

EXTENDED = 0x80000000
FILLER = 0xFF
BASE = 250  # of a digit: a byte that is never FILLER
DIGITS = 3
LIFE_MS = BASE**DIGITS  # 4 hours; births are told apart for so long
CHECK_DIGITS = 2
SHORT_CHECK = 0xFFFFFF
STRUCT = struct.Struct("=IB3x8s")  # struct can_frame


def _digits(value: int, count: int) -> bytes:
    return bytes(value // BASE**i % BASE for i in range(count))


def _value(digits: bytes) -> int:
    return sum(digit * BASE**i for i, digit in enumerate(digits))


def _check(can_id: int, told: bytes) -> int:
    return zlib.crc32(can_id.to_bytes(4, "big") + told)


def make(number: int, born_ms: int) -> tuple[int, bytes]:
    """Identifier and data: standard, extended, or extended and short with the check in the identifier."""
    told = _digits(number, DIGITS) + _digits(born_ms, DIGITS)
    if number % 5 < 4:
        can_id = 0x101 + 0x20 * (number % 3) if number % 5 < 3 else EXTENDED | 0x01234560 + number % 2
        return can_id, told + _digits(_check(can_id, told), CHECK_DIGITS)
    for salt in itertools.count(1):
        can_id = EXTENDED | salt << 24 | _check(salt, told) & SHORT_CHECK
        if FILLER not in (can_id << 3 & 0xFFFFFFFF).to_bytes(4, "big"):  # as the USB2CAN has it
            return can_id, told
    raise AssertionError


def read(can_id: int, data: bytes) -> tuple[int, int] | None:
    """Number and birth; None: nobody sent this."""
    told, check = data[: 2 * DIGITS], data[2 * DIGITS :]
    if len(told) < 2 * DIGITS or max(data) >= BASE:
        return None
    if check:
        true = check == _digits(_check(can_id, told), CHECK_DIGITS)
    else:
        true = (
            bool(can_id & EXTENDED)
            and can_id & SHORT_CHECK == _check(can_id >> 24 & 0x1F, told) & SHORT_CHECK
        )
    return (_value(told[:DIGITS]), _value(told[DIGITS:])) if true else None


def age_ms(born_ms: int, now_ms: int) -> int:
    age = (now_ms - born_ms) % LIFE_MS
    return age if age < LIFE_MS // 2 else age - LIFE_MS
