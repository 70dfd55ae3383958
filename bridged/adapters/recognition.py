"""Finds out which firmware is behind a port, without ever putting a frame on a bus or changing a device.

A command that a crashed program left half typed may be in the device's buffer. A CR would finish it: a frame
from another time goes out on a live bus. A "C" might even complete it, being a hex digit. "V" is no hex
digit, makes a half command invalid, and alone only asks for the version.

So nothing but V goes first. Then come only questions that no known firmware takes for an order: V, N without
digits, v, F and VV, the last three on a closed channel. (X, W, U, Q, A, M1 and N with digits write flash,
registers or pins somewhere, or start a bootloader.)
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, NamedTuple

from bridged.adapters import firmware
from bridged.adapters.base import Answer, Exchange, Identity, Reply, pause
from bridged.errors import AdapterError, WrongDeviceError

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence

    from bridged.adapters.base import Steps
    from bridged.adapters.firmware import Seen, Signature
    from bridged.adapters.firmware.profile import Profile

OK, REFUSED, TEXT, NONE = Reply.OK, Reply.REFUSED, Reply.TEXT, Reply.NONE
ANYTHING = (OK, REFUSED, TEXT, NONE)

# A CAN232 looks at the whole line, so as many V as a line holds are enough, with their CR.
GENTLE_FLUSH = b"V" * 26 + b"\r"

# Other firmware may send what such a line begins with, whatever follows. But its buffer overflows, after
# 30 to 165 characters, and then begins anew (or the line is thrown away). So more than any buffer holds, and
# no CR before it has overflowed. In pieces that fit into a USB packet (64 bytes) each. What forgets a half
# command after a silence (10 ms, 50 ms) has forgotten all of it after the pause.
FLUSH_PIECE = b"V" * 50
FLUSH_PIECES = 4
FLUSH_PAUSE_S = 0.06

TRIES = 4  # to ask V; the first one ends the line of the flush, which a CAN232 refuses
DEAF_S = 1.5  # an ESP32 that was reset, as opening its port does, hears nothing for a second
HEARD_KEPT = 16
PREFIX_MAX = 4  # bytes by which the relay knows an answer

# The buffer of this one has 30 characters: more of them overwrite its memory.
CANTACT = "CANtact"  # "CANtact dev", "CANtact b12": USB product ad50:60c4


class Recognised(NamedTuple):
    """What is behind the port."""

    profile: Profile
    identity: Identity
    version_prefix: bytes  # how the answer to V begins
    closed: bool  # its channel


def question(
    request: bytes,
    purpose: str,
    timeout_s: float,
    accept: tuple[Reply, ...] = (OK,),
    reject: tuple[Reply, ...] = (REFUSED, NONE),
    *,
    prefix: bytes = b"",
    advice: str = "",
) -> Exchange:
    """A command with its CR, and the answers that accept and reject it."""
    return Exchange(request, purpose, accept, reject, prefix, advice, timeout_s)


class Recognition:
    """Of one port. `forced` is the profile that the user names, None to find out."""

    def __init__(self, port: str, baudrate: int, forced: str | None, timeout_s: float) -> None:
        self._where = f"{port} at {baudrate} Bd"
        self._port = port
        self._baudrate = baudrate
        self._forced = None if forced is None else firmware.load(forced)
        self._timeout_s = timeout_s
        # Whether no half command of another program can be in the device's buffer.
        self.flushed = self._forced is not None and self._forced.gentle_flush
        self.keep_off = False  # not a byte may be sent to what is there
        self._heard: list[bytes] = []  # texts that answer no request, since the last question
        self._noise = False  # was heard since V was asked first

    def saw_text(self, text: bytes) -> None:
        """A text came that answers no request."""
        self._heard = [*self._heard[1 - HEARD_KEPT :], text]

    def saw_noise(self) -> None:
        """Bytes that mean nothing came."""
        self._noise = True

    def steps(self, product: str | None) -> Generator[Exchange, Answer, Recognised]:
        """Flush, then ask. `product` is the name of the USB device. WrongDeviceError: it is not used."""
        self.keep_off = product is not None and product.startswith(CANTACT)
        if self.keep_off:
            raise WrongDeviceError(
                f"the USB device of {self._port} calls itself '{product}': no CAN232, and the "
                f"first bytes of any flush would overwrite its memory, so nothing is sent to it"
            )
        if self._forced is not None and self._forced.gentle_flush:
            yield from self._flush_gently()
        else:
            self.flushed = False
            yield from self.flush()
        version = yield from self._version()
        if self._forced is not None:
            return (yield from self._as_told(self._forced, version))
        return (yield from self._recognise(version))

    # --- flush --------------------------------------------------------------------------------

    def flush(self) -> Steps:
        """For a device of which nothing is known yet. The line is still to be ended, by `V`: a lone CR means
        different things to different firmware (the last frame once more, the first byte of a command)."""
        for _ in range(FLUSH_PIECES):
            on_the_line_s = len(FLUSH_PIECE) * 10 / self._baudrate
            yield Exchange(
                FLUSH_PIECE, "drop a half-typed command", (NONE,), (), timeout_s=on_the_line_s
            )  # whatever answers it is of no interest
        yield pause(FLUSH_PAUSE_S)

    def _flush_gently(self) -> Steps:
        """Lone CRs, as the manual wants them, only once the channel is closed: on an open one some
        clones answer them by sending their last frame again."""
        yield self._ask_for(GENTLE_FLUSH, "drop a half-typed command", ANYTHING, b"V")
        yield self._close()
        yield self._ask_for(b"\r\r", "empty its command buffer", ANYTHING)

    # --- questions ----------------------------------------------------------------------------

    def _ask_for(
        self, request: bytes, purpose: str, accept: tuple[Reply, ...], prefix: bytes = b""
    ) -> Exchange:
        return question(request, purpose, self._timeout_s, accept, (), prefix=prefix)

    def _close(self) -> Exchange:
        return self._ask_for(b"C\r", "close the channel", (OK, REFUSED, NONE))

    def _version(self) -> Generator[Exchange, Answer, str]:
        """The answer to V. Most begin with V; others come as texts that answer no request."""
        self._heard, self._noise = [], False
        replies = []
        tries = max(TRIES, math.ceil(DEAF_S / self._timeout_s))
        ask = self._ask_for(b"V\r", "tell its version", (TEXT, REFUSED, NONE), b"V")
        for number in range(1, tries + 1):
            # An empty line may be the late answer to something else, but not each time.
            answer = yield ask._replace(accept=ANYTHING) if number == tries else ask
            self.flushed = True
            replies.append(answer.reply)
            if answer.reply is TEXT:
                return answer.text.decode("ascii", "replace")
            for text in self._heard:
                heard = text.decode("ascii", "replace")
                if any(signature.fits(firmware.Seen(heard)) for signature in firmware.BY_VERSION.values()):
                    return heard
        # Noise may look like a text, but not always like the same one.
        text = max(self._heard, key=self._heard.count, default=b"")
        if text and (not self._noise or self._heard.count(text) >= TRIES - 1):
            return text.decode("ascii", "replace")
        raise self._no_version(replies)

    def _seen(self, request: bytes, purpose: str) -> Generator[Exchange, Answer, str]:
        """The answer to a question that a device may not know, as Seen has it."""
        self._heard = []
        answer = yield self._ask_for(request + b"\r", purpose, (TEXT, REFUSED, NONE), request[:1])
        if answer.reply is TEXT or self._heard:
            return (answer.text or self._heard[-1]).decode("ascii", "replace")
        return firmware.BELL if answer.reply is REFUSED else firmware.SILENCE

    # --- conclusions --------------------------------------------------------------------------

    def _as_told(self, profile: Profile, version: str) -> Generator[Exchange, Answer, Recognised]:
        signature = firmware.SIGNATURES.get(profile.name)
        if profile.name == "can232" and not re.fullmatch(firmware.HEX4, version):
            raise self._unknown(firmware.Seen(version), "not a CAN232 (Vhhss)")
        seen = firmware.Seen(version)
        if profile.serial_number:
            seen = seen._replace(number=(yield from self._seen(b"N", "tell its serial number")))
        return _recognised(profile, signature, seen, closed=profile.gentle_flush)

    def _recognise(self, version: str) -> Generator[Exchange, Answer, Recognised]:
        seen = firmware.Seen(version)
        looks_like_a_can232 = re.fullmatch(firmware.HEX4, version)
        if not looks_like_a_can232 and (candidates := seen.fitting(firmware.BY_VERSION)):
            (name,) = candidates
            profile = firmware.load(name)
            if profile.serial_number:
                seen = seen._replace(number=(yield from self._seen(b"N", "tell its serial number")))
            return _recognised(profile, firmware.BY_VERSION[name], seen, closed=False)
        if not looks_like_a_can232:
            raise self._unknown(seen)
        seen = seen._replace(number=(yield from self._seen(b"N", "tell its serial number")))
        candidates = seen.fitting(firmware.BY_CONSTANTS) or seen.fitting(firmware.BY_ALL_ANSWERS)
        if not set(candidates) <= firmware.WITHOUT_PROFILE.keys():
            seen = yield from self._look_closer(seen, candidates)
            candidates = {name: one for name, one in candidates.items() if one.fits(seen)}
        if len(candidates) != 1:
            raise self._unknown(seen)
        (name,) = candidates
        if name in firmware.WITHOUT_PROFILE:
            raise self._unknown(
                seen, f"probably {firmware.WITHOUT_PROFILE[name]}, for which there is no profile"
            )
        return _recognised(firmware.load(name), candidates[name], seen, closed=True)

    def _look_closer(self, seen: Seen, candidates: dict[str, Signature]) -> Generator[Exchange, Answer, Seen]:
        """Asks what answers V and N as a CAN232 may: v, F, and VV where two can still be meant."""
        for _ in range(2):
            seen = seen._replace(details=(yield from self._seen(b"v", "tell its version in detail")))
            if seen.details != firmware.SILENCE:
                break
        for _ in range(2):  # a CAN232 answers F, too, if C did not reach it
            yield self._close()
            seen = seen._replace(flags=(yield from self._seen(b"F", "tell its status flags")))
            if seen.flags == firmware.BELL:
                break
        if sum(signature.fits(seen) for signature in candidates.values()) > 1:
            for _ in range(2):
                seen = seen._replace(malformed=(yield from self._seen(b"VV", "refuse nonsense")))
                if seen.malformed != firmware.SILENCE:
                    break
        return seen

    # --- what is wrong ------------------------------------------------------------------------

    def _unknown(self, seen: Seen, what: str = "no firmware that is known") -> WrongDeviceError:
        names = ", ".join(firmware.NAMES)
        return WrongDeviceError(
            f"the device on {self._port} answers {seen.description}: {what}, so it is not used. "
            f"If you know what it is, say so by `firmware:` in section adapter: one of {names} "
            f"(generic: any, as carefully as can be)"
        )

    def _no_version(self, replies: Sequence[Reply]) -> AdapterError:
        if REFUSED in replies:
            return AdapterError(
                f"the adapter on {self._port} refuses every command, V too: is it a CAN232, and well? "
                f"(A WeAct does so when nobody acknowledges its frames; unplug it)"
            )
        if OK in replies:
            return WrongDeviceError(f"the device on {self._port} answers V with an empty line: not a CAN232")
        if self._noise:
            return AdapterError(
                f"only noise answers V on {self._where}: is the baud rate right "
                f"(its LEDs blink it at power-on)?"
            )
        return AdapterError(
            f"no answer to V on {self._where}: is the adapter powered "
            f"(from the CAN side, 6-16 V), the baud rate right (its LEDs blink it at power-on), "
            f"the cable plugged?"
        )


def _recognised(profile: Profile, signature: Signature | None, seen: Seen, *, closed: bool) -> Recognised:
    match = re.fullmatch(signature.version, seen.version) if signature else None
    named = match.groupdict() if match else {}
    number = named.get("number")
    if profile.serial_number and seen.number is not None and seen.number.startswith("N"):
        number = seen.number[1:]
    identity = Identity(named.get("version", seen.version), number)
    return Recognised(profile, identity, seen.version.encode()[:PREFIX_MAX], closed)
