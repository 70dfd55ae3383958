"""Limits repeated log lines, so that what fails again and again is told without a flood. No clock."""

from __future__ import annotations

import re
from typing import Final

REPEAT_LOG_S: Final = 3600.0  # the same cause is logged again
LOGGED_AT_MOST: Final = 5  # the same cause within that time
CAUSES_MAX: Final = 32  # what an adapter says may be anything; causes beyond these count as one


class _Cause:
    def __init__(self, now: float, left: int) -> None:
        self.first_logged_at = now
        self.last_logged_at = now
        self.left = left  # how often it may be logged until REPEAT_LOG_S have passed
        self.not_logged = 0  # how often it came since it was logged
        self.is_news = False  # all was well since it was logged


class LogLimiter:
    """Limits repeated log lines: each cause once until all is well again, at most 5 times an hour.

    Texts that differ only in their digits are one cause. `interval_s`: so long at least between two lines of
    the same cause.
    """

    def __init__(self, interval_s: float = 0.0) -> None:
        self.failing = False  # something came since all was well
        self.quiet = False  # and nothing was logged since
        self._interval_s = interval_s
        self._causes: dict[str, _Cause] = {}

    def should_log(self, cause: str, now: float) -> int:
        """How often it came since it was logged last, this time included; 0: it is not to be logged now."""
        self.failing = True
        cause = re.sub(r"\d+", "#", cause)  # counts differ from time to time
        known = self._causes.get(cause)
        if known is None and len(self._causes) >= CAUSES_MAX:
            # Twice as long, so that one which comes back now and then is logged with its count.
            old = [text for text, c in self._causes.items() if now - c.first_logged_at >= 2 * REPEAT_LOG_S]
            for text in old:
                del self._causes[text]
            if len(self._causes) >= CAUSES_MAX:
                cause = ""
                known = self._causes.get(cause)
        if known is not None and now - known.first_logged_at < REPEAT_LOG_S:
            if not (known.is_news and known.left) or now - known.last_logged_at < self._interval_s:
                known.not_logged += 1
                return 0
            known.left -= 1
            known.is_news = False
            known.last_logged_at = now
        else:
            self._causes[cause] = _Cause(now, LOGGED_AT_MOST - 1)
        self.quiet = False
        times = 1 + (known.not_logged if known else 0)
        self._causes[cause].not_logged = 0
        return times

    def recovered(self) -> None:
        """Nothing fails any more: what comes now is news, unless it came very often."""
        self.failing = False
        self.quiet = True
        for cause in self._causes.values():
            cause.is_news = True


def repeated(times: int) -> str:
    """For a log line: what LogLimiter.should_log() returned."""
    return f" ({times} times since this was told last)" if times > 1 else ""
