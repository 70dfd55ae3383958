"""mintynet's esp32-slcan (TWAI). Its answer to a frame means nothing."""

from bridged.adapters.base import Confirms, Remote, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Profile

PROFILE = Profile(
    name="esp32",
    title="ESP32 with esp32-slcan",
    # N is N2233 in all of them.
    close_answers=(Reply.OK, Reply.NONE),
    bitrates=BITRATES,  # S0 and S1 are refused but by an ESP32-S3
    listen_only=None,
    # r goes out as R: an extended remote frame.
    sending=Sending(confirms=Confirms.ALWAYS, remote=Remote.NO_STANDARD, window=1, depth=1),
    paced=True,
    buffer=5,
    remote_digits=True,
    stamp_digits=(4,),
    longest_line=32,
    warnings=(
        "it answers each frame as sent, also those that it loses",
        "standard remote frames are dropped: it would send them as extended ones",
    ),
)
