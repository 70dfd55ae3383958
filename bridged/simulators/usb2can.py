"""A CANLAB USB2CAN as its manual ("Popis USB komunikace", Španěl) describes it; no I/O, no own clock.

How the firmware works, where the manual leaves it open: it reads the host's bytes with a state machine that
has no timeout, so half a message waits for its rest. An unknown command or a LENGTH above 16 makes it drop
the start byte and look for the next 0x0F, which may be the byte after it. It carries out one command after
the other, each when `processing_s` is over; mode changes, WRITE_MESSAGE and settings by COMMAND have no
answer. A command in a mode that the table does not list for it, or of another length, does nothing.

Decided here because the manual does not say, or says two things:
- NORMAL_MODE works in CONFIG and LOOPBACK only (the table; the text below it says everywhere); it does not
  clear the SJA1000's reset bit (step III.10 does), nor does CONFIG_MODE set it (step III.2 does).
- Leaving NORMAL mode drops what waits for the bus; BOOT_MODE is like power-on.
- A frame waits until it is on the bus. STOP is sent when more than `critical` wait, GO when fewer than
  `ready` do; a ready limit of 0 means that there is never a GO. Limits are 0, 0 at power-on: not usable,
  and the device says ERROR_CRITICAL_TRANSMIT 2 every 0.1 s in NORMAL mode, as seen on a real one.
- CMD_GET tells how many frames wait in each transmit buffer; single buffers leave the second one empty.
- READ_RST is little endian; so are time stamps unless `stamp_order` says otherwise. Seconds count from
  power-on; TIMESTAMP comes before the frames of its second.
- ERROR_STATUS is sent when the bit is set, not when it is cleared; its bytes 1-5 are bytes 1-5 of BUS_OFF.
- Bus-off lasts as long as the fault; the buffer is kept; MOD is as before, because the firmware restarts the
  chip. BUS_OFF is sent again if the chip goes on the bus once more while it lasts.
- RX messages have the RTR bit also after the identifier, as the receive buffer of the chip has (6.4.14).
- Sync messages are not simulated; their layout is not documented.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, ClassVar, Final, Literal

from bridged.simulators.device import OwnFault
from bridged.simulators.options import matching, whole
from bridged.simulators.sja1000 import MOD, Frame, accepts
from bridged.simulators.usb2can_firmware import ACCEPT_ALL, LIMITS_REPEAT_S, Counters, Firmware
from bridged.simulators.usb2can_messages import (
    CRITICAL_TRANSMIT,
    ERROR,
    LENGTH_MAX,
    LIMITS_UNUSABLE,
    RULES,
    START,
    STATUS,
    TIMESTAMP,
    WRITE_MESSAGE,
    State,
    Variant,
)

if TYPE_CHECKING:
    import argparse
    from collections.abc import Mapping

__all__ = [
    "ADAPTER",
    "FAULTS",
    "STOP_GRACE_S",
    "TITLE",
    "Counters",
    "State",
    "Usb2can",
    "add_arguments",
    "make_device",
]

TITLE: Final = "CANLAB USB2CAN"
ADAPTER: Final = {"type": "usb2can"}

STOP_GRACE_S = 5.0  # frames that the host sent before it read a STOP may be on their way for so long
VALUE_2_BURST = 20  # messages


def _lose_go(device: Usb2can, _now: float, times: int) -> None:
    device.lose_go = times


FAULTS: Final = {
    "lostgo": OwnFault("it does not say 'go on' after 'stop'", switch=_lose_go),
    "value2": OwnFault(
        f"{VALUE_2_BURST} messages about its transmit buffer, of a value that its document does not know",
        burst=lambda device, now: device.value_2_burst(now, VALUE_2_BURST),
    ),
    "overrun": OwnFault("it has lost received frames", burst=lambda device, now: device.overrun(now)),
}


class Usb2can(Firmware):
    """The device behind its FT245; times in seconds of the caller's clock, which must not go back.

    `version` as FW_VERSION answers it; its series decides about the size of the transmit buffer (`tx_buffer`
    frames, in series 3 and 5 twice) and time stamps. `receive_buffer` frames wait for `take_output`. `junk`
    is sent at power-on; `quirks` answers CONFIG_MODE with FF FF; `answers_get` and `get_length_4` (no leading
    128) are about CMD_GET; `padded` hands frames back as 13 bytes. The host may still send `stop_grace_s`
    after it was given a STOP.

    Faults are the attributes `silent` (nothing is sent, commands are carried out), `refusals` (so many frames
    from the host are handed back), `drop_answers` (so many answers are lost), `lose_go` (so many GO are), and
    the methods below. `violations` says in words what the host did against the manual. What it sends after a
    power failure, or in a mode that it did not choose, before its next CONFIG_MODE counts for nothing: it
    cannot know. ValueError if the version is none.
    """

    own_faults: ClassVar[Mapping[str, OwnFault]] = FAULTS

    def __init__(
        self,
        now: float = 0.0,
        *,
        version: str = "HW0003FW0016",
        processing_s: float = 0.0,
        tx_buffer: int = 20,
        receive_buffer: int = 64,
        junk: bytes = b"",
        quirks: bool = True,
        answers_get: bool = True,
        get_length_4: bool = False,
        padded: bool = False,
        stamp_order: Literal["little", "big"] = "little",
        stop_grace_s: float = 0.0,
    ) -> None:
        self.processing_s = processing_s
        self.receive_buffer = receive_buffer
        self.junk = junk
        self.stop_grace_s = stop_grace_s
        variant = Variant(version, tx_buffer, quirks, answers_get, get_length_4, padded, stamp_order)
        super().__init__(now, variant)
        self._start()

    def _start(self) -> None:
        """Power-on: nothing survives but what the host has been given."""
        self.powered = True
        self._power_on = self._free_at = self._clock
        self._input = b""  # the beginning of a message
        self._waiting: deque[tuple[float, int, bytes]] = deque()  # when it is carried out, command, data
        self._output.clear()
        self._output_frames = 0
        self._losing = False  # received frames, since the last that fitted
        self._boot()
        if self.junk:
            self._output.append(self.junk)
        self._reckon()

    @property
    def title(self) -> str:
        return f"USB2CAN {self.variant.version}"

    @property
    def record(self) -> list[str]:
        """The last commands that were carried out, WRITE_MESSAGE left out: "WRITE_REG 0 0x01"."""
        return list(self._record)

    def report(self) -> dict[str, object]:
        """Everything that can be asked, fit for JSON."""
        chip = self.chip
        return {
            "powered": self.powered,
            "state": self.state.value,
            "version": self.variant.version,
            "bitrate": chip.bitrate,
            "mode_register": chip.read(MOD),
            "code": chip.code.hex().upper(),
            "mask": chip.mask.hex().upper(),
            "limits": {"critical": self.critical, "ready": self.ready},
            "waiting": self.waiting,
            "restarts": self.restarts,
            "counters": vars(self.counters) | {"commands": dict(self.counters.commands)},
            "violations": list(self.violations),
            "record": self.record,
        }

    # What happens to the device

    def power_on(self, now: float) -> None:
        """Power is back, or the device is plugged in; it starts at once."""
        self.advance(now)
        self._unaware = True
        self._start()

    def power_off(self, now: float) -> None:
        """The power fails, or the device is unplugged: nothing goes in or out until `power_on`."""
        self.advance(now)
        self.powered = False
        self._waiting.clear()
        self._output.clear()
        self._discard_frames()
        self._update()
        self._reckon()

    def power_cycle(self, now: float) -> None:
        """Off and on again at once, or a reset behind the host's back."""
        self.power_off(now)
        self.power_on(now)

    def set_bus_off(self, now: float, bus_off: bool) -> None:
        """Bus-off: no frames either way as long as it lasts."""
        self.advance(now)
        self.bus_off = bus_off
        self._update()
        self._reckon()

    def set_listen_only(self, now: float, listen_only: bool) -> None:
        """The controller is in listen-only mode, which its host did not want, until it is set up anew."""
        self.advance(now)
        self._unaware = self._unaware or listen_only
        self.chip.force_listen_only(listen_only)
        self._update()
        self._reckon()

    def set_error_counters(self, now: float, tec: int, rec: int) -> None:
        """Errors on the bus have brought the counters to these values, 0-255; ignored during bus-off."""
        self.advance(now)
        chip = self.chip
        if self._on_bus() and not chip.bus_off:
            before = chip.error_status
            chip.count_errors(tec, rec)
            if chip.error_status and not before:
                self._emit_message(ERROR, bytes((STATUS,)) + self._bus_state()[1:])

    def garbage(self, now: float, noise: bytes) -> None:
        """Noise on the way to the host."""
        self.advance(now)
        if self.powered:
            self._output.append(noise)

    def value_2_burst(self, now: float, count: int) -> None:
        """ERROR_CRITICAL_TRANSMIT with the value 2 so many times, which the manual does not know."""
        self.advance(now)
        for _ in range(count):
            self._emit_message(ERROR, bytes((CRITICAL_TRANSMIT, LIMITS_UNUSABLE)))

    def overrun(self, now: float) -> None:
        """A frame from the bus is lost in the chip."""
        self.advance(now)
        if self._receiving:
            self.counters.frames_lost += 1
            self._tell_overrun()

    def host_writes(self, now: float, data: bytes) -> None:
        """The host gave bytes to the USB at `now`."""
        self.advance(now)
        counters = self.counters
        if not self.powered:
            counters.host_lost += len(data)
            return
        data = self._input + data
        size = len(data)
        at = 0
        while at < size:
            if data[at] != START:
                found = data.find(START, at)
                counters.bytes_skipped += (size if found < 0 else found) - at
                at = size if found < 0 else found
                continue
            if at + 1 == size:
                break
            command = data[at + 1]
            if command not in RULES:
                breach = f"unknown command {command}"
            elif at + 2 == size:
                break
            elif (length := data[at + 2]) > LENGTH_MAX:
                breach = f"{RULES[command].name} with LENGTH {length}"
            else:
                end = at + 3 + length
                if end > size:
                    break
                self._arrive(now, command, data[at + 3 : end])
                at = end
                continue
            self._catch_up(now)
            self._violate(breach)
            counters.bytes_skipped += 1
            at += 1
        self._input = data[at:]
        self._catch_up(now)

    def bus_frame(self, now: float, frame: Frame) -> None:
        """A frame was on the bus at `now`."""
        self.advance(now)
        counters = self.counters
        chip = self.chip
        if not self._receiving:
            counters.frames_unseen += 1
        elif chip.mask != ACCEPT_ALL and not accepts(chip.code, chip.mask, chip.single_filter, frame):
            counters.frames_filtered += 1
        elif self._output_frames >= self.receive_buffer:
            counters.frames_lost += 1
            if not self._losing:
                self._losing = True
                self._tell_overrun()
        else:
            counters.frames_received += 1
            self._losing = False
            if not self.silent:
                self._output_frames += 1
                self._output.append(self._received_message(frame))

    def advance(self, now: float) -> None:
        """Live through everything up to `now`, each thing at its own time, in order."""
        while self._due <= now:
            at = self._clock = max(self._clock, self._due)
            if self._head_done <= at:
                self._frame_sent(at)
            elif self._tick <= at:
                self._emit_message(TIMESTAMP, b"")
                self._tick += 1
            elif self._repeat <= at:
                self._emit_message(ERROR, bytes((CRITICAL_TRANSMIT, LIMITS_UNUSABLE)))
                self._repeat += LIMITS_REPEAT_S
            else:
                _, command, data = self._waiting.popleft()
                self._execute(command, data)
            self._reckon()
        self._clock = max(self._clock, now)

    def take_output(self, now: float) -> bytes:
        """What goes to the host at `now`; all of it counts as read."""
        self.advance(now)
        output = self._output
        if not output:
            return b""
        if self._stop_pending:
            self._stop_pending = False
            self._stop_limit = now + self.stop_grace_s
        taken = b"".join(output)
        output.clear()
        self._output_frames = 0
        return taken

    def take_bus_frames(self) -> list[Frame]:
        """The frames put on the bus up to the last `advance`."""
        frames, self._to_bus = self._to_bus, []
        return frames

    def next_deadline(self) -> float:
        """When something can be seen on either side, if nothing else happens before; math.inf if never."""
        return self._clock if self._output else self._due

    # The main loop

    def _reckon(self) -> None:
        """When the next thing happens."""
        waiting = self._waiting
        self._due = min(self._head_done, self._tick, self._repeat, waiting[0][0] if waiting else math.inf)

    def _catch_up(self, now: float) -> None:
        """Carry out what has arrived, if it is time."""
        self._reckon()
        self.advance(now)

    def _arrive(self, now: float, command: int, data: bytes) -> None:
        """A message is complete."""
        if command == WRITE_MESSAGE and now > self._stop_limit:
            self._catch_up(now)  # a command before it may have made an end of that
            if now > self._stop_limit:
                late_s = now - self._stop_limit + self.stop_grace_s
                self._violate(f"WRITE_MESSAGE {late_s:.6f} s after a STOP")
        self._free_at = max(self._free_at, now) + self.processing_s
        self._waiting.append((self._free_at, command, data))


# For `can-bridge simulate`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    version = matching(r"HW\d{4}FW\d{4}", "a version like HW0003FW0016")
    parser.add_argument(
        "--version",
        type=version,
        default="HW0003FW0016",
        dest="device_version",
        metavar="HWxxxxFWyzzz",
        help="answer to FW_VERSION; y: 5 and 6 stamp what they receive",
    )
    parser.add_argument(
        "--tx-buffer",
        type=whole,
        default=20,
        metavar="FRAMES",
        help="room for frames to be sent; default: 20",
    )


def make_device(now: float, args: argparse.Namespace) -> Usb2can:
    return Usb2can(
        now,
        version=args.device_version,
        processing_s=args.processing,
        tx_buffer=args.tx_buffer,
        stop_grace_s=STOP_GRACE_S,
    )
