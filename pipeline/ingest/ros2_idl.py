"""`ros2idl` schemas as the `ros2msg` text of the same layout, so that both kinds are decoded alike.

Covered is what message definitions need (OMG IDL 4.2, 7.4.1): modules, structures, constants, enumerations and
type definitions over primitive types, strings, sequences and arrays of one dimension.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import lru_cache

from pipeline.ingest.mcap_model import Schema

_SEPARATOR = "=" * 80
_DELIMITER = re.compile(r"^={3,}[ \t]*\r?\nIDL:[^\n]*$", re.MULTILINE)
_TOKEN = re.compile(
    r'(?P<skip>\s+|//[^\n]*|/\*.*?\*/|^[ \t]*#[^\n]*)|"(?:\\.|[^"\\])*"|\'(?:\\.|[^\'\\])*\''
    r"|[A-Za-z_]\w*(?:::[A-Za-z_]\w*)*|[-+]?[\d.][\w.+-]*|.",
    re.DOTALL | re.MULTILINE,
)
_PRIMITIVES = {
    "boolean": "bool", "octet": "byte", "char": "uint8", "float": "float32", "double": "float64",
    "short": "int16", "long": "int32", "long long": "int64", "unsigned short": "uint16", "unsigned long": "uint32",
    "unsigned long long": "uint64", "int8": "int8", "int16": "int16", "int32": "int32", "int64": "int64",
    "uint8": "uint8", "uint16": "uint16", "uint32": "uint32", "uint64": "uint64", "string": "string",
    "wstring": "wstring",
}  # fmt: skip


class IdlError(ValueError):
    """A definition that is not understood."""


@dataclass(frozen=True)
class Type:
    """A type of `ros2msg`: the name of one element, and an array suffix such as `[9]`, `[]` or `[<=5]`."""

    name: str
    suffix: str = ""

    def array(self, suffix: str) -> Type:
        if self.suffix:
            raise IdlError(f"an array of arrays ({self.name}{self.suffix}{suffix})")
        return replace(self, suffix=suffix)


@lru_cache(maxsize=64)  # the logs of a campaign share their schemas
def as_ros2msg(schema: Schema) -> Schema:
    """The schema itself, or what its IDL says as `ros2msg`; raises `IdlError` or UnicodeDecodeError."""
    if schema.encoding != "ros2idl":
        return schema
    text = ros2msg_text(schema.name, schema.data.decode("utf-8"))
    return replace(schema, encoding="ros2msg", data=text.encode())


def ros2msg_text(name: str, idl: str) -> str:
    """The definition of `pkg/msg/Type` and of all structures beside it, in the concatenated form."""
    parser = _Parser(_DELIMITER.sub("", idl))
    parser.definitions(())
    root = _short(name)
    if root not in parser.structures:
        raise IdlError(f"no definition of {name}")
    sections = [parser.structures.pop(root)]
    sections += [f"MSG: {other}\n{members}" for other, members in parser.structures.items()]
    return f"{_SEPARATOR}\n".join(sections)


def _short(name: str) -> str:
    """`pkg/Type` of `pkg/msg/Type` or `pkg::msg::Type`."""
    parts = re.split("/|::", name)
    return f"{parts[0]}/{parts[-1]}"


@dataclass
class _Parser:
    """Reads definitions one after the other; names are known once they were met, as IDL demands."""

    text: str
    structures: dict[str, str] = field(default_factory=dict)
    _types: dict[str, Type] = field(default_factory=dict)
    _numbers: dict[str, int] = field(default_factory=dict)
    _at: int = 0

    def __post_init__(self) -> None:
        self._tokens = [match.group() for match in _TOKEN.finditer(self.text) if match.lastgroup != "skip"]

    def definitions(self, scope: tuple[str, ...]) -> None:
        """Everything up to the end of the enclosing module."""
        while self._peek() not in ("", "}"):
            self._annotations()
            word = self._next()
            if word not in _DEFINITIONS:
                raise IdlError(f"{word!r} where a definition was expected")
            _DEFINITIONS[word](self, scope)
            self._expect(";")

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _next(self) -> str:
        token = self._peek()
        if not token:
            raise IdlError("the definition ends too early")
        self._at += 1
        return token

    def _expect(self, token: str) -> None:
        found = self._next()
        if found != token:
            raise IdlError(f"{found!r} where {token!r} was expected")

    def _met(self, token: str) -> bool:
        """Pass the token, if it is there."""
        if self._peek() != token:
            return False
        self._at += 1
        return True

    def _annotations(self) -> None:
        while self._met("@"):
            self._next()
            if self._met("("):
                depth = 1
                while depth:
                    depth += {"(": 1, ")": -1}.get(self._next(), 0)

    def _module(self, scope: tuple[str, ...]) -> None:
        inner = (*scope, self._next())
        self._expect("{")
        self.definitions(inner)
        self._expect("}")

    def _structure(self, scope: tuple[str, ...]) -> None:
        full = "::".join((*scope, self._next()))
        self._expect("{")
        lines = []
        while not self._met("}"):
            self._annotations()
            for name, kind in self._declared(scope):
                lines.append(f"{kind.name}{kind.suffix} {name}\n")
            self._expect(";")
        self._types[full] = Type(_short(full))
        self.structures[_short(full)] = "".join(lines)

    def _typedef(self, scope: tuple[str, ...]) -> None:
        for name, kind in self._declared(scope):
            self._types["::".join((*scope, name))] = kind

    def _constant(self, scope: tuple[str, ...]) -> None:
        self._type(scope)
        name = self._next()
        self._expect("=")
        if re.fullmatch(r"\d+", self._peek()):
            self._numbers["::".join((*scope, name))] = int(self._peek())
        while self._peek() != ";":
            self._next()

    def _enumeration(self, scope: tuple[str, ...]) -> None:
        """CDR writes an enumerator as 32 bits."""
        self._types["::".join((*scope, self._next()))] = Type("uint32")
        self._expect("{")
        while not self._met("}"):
            self._next()

    def _declared(self, scope: tuple[str, ...]) -> list[tuple[str, Type]]:
        """Names and types of one declaration, which may name several of a type."""
        kind, found = self._type(scope), []
        while True:
            name, declared = self._next(), kind
            while self._met("["):
                declared = declared.array(f"[{self._number(scope)}]")
                self._expect("]")
            found.append((name, declared))
            if not self._met(","):
                return found

    def _type(self, scope: tuple[str, ...]) -> Type:
        word = self._next()
        if word == "sequence":
            return self._sequence(scope)
        while f"{word} {self._peek()}" in _PRIMITIVES or (word == "unsigned" and self._peek() == "long"):
            word = f"{word} {self._next()}"
        if word in ("string", "wstring") and self._met("<"):
            bound = self._number(scope)
            self._expect(">")
            return Type(f"{word}<={bound}")
        return Type(_PRIMITIVES[word]) if word in _PRIMITIVES else self._named(word, scope)

    def _sequence(self, scope: tuple[str, ...]) -> Type:
        self._expect("<")
        element = self._type(scope)
        suffix = f"[<={self._number(scope)}]" if self._met(",") else "[]"
        self._expect(">")
        return element.array(suffix)

    def _named(self, word: str, scope: tuple[str, ...]) -> Type:
        """A type by name, looked up from the innermost module outwards."""
        for depth in range(len(scope), -1, -1):
            kind = self._types.get("::".join((*scope[:depth], word)))
            if kind is not None:
                return kind
        return self._ahead(word)

    def _ahead(self, word: str) -> Type:
        """A type of another file: recorders write the definition of a message before those that it needs."""
        if word.count("::") < 1:
            raise IdlError(f"the type {word!r} is not known")
        return Type(_short(word))

    def _number(self, scope: tuple[str, ...]) -> int:
        word = self._next()
        if word.isdigit():
            return int(word)
        for depth in range(len(scope), -1, -1):
            number = self._numbers.get("::".join((*scope[:depth], word)))
            if number is not None:
                return number
        raise IdlError(f"{word!r} where a length was expected")


_DEFINITIONS = {
    "module": _Parser._module,
    "struct": _Parser._structure,
    "typedef": _Parser._typedef,
    "const": _Parser._constant,
    "enum": _Parser._enumeration,
}
