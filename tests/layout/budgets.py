"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

from smartcam.emulator import load_scenario
from smartcam.fleet import load_fleet
from smartcam.inspection import load_cell
from smartcam.layout import Layout
from smartcam.layout._inside import load, pack_texts
from tests.budgets.inputs import MERGED, PAST_LOOKAHEAD, YAML, laughs_of
from tests.budgets.parser import Make, Parser, fill_text, from_file, grown
from tests.layout.inside import MAX_TEXT_CHARACTERS as MAX_LAYOUT
from tests.layout.inside import MAX_YAML_TEXT_CHARACTERS

_LAYOUTS: dict[str, Make] = {
    "fields": fill_text("f{}: int8, ", tail="z: int8"),
    "records": fill_text("f{}: real32 mm, ", "n: uint8, (", "z: int8)[n]"),
    "comments": fill_text("#\n", tail="a: int8"),
    "spaces": fill_text(" ", "a:", "int8"),
    "a long name": fill_text("a", tail=": int8"),
    "a name that is none": fill_text("a", "1"),
    "opening brackets": fill_text("("),
    "digits": fill_text("9", "a: string[", "]"),
    "a type that is none": fill_text("t", "a: "),
    "one name again and again": fill_text("a: int8,"),
}

_CELLS: dict[str, Make] = {
    "numbers": grown(lambda count: [f"{at % 9}" for at in range(count)], 1),
    "long numbers": grown(lambda count: ["1" * 100] * count, 100),
    "one long number": lambda size: ["1" * size],
    "one number of zeros": lambda size: ["0." + "0" * size],
}


def _pack(cells: list[str]) -> None:
    pack_texts(Layout("(x: real32)*"), [(f"A{at}", text) for at, text in enumerate(cells)])
    pack_texts(Layout("(x: int32)*"), [(f"A{at}", text) for at, text in enumerate(cells)])


_SCENARIO = "name: a\nseed: 1\n"

_SCENARIOS: dict[str, Make] = {
    **{
        f"YAML: {kind}": YAML[kind]
        for kind in ("a long list", "nested brackets", "aliases of aliases", "complex keys", MERGED)
    },
    "unknown fields": fill_text("field{}: 1\n", _SCENARIO),
    "applications": fill_text("- {id: {}, layout: 'x: int32'}\n", _SCENARIO + "applications:\n"),
    "wrong applications": fill_text("- {id: x, nothing{}: 1}\n", _SCENARIO + "applications:\n"),
    "faults": fill_text("- {kind: drop, on: Trigger}\n", _SCENARIO + "faults:\n"),
    "wrong faults": fill_text("- {kind: no, on: 1, x{}: 2}\n", _SCENARIO + "faults:\n"),
    "cues": fill_text("- {at: {}, do: []}\n", _SCENARIO + "timeline:\n"),
    "a key of many letters": fill_text("k", _SCENARIO, ": 1\n"),
    "aliases as a key": lambda size: f"x:\n{laughs_of(size)}? [*a9]\n: 1\n",
    "lists as a key": lambda size: "? " + "[" * 20 + "a, " * (size // 3) + "]" * 20 + "\n: 1\n",
}

_FLEETS: dict[str, Make] = {
    "cameras": fill_text("  c{}: bvs://h{}\n", "fleet: a\nname: a\ncameras:\n"),
    "wrong cameras": fill_text("  c{}: {url: 1, no{}: 2}\n", "name: a\ncameras:\n"),
    "unknown fields": fill_text("field{}: 1\n"),
    "endpoints": fill_text("- tcp/h:{}\n", "name: a\nlisten:\n"),
    "patterns that match twice": fill_text(
        "**/", "name: a\nrecord: {folder: x, cameras: ['", "!']}\n"
    ),
    "keys that are aliases": lambda size: f"x:\n{laughs_of(size)}? [*a9]\n: 1\n",
}

_APPLICATIONS = "cameras:\n  c:\n    software:\n      frames: x\n      applications:\n"

_CELL_FILES: dict[str, Make] = {
    "cameras": fill_text(
        "  c{}: {software: {frames: x, applications: {7: {present: {grey: [0, 9]}}}}}\n",
        "cameras:\n",
    ),
    "cameras of a fleet": fill_text("  c{}: {url: bvs://h{}}\n", "cameras:\n"),
    "applications": fill_text("        {}: {present: {grey: [0, 9]}}\n", _APPLICATIONS),
    "wrong applications": fill_text("        {}: {no{}: 1}\n", _APPLICATIONS),
    "applications that follow": lambda size: (
        _APPLICATIONS
        + "".join(
            f"        {n}: {{name: n{n}, present: {{grey: [0, 9], follow: n{n + 1}}}}}\n"
            for n in range(size // 60)
        )
    ),
    "tools": fill_text("          present t{}: {grey: [0, 9]}\n", f"{_APPLICATIONS}        7:\n"),
    "settings": fill_text("s{}: 1, ", f"{_APPLICATIONS}        7: {{read: {{", "}}\n"),
    "corners of a region": fill_text(
        "[{}, 1], ", f"{_APPLICATIONS}        7: {{read: {{region: [", "]}}\n"
    ),
    "a pattern": fill_text("(a+)", f"{_APPLICATIONS}        7: {{read: {{expect: '", "'}}\n"),
    "repetitions in a pattern": fill_text(
        "(", f"{_APPLICATIONS}        7: {{read: {{expect: '", "a+)+'}}\n"
    ),
}

PARSERS: tuple[Parser, ...] = (
    Parser("layouts", Layout, _LAYOUTS, MAX_LAYOUT, "layout._text.MAX_TEXT_CHARACTERS", size=4000),
    Parser(
        "layouts as YAML",
        Layout.from_yaml,
        {
            "fields": fill_text("- {name: f{}, type: int8}\n", "fields:\n"),
            "wrong fields": fill_text("- {name: 1, no: {}}\n", "fields:\n"),
            **{
                f"YAML: {kind}": YAML[kind]
                for kind in ("keys", "aliases of aliases", "nested brackets")
            },
        },
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yaml_parsing.MAX_YAML_TEXT_CHARACTERS",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
    ),
    Parser(
        "cells of a spreadsheet",
        _pack,
        _CELLS,
        1024 * 4096,
        "protocols._insight.words.MAX_CELLS, MAX_LINE",
    ),
    Parser(
        "YAML",
        load,
        YAML,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yaml_parsing.MAX_YAML_TEXT_CHARACTERS",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
        refused_from={MERGED: 20_000},
    ),
    Parser(
        "scenarios",
        from_file(load_scenario, "a.yaml"),
        _SCENARIOS,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yaml_parsing.MAX_YAML_TEXT_CHARACTERS",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
        refused_from={f"YAML: {MERGED}": 20_000},
    ),
    Parser(
        "fleet files",
        from_file(load_fleet, "a.yaml"),
        _FLEETS,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yaml_parsing.MAX_YAML_TEXT_CHARACTERS",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
    ),
    Parser(
        "cell files",
        from_file(load_cell, "a.yaml"),
        _CELL_FILES,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yaml_parsing.MAX_YAML_TEXT_CHARACTERS",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml", "cv2", "zxingcpp"),
    ),
)
