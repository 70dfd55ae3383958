"""How quickly frames go through one bridge, and how quickly its adapter answers. No clock."""

from __future__ import annotations

from collections import deque

RATE_PERIOD_S = 1.0
ANSWER_TIMES = 256


class Figures:
    """Of the last RATE_PERIOD_S, and of the last ANSWER_TIMES answers."""

    def __init__(self) -> None:
        self._answer_times_s: deque[float] = deque(maxlen=ANSWER_TIMES)
        self._samples: deque[tuple[float, int, int]] = (
            deque()
        )  # time, frames to the interface, to the adapter

    def answered(self, seconds: float) -> None:
        """The adapter took so long for an answer."""
        self._answer_times_s.append(seconds)

    def sample(self, now: float, rx_frames: int, tx_frames: int) -> None:
        """So many frames went to the interface, and to the adapter, until now."""
        self._samples.append((now, rx_frames, tx_frames))
        while len(self._samples) > 2 and now - self._samples[1][0] >= RATE_PERIOD_S:
            self._samples.popleft()

    def forget_rates(self) -> None:
        self._samples.clear()

    def answer_times_ms(self) -> dict[str, float] | None:
        times = sorted(self._answer_times_s)
        if not times:
            return None
        picked = {"min": times[0], "median": times[len(times) // 2], "max": times[-1]}
        return {name: round(1000 * seconds, 3) for name, seconds in picked.items()}

    def rates(self) -> dict[str, float]:
        """Frames a second."""
        rates = {"rx_fps": 0.0, "tx_fps": 0.0}
        if len(self._samples) > 1:
            (begin, rx, tx), (end, rx_end, tx_end) = self._samples[0], self._samples[-1]
            rates = {"rx_fps": (rx_end - rx) / (end - begin), "tx_fps": (tx_end - tx) / (end - begin)}
        return {name: round(rate, 1) for name, rate in rates.items()}
