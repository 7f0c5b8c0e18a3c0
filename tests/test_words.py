"""The texts of the package: what can be checked of how they read.

A text that begins in the middle of a sentence, or stands for its subject by a pronoun, makes a
reader open the lines around it.
"""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Callable, Iterator
from functools import cache, wraps
from typing import NamedTuple

import pytest

from tests import ROOT
from tests.imports import package, statements


class Text(NamedTuple):
    """A text and where it stands."""

    module: str
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.module}:{self.line}: {self.text.splitlines()[0]}"


def found_once(search: Callable[[], Iterator[Text]]) -> Callable[[], tuple[Text, ...]]:
    """Have a search through the package be made once for all tests."""
    return cache(wraps(search)(lambda: tuple(search())))


@found_once
def constants() -> Iterator[Text]:
    """Yield the text behind each assignment of a module or a class."""
    for module, tree in package().items():
        for owner in statements(tree):
            if not isinstance(owner, ast.Module | ast.ClassDef):
                continue
            for before, node in zip(owner.body, owner.body[1:], strict=False):
                if isinstance(before, ast.Assign | ast.AnnAssign) and (text := text_of(node)):
                    yield Text(module, node.lineno, text.strip())


def text_of(node: ast.stmt) -> str:
    """Return the text of a statement that is nothing but a text, else ''."""
    value = node.value if isinstance(node, ast.Expr) else None
    found = value.value if isinstance(value, ast.Constant) else None
    return found if isinstance(found, str) else ""


