"""slcanpty of can-utils, which plays an adapter on a pseudo terminal. It ends at a line of 200 characters."""

from bridged.adapters.base import Confirms, Remote, Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Profile

PROFILE = Profile(
    name="slcanpty",
    title="slcanpty",
    gentle_flush=True,
    # N is N4242 in all of them.
    close_answers=(Reply.OK, Reply.REFUSED),
    bitrates=BITRATES,
    listen_only=None,
    # The DLC of a remote frame would be read as the next command.
    sending=Sending(confirms=Confirms.QUEUED, remote=Remote.NONE),
    buffer=8,
    longest_line=1000,
    warnings=("remote frames are dropped: it would read a part of them as the next command",),
)
