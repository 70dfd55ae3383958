"""From samples to figures: the table's rows, each a function of what was measured in one run.

A ratio is the median of those of each round, in which both were measured one after the other; the spread is
the least and the most of them. FIGURES has them all in the order of the table: a new one is a function more.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Callable, Iterator, Sequence
from typing import Any

Sample = dict[str, Any]
Metric = Callable[[Sample], float]

RATES = (100, 1000, 4000, 8000)
LATENCIES = {"p50": "p50", "p99": "p99", "p999": "p99.9"}


@dataclasses.dataclass
class Row:
    """One line of the table. `limit`: the most there may be, with `least` the least; None: to compare."""

    figure: str
    what: str
    value: float
    unit: str = "x"
    limit: float | None = None
    spread: tuple[float, float] | None = None
    note: str = ""
    least: bool = False

    @property
    def met(self) -> bool | None:
        if self.limit is None:
            return None
        return self.value >= self.limit if self.least else self.value <= self.limit


def cpu_us(sample: Sample) -> float:
    """Of the subject's own threads, for each frame."""
    return float(sample["cpu_ns"]) / 1e3 / max(1, int(sample["frames"]))


def machine_us(sample: Sample) -> float:
    """Of the whole machine but the load, for each frame: what the kernel does by itself is nobody's."""
    return float(sample["busy_ns"] - sample["own_cpu_ns"]) / 1e3 / max(1, int(sample["frames"]))


def chosen(samples: Sequence[Sample], figure: str, subject: str, **where: Any) -> list[Sample]:
    wanted = {"figure": figure, "subject": subject, **where}
    return [s for s in samples if all(s.get(key) == value for key, value in wanted.items())]


def ratio(
    figure: str, what: str, ours: Sequence[Sample], theirs: Sequence[Sample], metric: Metric,
    limit: float | None = None, note: str = "",
) -> Iterator[Row]:  # fmt: skip
    """Round by round; where they had fewer rounds, against their median. None without samples of both."""
    if not ours or not theirs:
        return
    if len(ours) == len(theirs):
        by_round = dict.fromkeys(s["repetition"] for s in ours)
        pairs = [
            (
                metric(next(s for s in ours if s["repetition"] == n)),
                metric(next(s for s in theirs if s["repetition"] == n)),
            )
            for n in by_round
        ]
    else:
        usual = statistics.median(map(metric, theirs))
        pairs = [(metric(s), usual) for s in ours]
    ratios = [a / b for a, b in pairs if b]  # a subject that did not run at all in its time
    if not ratios:
        return
    absolute = (
        f"{statistics.median(map(metric, ours)):.3g} against {statistics.median(map(metric, theirs)):.3g}"
    )
    note = "; ".join(filter(None, (absolute, note)))
    yield Row(figure, what, statistics.median(ratios), "x", limit, (min(ratios), max(ratios)), note)


WIDE_NOTE = "window 32, the nearest to a peer that waits for no answer"


def saturation(samples: Sequence[Sample]) -> Iterator[Row]:
    name = "CPU per frame, as fast as it goes"

    def of(subject: str, direction: str, figure: str = "saturation") -> list[Sample]:
        return chosen(samples, figure, subject, direction=direction)

    ways = (
        ("to-bus", "device → bus", "", "µs"),
        ("to-device", "bus → device, window 1", "", "µs"),
        ("to-device", "bus → device, window 32", "-wide", "µs"),
    )
    for direction, words, kind, unit in ways:
        yield from ratio(name, f"{words}: floor, native", of(f"can-bridge{kind}", direction, "floor"),
                    of(f"floor{kind}", direction, "floor"), cpu_us, 1.2, unit)  # fmt: skip
        yield from ratio(name, f"{words}: floor, counted instructions", of(f"can-bridge{kind}", direction),
                    of(f"floor{kind}", direction), cpu_us, 1.2, unit)  # fmt: skip
        for peer, limit in (("slcanpty", 0.4), ("python-can", 1 / 40)):
            yield from ratio(
                name,
                f"{words}: {peer}",
                of(f"can-bridge{kind}", direction),
                of(peer, direction),
                cpu_us,
                limit,
                unit,
            )
        yield from ratio(name, f"{words}: kernel slcan + cangw", of(f"can-bridge{kind}", direction),
                    of("kernel-slcan", direction), machine_us, None, "µs of the whole machine")  # fmt: skip


def full_bus(samples: Sequence[Sample]) -> Iterator[Row]:
    name = "CPU at 8,000 frames/s, device → bus"
    ours = chosen(samples, "full-bus", "can-bridge")

    def share(sample: Sample) -> float:
        return float(sample["cpu_ns"]) / 1e7 / float(sample["wall_s"])

    yield from ratio(
        name, "slcanpty", ours, chosen(samples, "full-bus", "slcanpty"), share, 0.5, "% of a core"
    )
    usb2can = chosen(samples, "full-bus", "can-bridge-usb2can")
    yield from ratio(name, "USB2CAN by a tty: CAN232", usb2can, ours, share, 1.0, "% of a core")
    kernel = chosen(samples, "full-bus", "kernel-slcan")
    yield from ratio(
        name, "kernel slcan + cangw", ours, kernel, machine_us, None, "µs a frame of the whole machine"
    )


