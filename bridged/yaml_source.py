"""YAML read key by key into typed values; whatever is wrong is known by line and column.

The surprises of YAML 1.1 (octal numbers, base 60, `1e6` as a text) end here.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from yaml.reader import ReaderError

from bridged.errors import ConfigError
from bridged.text import cut, quoted

if TYPE_CHECKING:
    from pathlib import Path

    from msgspec import Struct
    from msgspec.structs import FieldInfo

Schemas = Callable[[], Mapping[str, "type[Struct]"]]

MAX_BYTES = 65_536
"""Far above any configuration; keeps a wrong path (/dev/zero, a log file) from being read to its end."""

VARIABLE_PREFIX = "CAN_BRIDGE__"
"""Of environment variables that stand for keys: see environment.py."""

COMMAND_LINE = "the command line"
"""Where options stand for keys (see options.py): what bears this name, or one that begins with --."""

CORE = "tag:yaml.org,2002:"
_KNOWN_TAGS = frozenset(
    CORE + name
    for name in ("str", "int", "float", "bool", "null", "timestamp", "value", "merge", "seq", "map")
)
_BOOLEANS = {"yes": True, "no": False, "true": True, "false": False, "on": True, "off": False}

_INTEGER = re.compile(r"[-+]?(?:0|[1-9][0-9_]*|0x[0-9a-fA-F_]+|0b[01_]+)", re.ASCII)
"""No leading zeros (octal in YAML 1.1, decimal in 1.2) and no 12:30 (base 60 in 1.1): they stay text."""

_EXPLANATIONS = (
    ("found character '\\t'", "indent with spaces, not with tabs"),
    ("expected <block end>", "the indentation does not fit the lines above"),
    ("mapping values are not allowed", "there is a ':' too many, or the indentation is wrong"),
    ("could not find expected ':'", "a key lacks its ':' and a space"),
    ("but found another document", "a file holds one configuration, so no second '---'"),
    ("found undefined alias", "a value that begins with '*' is written in quotes"),
)


class Problems:
    """What is wrong with a file and with environment variables, each with its place."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._found: list[tuple[str, int, int, str]] = []
        self._doubts: list[tuple[str, int, int, str]] = []

    def warn_at(self, node: Node, text: str) -> None:
        """Add what is allowed, but probably not meant."""
        mark = node.start_mark
        self._doubts.append((mark.name, mark.line, mark.column, text))

    def add(self, line: int, column: int, text: str, variable: str = "") -> None:
        """Add a problem of the file or of a variable; line and column from 0, as YAML marks count them."""
        self._found.append((variable, line, column, text))

    def add_at(self, node: Node, text: str) -> None:
        """Add a problem at the beginning of a node."""
        self.add(node.start_mark.line, node.start_mark.column, text, node.start_mark.name)

    def error(self) -> ConfigError:
        """All of them in the order of the file, `FILE:LINE:COLUMN: text` each; then `VARIABLE: text`."""
        return ConfigError(self._lines(self._found))

    def warnings(self) -> list[str]:
        """What was added by warn_at(), in the same form."""
        return self._lines(self._doubts)

    def _lines(self, found: list[tuple[str, int, int, str]]) -> list[str]:
        ordered = sorted(found, key=lambda problem: problem[:3])
        return [f"{self._place(variable, line, column)}: {text}" for variable, line, column, text in ordered]

    def _place(self, variable: str, line: int, column: int) -> str:
        if variable and line == column == 0:
            return variable
        return f"{variable or self._file}:{line + 1}:{column + 1}"

    def __bool__(self) -> bool:
        return bool(self._found)


