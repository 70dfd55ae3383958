"""The README's table of firmware profiles. `./dev python tests/firmware_table.py` writes it anew."""

from pathlib import Path

from bridged.adapters import firmware
from bridged.adapters.base import Confirms, Remote
from bridged.adapters.firmware.profile import BITRATES, Profile

README = Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- firmware profiles -->\n", "<!-- end of firmware profiles -->\n"
HEAD = (
    "`firmware`",
    "device",
    "`sent` means",
    "its buffer",
    "bit rates",
    "listen-only",
    "remote frames",
    "bus state",
)
SENT = {
    Confirms.TAKEN: "taken",
    Confirms.SENT: "on the bus",
    Confirms.QUEUED: "in its buffer",
    Confirms.ALWAYS: "nothing",
    Confirms.NOTHING: "written to USB",
}
REMOTE = {
    Remote.PLAIN: "yes",
    Remote.WITH_DIGITS: "yes",
    Remote.NO_STANDARD: "extended only",
    Remote.NONE: "no",
}


def bitrates(profile: Profile) -> str:
    """Where they differ from those of the manual."""
    missing = [str(rate) for rate in BITRATES if rate not in profile.bitrates]
    others = [str(rate) for rate in sorted(profile.bitrates) if rate not in BITRATES and rate <= 1_000_000]
    text = f"all but {', '.join(missing)}" if missing else "all"
    return text + (f"; {', '.join(others)}" if others else "") + ("; any" if profile.registers else "")


def buffer(profile: Profile) -> str:
    kept = "kept when closed" if profile.sending.keeps_buffer else "emptied when closed"
    order = "" if profile.in_order else ", order not certain"
    return f"{profile.buffer}, {kept}{order}"


def bus_state(profile: Profile) -> str:
    if not profile.flags:
        return "not told"
    return "flags, bus-off" if profile.bus_off_flag else "flags"


def row(profile: Profile) -> tuple[str, ...]:
    silent = "no" if profile.listen_only is None else f"`{' '.join(c.text for c in profile.listen_only)}`"
    return (
        f"`{profile.name}`",
        profile.title,
        SENT[profile.sending.confirms],
        buffer(profile),
        bitrates(profile),
        silent,
        REMOTE[profile.sending.remote],
        bus_state(profile),
    )


def table() -> str:
    rows = [HEAD, ("---",) * len(HEAD), *(row(firmware.load(name)) for name in firmware.NAMES)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def with_table(text: str) -> str:
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}{table()}{END}{after}"


if __name__ == "__main__":
    README.write_text(with_table(README.read_text()))