def latency(samples: Sequence[Sample]) -> Iterator[Row]:
    ways = (("to-bus", "device → bus", "can-bridge"), ("to-device", "bus → device", "can-bridge-wide"))
    for direction, words, subject in ways:
        for rate in RATES:
            found = [
                chosen(samples, "latency", s, direction=direction, rate=rate) for s in (subject, "slcanpty")
            ]
            if not all(found):
                continue
            ours, theirs = found[0][0], found[1][0]
            for key, percentile in LATENCIES.items():
                own = ours["latency_us"][key]
                their = theirs["latency_us"]["p99" if key == "p999" else key]
                beside = f"{own:.0f} µs against {theirs['latency_us'][key]:.0f}"
                limit = 2.0 if key == "p999" else 1.0
                against = "slcanpty's p99" if key == "p999" else "slcanpty"
                what = f"{words}, {rate}/s, {percentile}: {against}"
                yield Row("Latency one way", what, own / their, "x", limit, note=beside)


def loss(samples: Sequence[Sample]) -> Iterator[Row]:
    name = "Loss at twice the line's rate, 115200 Bd"
    for sample in (s for s in samples if s["figure"] == "loss"):
        ours = sample["subject"] == "can-bridge"
        beside = (
            f"{sample['sent']} sent, {sample['taken']} taken by the adapter, {sample['told']} told as dropped"
        )
        what = f"{sample['subject']}: frames unaccounted"
        yield Row(name, what, sample["unaccounted"], "", 0 if ours else None, note=beside)
        lost = sample["adapter_characters_lost"] + sample["adapter_refused"]
        yield Row(name, f"{sample['subject']}: lost in the adapter", lost, "", 0 if ours else None,
                  note="characters without a buffer, commands refused")  # fmt: skip


# Of all threads for each question: a timer, the relay sends, it reads, Python looks at the answer. A
# USB2CAN is asked five questions at once.
POLL_WAKEUPS = {"can-bridge": 4.0, "can-bridge-usb2can": 4.0 / 5}


def idle(samples: Sequence[Sample]) -> Iterator[Row]:
    name = "Idle, in the virtual machine"
    for sample in (s for s in samples if s["figure"] == "idle"):
        seconds = sample["wall_s"]
        ours = sample["subject"].startswith("can-bridge")
        extra = (sample["switches"] - POLL_WAKEUPS.get(sample["subject"], 0.0) * sample["commands"]) / seconds
        questions, switches = (sample[key] / seconds for key in ("commands", "switches"))
        note = f"{questions:.1f} questions and {switches:.1f} switches a second"
        # A question at either end of the time is counted in part.
        yield Row(name, f"{sample['subject']}: wake-ups beyond health polls", max(0.0, round(extra, 1)), "/s",
                  0 if ours else None, note=note)  # fmt: skip
        yield Row(
            name, f"{sample['subject']}: CPU", sample["cpu_ns"] / seconds / 1e7, "%", 0.1 if ours else None
        )


def growth(samples: Sequence[Sample]) -> Iterator[Row]:
    name = "Growth, 8,000 frames/s over all bridges"
    everyone = [s for s in samples if s["figure"] == "growth"]
    if not everyone:
        return
    idle_ns = {
        size: statistics.median(
            s["cpu_ns"] / s["wall_s"] for s in everyone if s["size"] == size and not s["rate"]
        )
        for size in {s["size"] for s in everyone}
    }

    def of(size: int) -> list[Sample]:
        return [s for s in everyone if s["size"] == size and s["rate"]]

    def beyond_polls(sample: Sample) -> float:
        return (
            float(sample["cpu_ns"] - idle_ns[sample["size"]] * sample["wall_s"]) / 1e3 / int(sample["frames"])
        )

    for size in sorted(idle_ns)[1:]:
        late = max(s["bunched"] / s["sent"] for s in of(size))  # they came with the next bridge's
        note = f"µs a frame; {late:.0%} of the frames offered late"
        what = f"{size} bridges: 1"
        yield from ratio(name, f"{what}, without health polls", of(size), of(1), beyond_polls, 1.1, note)
        yield from ratio(name, f"{what}, all", of(size), of(1), cpu_us, 1.1, note)


def codec(samples: Sequence[Sample]) -> Iterator[Row]:
    for sample in (s for s in samples if s["figure"] == "codec"):
        if sample["message"] == "standard, 8 bytes":
            what = f"{sample['codec']} {sample['way']}, standard, 8 bytes"
            yield Row("Codec alone", what, sample["millions"], "M/s", 20, least=True, note=sample["compiler"])


def line(samples: Sequence[Sample]) -> Iterator[Row]:
    """What line_use.py says."""
    lines = [s for s in samples if s["figure"] == "line"]
    for window, limit in dict.fromkeys((s["window"], s["limit"]) for s in lines):
        used = [s["percent"] for s in lines if s["window"] == window]
        yield Row("Use of the serial line, bus → device, 115200 Bd", f"window {window}, of {limit} frames/s",
                  statistics.median(used), "%", spread=(min(used), max(used)))  # fmt: skip


def process(samples: Sequence[Sample]) -> Iterator[Row]:
    """What start.py says."""
    for sample in (s for s in samples if s["figure"] == "process"):
        spread = sample.get("spread")
        yield Row("Process", sample["name"], sample["value"], sample["unit"], sample.get("target"),
                  (spread[0], spread[1]) if spread else None)  # fmt: skip


FIGURES: Sequence[Callable[[Sequence[Sample]], Iterator[Row]]] = (
    saturation, full_bus, latency, loss, line, codec, idle, process, growth,
)  # fmt: skip
