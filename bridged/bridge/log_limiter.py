"""Limits repeated log lines, so that what fails again and again is told without a flood. No clock."""

from __future__ import annotations

import re
from typing import Final

REPEAT_LOG_S: Final = 3600.0  # the same cause is told again
TOLD_AT_MOST: Final = 5  # the same cause within that time
CAUSES_MAX: Final = 32  # what an adapter says may be anything; causes beyond these are told as one


class _Cause:
    def __init__(self, told_at: float, left: int) -> None:
        self.told_at = told_at  # for the first time
        self.told_last_at = told_at
        self.left = left  # how often it may be told until REPEAT_LOG_S have passed
        self.untold = 0  # how often it came without being told
        self.again = False  # all was well since: it is news


class LogLimiter:
    """Limits repeated log lines: each cause once until all is well again, at most 5 times an hour.

    Texts that differ only in their digits are one cause. `interval_s`: so long at least between two lines of
    the same cause.
    """

    def __init__(self, interval_s: float = 0.0) -> None:
        self.failing = False  # something came since all was well
        self.quiet = False  # and nothing was told since
        self._interval_s = interval_s
        self._causes: dict[str, _Cause] = {}

    def tell(self, cause: str, now: float) -> int | None:
        """How often it came since it was told, this time included; None: not to be told this time."""
        self.failing = True
        cause = re.sub(r"\d+", "#", cause)  # counts differ from time to time
        known = self._causes.get(cause)
        if known is None and len(self._causes) >= CAUSES_MAX:
            # Twice as long, so that one which comes back now and then is told with its count.
            for text in [text for text, c in self._causes.items() if now - c.told_at >= 2 * REPEAT_LOG_S]:
                del self._causes[text]
            if len(self._causes) >= CAUSES_MAX:
                cause = ""
                known = self._causes.get(cause)
        if known is not None and now - known.told_at < REPEAT_LOG_S:
            if not (known.again and known.left) or now - known.told_last_at < self._interval_s:
                known.untold += 1
                return None
            known.left -= 1
            known.again = False
            known.told_last_at = now
        else:
            self._causes[cause] = _Cause(now, TOLD_AT_MOST - 1)
        self.quiet = False
        times = 1 + (known.untold if known else 0)
        self._causes[cause].untold = 0
        return times

    def well(self) -> None:
        """Nothing fails any more: what comes now is news, unless it came very often."""
        self.failing = False
        self.quiet = True
        for cause in self._causes.values():
            cause.again = True


def repeated(times: int) -> str:
    """For a log line: what LogLimiter.tell() returned."""
    return f" ({times} times since this was told last)" if times > 1 else ""
