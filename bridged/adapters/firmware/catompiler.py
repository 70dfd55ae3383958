"""catompiler's slcan slave library. What is malformed it does not answer."""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Profile

PROFILE = Profile(
    name="catompiler",
    title="device with catompiler's slcan library",
    # N is N1234 unless its maker has changed that. U when closed is taken at once, X changes its answers.
    close_answers=(Reply.OK, Reply.REFUSED),
    bitrates=BITRATES,
    registers=True,
    sending=Sending(confirms=Confirms.QUEUED, window=1, keeps_buffer=True),
    buffer=32,
    stamp_digits=(4,),
    longest_line=32,
    flags=True,
    warnings=(
        "closing its channel leaves up to 32 frames in its queue, which it sends when it is opened again",
        "if it was in listen-only mode since power-on it stays silent, whatever it is told: unplug it",
    ),
    listen_only_warning="it stays in listen-only mode until it is unplugged",
)
