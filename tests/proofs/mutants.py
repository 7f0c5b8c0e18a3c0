"""Mutants: small mistakes put into the code, one at a time. Does a test notice?

``python -m tests.proofs.mutants --count 40 --seed 1`` draws that many mistakes for each room of
:data:`ROOMS` and runs the room's tests on a copy of the tree with each. It prints those that no
test noticed, which is no error: some change nothing that anybody could notice. ``--tests FOLDER``
takes the tests of another checkout, to compare; ``--only`` repeats some by name. The tests run once
without a mistake first; those that fail then are named and left out.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from tests import ROOT

TAKEN = ("smartcam", "tests", "examples", "docs", "results", "pyproject.toml", "README.md")
"""Files and folders that a copy of the tree has."""

LONGEST = 200.0
"""Seconds that the tests of one mutant may take: one that hangs is noticed."""


class Room(NamedTuple):
    """A part of the code: patterns of its modules, and the tests that are to notice mistakes."""

    modules: tuple[str, ...]
    tests: tuple[str, ...]


ROOMS = {
    "protocols": Room(("protocols/**/*.py",), ("tests/protocols",)),
    "layout": Room(
        ("layout/*.py", "interpreters/*.py"),
        ("tests/layout", "tests/interpreters", "tests/test_examples.py"),
    ),
    "emulator": Room(("emulator/**/*.py",), ("tests/emulator",)),
    "client": Room(
        ("client.py", "streams.py", "_client/*.py"),
        ("tests/client", "tests/test_streams.py", "tests/proofs/test_cancel_sweep.py"),
    ),
    "calibration": Room(("calibration/**/*.py",), ("tests/calibration", "tests/test_examples.py")),
}
AWAY = ("test_docs.py", "test_exports.py", "test_pytest_plugin.py", "test_dissector.py")
"""Tests of no room."""


# ---------------------------------------------------------------------- mistakes

COMPARED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
CALCULATED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Add,
}  # fmt: skip
QUIET = (ast.Assign, ast.AugAssign, ast.Expr, ast.Return, ast.Raise, ast.Continue, ast.Break)


def mistaken(node: ast.AST) -> str:
    """Put a mistake where it fits into a node; return which, empty where none does."""
    match node:
        case ast.Compare(ops=[only]) if type(only) in COMPARED:
            node.ops = [COMPARED[type(only)]()]
            return f"{type(only).__name__} -> {type(node.ops[0]).__name__}"
        case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in CALCULATED:
            node.op = CALCULATED[type(op)]()
            return f"{type(op).__name__} -> {type(node.op).__name__}"
        case ast.BoolOp(op=op):
            node.op = ast.Or() if isinstance(op, ast.And) else ast.And()
            return f"{type(op).__name__} -> {type(node.op).__name__}"
        case ast.UnaryOp(op=ast.Not()):
            node.op = ast.UAdd()
            node.operand = ast.Call(ast.Name("bool", ast.Load()), [node.operand], [])
            return "Not -> nothing"
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            node.test = ast.UnaryOp(ast.Not(), test)
            return f"{type(node).__name__} turned round"
        case ast.Constant(value=bool(value)):
            node.value = not value
            return f"{value} -> {node.value}"
        case ast.Constant(value=int() | float() as value):
            node.value = value + 1
            return f"{value} -> {node.value}"
        case _:
            return ""


def hushed(body: list[ast.stmt], index: int) -> str:
    """Take a statement out; return which, empty where it should stay."""
    gone = body[index]
    plain = isinstance(gone, QUIET) and not (
        isinstance(gone, ast.Expr) and isinstance(gone.value, ast.Constant)
    )
    if not plain:
        return ""
    body[index] = ast.copy_location(ast.Pass(), gone)
    return f"without {ast.unparse(gone).splitlines()[0][:60]}"


def places(tree: ast.Module) -> Iterator[tuple[ast.AST, int | None]]:
    """Give each place inside functions where a mistake may be: a node, or a statement of it."""
    for function in ast.walk(tree):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for part in function.body:
            for node in ast.walk(part):
                if isinstance(node, ast.expr | ast.AugAssign | ast.If | ast.While):
                    yield node, None
                body = getattr(node, "body", []) if isinstance(node, ast.stmt) else []
                for index in range(len(body)):
                    yield node, index


class Mutant(NamedTuple):
    """A mistake: in which module, at which of its places."""

    room: str
    module: str
    place: int

    @property
    def name(self) -> str:
        """The mutant as ``--only`` takes it."""
        return f"{self.room}:{self.module}:{self.place}"

    def text(self) -> tuple[str, str]:
        """Return the module with the mistake, and what it is; empty where there is none."""
        tree = ast.parse((ROOT / self.module).read_text(encoding="utf-8"))
        for number, (node, index) in enumerate(places(tree)):
            if number == self.place:
                line = getattr(node, "lineno", 0) if index is None else node.body[index].lineno  # type: ignore[attr-defined]
                what = mistaken(node) if index is None else hushed(node.body, index)  # type: ignore[attr-defined]
                text = ast.unparse(ast.fix_missing_locations(tree)) if what else ""
                return text, f"line {line}: {what}"
        return "", ""


def named(name: str) -> Mutant:
    room, _, rest = name.partition(":")
    module, _, place = rest.partition(":")
    if room in ROOMS and place.isdecimal() and (ROOT / module).is_file():
        mutant = Mutant(room, module, int(place))
        if mutant.text()[0]:
            return mutant
    raise argparse.ArgumentTypeError(f"no mutant {name!r}; a name is ROOM:MODULE:PLACE, as printed")


def draw(room: str, count: int, seed: int) -> list[Mutant]:
    """Draw mistakes for a room, evenly over its code."""
    chance = random.Random(f"{room} {seed}")  # noqa: S311
    found = [
        Mutant(room, path.relative_to(ROOT).as_posix(), place)
        for pattern in ROOMS[room].modules
        for path in sorted((ROOT / "smartcam").glob(pattern))
        for place, _ in enumerate(places(ast.parse(path.read_text(encoding="utf-8"))))
    ]
    chance.shuffle(found)
    return [one for one in found[: count * 10] if one.text()[0]][:count]


# ---------------------------------------------------------------------- who notices


def copy(folder: Path, tests: Path) -> Path:
    """Copy the tree, with the tests of a checkout."""
    for name in TAKEN:
        source = (tests if name in {"tests", "pyproject.toml"} else ROOT) / name
        if source.is_dir():
            leave = shutil.ignore_patterns("__pycache__", "_build")
            shutil.copytree(source, folder / name, ignore=leave)
        else:
            shutil.copy(source, folder / name)
    return folder


def command(folder: Path, room: str, first: str, options: Iterable[str]) -> list[str]:
    """Return the command of a room's tests: those that have the module's name come first."""
    found = [path for one in ROOMS[room].tests for path in sorted(folder.glob(one))]
    files = [file for one in found for file in ([one] if one.is_file() else one.rglob("test_*.py"))]
    files = sorted({*files}, key=lambda one: (first not in one.stem, one))
    names = [str(one.relative_to(folder)) for one in files if one.name not in AWAY]
    plain = ["-q", "-n", "0", "-p", "no:cacheprovider", "-p", "no:randomly"]
    return [sys.executable, "-m", "pytest", *plain, *options, *names]


def environment(folder: Path) -> dict[str, str]:
    """Return that of a process which runs the tests of a copy on its code."""
    return {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}


def failing(folder: Path, room: str, marks: str) -> list[str]:
    """Return pytest's options that leave out what fails without any mistake."""
    options = ["-m", marks, "--tb=no", "-rfE", "--continue-on-collection-errors"]
    call = command(folder, room, "", options)
    ran = subprocess.run(  # noqa: S603
        call, cwd=folder, env=environment(folder), capture_output=True, text=True, check=False
    )
    if ran.returncode not in (0, 1):
        raise SystemExit(
            f"{room}: its tests do not run without a mistake:\n{ran.stdout}{ran.stderr}"
        )
    found = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", ran.stdout, re.MULTILINE)
    for name in found:
        print(f"left out, fails without a mistake: {name}", flush=True)  # noqa: T201
    return [f"--{'deselect' if '::' in name else 'ignore'}={name}" for name in found]


