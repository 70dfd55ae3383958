"""LAWICEL's CAN232 and CANUSB (CAN232 manual, version 3)."""

from bridged.adapters.base import Reply, Sending
from bridged.adapters.firmware.profile import BITRATES, Profile

PROFILE = Profile(
    name="can232",
    title="CAN232",
    gentle_flush=True,  # what a longer line does beside being refused is not documented
    serial_number=True,
    close_answers=(Reply.OK, Reply.REFUSED),
    bitrates=BITRATES,
    registers=True,
    passes_all=True,
    acceptance=True,
    polls=True,
    sending=Sending(),
    buffer=8,
    stamp_digits=(4,),
    longest_line=26,
    flags=True,
    full_flag=True,
)
