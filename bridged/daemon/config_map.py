"""A configuration that Kubernetes mounts from a ConfigMap or a Secret: whether it has another content now.

The kubelet writes all files anew in a directory `..2026_11_25_02_30_00.123/`, then has the link `..data` lead
there, in one step. So another real path is another file, and a whole one. A file that is edited in place is
not looked at: what an editor has written by then may be a configuration too, with half of a bit rate.
"""

from __future__ import annotations

import os
from pathlib import Path

LOOK_INTERVAL_S = 5.0  # the kubelet itself takes a minute


class MountedConfig:
    """`path`: of the configuration, before it is read. The owner calls look() when `next_at` has come."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._real = os.path.realpath(path)
        is_mounted = any(part.startswith("..") for part in Path(self._real).parts)
        self.next_at: float | None = 0.0 if is_mounted else None

    def look(self, now: float) -> bool:
        """Whether there is another file since the last look; seconds of any clock."""
        if self.next_at is None or now < self.next_at:
            return False
        self.next_at = now + LOOK_INTERVAL_S
        before, self._real = self._real, os.path.realpath(self._path)
        return self._real != before
