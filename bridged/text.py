"""Text of devices, files and other programs, made fit for a terminal and for one line of a log."""

from __future__ import annotations

import contextlib
import pwd


def printable(text: str) -> str:
    r"""With each character that is not printable as Python writes it: ESC becomes `\x1b`, a line feed `\n`.

    Bytes that the locale could not decode (PEP 383) are decoded as UTF-8 where they are that, else shown as
    `\xfc`.
    """
    if text.isprintable():
        return text
    with contextlib.suppress(UnicodeEncodeError):  # a surrogate that stands for no byte: escaped below
        text = text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def quoted(text: str) -> str:
    """Quote a text of the file for a message: one line, nothing unprintable, not too long."""
    return repr(cut(text))


def cut(text: str) -> str:
    """Not more of a text than fits into a message."""
    return text if len(text) <= 40 else f"{text[:40]}…"


def user_name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return f"user {uid}"
