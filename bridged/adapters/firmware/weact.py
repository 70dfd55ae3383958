"""WeActStudio's USB2CANFDV1 with its slcan firmware. It answers a frame when that was sent on the bus."""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, OPEN, RETRANSMIT, Command, Profile

PROFILE = Profile(
    name="weact",
    title="WeAct USB2CANFDV1",
    close_answers=(Reply.OK, Reply.REFUSED),
    bitrates={5_000: "SD", 33_333: "SC", 62_500: "SB", 75_000: "SA", 83_333: "S9", **BITRATES},
    # Without A1 a frame that loses arbitration is gone. With it 16 frames that nobody acknowledges lock the
    # device up (BELL to V and C, too): never so many. A bare X enters the bootloader.
    open=(RETRANSMIT, Command("M0", "end listen-only mode", may_be_refused=True), OPEN),
    listen_only=(Command("M1", "choose listen-only mode"), OPEN),
    sending=Sending(confirms=Confirms.SENT, window=8, depth=8, retries=False),
    buffer=16,
    longest_line=139,
    warnings=("received frames that are not fetched within 0.1 s are lost, and nothing tells of it",),
)