def read_text(path: Path, problems: Problems) -> str:
    """Return the text of a file; ConfigError if it cannot be read or is not UTF-8."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        from bridged.text import user_name  # noqa: PLC0415 - only for a file that cannot be read

        by = f" (as {user_name(os.geteuid())})" if isinstance(error, PermissionError) else ""
        raise ConfigError([f"{path}: cannot be read: {error.strerror or error}{by}"]) from error
    if len(data) > MAX_BYTES:
        raise ConfigError([f"{path}: is larger than {MAX_BYTES} bytes: not a configuration"])
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = error.object[: error.start].decode().rpartition("\n")
        line = error.object.count(b"\n", 0, error.start)
        byte = error.object[error.start]
        problems.add(line, len(before[2]), f"byte 0x{byte:02X} is not UTF-8; save the file as UTF-8")
        raise problems.error() from error


def parse(text: str, problems: Problems, variable: str = "") -> Node | None:
    """Return the root of a document, None if there is none; ConfigError if it is not YAML.

    The marks of its nodes bear the name of the variable that it is the value of; none: it is the file's.

    By the loader in Python: the one in C is 1 ms faster for a file of 20 lines, words its errors in another
    way, and ends the process when a file nests deeply.
    """
    loader: yaml.SafeLoader | None = None
    try:
        loader = yaml.SafeLoader(text)
        loader.name = variable
        return loader.get_single_node()
    except ReaderError as error:
        line_start = text.rfind("\n", 0, error.position) + 1
        line = text.count("\n", 0, error.position)
        character = f"U+{ord(text[error.position]):04X}"
        what = f"character {character} is not allowed"
        problems.add(line, error.position - line_start, f"not valid YAML: {what}", variable)
        raise problems.error() from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = error.problem or "syntax error"
        what = next((f"{hint} ({problem})" for start, hint in _EXPLANATIONS if start in problem), problem)
        problems.add(
            mark.line if mark else 0, mark.column if mark else 0, f"not valid YAML: {what}", variable
        )
        raise problems.error() from error
    except (ValueError, OverflowError, RecursionError) as error:  # PyYAML lets through "\UFFFFFFFF", many "["
        mark = loader.get_mark() if loader else None
        what = "nested too deeply" if isinstance(error, RecursionError) else "a number is out of range"
        problems.add(
            mark.line if mark else 0, mark.column if mark else 0, f"not valid YAML: {what}", variable
        )
        raise problems.error() from error


def foreign_tag(node: Node) -> str | None:
    """Return a tag that means nothing here, as it was written: `!!python/name:os.system`, `!secret`."""
    if node.tag in _KNOWN_TAGS:
        return None
    return quoted(re.sub(f"^{CORE}", "!!", node.tag))


def is_empty(node: Node) -> bool:
    """True for `key:`, `key: ~` and `key: null`."""
    return node.tag == f"{CORE}null"


def scalar_value(node: ScalarNode) -> object:
    """Return what a reader of the file takes the scalar for: None, a bool, an int, a float, or its text.

    Text also for what reads as a number in YAML 1.1 only: 0125, 12:30, 0o17, .nan, 2026-11-22.
    """
    text: str = node.value
    try:
        match node.tag.removeprefix(CORE):
            case "null":
                return None
            case "bool":
                return _BOOLEANS.get(text.lower(), text)
            case "int" if _INTEGER.fullmatch(text):
                return int(text.replace("_", ""), 0)
            case "float" if math.isfinite(number := float(text.replace("_", ""))):
                return number
    except ValueError:  # 0x_, 1:30.5, more than 4300 digits
        pass
    return text


def describe(node: Node, *, number_wanted: bool = False) -> str:
    """Say what a node is, after "expected …, got"; and how the number, which it may be, is written."""
    if isinstance(node, SequenceNode):
        return "a list"
    if not isinstance(node, ScalarNode):
        return "a mapping"
    value = scalar_value(node)
    if isinstance(value, bool):
        return f"the yes-or-no value {quoted(node.value)}"
    if isinstance(value, int | float):
        return cut(node.value)
    text = f"the text {quoted(node.value)}"
    number = _as_number(node.value) if number_wanted else None
    if number is None:
        return text
    if node.style is not None:
        return f"{text} (write {number}, without quotes)"
    return f"{text} (write {number})"


def _as_number(text: str) -> str | None:
    """Return what was probably meant by a number that YAML takes for text: 1e6 -> 1000000, 0125 -> 125."""
    plain = text.replace("_", "")
    try:
        number: float = int(plain, 0)
    except ValueError:
        try:
            number = float(plain)
        except ValueError:
            return None
    if not (number == 0 or 1e-6 <= abs(number) < 1e15):  # NaN is neither
        return None
    if plain.lower().startswith(("0x", "0b", "0o")):
        return plain.lower() if plain[1] in "xX" else str(number)
    return str(int(number)) if number == int(number) else f"{number:.6f}".rstrip("0")


class Section:
    """A mapping while it is read: where its keys and values are, and the values that are right by themselves.

    `schemas` gives the Struct of each section, by path: `channel.acceptance`. Only a file that is wrong
    has it called.
    """

    def __init__(
        self,
        node: MappingNode,
        schemas: Schemas,
        problems: Problems,
        *,
        path: str = "",
        parent: Node | None = None,
    ) -> None:
        self.problems = problems
        self.keys: dict[str, Node] = {}
        self.nodes: dict[str, Node] = {}
        self.values: dict[str, Any] = {}  # by attribute name
        self._path = path
        self._parent = parent or node  # where something missing is reported: the key above
        self._schemas = schemas
        for key, value in node.value:
            if not isinstance(key, ScalarNode) or foreign_tag(key):
                problems.add_at(key, f"{path or 'the file'}: a key is a single word")
            elif key.value in self.keys:
                first = self.keys[key.value].start_mark.line + 1
                text = f"{self._where(key.value)}: given twice, first in line {first}; remove one"
                problems.add_at(key, text)
            else:
                self.keys[key.value] = key
                self.nodes[key.value] = value

    def _below(self, key: str) -> str:
        return f"{self._path}.{key}" if self._path else key

    def _where(self, key: str) -> str:
        return self._below(key if re.fullmatch(r"[\w-]{1,40}", key, re.ASCII) else quoted(key))

    def refuse_key(self, key: str, text: str) -> None:
        """Report a key that should not be there, or not with the others."""
        self.problems.add_at(self.keys[key], f"{self._where(key)}: {text}")

    def refuse_value(self, key: str, text: str) -> None:
        """Report a value."""
        self.problems.add_at(self.nodes[key], f"{self._where(key)}: {text}")

    def warn_key(self, key: str, text: str) -> None:
        """Add a doubt about a key; nothing if it is not given."""
        if key in self.keys:
            self.problems.warn_at(self.keys[key], f"{self._where(key)}: warning: {text}")

    def refuse_missing(self, key: str, wanted: str) -> None:
        """Report that a key is not there."""
        path = self._below(key)
        origin = self._parent.start_mark.name
        by_option = origin.startswith("--") or origin == COMMAND_LINE
        other = f"--{path}" if by_option else f"{VARIABLE_PREFIX}{path.replace('.', '__').upper()}"
        hint = f" ({other})" if origin else ""
        self.problems.add_at(self._parent, f"{self._where(key)}: is missing{hint}; expected {wanted}")

    def refuse_unknown(self, allowed: list[str]) -> None:
        """Report each key that is not allowed here, and what was probably meant."""
        for key in self.keys:
            if key not in allowed:
                self.refuse_key(
                    key, f"unknown key{self._meant(key, allowed)}; allowed here: {', '.join(allowed)}"
                )

    def _meant(self, key: str, allowed: list[str]) -> str:
        homes = [path for path, schema in self._schemas().items() if key in key_names(schema)]
        if homes:
            return f", it belongs to {' or '.join(homes)}"
        import difflib  # noqa: PLC0415 - only for a file that is wrong

        near = difflib.get_close_matches(key.lower(), allowed, n=1)
        return f", {near[0]} is probably meant" if near else ""

    def section(self, key: str, *, required: bool = True) -> Section | None:
        """Return a section below; None, reported, if it is missing or not a mapping."""
        path = self._below(key)
        node = self.nodes.get(key)
        if isinstance(node, MappingNode) and not foreign_tag(node):
            return Section(node, self._schemas, self.problems, path=path, parent=self.keys[key])
        schema = self._schemas()[path]
        needed = [field.encode_name for field in msgspec.structs.fields(schema) if field.required]
        wanted = f"a section with {', '.join(needed or key_names(schema))}"
        if node is None:
            self.refuse_missing(key, wanted)
        elif self._is_usable(key, wanted, required=required):
            self.refuse_value(key, f"expected {wanted}, got {describe(node)}")
        return None

    def read(self, schema: type[Struct], *, unknown_keys: bool = False) -> dict[str, Any]:
        """Read the values of all keys that are no sections; report what is missing, wrong or unknown."""
        if not unknown_keys:
            self.refuse_unknown(key_names(schema))
        for field in msgspec.structs.fields(schema):
            key = field.encode_name
            type_ = _without_none(field.type)
            if get_origin(type_) is not Annotated:
                continue
            wanted = next(meta.description for meta in type_.__metadata__)
            if key in self.nodes:
                self._read_value(key, field, type_, wanted)
            elif field.required:
                self.refuse_missing(key, wanted)
        return self.values

    def _read_value(self, key: str, field: FieldInfo, type_: Any, wanted: str) -> None:
        if not self._is_usable(key, wanted, required=field.required):
            return
        node = self.nodes[key]
        is_number = type_.__origin__ in (int, float)
        is_text = type_.__origin__ is str or get_origin(type_.__origin__) is Literal
        if isinstance(node, ScalarNode):
            value = node.value if is_text else scalar_value(node)
            if is_text and not node.value.isprintable():
                self.refuse_value(key, f"expected {wanted}, without unprintable characters")
                return
            try:
                self.values[field.name] = msgspec.convert(value, type_)
            except msgspec.ValidationError:
                pass
            else:
                return
        self.refuse_value(key, f"expected {wanted}, got {describe(node, number_wanted=is_number)}")

    def _is_usable(self, key: str, wanted: str, *, required: bool) -> bool:
        if tag := foreign_tag(self.nodes[key]):
            self.refuse_value(key, f"the YAML tag {tag} means nothing here; remove it")
        elif is_empty(self.nodes[key]):
            self.refuse_value(key, f"is empty; expected {wanted}{'' if required else ', or remove the key'}")
        else:
            return True
        return False


def _without_none(type_: Any) -> Any:
    """`Annotated[int, Meta(...)] | None` -> `Annotated[int, Meta(...)]`."""
    if get_origin(type_) not in (Union, UnionType):
        return type_
    return next(part for part in get_args(type_) if part is not type(None))


def is_flag(field: FieldInfo) -> bool:
    """Whether the key is true or false."""
    return getattr(_without_none(field.type), "__origin__", None) is bool


def key_names(schema: type[Struct]) -> list[str]:
    """Return the keys of a section as the file has them."""
    return [field.encode_name for field in msgspec.structs.fields(schema)]
