"""canable-fw of normaldotcom, with which CANable 1.0 (STM32F0) adapters are sold."""

from bridged.adapters.base import Confirms, Reply, Sending
from bridged.adapters.firmware.profile import OPEN, RETRANSMIT, SLOW_BITRATES, Profile

PROFILE = Profile(
    name="canable1",
    title="CANable with canable-fw",
    answers=False,
    close_answers=(Reply.NONE,),
    # S7 promises 800 kbit/s.
    bitrates={**SLOW_BITRATES, 500_000: "S6", 750_000: "S7", 1_000_000: "S8"},
    # A lone CR repeats the last command, M1 (silent) is undone by O. A without a digit takes a stale one.
    open=(RETRANSMIT, OPEN),
    listen_only=None,
    sending=Sending(confirms=Confirms.NOTHING, depth=4, keeps_buffer=True),
    paced=True,
    buffer=27,
    remote_digits=True,
    longest_line=30,
    warnings=(
        "closing its channel leaves up to 27 frames in its queue, which it sends when it is opened again, "
        "however old they are: unplug it to get rid of them",
        "it loses received frames while USB is busy",
    ),
)
