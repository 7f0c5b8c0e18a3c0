"""Rooms have walls: a room imports another one by its door, or by its module ``_inside``.

The door is the package itself, or a public package in it. ``_inside`` lists what other rooms use
and users do not. What stands beside the rooms, such as ``smartcam/_locks.py``, is for all of them.
"""

from __future__ import annotations

import ast
import importlib
import re
from typing import TYPE_CHECKING, cast

from tests import ROOT
from tests.imports import MODULES, ROOMS, dotted, imports, package, room_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

THROUGH_THE_WALL: dict[tuple[str, str], str] = {}
"""The imports of another room's private module that stand, as (importer, module): the reason."""

ROOMS_OF_TESTS = {"cli": "_cli", "client": "_client", "dissector": "_dissector"}
"""Folders of tests whose room has another name."""

MAX_OWN_PRIVATE = 140
"""Test files that may import a private module of their own room."""


def is_private(module: str) -> bool:
    """Return whether a module stands behind the wall of its room."""
    room = room_of(module)
    inner = module.split(".")[2:]
    if room is None or not inner or inner[-1] == "_inside":
        return False
    return room.startswith("smartcam._") or any(part.startswith("_") for part in inner)


def room_of_test(module: str) -> str | None:
    """Return the room that a module of tests is about; None for tests of the whole."""
    parts = module.split(".")
    room = f"smartcam.{ROOMS_OF_TESTS.get(parts[1], parts[1])}"
    return room if room in ROOMS and len(parts) > 2 else None


def private_imports(modules: Mapping[str, ast.Module]) -> Iterator[tuple[str, str]]:
    """Yield (importer, module) for each private module that is imported."""
    for importer, tree in modules.items():
        for module in {one.module for one in imports(importer, tree)}:
            if is_private(module):
                yield importer, module


def test_room_is_entered_by_its_door() -> None:
    found = {
        (importer, module)
        for importer, module in private_imports(package())
        if room_of(importer) != room_of(module)
    }
    assert found == set(THROUGH_THE_WALL)


def test_names_of_each_inside_resolve() -> None:
    insides = [importlib.import_module(name) for name in package() if name.endswith("._inside")]
    assert insides
    unresolved = {
        (module.__name__, name)
        for module in insides
        for name in (*module.__all__, *dir(module))
        if not hasattr(module, name)
    }
    assert unresolved == set()


def test_inside_lists_what_other_rooms_use_and_nothing_else() -> None:
    used: dict[str, set[str]] = {}
    for importer, tree in package().items():
        for one in imports(importer, tree):
            if one.module.endswith("._inside") and one.name is not None:
                assert room_of(importer) != room_of(one.module), f"{importer} goes round the house"
                used.setdefault(one.module, set()).add(one.name)
    listed = {
        name: importlib.import_module(name).__all__ for name in package() if "._inside" in name
    }
    assert {name: sorted(names) for name, names in used.items()} == {
        name: sorted(names) for name, names in listed.items()
    }


LONG_TEXT = re.compile(r'"""(?:.|\n)*?"""')
IMPORT = re.compile(
    r"^ *(from smartcam[\w.]* import (?:\([^)]*\)|[^\n(]*)|import smartcam[^\n]*)", re.MULTILINE
)


def imports_of_tests() -> dict[str, ast.Module]:
    """Return what each file of the tests imports from smartcam: whole files take long to parse."""
    return {
        dotted(path): ast.parse(
            "\n".join(IMPORT.findall(LONG_TEXT.sub("", path.read_text("utf-8"))))
        )
        for path in (ROOT / "tests").rglob("*.py")
    }


OF_TESTS = re.compile(r"^ *from (tests\.\w+\.)inside import (\([^)]*\)|[^\n(]*)", re.MULTILINE)


def test_inside_of_a_room_s_tests_lists_what_its_kits_or_several_of_them_use() -> None:
    """Each private module is named in one file: in the test of it, or in the room's ``inside``.

    A kit is a module of tests without tests in it: helpers, proofs, budgets.
    """
    uses: dict[tuple[str, str], set[str]] = {}
    for path in (ROOT / "tests").rglob("*.py"):
        for room, names in OF_TESTS.findall(path.read_text("utf-8")):
            assert dotted(path).startswith(room), f"{dotted(path)} goes round the house"
            for name in re.findall(r"(\w+)(?: as \w+)?", names):
                uses.setdefault((f"{room}inside", name), set()).add(dotted(path))
    listed, users = set[tuple[str, str]](), dict[str, set[str]]()
    for path in (ROOT / "tests").glob("*/inside.py"):
        for node in ast.parse(path.read_text("utf-8")).body[2:]:
            for one in cast("ast.ImportFrom", node).names:
                key, module = (dotted(path), one.asname or one.name), cast("ast.ImportFrom", node)
                full = f"{module.module}.{one.name}"
                listed.add(key)
                home = full if full in MODULES else f"{module.module}"
                users.setdefault(home, set()).update(uses[key])
    assert listed == set(uses)
    assert [
        module
        for module, files in users.items()
        if len(files) == 1 and all(".test_" in name for name in files)
    ] == []
    direct = [
        module
        for importer, module in private_imports(imports_of_tests())
        if not importer.endswith(".inside") and importer not in ALONE
    ]
    assert sorted(set(direct) & set(users)) == []
    assert sorted(module for module in set(direct) if direct.count(module) > 1) == []


ALONE = {"tests.frames.vivid.guest"}
"""Runs in a virtual machine that has little more than Python."""


def test_tests_import_ever_fewer_private_modules_and_none_of_other_rooms() -> None:
    own: set[str] = set()
    others: set[str] = set()
    for importer, module in private_imports(imports_of_tests()):
        (own if room_of(module) == room_of_test(importer) else others).add(importer)
    assert others == set()
    assert len(own) <= MAX_OWN_PRIVATE
