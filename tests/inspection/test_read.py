"""The tool `read`: bytes, GS1, corners, expected texts, and retries after a miss."""

from __future__ import annotations

import contextlib
import math
import re
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zxingcpp

from smartcam.exceptions import ConfigurationError
from smartcam.inspection import ToolSetup
from smartcam.inspection._read import ladder
from smartcam.inspection._read.ladder import KINDS_TO_CONFIRM, RUNGS
from smartcam.inspection._read.patterns import MatchTimeoutError, TextPattern
from tests.inspection.cells import inspected
from tests.inspection.drawn_codes import Look, draw_code
from tests.inspection.inside import ReadSettings, ReadTool, formats_of, read_codes, split_elements
from tests.inspection.proofs import codes

if TYPE_CHECKING:
    from numpy.typing import NDArray

TEXT = "SN:47-0815"


def picture(kind: str = "DataMatrix", text: str | bytes = TEXT, **look: Any) -> NDArray[np.uint8]:
    return draw_code(kind, text, Look(**look), np.random.default_rng(1))


def beside(*pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures side by side on white."""
    height = max(one.shape[0] for one in pictures)
    return np.hstack(
        [
            np.pad(one, ((0, height - one.shape[0]), (0, 20)), constant_values=210)
            for one in pictures
        ]
    )


@pytest.mark.parametrize("kind", codes.CONTENTS)
def test_code_of_each_kind_is_read_with_its_place(tmp_path: Path, kind: str) -> None:
    found = inspected(tmp_path, f"{{read: {{codes: {kind}}}}}", picture(kind, codes.CONTENTS[kind]))
    assert found.ok
    assert found.value.text == codes.CONTENTS[kind]
    assert found.value.kind == kind
    assert (found.value.count, found.findings["read"].details[0].prepared) == (1, "")


def test_bytes_are_unchanged_and_text_has_no_escapes(tmp_path: Path) -> None:
    data = b"[)>\x1e06\x1dP4711\x1d\x1e\x04"
    found = inspected(tmp_path, "{read: {codes: DataMatrix}}", picture(text=data))
    (code,) = found.findings["read"].details
    assert code.data == data
    assert found.value.text == code.text == data.decode()


def test_elements_of_gs1_come_apart(tmp_path: Path) -> None:
    made = zxingcpp.create_barcode(
        "(01)09501101530003(10)AB-12(17)290101", zxingcpp.BarcodeFormat.Code128, gs1=True
    )
    grey = np.pad(np.array(made.to_image(scale=3)), 30, constant_values=255)
    found = inspected(tmp_path, "{read: {codes: Code128}}", grey)
    (code,) = found.findings["read"].details
    assert code.gs1 == (("01", "09501101530003"), ("10", "AB-12"), ("17", "290101"))
    assert code.symbology == "]C1"
    assert b"\x1d17290101" in code.data


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("010950110153000310ABC", [("01", "09501101530003"), ("10", "ABC")]),
        ("10ABC\x1d0109501101530003", [("10", "ABC"), ("01", "09501101530003")]),
        ("\x1d3103001750", [("3103", "001750")]),
        ("8020REF\x1d21X", [("8020", "REF"), ("21", "X")]),
        ("01095", [("", "01095")]),
        ("10", [("", "10")]),
        ("xx", [("", "xx")]),
        ("10A\x1d\x1d21B", [("10", "A"), ("", "\x1d21B")]),
        ("", []),
    ],
)
def test_element_strings_are_cut_by_their_lengths(
    text: str, expected: list[tuple[str, str]]
) -> None:
    assert list(split_elements(text)) == expected


@pytest.mark.parametrize("degrees", [0, 20, 90, 200])
def test_corners_and_angle_match_the_printed_code(tmp_path: Path, degrees: float) -> None:
    grey = picture(px=6, degrees=degrees)
    found = inspected(tmp_path, "{read: {codes: DataMatrix, corners: true}}", grey)
    difference = found.value.angle - math.radians(degrees)
    assert abs(math.remainder(difference, 2 * math.pi)) < math.radians(2)
    middle = (np.array(grey.shape[::-1]) - 1) / 2
    assert math.dist((found.value.x, found.value.y), middle) < 3
    edge = math.dist((found.value.x1, found.value.y1), (found.value.x2, found.value.y2))
    assert edge == pytest.approx(6 * 14, abs=6)
    region = "[{:.0f}, {:.0f}, 40, 40]".format(*(middle - 20))
    assert not inspected(tmp_path, f"{{read: {{region: {region}}}}}", grey).ok


def test_corners_of_a_region_are_the_pictures_pixels(tmp_path: Path) -> None:
    grey = picture(px=6)
    whole = inspected(tmp_path, "{read: {codes: DataMatrix}}", grey).value
    wide = np.pad(grey, ((40, 0), (70, 0)), constant_values=210)
    region = f"[70, 40, {grey.shape[1]}, {grey.shape[0]}]"
    part = inspected(tmp_path, f"{{read: {{codes: DataMatrix, region: {region}}}}}", wide).value
    assert (part.x, part.y) == (whole.x + 70, whole.y + 40)


def test_code_beside_a_region_of_corners_does_not_count(tmp_path: Path) -> None:
    grey = beside(picture(text="A"), picture(text="B"))
    height, width = grey.shape
    for corners, text in (
        (f"[[0, 0], [{width}, 0], [0, {1.2 * height}]]", "A"),
        (f"[[0, {-height}], [{width}, 0], [{width}, {1.6 * height}]]", "B"),
    ):
        found = inspected(tmp_path, f"{{read: {{most: 2, region: {corners}}}}}", grey)
        assert [code.text for code in found.value.read] == [text]


def test_whole_text_must_match(tmp_path: Path) -> None:
    for pattern, ok in ((r"SN:\d\d-\d{4}", True), (r"SN", False), (r"\d+", False)):
        found = inspected(tmp_path, f"{{read: {{expect: '{pattern}'}}}}", picture())
        assert found.ok is ok
        assert found.value.text == TEXT  # the text that came is told either way
    assert found.reason == rf"read '{TEXT}', expected \d+"


def test_pattern_that_is_too_large_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="expected a regular expression"):
        inspected(tmp_path, "{read: {expect: 'a{99999999999999999999}'}}", picture())


@pytest.mark.parametrize(
    "pattern",
    [
        "(a+)+$",
        "(a|a)+",
        "(a{1,30}){1,30}",
        "(a*){30}",
        "(?:a?){29}a{29}",
        "(?=(a+)+b).*",
        "(a|a?)+b",
    ],
)
def test_pattern_of_exponential_time_is_refused_or_times_out(
    pattern: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("smartcam.inspection._read.patterns.MAX_MATCH_SECONDS", 0.05)
    expected = TextPattern(pattern)
    for length in (28, 4000):
        with contextlib.suppress(MatchTimeoutError):
            assert not expected.fits(length * "a" + "!")  # by re, some of these take years


def test_comparing_lets_other_threads_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smartcam.inspection._read.patterns.MAX_MATCH_SECONDS", 0.1)
    ways, turns, ended = TextPattern("(a|a)+"), 0, False

    def work() -> None:
        nonlocal turns
        while not ended:
            turns += 1

    other = threading.Thread(target=work)
    other.start()
    before = turns
    try:
        with contextlib.suppress(MatchTimeoutError):
            ways.fits(4000 * "a" + "!")
        assert turns > before
    finally:
        ended = True
        other.join()


def test_patterns_match_like_re() -> None:
    random = np.random.default_rng(5)
    # not \B, as Python 3.14 changed it
    atoms = ["a", "b", ".", r"\d", "[ab]", "[^a]", "(?i:B)", r"\b", "^", "$", r"\Z", ""]
    times = ["*", "+", "?", "{2}", "{1,2}", "*?", "??"]

    def pattern(depth: int) -> str:
        kind = random.integers(0, 6) if depth else 0
        inner = [pattern(depth - 1) for _ in range(2)] if kind else []
        if kind == 0:
            return str(random.choice(atoms))
        if kind in (1, 2):
            return "".join(inner)
        if kind == 3:
            return f"(?:{inner[0]}|{inner[1]})"
        if kind == 4:
            return f"(?:{inner[0]}){random.choice(times)}"
        return f"({random.choice(['?=', '?!', '', '?s:', '?m:'])}{inner[0]}){inner[1]}"

    matches = 0
    for _ in range(80):
        given = pattern(3)
        for _ in range(5):
            text = "".join(random.choice([*"aabB1\n"], random.integers(0, 5)))
            wanted = re.fullmatch(given, text) is not None
            assert TextPattern(given).fits(text) is wanted, (given, text)
            matches += wanted
    assert matches > 25


def test_pattern_that_is_too_long_is_refused() -> None:
    with pytest.raises(ValueError, match="4000 characters at most, got 4001"):
        TextPattern("a" * 4001)


def test_text_that_takes_too_long_to_compare_is_not_ok(tmp_path: Path) -> None:
    cell = "{read: {codes: DataMatrix, length: 200, expect: '(a|a)+'}}"
    found = inspected(tmp_path, cell, picture(text=150 * "a" + "!"))
    assert (found.ok, found.reason.endswith("takes too long")) == (False, True)


def test_other_repetitions_are_accepted(tmp_path: Path) -> None:
    for pattern in ("(SN:)?[0-9]+-[0-9]+", r"(SN|:|\d{2}|-)+", r"(\w+:)?(\d+-){1,3}\d*"):
        assert inspected(tmp_path, f"{{read: {{expect: '{pattern}'}}}}", picture()).ok


def test_bytes_have_to_be_the_input(tmp_path: Path) -> None:
    cell = "{read: {expect: input}}"
    assert inspected(tmp_path, cell, picture(), given=TEXT.encode()).ok
    assert not inspected(tmp_path, cell, picture(), given=TEXT[:-1].encode()).ok
    assert not inspected(tmp_path, cell, picture()).ok


def test_several_codes_are_listed_from_top_to_bottom(tmp_path: Path) -> None:
    upper = beside(picture(text="A"), picture("QRCode", "B", px=3))
    both = np.vstack([upper, np.full((60, upper.shape[1]), 210, np.uint8)])
    lower = picture(text="C")
    both = np.vstack([both, np.pad(lower, ((0, 0), (0, both.shape[1] - lower.shape[1])))])
    found = inspected(tmp_path, "{read: {most: 5, least: 3}}", both)
    assert found.ok
    assert found.value.count == 3
    assert {code.text for code in found.value.read[:2]} == {"A", "B"}
    assert found.value.read[2].text == "C"
    few = inspected(tmp_path, "{read: {most: 5, least: 4, seconds: 0}}", both)
    assert (few.ok, few.reason) == (False, "3 codes, expected 4")


def test_too_long_text_is_reported_and_not_cut(tmp_path: Path) -> None:
    found = inspected(tmp_path, "{read: {length: 9}}", picture())
    assert (found.ok, found.value.text) == (False, "")
    assert found.reason == "the text has 10 bytes, expected up to 9"
    found = inspected(tmp_path, "{read: {length: 9, expect: SN}}", picture())
    assert found.reason == "the text has 10 bytes, expected up to 9"  # before it matches
    zero = inspected(tmp_path, "{read: {}}", picture(text=b"A\0B"))
    assert (zero.ok, zero.value.text) == (False, "")


def test_unused_correction_tells_damage(tmp_path: Path) -> None:
    whole = picture(px=6)
    spoiled = whole.copy()
    spoiled[60:80, 60:80] = 210
    best, worse = (
        inspected(tmp_path, "{read: {codes: DataMatrix}}", one).value for one in (whole, spoiled)
    )
    assert best.text == worse.text == TEXT
    assert 0 <= worse.unused_correction < best.unused_correction == 1


# ---------------------------------------------------------------------- after a miss


def test_without_time_no_picture_is_prepared(tmp_path: Path) -> None:
    dotted = picture(px=6, dots=0.7)
    assert not inspected(tmp_path, "{read: {codes: DataMatrix, seconds: 0}}", dotted).ok
    found = inspected(tmp_path, "{read: {codes: DataMatrix, seconds: 9}}", dotted)
    assert found.value.text == TEXT
    assert found.findings["read"].details[0].prepared == "half as large, blurred, threshold"


@pytest.mark.parametrize("look", [{"px": 6, "dots": 0.7}, {"px": 1.5}, {"px": 4, "noise": 40}])
def test_prepared_picture_gives_places_in_the_picture(look: dict[str, Any]) -> None:
    grey = picture(**look)
    (code,) = codes.with_ladder("DataMatrix", grey)
    assert code.prepared
    middle = (np.array(grey.shape[::-1]) - 1) / 2
    assert math.dist(code.centre, middle) < max(2.0, look["px"])


@pytest.mark.parametrize("rung", RUNGS, ids=lambda rung: rung.name)
def test_each_rung_maps_its_pixels_back(rung: object) -> None:
    prepare = next(one.prepare for one in RUNGS if one is rung)
    grey = np.full((90, 140), 200, np.uint8)
    grey[20:41, 90:111] = 0  # a spot around (100, 30)
    prepared, back = prepare(grey)
    dark = prepared < 100 if prepared.mean() > 100 else prepared > 150
    rows, columns = np.nonzero(dark)
    centre = back[:, :2] @ (columns.mean(), rows.mean()) + back[:, 2]
    assert math.dist(centre, (100, 30)) < 1.0


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("kind", ["PDF417", "EAN13"])
def test_weak_kind_counts_only_if_a_second_reading_is_the_same(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    assert kind in KINDS_TO_CONFIRM
    grey = picture(kind, codes.CONTENTS[kind], px=8, dots=0.6)
    assert codes.alone(kind, grey) == []
    assert [code.text for code in codes.with_ladder(kind, grey)] == [codes.CONTENTS[kind]]
    once = [
        rung
        for rung in RUNGS
        if read_codes(
            np.ascontiguousarray(rung.prepare(grey)[0]),
            formats_of([kind]),
            np.eye(2, 3),
            rung.binarizer,
        )
    ]
    assert len(once) >= 2
    monkeypatch.setattr(ladder, "RUNGS", (once[0],))
    monkeypatch.setattr(ladder, "CONFIRMING_SCALE", 0.02)  # in which nothing can be read
    assert codes.with_ladder(kind, grey) == []
    monkeypatch.setattr(ladder, "RUNGS", tuple(once[:2]))
    assert [code.text for code in codes.with_ladder(kind, grey)] == [codes.CONTENTS[kind]]


def test_slanted_bar_code_is_read(tmp_path: Path) -> None:
    for kind, degrees in (("Code128", 45.0), ("PDF417", 17.0), ("EAN13", -30.0)):
        grey = picture(kind, codes.CONTENTS[kind], px=3, degrees=degrees)
        assert codes.alone(kind, grey) == []
        assert [code.text for code in codes.with_ladder(kind, grey)] == [codes.CONTENTS[kind]]


def test_no_rung_begins_after_the_time_is_over() -> None:
    settings = ReadSettings.model_validate({"codes": ["DataMatrix"], "seconds": 1e-9})
    tool = ReadTool(settings, ToolSetup(folder=Path()))
    assert tool.read(picture(px=6, dots=0.7), (0, 0)) == []


@pytest.mark.long
def test_ladder_reads_drawn_codes_that_zxing_cpp_alone_misses_and_none_wrong() -> None:
    names = ["1.5 px a module", "4 px, noise 40", "6 px, dots of 70 %", "4 px, contrast 18"]
    count, wrong = codes.drawn(1, looks={name: codes.LOOKS[name] for name in names})
    assert wrong == []
    read = {
        name: sum(number for (reader, *_), number in count.items() if reader == name)
        for name in ("zxing-cpp", "smartcam")
    }
    assert read["smartcam"] >= read["zxing-cpp"] + 8
    for (reader, *case), number in count.items():
        if reader == "zxing-cpp":
            assert count["smartcam", *case] >= number, case


def test_no_code_is_read_in_an_empty_picture() -> None:
    random = np.random.default_rng(3)
    for grey in (
        random.integers(0, 256, (120, 160), np.uint8),
        np.tile(np.repeat(np.array([0, 255], np.uint8), 4), (100, 20)),
        np.kron(random.integers(0, 2, (16, 20)).astype(np.uint8) * 255, np.ones((8, 8), np.uint8)),
    ):
        assert codes.with_ladder("", grey) == []
