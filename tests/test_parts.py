"""The distributions: which modules each holds, and what a module may import from another one."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING

from parts import CORE, PACKAGE, PARTS, Part, core_project, files_of, part_of
from tests import ROOT
from tests.imports import dotted, imports, inner_statements, package

if TYPE_CHECKING:
    from collections.abc import Iterator

PART_OF = {dotted(path): part_of(path) for path in PACKAGE.rglob("*.py")}


def allowed(part: str) -> set[str]:
    """Return the parts whose modules a part may import."""
    return {CORE, part, *(PARTS[part].needs if part in PARTS else ())}


def unguarded(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield a module's imports at run time but those below ``with from_part(...)``, one by one."""
    for node in inner_statements(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            yield from unguarded(ast.Module(node.orelse, []))
            continue
        if isinstance(node, ast.With) and any(
            isinstance(item.context_expr, ast.Call)
            and getattr(item.context_expr.func, "id", "") == "from_part"
            for item in node.items
        ):
            continue
        yield from unguarded(node)
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield ast.Module([node], [])


def test_module_imports_from_its_own_part_and_those_that_it_needs() -> None:
    found = {
        (importer, one.home)
        for importer, tree in package().items()
        for node in unguarded(tree)
        for one in imports(importer, node)
        if PART_OF[one.home] not in allowed(PART_OF[importer])
    }
    assert found == set()


def test_each_file_is_in_one_part_and_each_pattern_matches_one() -> None:
    held = [file for name in (CORE, *PARTS) for file in files_of(name)]
    assert len(held) == len(set(held))
    for part in PARTS.values():
        names = [file.relative_to(PACKAGE).as_posix() for file in files_of(part.name)]
        for pattern in part.modules:
            alone = Part("", "", frozenset(), (), (pattern,))
            assert any(alone.covers(name) for name in names), pattern


def test_needs_go_in_one_direction() -> None:
    for part in PARTS.values():
        assert all(part.name not in PARTS[need].needs for need in part.needs)
        assert all(PARTS[need].needs <= part.needs for need in part.needs)


def test_extras_that_bring_parts_are_those_of_the_project() -> None:
    text = core_project((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for part in PARTS.values():
        assert text.count(f'"{part.distribution}==') == len(part.extras)
