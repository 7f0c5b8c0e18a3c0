"""The budgets: work grows with the input and not faster, and every parser has a row."""

from __future__ import annotations

import importlib
import pkgutil
import re
import shutil
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pytest

import smartcam
from tests.budgets import counting
from tests.budgets.__main__ import count_instructions, memory_of, wrong
from tests.budgets.inputs import PAST_LOOKAHEAD
from tests.budgets.modules import OTHERS, PARSERS_OF, reading_modules, without_place
from tests.budgets.parser import Parser, fill
from tests.budgets.table import EXAMPLE, PAGE, PARSERS, budgets, row
from tests.fuzz.fuzz_targets import TARGETS

NEGLIGIBLE_STEPS = 1500
"""Lines of Python that a doubling may add whatever it is."""

IN_CALLGRIND = ("GenICam: descriptions", "RTSP: requests", "layouts", "fleet: patterns of cameras")
"""Parsers whose instructions CI counts; ``python -m tests.budgets`` counts those of all."""

FUZZED = {
    "framing": "frames of a camera, handbook",
    "messages": "frames of a camera, handbook",
    "machine": "frames of a camera, handbook",
    "camera": "frames of a client, handbook",
    "makes": "ifm: frames of a device",
    "layout": "layouts",
    "layout_file": "layouts as YAML",
    "interpreters": "containers: localizations",
    "scenario": "scenarios",
    "address": "",  # the program's own option
    "spec": "layouts",
    "cell_file": "cell files",
    "gs1": "GS1 elements",
    "program_result": "containers: record",
}
"""By target of the fuzzing: the row of the table."""

each_parser = pytest.mark.parametrize("parser", PARSERS.values(), ids=list(PARSERS))

# what reads YAML needs larger inputs; in the short run the row of YAML stands for all
each_parser_in_turn = pytest.mark.parametrize(
    "parser",
    [
        pytest.param(one, marks=[pytest.mark.long, pytest.mark.widest] if large else [])
        for one in PARSERS.values()
        if one.name != "YAML"
        for large in [one.short == PAST_LOOKAHEAD]
    ],
    ids=lambda one: one.name,
)


def needed(parser: Parser) -> None:
    if parser.missing:
        pytest.skip(f"{', '.join(parser.missing)}: not installed")


@pytest.mark.sampled(every=3)
@each_parser_in_turn
def test_parser_twice_the_input_takes_twice_the_steps_at_most(parser: Parser) -> None:
    grows_no_faster(parser, 1)


def test_yaml_twice_the_input_takes_twice_the_steps_at_most() -> None:
    grows_no_faster(PARSERS["YAML"], 6)


def grows_no_faster(parser: Parser, every: int) -> None:
    needed(parser)
    for kind, make in list(parser.inputs.items())[::every]:
        if kind in parser.refused_from or kind.startswith("YAML: "):
            continue  # such inputs are large, or the row of YAML has them: the long run counts them
        grown = counting.grow(parser, make, counting.steps, min(parser.size, parser.short))
        assert not grown.is_faster or grown.added < NEGLIGIBLE_STEPS, (kind, grown)


@pytest.mark.long
@pytest.mark.widest
@each_parser
def test_parser_twice_the_input_takes_twice_the_steps_at_most_in_full(parser: Parser) -> None:
    needed(parser)
    for kind, make in parser.inputs.items():
        grown = counting.grow(parser, make, counting.steps, parser.start(kind))
        assert not grown.is_faster or grown.added < NEGLIGIBLE_STEPS, (kind, grown)


@pytest.mark.long
@pytest.mark.widest
@each_parser
def test_parser_takes_the_memory_of_its_budget(parser: Parser) -> None:
    needed(parser)
    most = budgets()[parser.name].memory
    assert {kind: one for kind, one in memory_of(parser.name).items() if one > most} == {}


@pytest.mark.long
@pytest.mark.widest
@pytest.mark.parametrize("name", IN_CALLGRIND)
def test_parser_takes_the_instructions_of_its_budget(name: str) -> None:
    if shutil.which("valgrind") is None:
        pytest.skip("valgrind is not installed: it counts instructions")
    known = budgets()[name]
    found = count_instructions([name])[name]
    assert set(found) == set(PARSERS[name].inputs)
    assert [text for kind, one in found.items() for text in wrong(name, kind, one, known)] == []


