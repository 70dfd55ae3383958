"""Elmue's CANable 2.5. Closing its channel makes it forget everything, the bit rate too."""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Command, Profile

PROFILE = Profile(
    name="elmue",
    title="CANable with the firmware of Elmue",
    close_answers=(Reply.NONE,),
    bitrates={5_000: "SD", 33_333: "SC", 62_500: "SB", 75_000: "SA", 83_333: "S9", **BITRATES},
    # F is a filter list, m is refused; `*DFU` and its like write flash or enter the bootloader.
    listen_only=(Command("OS", "open the channel in listen-only mode"),),
    sending=Sending(confirms=Confirms.QUEUED, window=32, depth=56),
    paced=True,  # a frame that it refuses, being full, would be overtaken by the next in the window
    buffer=64,
    longest_line=165,
    warnings=(
        "frames that no other node acknowledges for 0.5 s are thrown away by the adapter, without a word",
    ),
)
