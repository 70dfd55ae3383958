"""USBtin, firmware 1.4 to 1.7 (MCP2515)."""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Profile

PROFILE = Profile(
    name="usbtin",
    title="USBtin",
    # N is NFFFF in all of them.
    close_answers=(Reply.OK, Reply.REFUSED),
    bitrates=BITRATES,  # s has three bytes, CNF1 to CNF3; W writes a register of the controller
    passes_all=True,
    # The controller may send what is in its three buffers in another order: one at a time then.
    sending=Sending(confirms=Confirms.QUEUED, window=1, depth=1, keeps_buffer=True),
    paced=True,
    buffer=3,
    in_order=False,
    stamp_digits=(4,),
    longest_line=100,
    flags=True,
    bus_off_flag=7,
    warnings=(
        "closing its channel leaves up to 3 frames in its controller, which it may send when opened again",
        "a burst of more than 128 characters loses bytes of received frames",
    ),
)