@found_once
def docstrings() -> Iterator[Text]:
    """Yield the docstring of each module, class and function."""
    for module, tree in package().items():
        for node in statements(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text:
                    yield Text(module, node.body[0].lineno, text)


ENTRY = re.compile(r"^    (?:\*{0,2}[\w, ]+): (.+)$", re.MULTILINE)


def entries(*sections: str) -> Iterator[Text]:
    """Yield the first line of what is said of each attribute and argument, or in sections."""
    for module, line, text in docstrings():
        for section in re.split(r"^(?=\w+:$)", text, flags=re.MULTILINE):
            if section.startswith(sections or ("Args:", "Attributes:")):
                for one in ENTRY.findall(section):
                    yield Text(module, line, one)


def errors() -> Iterator[Text]:
    """Yield the first line of the cause of each error that a function raises."""
    yield from entries("Raises:")


FRAGMENT = re.compile(r"(Of|The same|This|That|Those|These|In which|By which|At which|Of which)\b")
PRONOUN = re.compile(r"(it|its|they|them|that|those|the same|which|whose|who)[.;,:]?(\s|$)")
CLAUSE = re.compile(r"(Return|Yield|Say|Tell) (what|who|whose|whether|how|where|which)\b")


def test_constants_are_explained_by_sentences() -> None:
    found = [one for one in constants() if FRAGMENT.match(one.text)]
    assert not found, "\n".join(map(str, found))


def test_attributes_are_explained_by_nouns() -> None:
    found = [one for one in entries() if PRONOUN.match(one.text)]
    assert not found, "\n".join(map(str, found))


def test_functions_say_what_they_return_by_a_noun() -> None:
    found = [one for one in docstrings() if CLAUSE.match(one.text)]
    assert not found, "\n".join(map(str, found))


HALF = {
    "an argument is said by a noun, not by 'of ...'": (entries, r"^(of|for|in|by) (?!ten )"),
    "a function is called one": (entries, r"^(returns|makes|called)\b"),
    "an error is said of a noun": (errors, r"^(it|they|that|none|one(?! of)|there is none)\b"),
    "'is none' says nothing of what it is not": (
        docstrings,
        r"(?<!there) (is|are|was|were) none\b",
    ),
    "a first line names its object": (docstrings, r"^(?!Is )[A-Z]\w+ (it|its|them|their)\b"),
    "'in here' may be a module or a folder": (docstrings, r"\bin here\b"),
    "'cannot be' what?": (docstrings, r"\b(topic|name|value|URL|domain|range) cannot be[.,;]"),
    "'who' is no noun": (docstrings, r"\b(of|for|to|by|from|with|at) who\b"),
    "whose are ours?": (docstrings, r"\b(error|errors|file|recording|bag) of ours\b"),
    "one word in two spellings": (docstrings, r"\bfor ever\b"),
}
"""Ways to say half a thing: what is wrong, where it is looked for, and how it is found."""

IDIOM = re.compile(r" (is|are|was|were) none of\b")
"""Part of a whole sentence that a pattern of :data:`HALF` finds, too."""


@pytest.mark.parametrize("wrong", HALF)
def test_texts_say_whole_things(wrong: str) -> None:
    texts, pattern = HALF[wrong]
    found = [
        one for one in texts() if re.search(pattern, IDIOM.sub("", " ".join(one.text.split())))
    ]
    assert not found, "\n".join(map(str, found))


TIMES = {
    *("AFTER", "AGE", "DEADLINE", "DELAY", "DELAYS", "DURATION", "GRACE", "INTERVAL", "LATENCY"),
    *("LINGER", "PAUSE", "PERIOD", "PERIODS", "RESOLUTION", "SECONDS", "TIME", "TIMEOUT"),
    *("TIMEOUTS", "WAIT", "WITHIN"),
}
"""Words of which one stands in the name of each constant that counts seconds."""

UNITS = {"Milliseconds": "MS", "Microseconds": "US", "Nanoseconds": "NS"}
"""Ends of the names of constants that count times in another unit, by the unit."""


class Named(NamedTuple):
    """A constant, and the text that explains it."""

    module: str
    name: str
    text: str

    @property
    def says_its_unit(self) -> bool:
        """True if the name says that it is a time, where the text counts one."""
        unit, parts = self.text.split()[0].rstrip(".:"), self.name.split("_")
        if unit == "Seconds":
            return not TIMES.isdisjoint(parts)
        return unit not in UNITS or parts[-1] == UNITS[unit]


def named_constants() -> Iterator[Named]:
    """Yield each constant in capitals with its text."""
    for module, tree in package().items():
        for owner in statements(tree):
            if isinstance(owner, ast.Module | ast.ClassDef):
                for before, node in zip(owner.body, owner.body[1:], strict=False):
                    target = target_of(before)
                    if target.isupper() and (text := text_of(node).strip()):
                        yield Named(module, target, text)


def target_of(node: ast.stmt) -> str:
    """Return the name that a statement assigns to, else ''."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return targets[0].id if isinstance(targets[0], ast.Name) else ""


def test_names_of_times_say_that_they_are_times() -> None:
    wrong = [named for named in named_constants() if not named.says_its_unit]
    assert [f"{named.module}.{named.name}: {named.text}" for named in wrong] == []


COUNTED = re.compile(
    r"(Largest|Least) number of (bytes|characters)\b|[^.]*\bat most this many (bytes|characters)\b"
)
"""Texts that count something whose name belongs into the constant's own."""

COUNTING_WORDS = {"bytes": {"BYTES"}, "characters": {"CHARACTERS", "LENGTH"}}
"""Words of which one stands in the name of each constant that bounds bytes or characters."""

MANY_THINGS = {"smartcam.ros2._node.parameters", "smartcam.layout._text", "smartcam.protocols"}
"""Modules with a constant that bounds several things, or whose public name has no unit."""


def test_names_of_bounds_say_what_they_count() -> None:
    wrong = []
    for one in named_constants():
        if (found := COUNTED.match(one.text)) and not one.module.startswith(tuple(MANY_THINGS)):
            words = COUNTING_WORDS[found[2] or found[3]]
            if words.isdisjoint(one.name.split("_")):
                wrong.append(f"{one.module}.{one.name}: {one.text}")
    assert not wrong, "\n".join(wrong)


VERBLESS = re.compile(r"[A-Z]\w+ [^.:;]* at (most|least)([.:;,]|$)")
BOUNDING = re.compile(r"\b(has|have|is|are|may|must|can|needs?|takes?|holds?|keeps?|reach(es)?)\b")


def test_bounds_are_explained_by_sentences() -> None:
    found = [
        one
        for one in constants()
        if VERBLESS.match(one.text) and not BOUNDING.search(VERBLESS.match(one.text)[0])  # type: ignore[index]
    ]
    assert not found, "\n".join(map(str, found))


OPENING = re.compile(r"(What|Who|Whose|Whether|Where|Which|How|When|Why|It)\b")


def test_first_lines_name_what_they_are_about() -> None:
    found = [one for one in (*docstrings(), *constants()) if OPENING.match(one.text)]
    assert not found, "\n".join(map(str, found))


QUESTION = re.compile(r'^\s*"""(What|Who|Whose|Whether|Where|Which|How|When|Why)\b')


def test_texts_of_the_tests_name_what_they_are_about() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in sorted((ROOT / "tests").rglob("*.py"))
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if QUESTION.match(line)
    ]
    assert not found, "\n".join(found)


