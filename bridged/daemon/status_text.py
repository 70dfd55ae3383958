"""A status as a person reads it: in full, in one line, and as the last line of a bridge's log."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bridged.daemon.status import StatusError
from bridged.text import printable

if TYPE_CHECKING:
    from collections.abc import Callable


def render(status: dict[str, Any]) -> str:
    """The status for a human; the state is in the first line, for small terminals."""
    return _written(_lines, status)


def render_short(status: dict[str, Any]) -> str:
    """The status in one line."""
    return _written(_short, status)


def farewell(status: dict[str, Any]) -> str:
    """What a bridge has done, for the last line of its log."""
    return _written(_farewell, status)


def _written(write: Callable[[dict[str, Any]], list[str]], status: dict[str, Any]) -> str:
    """As one writes it, without what moves a terminal's cursor."""
    try:
        lines = write(status)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        msg = "the bridge that answers is of another version of can-bridge: restart it, or use --json"
        raise StatusError(msg) from error
    return "\n".join(printable(line) for line in lines)


def _headline(status: dict[str, Any]) -> str:
    return f"{status['name']}: {status['state']}, up {_duration(status['uptime_s'])}"


def _lines(status: dict[str, Any]) -> list[str]:
    adapter, counters, bus, rates = status["adapter"], status["counters"], status["bus"], status["rates"]
    identity = f"version {adapter['version'] or '?'}, serial number {adapter['serial_number'] or '?'}"
    if adapter["firmware"]:
        identity += f", firmware {adapter['firmware']}"
    place = adapter["port"]
    if adapter["opened"] not in {None, place}:
        place += f" ({adapter['opened']})"
    parts = {
        "adapter": f"{adapter['type']} on {place}, {identity}",
        "CAN bus": _bus_state(status),
        "interface": f"{bus['interface']} {bus['channel']}{'' if bus['open'] else ', NOT OPEN'}",
        "received": (
            f"{counters['rx_frames']} frames from the adapter, {rates['rx_fps']:.0f}/s, "
            f"{counters['rx_errors']} line errors, {counters['rx_overruns']} adapter overruns"
        ),
        "rx dropped": _reasons(counters["rx_dropped"]) or "none",
        "sent": (
            f"{_given(counters)} to the adapter, {rates['tx_fps']:.0f}/s, "
            f"{counters['tx_retries']} retries, {status['queued']} queued"
        ),
        "tx dropped": _reasons(counters["tx_dropped"]) or "none",
        "can-bridge": f"version {status['version']}",
    }
    if adapter["sent_means"]:
        parts["sent means"] = adapter["sent_means"].removeprefix("sent means ")
    if status["reason"]:
        parts = {"reason": status["reason"], **parts}
    return [_headline(status), *(f"  {name:<10}  {text}" for name, text in parts.items())]


def _short(status: dict[str, Any]) -> list[str]:
    counters = status["counters"]
    dropped = sum(counters["rx_dropped"].values()) + sum(counters["tx_dropped"].values())
    reason = f" ({status['reason']})" if status["reason"] else ""
    return [
        f"{_headline(status)}, {counters['rx_frames']} frames received, {_given(counters, '')} sent, "
        f"{dropped} dropped{reason}"
    ]


def _farewell(status: dict[str, Any]) -> list[str]:
    counters = status["counters"]
    rx, tx = _reasons(counters["rx_dropped"]), _reasons(counters["tx_dropped"])
    dropped = "; ".join([f"rx dropped: {rx}"] * bool(rx) + [f"tx dropped: {tx}"] * bool(tx))
    channel = {
        None: "no adapter was reached",
        False: "the adapter's channel is closed",
        True: "the adapter's channel may still be open",
    }
    return [
        f"stopped after {_duration(status['uptime_s'])}: {counters['rx_frames']} frames received, "
        f"{_given(counters, '')} sent; {dropped or 'none dropped'}; {channel[status['channel_open']]}"
    ]


def _given(counters: dict[str, Any], frames: str = " frames") -> str:
    """How many: `8 frames`; `8 frames, 3 queued, 2 unconfirmed` where the adapter does not vouch for all."""
    apart = {"tx_queued": "queued", "tx_unconfirmed": "unconfirmed", "tx_late": "of these perhaps late"}
    others = [f"{counters[key]} {what}" for key, what in apart.items() if counters[key]]
    return ", ".join([f"{counters['tx_frames']}{frames}", *others])


def _reasons(dropped: dict[str, int]) -> str:
    return ", ".join(f"{reason} {n}" for reason, n in dropped.items() if n)


def _bus_state(status: dict[str, Any]) -> str:
    if status["bus_state"] is None:
        return "not known"
    counters = "" if status["tec"] is None else f", TEC {status['tec']}, REC {status['rec']}"
    times = status["answer_time_ms"]
    answers = f", answers in {times['median']:.1f} ms" if times else ""
    return f"{status['bus_state']}{counters}{answers}"


def _duration(seconds: float) -> str:
    """Its two largest units: `3 d 4 h`."""
    minutes, left = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    if days:
        return f"{days} d {hours} h"
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {left} s" if minutes else f"{left} s"
