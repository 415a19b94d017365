"""The house rules of architecture: imports run one way, and no module is a drawer for everything."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = ("schemas", "pipeline", "datasets", "cli")
DOORS = {
    "storage": set[str](),
    "stages": set[str](),
    "read": {"storage", "stages"},
    "one_run": {"stages", "studies"},
    "results": {"read", "storage", "stages"},
    "campaign": {"one_run", "read", "results", "stages", "storage", "studies"},
    "studies": {"one_run", "read", "results", "stages", "storage"},
    "make": {"read", "stages", "storage"},
    "show": {"read", "results", "stages", "storage", "studies"},
    "project": {"campaign", "make", "read", "results", "show", "stages", "storage", "studies"},
}
"""What each door of `pipeline/` may import of the others."""
DRAWERS = {"utils", "util", "tools", "common", "helpers", "helper", "misc"}


def _sources() -> list[Path]:
    packages = [path for layer in LAYERS[:3] for path in sorted((ROOT / layer).rglob("*.py"))]
    return [*packages, ROOT / "cli.py"]


@cache
def _tree(source: Path) -> ast.Module:
    return ast.parse(source.read_text(encoding="utf-8"))


@cache
def _imported(source: Path, top_level_only: bool = False) -> frozenset[str]:
    tree = _tree(source)
    nodes = tree.body if top_level_only else ast.walk(tree)
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{source}: relative import"
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {name for name in inner if _is_module(name)}
            names |= modules if modules == inner else {node.module, *modules}
    return frozenset(names)


@cache
def _is_module(name: str) -> bool:
    path = ROOT / name.replace(".", "/")
    return path.is_dir() or path.with_suffix(".py").is_file()


def _layer(name: str) -> int:
    return LAYERS.index(name.partition(".")[0])


@pytest.mark.parametrize("source", _sources(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_imports_run_one_way(source: Path) -> None:
    own = _layer(source.relative_to(ROOT).as_posix().removesuffix(".py").replace("/", "."))
    upward = {name for name in _imported(source) if name.partition(".")[0] in LAYERS and _layer(name) > own}
    assert upward == set()


def test_doors_of_the_pipeline() -> None:
    ways = {way for path in _sources() if path.is_relative_to(ROOT / "pipeline") for way in _wrong_ways(path)}
    assert ways == set()


def _wrong_ways(path: Path) -> set[str]:
    """Doors that a module of `pipeline/` imports though its own may not."""
    module = _module(path)
    doors = {".".join(name.split(".")[1:2]) for name in _imported(path) if name.startswith("pipeline.")}
    own = ".".join(module.split(".")[1:2])
    if not own:
        return set()
    return {f"{module} -> {door}" for door in doors - {own} - DOORS[own]}


def test_no_drawers() -> None:
    assert [path for path in _sources() if path.stem in DRAWERS or path.parent.name in DRAWERS] == []


def test_no_import_cycles() -> None:
    modules = {_module(path): path for path in _sources()}
    graph = {
        name: {found for found in _imported(path, top_level_only=True) if found in modules and found != name}
        for name, path in modules.items()
    }
    assert _cyclic(graph) == {}


def _cyclic(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """What remains after taking away, again and again, the modules that need no other or that none needs."""
    needed = set().union(*graph.values()) if graph else set()
    inner = {name: needs & graph.keys() for name, needs in graph.items() if needs & graph.keys() and name in needed}
    return inner if len(inner) == len(graph) else _cyclic(inner)


def test_cycles_are_seen() -> None:
    chain = {"top": {"a"}, "a": {"b"}, "b": {"c"}, "c": set[str]()}
    assert _cyclic(chain) == {}
    assert _cyclic({**chain, "c": {"a"}}) == {"a": {"b"}, "b": {"c"}, "c": {"a"}}


def _module(path: Path) -> str:
    return path.relative_to(ROOT).as_posix().removesuffix(".py").replace("/", ".").removesuffix(".__init__")