def noticed(folder: Path, mutant: Mutant, text: str, options: Iterable[str]) -> bool:
    """Run the tests on a mutant."""
    path = folder / mutant.module
    whole = path.read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    try:
        with subprocess.Popen(  # noqa: S603
            command(folder, mutant.room, Path(mutant.module).stem, ["-x", *options]),
            cwd=folder,
            env=environment(folder),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        ) as process:
            try:
                return process.wait(LONGEST) != 0
            except subprocess.TimeoutExpired:
                return True
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
    finally:
        path.write_text(whole, encoding="utf-8")


def hunt(mutants: Sequence[Mutant], tests: Path, marks: str, jobs: int) -> Iterator[Mutant]:
    """Give those that no test noticed."""
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as scratch,
        ThreadPoolExecutor(jobs) as pool,
    ):
        trees: SimpleQueue[Path] = SimpleQueue()
        for number in range(jobs):
            (Path(scratch) / str(number)).mkdir()
            trees.put(copy(Path(scratch) / str(number), tests))
        sound = Path(scratch) / "0"
        options = {
            room: ["-m", marks, *failing(sound, room, marks)]
            for room in dict.fromkeys(mutant.room for mutant in mutants)
        }

        def one(mutant: Mutant) -> bool:
            text, what = mutant.text()
            tree = trees.get()
            try:
                seen = noticed(tree, mutant, text, options[mutant.room])
            finally:
                trees.put(tree)
            print(f"{'noticed ' if seen else 'SURVIVES'} {mutant.name} {what}", flush=True)  # noqa: T201
            return seen

        for mutant, seen in zip(mutants, pool.map(one, mutants), strict=True):
            if not seen:
                yield mutant


def main(arguments: Iterable[str]) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rooms", nargs="*", metavar="ROOM", help=f"of {', '.join(ROOMS)}")
    parser.add_argument("--count", type=int, default=40, help="mistakes in each room")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="at once")
    parser.add_argument("--marks", default="", help="tests, as pytest's -m; default: all")
    parser.add_argument("--tests", type=Path, default=ROOT, help="a checkout with other tests")
    parser.add_argument("--only", nargs="+", type=named, metavar="NAME", help="these")
    options = parser.parse_args([*arguments])
    unknown = [room for room in options.rooms if room not in ROOMS]
    if unknown:
        parser.error(f"no room {unknown[0]!r}; there are {', '.join(ROOMS)}")
    if not (options.tests / "tests").is_dir():
        parser.error(f"{options.tests} is no checkout: it has no tests/")
    mutants: list[Mutant] | None = options.only
    if mutants is None:
        rooms = options.rooms or ROOMS
        mutants = [one for room in rooms for one in draw(room, options.count, options.seed)]
    left = [*hunt(mutants, options.tests.resolve(), options.marks, options.jobs)]
    print(f"{len(mutants)} mutants, {len(mutants) - len(left)} noticed; not:")  # noqa: T201
    print(*(one.name for one in left))  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
