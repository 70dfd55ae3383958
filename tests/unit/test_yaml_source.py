"""bridged.yaml_source: files that cannot be read or are not YAML, and where in them that shows."""
# ruff: noqa: E501 - in the table, a message is one line as the user sees it

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from bridged.errors import ConfigError
from bridged.yaml_source import Problems, parse, read_text


def problems_of(file: Path, content: str | bytes | None = None) -> list[str]:
    """The problems of a file, without its name."""
    if content is not None:
        file.write_bytes(content.encode() if isinstance(content, str) else content)
    problems = Problems(str(file))
    with pytest.raises(ConfigError) as caught:
        parse(read_text(file, problems), problems)
    assert all(problem.startswith(f"{file}:") for problem in caught.value.problems)
    return [problem.removeprefix(f"{file}:") for problem in caught.value.problems]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "test.yaml"


CASES: dict[str, tuple[str | bytes, list[str]]] = {
    "tab": ("adapter:\n\ttype: can232\n", ["2:1: not valid YAML: indent with spaces, not with tabs (found character '\\t' that cannot start any token)"]),
    "indentation": ("adapter:\n  type: can232\n port: x\n", [
        "3:2: not valid YAML: the indentation does not fit the lines above (expected <block end>, but found '<block mapping start>')",
    ]),
    "colons": ("adapter: type: can232\n", ["1:14: not valid YAML: there is a ':' too many, or the indentation is wrong (mapping values are not allowed here)"]),
    "no colon": ("adapter: {}\nchannel\nbus: {}\n", ["3:1: not valid YAML: a key lacks its ':' and a space (could not find expected ':')"]),
    "two documents": ("a: b\n---\nc: d\n", ["2:1: not valid YAML: a file holds one configuration, so no second '---' (but found another document)"]),
    "alias": ("a: *b\n", ["1:4: not valid YAML: a value that begins with '*' is written in quotes (found undefined alias 'b')"]),
    "unclosed": ("adapter: {type: can232\n", ["2:1: not valid YAML: expected ',' or '}', but got '<stream end>'"]),
    "escape": ('a: "\\UFFFFFFFF"\n', ["1:7: not valid YAML: a number is out of range"]),
    "control character": ("a: 1\nb: \x07\n", ["2:4: not valid YAML: character U+0007 is not allowed"]),
    "latin-1": (b"a: 1\nb: gr\xf6\xdfe\n", ["2:6: byte 0xF6 is not UTF-8; save the file as UTF-8"]),
    "utf-16": ("a: b".encode("utf-16"), ["1:1: byte 0xFF is not UTF-8; save the file as UTF-8"]),
}  # fmt: skip


@pytest.mark.parametrize(("content", "expected"), CASES.values(), ids=CASES.keys())
def test_problems(file: Path, content: str | bytes, expected: list[str]) -> None:
    assert problems_of(file, content) == expected


def test_nested_too_deeply(file: Path) -> None:
    [problem] = problems_of(file, "a: " + "[" * 60_000)
    assert re.fullmatch(r"1:\d+: not valid YAML: nested too deeply", problem)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    missing, large = tmp_path / "missing.yaml", tmp_path / "large.yaml"
    large.write_bytes(b"#" * 65_537)
    for path, text in [
        (missing, "cannot be read: No such file or directory"),
        (tmp_path, "cannot be read: Is a directory"),
        (large, "is larger than 65536 bytes: not a configuration"),
        (Path("/dev/zero"), "is larger than 65536 bytes: not a configuration"),
    ]:
        assert problems_of(path) == [f" {text}"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_without_permission(file: Path) -> None:
    file.touch(mode=0)
    (problem,) = problems_of(file)
    assert problem.startswith(" cannot be read: Permission denied")
