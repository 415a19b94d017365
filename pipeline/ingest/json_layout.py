"""JSON messages of one writer as one pattern: the same keys in the same order, only values differ.

The pattern of a message is an exact regular expression with a group per wanted value. Messages that match
it from first to last byte are JSON objects whose fields are known; all others go to the parsers.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import polars as pl

# RFC 8259: number, string without escapes, and white space.
_INTEGER = r"-?(?:0|[1-9][0-9]*)"
_NUMBER = _INTEGER + r"(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?"
_TEXT = r'[^"\\\x00-\x1f]*'
_ESCAPE = r'\\(?:["\\/bfnrt]|u[0-9a-fA-F]{4})'
_ESCAPED_TEXT = rf"{_TEXT}(?:{_ESCAPE}{_TEXT})*"
_ANY = rf'(?:{_NUMBER}|"{_ESCAPED_TEXT}"|true|false|null)'
_TOKEN = re.compile(
    rf'(?P<space>[ \t\r\n]+)|(?P<mark>[{{}}\[\],:])|"(?P<text>{_TEXT})"'
    rf'|(?P<other>{_NUMBER}|true|false|null|"{_ESCAPED_TEXT}")'
)
_MOST_TOKENS = 2000


class NoPatternError(Exception):
    """A message that has no simple pattern."""


@dataclass(frozen=True)
class JsonLayout:
    """The pattern of a message; `paths` names its groups in order, `absent` the wanted paths it lacks."""

    pattern: str
    paths: tuple[str, ...]
    absent: tuple[str, ...]


def layout_of(payload: bytes, types: Mapping[str, pl.DataType]) -> JsonLayout:
    """The layout of one message."""
    try:
        builder = _Builder(payload.decode("utf-8"), types)
    except UnicodeDecodeError:
        raise NoPatternError from None
    builder.value("")
    builder.end()
    absent = tuple(path for path in types if path not in builder.paths)
    return JsonLayout(f"^{''.join(builder.parts)}$", tuple(builder.paths), absent)


class _Builder:
    """Reads one message and writes its pattern beside it."""

    def __init__(self, text: str, types: Mapping[str, pl.DataType]) -> None:
        self.parts: list[str] = []
        self.paths: list[str] = []
        self._types = types
        self._tokens = self._split(text)
        self._next = 0

    def _split(self, text: str) -> list[re.Match[str]]:
        tokens: list[re.Match[str]] = []
        at = 0
        while at < len(text):
            match = _TOKEN.match(text, at)
            if match is None or len(tokens) > _MOST_TOKENS:
                raise NoPatternError
            tokens.append(match)
            at = match.end()
        return tokens

    def _space(self) -> None:
        while self._next < len(self._tokens) and self._tokens[self._next].lastgroup == "space":
            self._literal()

    def _token(self) -> re.Match[str]:
        """The token that comes next; a text that ends before it has no pattern."""
        if self._next >= len(self._tokens):
            raise NoPatternError
        return self._tokens[self._next]

    def _literal(self) -> re.Match[str]:
        token = self._token()
        self._next += 1
        self.parts.append(re.escape(token.group()))
        return token

    def _mark(self, *expected: str) -> str:
        self._space()
        if self._token().group() not in expected:
            raise NoPatternError
        mark = self._literal().group()
        self._space()
        return mark

    def end(self) -> None:
        self._space()
        if self._next != len(self._tokens):
            raise NoPatternError

    def value(self, path: str) -> None:
        self._space()
        token = self._token()
        if token.group() == "{":
            self._object(path)
        elif token.group() == "[":
            self._array(path)
        elif not path or token.lastgroup == "mark":
            raise NoPatternError
        else:
            self._next += 1
            self.parts.append(self._scalar(path, token))

    def _scalar(self, path: str, token: re.Match[str]) -> str:
        """A group for a wanted value, any value for another; null is a value that may come and go."""
        if path not in self._types:
            return _ANY
        forms = {pl.Float64: _NUMBER, pl.Int64: _INTEGER, pl.Boolean: "true|false", pl.String: _TEXT}
        form = forms[type(self._types[path])]
        self.paths.append(path)
        group = f'"({form})"' if self._types[path] == pl.String else f"({form})"
        if not re.fullmatch(f"(?:{group}|null)", token.group()):
            raise NoPatternError
        return f"(?:{group}|null)"

    def _object(self, path: str) -> None:
        self._mark("{")
        names: set[str] = set()
        while self._token().lastgroup == "text":
            name = self._literal().group("text")
            if name in names or "." in name or "[" in name:
                raise NoPatternError
            names.add(name)
            self._mark(":")
            self.value(f"{path}.{name}" if path else name)
            if self._mark(",", "}") == "}":
                return
        if names:
            raise NoPatternError
        self._mark("}")

    def _array(self, path: str) -> None:
        self._mark("[")
        index = 0
        while self._token().group() != "]":
            self.value(f"{path}[{index}]")
            index += 1
            if self._mark(",", "]") == "]":
                return
        if index:
            raise NoPatternError
        self._mark("]")
