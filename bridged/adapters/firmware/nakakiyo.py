"""Nakakiyo092's firmware for the CANable 2.0 (V answers VL2K4) and the USB2CANFDV1 (VW1K2).

The second is known by its source only. There X, whatever follows it, enters the bootloader.
"""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Profile

PROFILE = Profile(
    name="nakakiyo",
    title="device with the firmware of Nakakiyo092",
    serial_number=True,  # BELL until somebody has set one; N with digits writes flash, as does Q
    close_answers=(Reply.OK, Reply.REFUSED),
    bitrates=BITRATES,
    passes_all=True,
    sending=Sending(confirms=Confirms.QUEUED, window=32, depth=56, long_stamps=True),
    paced=True,  # a frame that it refuses, being full, would be overtaken by the next in the window
    buffer=64,
    stamp_digits=(4, 8),
    longest_line=165,
    flags=True,
)
