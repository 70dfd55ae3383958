"""kahiroka's slcanuino (Arduino, MCP2515): on its bus from power-on. Its answer to a frame means nothing."""

from bridged.adapters.base import Confirms, Remote, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Profile

PROFILE = Profile(
    name="slcanuino",
    title="Arduino with slcanuino",
    # N is N1234 in all of them.
    close_answers=(Reply.OK,),
    bitrates={rate: command for rate, command in BITRATES.items() if command not in {"S0", "S1", "S2", "S7"}},
    listen_only=None,
    sending=Sending(
        confirms=Confirms.ALWAYS, remote=Remote.WITH_DIGITS, window=1, depth=1, keeps_buffer=True
    ),
    paced=True,
    buffer=3,
    in_order=False,
    remote_digits=True,
    stamp_digits=(4,),  # a counter, not a time
    longest_line=32,
    stops=False,
    warnings=(
        "closing its channel leaves it on the CAN bus: it goes on acknowledging frames until it is unplugged",
        "it answers each frame as sent, also those that it loses",
        "it stops answering for good when no other node acknowledges its frames: unplug it then",
    ),
)
