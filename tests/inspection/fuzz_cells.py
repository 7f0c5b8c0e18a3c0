"""Targets of inspection: ``cell_file``, ``gs1`` and ``program_result``.

- ``cell_file``: any text as a cell file: cameras whose programs have a layout, or an error that
  names the file; what is taught is what is read again. Input: the file.
- ``gs1``: any text as GS1 elements, which together are the text. Input: the text.
- ``program_result``: the container of a program whatever its tools say, and of one that failed
  with any reason. Input: a byte that says which program, the values, the reason.
"""

from __future__ import annotations

import functools
import math
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.inspection import Picture, Program, load_cell
from smartcam.inspection._inside import Teaching
from tests.fuzz.fuzz_input import Choices, text_of
from tests.fuzz.fuzz_scenario import measured, scratch
from tests.inspection.inside import (
    GS,
    MAX_REASON_BYTES,
    failed_values,
    frame_inspector,
    gs1,
    split_elements,
)

if TYPE_CHECKING:
    from smartcam.inspection import Inspection

INSPECTOR = frame_inspector
"""Module of the function that cuts reasons."""

PROGRAMS = """
cameras:
  cam:
    software:
      frames: .
      applications:
        1: {present: {grey: [0, 90], most: 3}}
        2: {read: {codes: [QRCode], least: 0, most: 2}}
        3: {sequence: true, present: {grey: [0, 90]}, measure: {edge: {across: [[1, 2], [9, 2]]}}}
        4: {measure: {line: {along: [[2, 2], [2, 12]], strips: 4}}}
"""

ODD: tuple[Any, ...] = (
    *(0, 1, -1, 255, 1 << 15, 1 << 31, 1 << 32, 1 << 64, 0.5, math.nan, math.inf, -math.inf),
    *("", "x", "\0", "a" * 100, "\u00fc" * 50, "\udc80", True, None, b"x", [], (1, 2)),
)
"""Values that a user's tool may return."""


def check_cell_file(data: bytes) -> None:
    """Read a cell file: its programs have layouts, or the error names the file."""
    inspections()  # loads the tools, which takes memory once
    path = scratch()
    path.write_bytes(data)
    try:
        with measured() if b"&" in data else nullcontext():
            cells = load_cell(path)
    except ConfigurationError as error:
        text = str(error)
        assert text.startswith(f"cell {path}")
        assert "MemoryError" not in text, "too much memory for one file"
        return
    for name, cell in cells.items():
        for number, program in cell.programs.items():
            assert program.layout.text == program.interpret_as
            assert cell.program(number) is program
            check_teaching(name, number, program)
            return  # of one, which takes time


def check_teaching(name: str, number: int, program: Program) -> None:
    """Assert that a saved file means the same as before, or is refused and changes nothing."""
    path = scratch()
    before = path.read_bytes()
    try:
        teaching = Teaching(path, name, number)
        teaching.save(teaching.tools)
    except ConfigurationError:
        assert path.read_bytes() == before
        return
    assert load_cell(path)[name].programs[number].interpret_as == program.interpret_as


def first_element(text: str) -> tuple[tuple[str, str], ...]:
    """Return only the first element, as a planted mistake."""
    return gs1.split_elements(text)[:1]


def check_gs1(data: bytes) -> None:
    """Check that a text's elements are whole, and that joined they are the text."""
    text = text_of(data)
    found = split_elements(text)
    assert "".join(one + other for one, other in found).replace(GS, "") == text.replace(GS, "")
    for place, (identifier, value) in enumerate(found):
        if not identifier:
            assert place == len(found) - 1
            continue
        assert identifier.isascii()
        assert identifier.isdigit()
        assert 2 <= len(identifier) <= 4
        assert value
        assert GS not in value


@functools.cache
def inspections() -> tuple[tuple[Program, Inspection], ...]:
    """Return the programs with an inspection of each."""
    path = scratch()
    path.write_text(PROGRAMS, encoding="utf-8")
    picture = Picture(np.full((24, 32), 50, np.uint8))
    programs = load_cell(path)["cam"].programs.values()
    return tuple((one, one.inspect(picture)) for one in programs)


def check_program_result(data: bytes) -> None:
    """Check that containers of odd values are readable, or a typed error."""
    choices = Choices(data)
    program, seen = choices.pick(inspections())
    values = dict(seen.values)
    for _ in range(choices.byte() % 4):
        name = choices.pick([*values])
        values[name] = choices.pick(ODD)
    try:
        payload = replace(seen, values=values).payload(sequence=choices.pick((None, 0, 7, 1 << 31)))
    except SmartCamError:
        pass
    else:
        program.layout.parse(payload)
    failed = failed_values(program, text_of(choices.rest()))
    try:
        record = program.layout.parse(program.layout.build(failed))
    except ConfigurationError as error:
        raise AssertionError("a failed program has no result") from error
    assert record.ok is False
    assert len(record.reason.encode()) <= MAX_REASON_BYTES
