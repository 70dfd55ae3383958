"""What is known of EEPROM settings that an adapter cannot be asked for, kept across starts.

EEPROM cells wear out, so a setting is written once and remembered by serial number.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path

from bridged.status import runtime_directory

log = logging.getLogger(__name__)


def state_directory() -> Path:
    """systemd's StateDirectory, else /var/lib for root, else XDG_STATE_HOME (basedir specification)."""
    if given := os.environ.get("STATE_DIRECTORY"):
        return Path(given.split(":", maxsplit=1)[0])
    if os.geteuid() == 0:
        return Path("/var/lib/can-bridge")
    if home := os.environ.get("XDG_STATE_HOME"):
        return Path(home) / "can-bridge"
    try:
        return Path("~/.local/state/can-bridge").expanduser()
    except RuntimeError:  # a user without a home
        return runtime_directory()


class FileMemory:
    """One JSON file for each adapter. A file that cannot be read or written costs EEPROM writes, no more."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def _path(self, serial_number: str) -> Path:
        safe = "".join(c if c.isalnum() else "_" for c in serial_number)
        return self._directory / f"{safe}.json"

    def _load(self, serial_number: str) -> dict[str, int]:
        import json  # noqa: PLC0415 - 2 ms, when the bridge is up already

        try:
            values = json.loads(self._path(serial_number).read_text())
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            log.warning("cannot read what is known of adapter %s: %s", serial_number, error)
            return {}
        return values if isinstance(values, dict) else {}

    def recall(self, serial_number: str, setting: str) -> int | None:
        return self._load(serial_number).get(setting)

    def remember(self, serial_number: str, setting: str, value: int) -> None:
        import json  # noqa: PLC0415

        path = self._path(serial_number)
        values = self._load(serial_number) | {setting: value}
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            fresh = path.with_suffix(".new")
            fresh.write_text(json.dumps(values))
            fresh.replace(path)
        except OSError as error:
            log.warning(
                "cannot remember %s=%d, it will be written again at each start: %s", setting, value, error
            )
