"""What a log record carries and looks like, for the journal and for a terminal."""

import json
import logging
import os
import sys
from pathlib import Path

import pytest

from bridged.daemon import journal


class TestLog:
    def record(self, level: int = logging.WARNING, text: str = "one\ntwo") -> logging.LogRecord:
        return logging.LogRecord("bridged.x", level, __file__, 1, text, (), None)

    def test_fields(self) -> None:
        fields = journal.Fields("can232")
        fields.state = lambda: "running"
        record = self.record()
        assert fields.filter(record)
        assert json.dumps([record.__dict__["BRIDGE"], record.__dict__["STATE"]]) == '["can232", "running"]'

    def test_each_line_of_a_traceback_has_its_priority(self) -> None:
        made = journal.PrefixFormatter("can232: %(message)s")
        record = self.record()
        record.exc_text = "Traceback\nValueError"
        assert made.format(record).splitlines() == ["<4>can232: one\\ntwo", "<4>Traceback", "<4>ValueError"]
        assert made.format(self.record(logging.INFO, "x")) == "<6>can232: x"

    def test_a_device_writes_no_line_of_its_own(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setattr(logging, "root", logging.RootLogger(logging.WARNING))
        monkeypatch.setattr(journal.StderrHandler, "emit", logging.StreamHandler.emit)
        journal.start_logging("50%s\udcff", verbose=False)
        logging.root.info("serial_number=%s", "A\x1b[2J\n12:00:00 INFO    all is well")
        (line,) = capsys.readouterr().err.splitlines()
        assert line.endswith(r"INFO    50%s\xff: serial_number=A\x1b[2J\n12:00:00 INFO    all is well")

    def test_stderr_is_the_journal_only_if_it_is_the_same_stream(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        with (tmp_path / "stream").open("w") as stream:
            monkeypatch.setattr(sys, "stderr", stream)
            monkeypatch.delenv("JOURNAL_STREAM", raising=False)
            assert not journal._stderr_is_journal()
            identity = os.fstat(stream.fileno())
            monkeypatch.setenv("JOURNAL_STREAM", f"{identity.st_dev}:{identity.st_ino}")
            assert journal._stderr_is_journal()
            monkeypatch.setenv("JOURNAL_STREAM", f"{identity.st_dev}:{identity.st_ino + 1}")
            assert not journal._stderr_is_journal()
        assert not journal._stderr_is_journal()
