"""Settings that are given one by one, as YAML texts, laid over the document of a file or in place of one."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode

from bridged.yaml_source import CORE, foreign_tag, is_empty, parse

if TYPE_CHECKING:
    from collections.abc import Iterable

    from bridged.yaml_source import Problems


class Setting(NamedTuple):
    """One key with its value. `name`: as the user knows it, for messages."""

    name: str  # CAN_BRIDGE__CHANNEL__BITRATE, --bitrate
    path: tuple[str, ...]  # ("channel", "bitrate")
    text: str  # YAML, as it would stand behind that key


def overlay(root: Node | None, settings: Iterable[Setting], problems: Problems, origin: str) -> Node | None:
    """The root of the document with the settings; the marks of their nodes bear their names.

    `origin`: what all of them are, for problems that none of them has. Two for one key are a problem.
    """
    seen: dict[tuple[str, ...], str] = {}
    for setting in sorted(settings, key=lambda setting: (len(setting.path), setting.name)):
        name, path = setting.name, setting.path
        if root is None:
            root = MappingNode(f"{CORE}map", [], *_marks(origin))
        if path in seen:
            problems.add(0, 0, f"is the same key as {seen[path]}; remove one of them", name)
            continue
        seen[path] = name
        value = parse(setting.text, problems, name)
        root = _put(root, setting, value or ScalarNode(f"{CORE}null", "", *_marks(name)), problems)
    return root


def _put(node: Node | None, setting: Setting, value: Node, problems: Problems, depth: int = 0) -> Node:
    """A copy of a mapping with the value in its place; what is there and is none stays, for its own error."""
    name, path = setting.name, setting.path
    if node is None or is_empty(node):  # also `key:` in the file
        node = MappingNode(f"{CORE}map", [], *_marks(name))
    if not isinstance(node, MappingNode):
        if depth:  # at 0 the file is no mapping, and said to be none
            section = ".".join(path[:depth])
            problems.add(0, 0, f"cannot be set: {section} has a value that is no section", name)
        return node
    if foreign_tag(node):
        return node
    key = path[depth]
    present = [(word, there) for word, there in node.value if word.value == key]
    others = [(word, there) for word, there in node.value if word.value != key]
    word: Node = ScalarNode(f"{CORE}str", key, *_marks(name))
    if depth + 1 < len(path):
        old = present[0] if present else (word, None)
        word, value = old[0], _put(old[1], setting, value, problems, depth + 1)
    return MappingNode(node.tag, [*others, (word, value)], node.start_mark, node.end_mark)


def _marks(name: str) -> tuple[yaml.Mark, yaml.Mark]:
    mark = yaml.Mark(name, 0, 0, 0, None, 0)
    return mark, mark
