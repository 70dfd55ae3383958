"""Environment variables as a configuration, or laid over that of a file: `CAN_BRIDGE__SECTION__KEY`.

One rule for every key: `CAN_BRIDGE__CHANNEL__ACCEPTANCE__CODE` is `channel.acceptance.code`, and its value is
YAML as it would stand behind that key. The environment wins. (With one underscore, Kubernetes sets
CAN_BRIDGE_PORT and others by itself where a Service is called can-bridge.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode

from bridged.yaml_source import CORE, VARIABLE_PREFIX, foreign_tag, is_empty, parse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from bridged.yaml_source import Problems


def variables(environment: Mapping[str, str]) -> list[str]:
    """Their names, sections before what is in them."""
    names = (name for name in environment if name.startswith(VARIABLE_PREFIX))
    return sorted(names, key=lambda name: (len(_path(name)), name))


def overlay(root: Node | None, environment: Mapping[str, str], problems: Problems) -> Node | None:
    """The root of the document with what the environment says; its nodes' marks bear the variables' names."""
    seen: dict[tuple[str, ...], str] = {}
    if root is None and variables(environment):
        root = MappingNode(f"{CORE}map", [], *_marks("the environment"))
    for name in variables(environment):
        path = _path(name)
        if not all(path):
            problems.add(0, 0, f"names no key; expected {VARIABLE_PREFIX}SECTION__KEY", name)
        elif path in seen:
            problems.add(0, 0, f"is the same key as {seen[path]}; unset one of them", name)
        else:
            seen[path] = name
            value = parse(environment[name], problems, name)
            root = _put(root, path, value or ScalarNode(f"{CORE}null", "", *_marks(name)), name)
    return root


def _path(name: str) -> tuple[str, ...]:
    return tuple(name.removeprefix(VARIABLE_PREFIX).lower().split("__"))


def _put(node: Node | None, path: Sequence[str], value: Node, name: str) -> Node:
    """A copy of a mapping with the value in its place; what is there and is none stays, for its own error."""
    if node is None or is_empty(node):  # also `key:` in the file
        node = MappingNode(f"{CORE}map", [], *_marks(name))
    if not isinstance(node, MappingNode) or foreign_tag(node):
        return node
    key, *rest = path
    present = [(word, there) for word, there in node.value if word.value == key]
    others = [(word, there) for word, there in node.value if word.value != key]
    word: Node = ScalarNode(f"{CORE}str", key, *_marks(name))
    if rest:
        old = present[0] if present else (word, None)
        word, value = old[0], _put(old[1], rest, value, name)
    return MappingNode(node.tag, [*others, (word, value)], node.start_mark, node.end_mark)


def _marks(name: str) -> tuple[yaml.Mark, yaml.Mark]:
    mark = yaml.Mark(name, 0, 0, 0, None, 0)
    return mark, mark