HAPPENING = re.compile(r"(The|A|An|In here|No|Nothing|There|Each|All|From|These|Another) ")


SHOWN = ("smartcam.conformance.", "smartcam.emulator._generators")
"""Modules whose docstrings are shown to people: rules of the judges, names of generators."""


def plain_functions() -> Iterator[Text]:
    """Yield the first lines of functions without a decorator, by which others show docstrings."""
    for module, tree in package().items():
        for node in [] if module.startswith(SHOWN) else statements(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.decorator_list:
                text = ast.get_docstring(node)
                if text:
                    yield Text(module, node.lineno, text)


def test_functions_begin_with_a_verb() -> None:
    found = [one for one in plain_functions() if HAPPENING.match(one.text)]
    assert not found, "\n".join(map(str, found))


ENTRY_NAMES = re.compile(r"^    ((?:\*{0,2}\w+)(?:, \*{0,2}\w+)*): ", re.MULTILINE)
"""Names in front of the explanations of a section."""


def explained_arguments(node: ast.AST) -> set[str]:
    """Return the names that the section ``Args`` of a docstring explains."""
    if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return set()
    sections = re.split(r"^(?=\w+:$)", ast.get_docstring(node) or "", flags=re.MULTILINE)
    text = "".join(section for section in sections if section.startswith("Args:"))
    names = {name.strip(" *") for match in ENTRY_NAMES.findall(text) for name in match.split(",")}
    return names - {"None"}


def arguments_of(node: ast.AST) -> set[str] | None:
    """Return the arguments of a function, or of a class' own initializer; None without one."""
    if isinstance(node, ast.ClassDef):
        return next(
            (
                arguments_of(part)
                for part in node.body
                if isinstance(part, ast.FunctionDef) and part.name in {"__init__", "__new__"}
            ),
            None,
        )
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return {part.arg for part in ast.walk(node.args) if isinstance(part, ast.arg)}
    return None


def test_explained_arguments_exist() -> None:
    found = [
        f"{module}:{node.lineno}: {', '.join(sorted(explained - names))}"  # type: ignore[attr-defined]
        for module, tree in package().items()
        for node in statements(tree)
        if (explained := explained_arguments(node))
        and (names := arguments_of(node)) is not None
        and not explained <= names
    ]
    assert not found, "\n".join(found)


UNNAMED = {"one", "found", "came", "it", "said", "told", "heard", "mine", "theirs"}
"""Names of loop variables that do not name the thing that they hold."""


def loop_variables(tree: ast.AST) -> Iterator[ast.Name]:
    """Yield the variables of loops and comprehensions, pairs such as ``one, other`` left out."""
    for node in ast.walk(tree):
        if isinstance(node, ast.For | ast.AsyncFor | ast.comprehension):
            names = [part for part in ast.walk(node.target) if isinstance(part, ast.Name)]
            if not {"one", "other"} <= {name.id for name in names}:
                yield from names


def test_loop_variables_name_what_they_hold() -> None:
    found = [
        f"{module}:{name.lineno}: {name.id}"
        for module, tree in package().items()
        for name in loop_variables(tree)
        if name.id in UNNAMED
    ]
    assert not found, "\n".join(found)


def test_code_in_docstrings_is_whole() -> None:
    """A block that begins as Python is Python to its end: no lines were joined."""
    starts = (ast.Assign, ast.AsyncWith, ast.With, ast.Import, ast.ImportFrom)
    broken = []
    for text in docstrings():
        for block in re.findall(r"::\n\n((?: {4}.*\n|\n)+)", f"{text.text}\n"):
            lines = textwrap.dedent(block).strip().splitlines()
            first = lines[0] + ("\n    pass" if lines[0].endswith(":") else "")
            if isinstance(parsed(f"async def _():\n{textwrap.indent(first, '    ')}"), starts):
                whole = textwrap.indent("\n".join(lines), "    ")
                if parsed(f"async def _():\n{whole}") is None:
                    broken.append(str(text))
    assert not broken, "\n".join(broken)


def parsed(code: str) -> ast.AST | None:
    """Return the first statement of a function, None if the code is not Python."""
    try:
        function = ast.parse(code).body[0]
    except SyntaxError:
        return None
    return function.body[0] if isinstance(function, ast.AsyncFunctionDef) else None
