"""The imports of each module, as the source says them."""

from __future__ import annotations

import ast
import gc
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from tests import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def sources(folder: str) -> dict[str, ast.Module]:
    """Return each module below a folder of the project by its dotted name, parsed."""
    return {
        dotted(path): ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted((ROOT / folder).rglob("*.py"))
    }


def dotted(path: Path) -> str:
    """Return the dotted name of the module in a file."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


@cache
def package() -> dict[str, ast.Module]:
    """Return the modules of smartcam, parsed once in each process that asks.

    Millions of nodes, of which none goes: each garbage collection would look at all.
    """
    gc.collect()
    gc.disable()
    try:
        found = sources("smartcam")
        gc.freeze()
    finally:
        gc.enable()
    return found


MODULES = {dotted(path) for path in (ROOT / "smartcam").rglob("*.py")}

PACKAGES = {dotted(path) for path in (ROOT / "smartcam").rglob("__init__.py")}

ROOMS = {name for name in PACKAGES if name.count(".") == 1}


class Import(NamedTuple):
    """One name that a module imports from smartcam."""

    module: str  # that is imported, or that the name is imported from
    name: str | None  # None where the module itself is imported
    home: str  # the module in which what is imported stands: another one where `module` is a door
    runs: bool  # it is there when the code runs, and not for type checkers only


def room_of(module: str) -> str | None:
    """Return the room that a module stands in; None for one that stands beside the rooms.

    The camera on the wire, ``smartcam.client``, is the door of ``smartcam._client``.
    """
    if module == "smartcam.client":
        return "smartcam._client"
    return next((room for room in ROOMS if f"{module}.".startswith(f"{room}.")), None)


def is_door(module: str) -> bool:
    """Return whether a module only gives out what stands elsewhere in its package."""
    return module in PACKAGES or module.endswith("._inside")


BLOCKS = ("body", "handlers", "orelse", "finalbody", "cases")
"""The fields of a node in which statements stand."""


def inner_statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the statements that stand directly in a module or in a statement."""
    for field in BLOCKS:
        yield from getattr(node, field, ())


@cache
def statements(tree: ast.Module) -> tuple[ast.AST, ...]:
    """Return a module and all statements in it, those of functions and classes too."""
    found: list[ast.AST] = [tree]
    for node in found:
        found.extend(inner_statements(node))
    return tuple(found)


def imports(importer: str, tree: ast.AST, *, runs: bool = True) -> Iterator[Import]:
    """Yield what a module imports from smartcam, in functions too."""
    for node in inner_statements(tree):
        checked_only = isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        if isinstance(node, ast.ImportFrom) and node.module in MODULES:
            for one in node.names:
                module = f"{node.module}.{one.name}"
                if module in MODULES:
                    yield Import(module, None, module, runs)
                else:
                    home = (
                        node.module if importer == node.module else home_of(node.module, one.name)
                    )
                    yield Import(node.module, one.name, home, runs)
        elif isinstance(node, ast.Import):
            for one in node.names:
                if one.name in MODULES:
                    yield Import(one.name, None, one.name, runs)
        yield from imports(importer, node, runs=runs and not checked_only)


_homes: dict[str, dict[str, str]] = {}


def home_of(door: str, name: str) -> str:
    """Return the module in which a name stands that a door gives out."""
    if not is_door(door):
        return door
    if door not in _homes:
        _homes[door] = {}  # of itself it imports nothing
        found = [one for one in imports(door, package()[door]) if not one.runs]
        _homes[door] = {one.name or one.module.rpartition(".")[2]: one.home for one in found}
    return _homes[door].get(name, door)