def test_counting_finds_work_that_goes_with_the_square() -> None:
    def parse(data: bytes) -> None:
        for end in range(len(data)):
            for _ in range(end // 16):
                pass

    parser = Parser("square", parse, {}, 1 << 20, "", size=64)
    assert counting.grow(parser, fill(b"a"), counting.steps, 64).factor > 3.5


@pytest.mark.parametrize(
    ("counts", "is_faster"),
    [
        ((1000, 2000, 4000), False),
        ((1248, 2269, 4720), False),  # a buffer that got longer saved some work at the second size
        ((100, 400, 1600), True),  # n squared
        ((1_000_100, 1_000_400, 1_001_600), True),  # the same beside a large cost at any size
        ((1010, 2040, 4160), False),
        ((1200, 2800, 7200), True),  # n and a fifth of n squared
    ],
)
def test_growth_that_is_even_by_the_byte_is_none(counts: tuple[int, ...], is_faster: bool) -> None:
    assert counting.Growth((1000, 2000, 4000), counts).is_faster == is_faster


@pytest.mark.long
@pytest.mark.widest
def test_instructions_show_text_that_is_copied_for_each_piece() -> None:
    if shutil.which("valgrind") is None:
        pytest.skip("valgrind is not installed: it counts instructions")
    grown = count_instructions([EXAMPLE.name])[EXAMPLE.name]["pieces"]
    assert len(wrong(EXAMPLE.name, "pieces", grown, None)) == 1


# ---------------------------------------------------------------------- the table


def test_page_has_a_row_for_each_parser_as_the_code_has_it() -> None:
    known = budgets()
    assert set(known) == set(PARSERS)
    text = "\n".join(
        row(PARSERS[name], one.instructions, one.memory) for name, one in known.items()
    )
    assert text in PAGE.read_text(encoding="utf-8"), "python -m tests.budgets --write"


@each_parser
def test_bound_is_a_constant_of_the_code(parser: Parser) -> None:
    path = parser.bound.partition(",")[0]
    if re.fullmatch(r"[a-z_0-9.]+\.[A-Z_]+", path) is None:
        assert ":" in parser.bound or " " in parser.bound  # a reason
        return
    place, _, name = path.rpartition(".")
    value = getattr(importlib.import_module(f"smartcam.{place}"), name)
    assert path != parser.bound or value == parser.largest


def test_each_target_of_the_fuzzing_has_a_row() -> None:
    assert set(FUZZED) == set(TARGETS)
    assert {one for one in FUZZED.values() if one} <= set(PARSERS)


def test_each_module_that_reads_bytes_or_text_has_a_row() -> None:
    found = reading_modules()
    assert [one for one in found if without_place(one)] == []
    assert set(PARSERS_OF.values()) <= set(PARSERS)
    assert [one for one in PARSERS_OF if one not in found] == []
    assert [one for one in OTHERS if not any(f"{m}.".startswith(f"{one}.") for m in found)] == []


# ---------------------------------------------------------------------- regular expressions

REVIEWED = {
    "_cli.byte_text": "0x begins each repetition",
    "_file_values": "a slash begins each repetition",
    "ros2._types.definitions": "an underscore begins each repetition",
    "layout._text": "nothing stands behind it that could fail",
    "_ros_names": "a slash begins each repetition; names are short",
}
"""By module: why a pattern that repeats what repeats takes no long time."""


@pytest.mark.long
def test_no_pattern_repeats_what_repeats() -> None:
    # where both may take the same character, there are ways without number to fail
    found = {name for name, pattern in _patterns() if _nested(_parsed(pattern), 0)}
    assert found == set(REVIEWED)


def _patterns() -> Iterator[tuple[str, re.Pattern[Any]]]:
    for module in _modules():
        for value in vars(module).values():
            several = value.values() if isinstance(value, dict) else [value]
            for one in several:
                if isinstance(one, re.Pattern):
                    yield module.__name__.removeprefix("smartcam."), one


def _modules() -> Iterator[ModuleType]:
    for info in pkgutil.walk_packages(smartcam.__path__, "smartcam."):
        if info.name.endswith("__main__") or ".test_" in info.name:
            continue
        try:
            yield importlib.import_module(info.name)
        except ImportError:
            continue  # of an extra that is not installed, or another system


def _parsed(pattern: re.Pattern[Any]) -> Any:
    parser: Any = importlib.import_module("re._parser")
    return parser.parse(pattern.pattern, pattern.flags)


def _nested(parts: Any, depth: int) -> bool:
    for operation, argument in parts:
        name = str(operation)
        if name in ("MAX_REPEAT", "MIN_REPEAT"):
            many = int(argument[1]) > 30
            if (many and depth) or _nested(argument[2], depth + many):
                return True
        elif name == "SUBPATTERN":
            if _nested(argument[3], depth):
                return True
        elif name == "BRANCH":
            if any(_nested(one, depth) for one in argument[1]):
                return True
        elif name in ("ASSERT", "ASSERT_NOT") and _nested(argument[1], depth):
            return True
    return False
