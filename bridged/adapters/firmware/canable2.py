"""canable2-fw of normaldotcom, with which CANable 2.0 (STM32G4) adapters are sold."""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import OPEN, RETRANSMIT, SLOW_BITRATES, Profile

PROFILE = Profile(
    name="canable2",
    title="CANable 2.0 with canable2-fw",
    answers=False,
    close_answers=(Reply.NONE,),
    # S7 promises 800 kbit/s and is 170 MHz / 7 / 17.
    bitrates={83_333: "S9", **SLOW_BITRATES, 500_000: "S6", 1_000_000: "S8", 1_428_571: "S7"},
    # As canable1; X sends a frame.
    open=(RETRANSMIT, OPEN),
    listen_only=None,
    sending=Sending(confirms=Confirms.NOTHING, depth=8),
    paced=True,
    buffer=63,
    remote_digits=True,
    longest_line=155,
)
