"""For firmware that nobody has described: only what all have in common, and no answer is believed."""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import SLOW_BITRATES, Profile

PROFILE = Profile(
    name="generic",
    title="device with unknown firmware",
    answers=None,
    close_answers=(Reply.OK, Reply.REFUSED, Reply.NONE),
    bitrates={**SLOW_BITRATES, 500_000: "S6", 1_000_000: "S8"},  # S7 differs
    listen_only=None,
    sending=Sending(confirms=Confirms.ALWAYS, window=1, depth=1, keeps_buffer=True),
    paced=True,
    buffer=1,
    longest_line=26,
    warnings=(
        "its firmware is not known: nobody knows whether it sends the frames that it gets, and when",
        "closing its channel may leave it on the CAN bus, and old frames in its buffer",
    ),
)
