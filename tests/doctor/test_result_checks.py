"""Test the doctor's checks of results: the layout, its dump, and values that are not SI."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest

from smartcam.doctor._inside import Finding
from smartcam.doctor._result_checks import MAX_ROWS, PLAUSIBILITY_LIMITS, DumpRow, dump_container
from smartcam.emulator import Application, EmulatedCamera, faults
from smartcam.layout import Layout
from tests import ROOT
from tests.doctor.doctorkit import errors, examined, finding_of, severities
from tests.doctor.inside import Exit


async def read(layout: str, values: Any, interpret_as: str | None, **more: Any) -> list[Finding]:
    """Return the findings about a camera that sends ``values`` in ``layout``."""
    application = Application(
        id=2, layout=layout, constant=values, load_time=0, processing_time=0.001
    )
    async with EmulatedCamera([application], running=True, **more) as emulator:
        return await examined(emulator.url, trigger=True, count=2, interpret_as=interpret_as)


# ---------------------------------------------------------------------- the layout


async def test_layout_that_fits_is_well() -> None:
    findings = await read("n: int32", {"n": 5}, "n: int32")
    found = finding_of(findings, "layout")
    assert (found.severity, found.text) == ("ok", "2 results fit the layout 'n: int32'")


async def test_layout_that_differs_is_reported_with_sizes_and_bytes_beside_its_fields() -> None:
    text = "passed: bool, n: int32, x: real32 mm"
    findings = await read("n: int32, text: string[3]", {"n": 5, "text": "abc"}, text)
    assert errors(findings) == [("layout", Exit.UNREADABLE)]
    found = finding_of(findings, "layout")
    assert "The layout has 9 bytes, 7 came" in found.text
    assert "field 'x' (real32 mm) at offset 5" in found.text
    assert (found.details["expected"], found.details["received"]) == ("9 bytes", 7)
    assert found.details["dump"] == [
        DumpRow(0, "passed: bool", "05", 5),
        DumpRow(1, "n: int32", "00 00 00 61", 0x61000000),
        DumpRow(5, "x: real32 mm", "62 63", "2 of 4 bytes are missing"),
    ]


@pytest.mark.parametrize(
    ("layout", "expected"),
    [
        ("(x: uint8, y: uint8)[2]", "4 bytes"),
        ("(x: int16)*", "whole records of 2 bytes"),
        ("n: uint8, (x: uint8, y: uint32)*", "1 bytes and whole records of 5 bytes"),
    ],
)
async def test_size_that_a_layout_expects_is_reported(layout: str, expected: str) -> None:
    findings = await read("text: string[7]", {"text": "abc"}, layout)
    found = finding_of(findings, "layout")
    assert (found.details["expected"], found.details["received"]) == (expected, 7)


async def test_layout_of_the_right_size_with_a_wrong_type_is_reported() -> None:
    findings = await read("n: int32", {"n": 5}, "a: bool, b: string[3]")
    assert errors(findings) == [("layout", Exit.UNREADABLE)]
    found = finding_of(findings, "layout")
    assert "expected 0x00 or 0xFF" in found.text
    assert found.details["offset"] == 0


async def test_layout_is_compared_in_the_cameras_byte_order() -> None:
    status = faults.Insert(
        on="StatusReport",
        message="StatusReport",
        fields={"status": 0x280, "endian": 1},
        where="instead",
        times=None,
    )
    application = Application(
        id=2, layout="x: real32", constant={"x": 0.5}, rate=100, load_time=0, processing_time=0
    )
    async with EmulatedCamera([application], running=True, faults=[status]) as emulator:
        emulator.device.set_endian(1)
        findings = await examined(emulator.url, interpret_as="x: real32", seconds=0.1)
    assert severities(findings, "values") == []
    assert finding_of(findings, "layout").severity == "ok"


async def test_byte_order_that_is_none_is_an_error() -> None:
    status = faults.Insert(
        on="StatusReport",
        message="StatusReport",
        fields={"status": 0x280, "endian": 7},
        where="instead",
        times=None,
    )
    application = Application(
        id=2, layout="n: int32", constant={"n": 1}, rate=100, load_time=0, processing_time=0
    )
    async with EmulatedCamera([application], running=True, faults=[status]) as emulator:
        findings = await examined(emulator.url, seconds=0.1)
    assert errors(findings) == [("layout", Exit.UNREADABLE)]
    assert "endian field is 7" in finding_of(findings, "layout").text


async def test_layout_without_a_result_is_a_hint() -> None:
    async with EmulatedCamera(active=21, running=True) as emulator:
        found = finding_of(await examined(emulator.url, interpret_as="n: int32"), "layout")
    assert found.severity == "hint"
    assert found.text == "no result came, so the layout was not compared with one"


async def test_results_without_a_layout_are_shown_as_bytes() -> None:
    found = finding_of(await read("n: int32", {"n": 5}, None), "layout")
    assert found.text.startswith("2 results looked at, of 4 bytes: 05 00 00 00; ")
    assert found.details == {"sizes": [4], "first": bytes.fromhex("05000000")}


async def test_interpreter_without_a_layout_reads_them() -> None:
    found = finding_of(await read("n: int32", {"n": 5}, "raw"), "layout")
    assert found.text == "2 results were read"


# ---------------------------------------------------------------------- bytes beside fields


def test_dump_container_names_what_is_too_many() -> None:
    assert dump_container(Layout("n: int16"), bytes.fromhex("0100 ff01")) == [
        DumpRow(0, "n: int16", "01 00", 1),
        DumpRow(2, "(no field)", "ff 01", "2 bytes too many"),
    ]


def test_dump_container_numbers_records_after_the_head() -> None:
    layout = Layout("n: uint8, (x: uint8, name: string[2])*")
    assert dump_container(layout, b"\x02\x07ab\x08c") == [
        DumpRow(0, "n: uint8", "02", 2),
        DumpRow(1, "[0].x: uint8", "07", 7),
        DumpRow(2, "[0].name: string[2]", "61 62", "ab"),
        DumpRow(4, "[1].x: uint8", "08", 8),
        DumpRow(5, "[1].name: string[2]", "63", "1 of 2 bytes are missing"),
    ]


def test_dump_container_fixed_number_of_records_that_are_missing() -> None:
    rows = dump_container(Layout("(x: uint16)[3]"), bytes(4))
    assert [row.value for row in rows] == [0, 0, "2 of 2 bytes are missing"]


def test_dump_container_big_endian() -> None:
    assert dump_container(Layout("n: int32"), bytes.fromhex("00000005"), "big")[0].value == 5


def test_dump_container_long_container_shows_the_place_and_is_bounded() -> None:
    layout, data = Layout("(x: uint8, y: uint8)*"), bytes(100_001)
    begin = dump_container(layout, data)
    assert len(begin) == MAX_ROWS + 1
    assert begin[-1].field == "..."
    rows = dump_container(layout, data, shown_offset=100_000)
    assert [row.offset for row in rows] == [99_998, 99_999, 100_000, 100_001]
    assert rows[-1].value == "1 of 1 bytes are missing"


def test_dump_container_long_field_shows_its_beginning() -> None:
    (row,) = dump_container(Layout("text: string[1000]"), b"a" * 1000)
    assert row.hex == " ".join(["61"] * 32)


def test_dump_container_empty_container_shows_what_was_expected() -> None:
    assert [row.offset for row in dump_container(Layout("(x: uint8)*"), b"")] == []
    assert [row.offset for row in dump_container(Layout("x: uint8, y: uint8"), b"")] == [0, 1]


# ---------------------------------------------------------------------- values


@pytest.mark.parametrize(
    ("field", "value", "unit", "text"),
    [
        ("x", 112.5, "mm", "x goes up to 112.5: as metres that is not plausible"),
        ("y", -187.25, "mm", "y goes up to 187.25"),
        ("hole_diameter", 8.5, "mm", "hole_diameter goes up to 8.5"),
        ("theta", 90.0, "deg", "theta goes up to 90: as radians"),
        ("angle_2", -45.0, "deg", "angle_2 goes up to 45"),
        ("quality", 87.5, "percent", "quality goes up to 87.5: as a ratio"),
    ],
)
async def test_value_that_is_no_si_gets_a_hint(
    field: str, value: float, unit: str, text: str
) -> None:
    layout = f"{field}: real32"
    findings = await read(layout, {field: value}, layout)
    assert errors(findings) == []
    found = finding_of(findings, "values")
    assert found.severity == "hint"
    assert text in found.text
    assert f"Write {field}: real32 {unit} in the layout" in found.cure


@pytest.mark.parametrize(
    ("layout", "values"),
    [
        ("x: real32, y: real32, theta: real32", {"x": 0.11, "y": -4.9, "theta": 6.28}),
        ("x: real32, theta: real32, quality: real32", {"x": 0.0, "theta": -3.14, "quality": 1.0}),
        ("area: real32, index: real32", {"area": 1e6, "index": 640.0}),
        ("x: int32", {"x": 640}),
    ],
)
async def test_value_that_is_plausible_gets_no_hint(layout: str, values: dict[str, Any]) -> None:
    assert severities(await read(layout, values, layout), "values") == []


async def test_value_with_a_unit_gets_no_hint() -> None:
    written = {"x": 112.5, "theta": 90.0}
    findings = await read("x: real32, theta: real32", written, "x: real32 mm, theta: real32 deg")
    assert severities(findings, "values") == []


async def test_pixels_get_no_hint() -> None:
    findings = await read("x: real32", {"x": 640.0}, "x: real32 px")
    assert severities(findings, "values") == []


async def test_localizations_in_millimetres_and_degrees_get_hints() -> None:
    layout = "(x: real32, y: real32, theta: real32)*"
    parts = [{"x": 12.5, "y": 3.0, "theta": 30.0}, {"x": 200.0, "y": 4.0, "theta": 90.0}]
    findings = await read(layout, parts, f"localizations: {layout}")
    hints = {
        one.details["field"]: one.details["value"] for one in findings if one.check == "values"
    }
    assert hints == {"x": 200.0, "theta": 90.0}


async def test_localizations_in_whole_millimetres_get_hints() -> None:
    layout = "(x: int32, y: int16 mm)*"
    findings = await read(layout, [{"x": 112, "y": 0.187}], f"localizations: {layout}")
    hints = [one.details["field"] for one in findings if one.check == "values"]
    assert hints == ["x"]


async def test_value_of_shifted_bytes_gets_a_hint() -> None:
    (tiny,) = struct.unpack("<f", struct.pack("<i", 7))
    findings = await read("n: int32", {"n": 7}, "x: real32")
    found = finding_of(findings, "values")
    assert found.details["value"] == tiny
    assert "which no camera measures" in found.text
    assert "all after it are shifted" in found.cure


def test_limits_say_why() -> None:
    assert [rule.quantity for rule in PLAUSIBILITY_LIMITS] == ["angle", "length", "ratio"]
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    assert [rule.reason for rule in PLAUSIBILITY_LIMITS if f"| {rule.reason} |" not in page] == []
    assert PLAUSIBILITY_LIMITS[0].largest == pytest.approx(2 * math.pi)


@pytest.mark.parametrize(
    ("layout", "values", "text"),
    [
        ("x: real32 mm, y: real32 mm", {"x": 0.00012, "y": -0.0015}, "x, y: no more than 1.5 mm"),
        ("theta: real32 deg", {"theta": 0.0548}, "theta: no more than 3.14 deg"),
        ("(a: real64 deg)*", [{"a": 0.01}, {"a": -0.02}], "a: no more than 1.146 deg"),
    ],
)
async def test_si_that_a_layout_takes_for_a_unit_is_reported(
    layout: str, values: Any, text: str
) -> None:
    found = finding_of(await read(layout, values, layout), "values")
    assert (found.severity, found.text.startswith(text)) == ("hint", True), found.text
    assert found.text.count("which looks like metres") + found.text.count("like radians") == 1


@pytest.mark.parametrize(
    ("layout", "values"),
    [
        ("x: real32 mm, y: real32 mm", {"x": 0.00012, "y": 0.112}),  # one is large enough
        ("x: real32 mm", {"x": 0}),
        ("theta: real32 deg", {"theta": 0.5}),
        ("x: int32 mm", {"x": 0.001}),  # metres are no integers
        ("x: real32 um", {"x": 0.0001}),
    ],
)
async def test_small_values_that_need_no_question(layout: str, values: Any) -> None:
    assert severities(await read(layout, values, layout), "values") == []
