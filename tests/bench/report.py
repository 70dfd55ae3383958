"""The table of a run, as text, as Markdown and as a picture (SVG)."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

from figures import Row

WIDTH, LABEL, BAR_HEIGHT, GAP = 1000, 430, 14, 5
DECADES = (-2, 1)  # of value/limit that the picture shows
COLOURS = {True: "#2a7f3f", False: "#b3261e"}


def number(value: float) -> str:
    if value and abs(value) < 0.1:
        return f"{value:.4f}"
    return f"{value:.0f}" if abs(value) >= 100 or value == int(value) else f"{value:.2f}"


def cells(row: Row) -> tuple[str, str, str, str, str, str]:
    measured = f"{number(row.value)} {row.unit}".strip()
    spread = f"{number(row.spread[0])} … {number(row.spread[1])}" if row.spread else ""
    target = "" if row.limit is None else f"{'≥' if row.least else '≤'} {number(row.limit)}"
    verdict = {None: "", True: "met", False: "not met"}[row.met]
    return row.what, measured, spread, target, verdict, row.note


HEADER = ("", "measured", "least … most", "target", "", "")


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(row.figure, []).append(row)
    return found


def text(rows: Sequence[Row]) -> str:
    lines = []
    for figure, members in groups(rows).items():
        lines += ["", figure]
        for row in members:
            what, measured, spread, target, verdict, note = cells(row)
            lines.append(f"  {what:<58} {measured:>12} {spread:>18} {target:>8} {verdict:<8} {note}".rstrip())
    return "\n".join(lines)


def markdown(rows: Sequence[Row]) -> str:
    lines = []
    for figure, members in groups(rows).items():
        header = (figure, *HEADER[1:])
        lines += ["", "| " + " | ".join(header) + " |", "|---|--:|--:|--:|---|---|"]
        lines += ["| " + " | ".join(cells(row)) + " |" for row in members]
    return "\n".join(lines).lstrip("\n") + "\n"


def _x(share: float) -> float:
    low, high = DECADES
    at = (math.log10(max(share, 10.0**low)) - low) / (high - low)
    return LABEL + min(1.0, at) * (WIDTH - LABEL - 90)


def svg(rows: Sequence[Row]) -> str:
    """Each figure that has a target, as a share of it: bars that end left of the line have met it."""
    parts, y = [], 30
    for figure, members in groups([row for row in rows if row.limit]).items():
        y += 12
        parts.append(f'<text x="8" y="{y}" class="h">{html.escape(figure)}</text>')
        y += 6
        for row in members:
            assert row.limit
            share = row.limit / row.value if row.least else row.value / row.limit
            colour = COLOURS[bool(row.met)]
            parts.append(f'<text x="18" y="{y + BAR_HEIGHT - 3}">{html.escape(row.what)}</text>')
            size = f'width="{_x(share) - LABEL:.1f}" height="{BAR_HEIGHT}"'
            parts.append(f'<rect x="{LABEL}" y="{y}" {size} fill="{colour}"/>')
            if row.spread and not row.least:
                low, high = (_x(value / row.limit) for value in row.spread)
                middle = y + BAR_HEIGHT / 2
                parts.append(f'<path d="M{low:.1f} {middle}H{high:.1f}" stroke="#000" stroke-width="1"/>')
            label = f"{number(row.value)} {row.unit}"
            parts.append(f'<text x="{max(_x(share), _x(1)) + 6:.1f}" y="{y + BAR_HEIGHT - 3}">{label}</text>')
            y += BAR_HEIGHT + GAP
    line = _x(1)
    parts.append(f'<path d="M{line:.1f} 24V{y}" stroke="#000" stroke-dasharray="4 3"/>')
    parts.append(f'<text x="{line:.1f}" y="18" text-anchor="middle">the target = 1</text>')
    style = "text{font:12px sans-serif;fill:#222}.h{font-weight:bold}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y + 10}" width="{WIDTH}">'
        f'<style>{style}</style><rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}</svg>\n'
    )
