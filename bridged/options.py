"""Options of the command line as a configuration: `--bitrate 125000`, `--channel.bitrate 125000`.

One rule for every key: `--SECTION.KEY VALUE` or `--SECTION.KEY=VALUE`, the value being YAML as it would stand
behind that key; `--KEY` where only one section has a key of this name and no section is called so. A hyphen
stands for an underscore. A key that is true or false needs no value to be true: `--create`, `--create=false`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bridged.errors import ConfigError
from bridged.overlay import Setting

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    Path = tuple[str, ...]


def names(keys: Mapping[Path, bool]) -> dict[str, Path]:
    """What each key may be called, without `--`; `keys`: all, and whether each is one of true and false."""
    found = {".".join(path): path for path in keys}
    last = [path[-1] for path in keys if len(path) == 2]
    short = {path[-1]: path for path in keys if len(path) == 2 and last.count(path[-1]) == 1}
    return {**short, **found}


def take(arguments: Sequence[str], keys: Mapping[Path, bool]) -> tuple[list[Setting], list[str]]:
    """The settings among the arguments, and the other arguments. ConfigError: a value is missing.

    With a dot in it, an option is a key, there or not: what is wrong with it is told with all other problems.
    """
    known = names(keys)
    settings: list[Setting] = []
    others: list[str] = []
    left = list(arguments)
    while left:
        argument = left.pop(0)
        option, equals, value = argument.partition("=")
        name = option.removeprefix("--").replace("-", "_")
        if argument == "--":
            others += ["--", *left]
            break
        if not option.startswith("--") or not (name in known or "." in name):
            others.append(argument)
            continue
        path = known.get(name, tuple(name.split(".")))
        if not equals and keys.get(path):
            value = "true"
        elif not equals:
            if not left or left[0].startswith("--"):
                raise ConfigError([f"{option}: expected a value behind it"])
            value = left.pop(0)
        settings.append(Setting(option, path, value))
    return settings, others
