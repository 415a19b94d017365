"""Single defects of a source file: a comparison turned, a constant changed, signs, `and`, `min` or a result swapped."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
}
_SIGNS: dict[type[ast.operator], type[ast.operator]] = {ast.Add: ast.Sub, ast.Sub: ast.Add}
_EXTREMES = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "min_horizontal": "max_horizontal",
    "max_horizontal": "min_horizontal",
}


@dataclass(frozen=True)
class Mutant:
    """The `number`-th defect of a file."""

    path: Path
    number: int
    line: int
    what: str

    def source(self) -> str:
        """The file with the defect."""
        tree = ast.parse(self.path.read_text(encoding="utf-8"))
        for number, (_, _, change) in enumerate(_changes(tree)):
            if number == self.number:
                change()
                return ast.unparse(ast.fix_missing_locations(tree))
        raise IndexError(f"{self.path}: has no defect {self.number}")


def mutants_of(path: Path) -> list[Mutant]:
    """Every defect that can be made in a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [Mutant(path, number, line, what) for number, (line, what, _) in enumerate(_changes(tree))]


def _changes(tree: ast.AST) -> Iterator[tuple[int, str, Callable[[], None]]]:
    """Line, description and what makes the defect, for each place in order."""
    for node in _code_of(tree):
        for what, change in _of_node(node):
            yield getattr(node, "lineno", 0), what, change


def _code_of(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes that are run: no annotations, no decorators, no text that is only joined to a message."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params") or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _code_of(child)


def _of_node(node: ast.AST) -> Iterator[tuple[str, Callable[[], None]]]:
    if isinstance(node, ast.Compare):
        yield from _comparison(node)
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
        yield from _constant(node)
    elif isinstance(node, ast.BinOp) and type(node.op) in _SIGNS and not _is_text(node):
        swapped = _SIGNS[type(node.op)]
        yield "+ and - swapped", lambda: setattr(node, "op", swapped())
    elif isinstance(node, ast.BoolOp):
        other = ast.Or if isinstance(node.op, ast.And) else ast.And
        yield "and/or swapped", lambda: setattr(node, "op", other())
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitAnd | ast.BitOr):
        turned = ast.BitOr if isinstance(node.op, ast.BitAnd) else ast.BitAnd
        yield "& and | swapped", lambda: setattr(node, "op", turned())
    elif isinstance(node, ast.Call):
        yield from _extreme(node.func)
    elif isinstance(node, ast.Return) and isinstance(node.value, ast.Compare | ast.BoolOp):
        asked = node.value
        yield "result negated", lambda: setattr(node, "value", ast.UnaryOp(ast.Not(), asked))


def _comparison(node: ast.Compare) -> Iterator[tuple[str, Callable[[], None]]]:
    for place, operator in enumerate(node.ops):
        other = _COMPARISONS.get(type(operator))
        if other is not None:
            what = f"{type(operator).__name__} becomes {other.__name__}"
            yield what, lambda place=place, other=other: node.ops.__setitem__(place, other())  # type: ignore[misc]


def _constant(node: ast.Constant) -> Iterator[tuple[str, Callable[[], None]]]:
    changed = _other_than(node.value)
    yield f"{node.value!r} becomes {changed!r}", lambda: setattr(node, "value", changed)


def _other_than(value: object) -> bool | int | float:
    """The other truth, one more, or twice as much (1 for 0)."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return value * 2.0 or 1.0
    raise TypeError(f"{value!r}: is no number")


def _extreme(called: ast.expr) -> Iterator[tuple[str, Callable[[], None]]]:
    field = "id" if isinstance(called, ast.Name) else "attr" if isinstance(called, ast.Attribute) else None
    other = _EXTREMES.get(getattr(called, field)) if field else None
    if field and other:
        yield f"{getattr(called, field)} becomes {other}", lambda: setattr(called, field, other)


def _is_text(node: ast.BinOp) -> bool:
    """Texts that are joined by +."""
    return any(
        isinstance(side, ast.JoinedStr) or (isinstance(side, ast.Constant) and isinstance(side.value, str))
        for side in (node.left, node.right)
    )
