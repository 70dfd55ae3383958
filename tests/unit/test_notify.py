"""What systemd is told, and how often it wants to hear from the watchdog's feeder."""

import os
import sys

import pytest

from bridged.daemon import notify
from bridged.daemon.notify import Notifier
from bridged.errors import ConfigError


class TestNotifier:
    def test_nobody_asked(self) -> None:
        made = notify.systemd_notifier({})
        made.ready()
        assert made.feed_interval_s is None

    def test_a_status_is_one_line_and_told_once(self) -> None:
        heard: list[str] = []
        made = Notifier(heard.append)
        for text in ("a\nREADY=1", "a\nREADY=1", "c\udcff"):
            made.status(text)
        assert heard == ["STATUS=a\\nREADY=1", "STATUS=c\\xff"]

    def test_a_systemd_that_does_not_listen_is_no_reason_to_end(
        self, caplog: pytest.LogCaptureFixture
    ) -> None:
        def refuse(_text: str) -> None:
            raise ConnectionRefusedError

        Notifier(refuse).ready()
        assert "cannot notify systemd" in caplog.text

    def test_a_missing_package_is_an_error(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "systemd", None)
        with pytest.raises(ConfigError, match="python3-systemd"):
            notify.systemd_notifier({"NOTIFY_SOCKET": "/run/systemd/notify"})


@pytest.mark.parametrize(
    ("environment", "interval_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "10000000"}, 5.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, 5.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "often"}, None),
    ],
)
def test_interval(environment: dict[str, str], interval_s: float | None) -> None:
    assert notify.feed_interval_s(environment) == interval_s
