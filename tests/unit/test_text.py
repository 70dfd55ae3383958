"""Text from elsewhere on a terminal."""

import pytest

from bridged.text import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("serial A123, brücke", "serial A123, brücke"),
        ("\x1b]0;x\x07\n\x00\x7f", r"\x1b]0;x\x07\n\x00\x7f"),
        ("\u202eevil\u2028", r"\u202eevil\u2028"),  # writes backwards; ends a line
        ("br\udcc3\udcbccke", "brücke"),  # a name in UTF-8 in a locale that has none
        ("br\udcfccke\n", r"br\xfccke\n"),  # and one in Latin-1
        ("\ud800", r"\ud800"),
    ],
)
def test_printable(text: str, shown: str) -> None:
    assert printable(text) == shown
