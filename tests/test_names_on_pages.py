"""The architecture pages and the decisions name only what is in the package.

A class, a function, a module or a file that was renamed leaves its old name on these pages, and a
reader looks for it in vain.
"""

from __future__ import annotations

import ast
import re
import sys
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

from tests import ROOT
from tests.imports import package
from tests.strategies import over

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for folder in ("architecture", "decisions")
    for path in sorted((ROOT / "docs" / folder).glob("*.md"))
}
SHOWN = re.compile(r"^```text\n(.*?)^```$", re.DOTALL | re.MULTILINE)
QUOTED = re.compile(r"`([^`\n]+)`")
MEMBER = re.compile(r"\b(_?[A-Z]\w*[a-z]\w*)\.(\w+)")
DOTTED = re.compile(r"(?:\w+\.)+\w+")
FILE = re.compile(r"[a-z_][\w.-]*(?:/[\w.-]+)*\.(?:py|toml|yaml)|[a-z_./]+/")
PLAIN = re.compile(r"_?[A-Z]\w*[a-z]\w*|_?[a-z]+(_\w+)+")
PLACES = ("", "smartcam/", "docs/")


class Class(NamedTuple):
    """The members that all classes of one name have, and the names of their bases."""

    members: set[str]
    bases: set[str]


@cache
def classes() -> dict[str, Class]:
    """Return the classes of the package by name."""
    found: dict[str, Class] = {}
    for tree in package().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                one = found.setdefault(node.name, Class(set(), set()))
                one.members.update(members(node))
                one.bases.update(name for base in node.bases for name in words_of(base))
    return found


def members(owner: ast.ClassDef) -> Iterator[str]:
    """Yield the methods and attributes of a class, those set on an object included."""
    for node in ast.walk(owner):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                yield name
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name


def words_of(tree: ast.AST) -> Iterator[str]:
    """Yield every identifier in a piece of code, and the words of its short texts."""
    for node in ast.walk(tree):
        match node:
            case ast.Load():  # nearly half of all
                pass
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name):
                yield name
            case ast.ClassDef(name=name) | ast.FunctionDef(name=name):
                yield name
            case ast.AsyncFunctionDef(name=name):
                yield name
            case ast.alias(name=name):
                yield from name.split(".")
            case ast.keyword(arg=str(name)):
                yield name
            case ast.Constant(value=str(text)) if len(text) <= 60:
                yield from re.findall(r"\w+", text)


@cache
def words() -> frozenset[str]:
    """Return every word by which the package calls something."""
    found = {name for tree in package().values() for name in words_of(tree)}
    modules = {part for module in package() for part in module.split(".")}
    return frozenset(found | modules | {name.lstrip("_") for name in modules})


def has(name: str, member: str) -> bool:
    """Return whether a class, or one that it is made of, has a member."""
    one = classes().get(name)
    return one is not None and (
        member in one.members or any(has(base, member) for base in one.bases - {name})
    )


@cache
def files() -> frozenset[str]:
    """Return the name of each module's file."""
    return frozenset(path.name for path in (ROOT / "smartcam").rglob("*.py"))


@cache
def modules() -> dict[str, str]:
    """Return each module's name below smartcam, with and without underscores in front."""
    full = {module.removeprefix("smartcam."): module for module in package()}
    plain = {re.sub(r"(^|\.)_", r"\1", short): module for short, module in full.items()}
    return plain | full


def is_there(name: str) -> bool:
    """Return whether a dotted name of the package is a module, or a name in one."""
    short = name.removeprefix("smartcam.")
    head, _, last = short.rpartition(".")
    if short in modules():
        return True
    return head in modules() and last in set(words_of(package()[modules()[head]]))


def missing(text: str) -> Iterator[str]:
    """Yield each name on a page that nothing in the package has."""
    shown = "\n".join(SHOWN.findall(text))
    quoted = [one.removesuffix("()") for one in QUOTED.findall(SHOWN.sub("", text))]
    for name, member in MEMBER.findall("\n".join([shown, *quoted])):
        if name in classes() and not has(name, member):
            yield f"{name}.{member}"
    rooms = {name.split(".")[0] for name in modules()} - sys.stdlib_module_names
    named = [name for name in quoted if not FILE.fullmatch(name)]
    for name in [*named, *re.findall(r"(?<= )_?[a-z]\w*\.[\w.]+", shown)]:
        known = name in words() or not PLAIN.fullmatch(name)
        if DOTTED.fullmatch(name) and name.split(".")[0] in rooms:
            known = is_there(name)
        if not known:
            yield name
    for name in filter(FILE.fullmatch, quoted):
        if name not in files() and not any((ROOT / place / name).exists() for place in PLACES):
            yield name


@over("page", PAGES)
def test_names_on_a_page_are_in_the_package(page: str) -> None:
    assert sorted(set(missing(PAGES[page])) - ELSEWHERE.get(page, set())) == []


ELSEWHERE = {
    "docs/architecture/inspection.md": {"smartcam.tools"},  # entry points
    "docs/decisions/0002-receive-task.md": {"epoll_wait"},  # the system's
    "docs/decisions/0026-the-door.md": {"tls_handshake_timeout_ms"},  # Zenoh's
}
"""Names by page that are not the package's: other programs' and those that were rejected."""


def test_exceptions_are_on_their_pages() -> None:
    unused = [
        name for page, names in ELSEWHERE.items() for name in names if name not in PAGES[page]
    ]
    assert unused == []


def test_renamed_function_is_found() -> None:
    text = "`Machine.no_such_method`, `_client/gone.py`\n```text\nLink.no_such  _client.gone\n```"
    assert set(missing(text)) == {
        "Machine.no_such_method", "_client/gone.py", "Link.no_such", "_client.gone",
    }  # fmt: skip


@over("page", [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"])
def test_links_on_a_page_have_a_text(page: Path) -> None:
    """Sphinx gives a link without one the title of its page; elsewhere nothing is to be seen."""
    assert re.findall(r"\[\]\([^)]*\)", page.read_text(encoding="utf-8")) == []
