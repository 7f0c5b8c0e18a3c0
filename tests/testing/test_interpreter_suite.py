"""The suite for authors of interpreters: smartcam's own pass it, and a bad one fails each check."""

from __future__ import annotations

import struct
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, ClassVar

import pytest

from smartcam.exceptions import InterpretationError
from smartcam.interpreters import Context, Interpreter, PlainInterpreter, Reader
from smartcam.interpreters._inside import LocalizationsInterpreter
from smartcam.layout import Layout
from smartcam.models import Header, Localization, Pose, Position, Quaternion
from smartcam.registry import INTERPRETERS
from smartcam.testing import ContainerSample, InterpreterSuite
from tests import ROOT

pytest_plugins = ["pytester"]

PACKAGE = ROOT / "examples" / "smartcam-weights"
OPTIONS = ("-p", "no:cacheprovider", "-rs", "-o", "asyncio_default_fixture_loop_scope=function")

HEADER = Header(0, datetime(1970, 1, 1, tzinfo=UTC), "")
PART = struct.Struct("<50sfifff")
XY = "(x: real32 mm, y: real32 mm)*"


def localization(feature: str, x: float, y: float, quality: float, photo: int) -> Localization:
    return Localization(feature, quality, photo, Pose(HEADER, Position(x, y), Quaternion()))


class TestRaw(InterpreterSuite):
    spec = name = "raw"
    samples = (
        ContainerSample(b"\x01\xff", b"\x01\xff", big=b"\x01\xff"),
        ContainerSample(b"", b"", big=b""),
    )


TEXTS = b"".join(text.ljust(50, b"\0") for text in (b"one", b"", b"x" * 50))


class TestStrings50(InterpreterSuite):
    spec = name = "strings50"
    samples = (
        ContainerSample(TEXTS, ["one", "", "x" * 50], big=TEXTS, name="three"),
        ContainerSample(b"", [], big=b"", name="none"),
    )


class TestRecord(InterpreterSuite):
    spec: ClassVar[Any] = INTERPRETERS.load("record")
    name = "record"
    samples = (
        ContainerSample(
            struct.pack("<h?f4s", 5, False, 10.0, b"M8"),
            (5, False, 0.01, "M8"),
            layout="n: int16, ok: bool, x: real32 mm, code: string[4]",
        ),
        ContainerSample(
            struct.pack("<Iqq", 7, 1, -1),
            [(1,), (-1,)],
            layout="n: uint32 @sequence, (a: int64)*",
            sequence=7,
        ),
        ContainerSample(
            struct.pack("<Bddd", 2, 1, 2, 3), [(1.0,), (2.0,)], layout="n: uint8, (x: real64)[n]"
        ),
    )


class TestTable(InterpreterSuite):
    spec: ClassVar[Any] = INTERPRETERS.load("table")
    name = "table"
    samples = (
        ContainerSample(
            struct.pack("<hhhh", 1, 2, 3, 4),
            [(1, 0.002), (3, 0.004)],
            layout="(n: int16, x: int16 mm)*",
        ),
        ContainerSample(struct.pack("<ff", 1, 2), [(1.0,), (2.0,)], layout="(x: real32)*"),
        ContainerSample(b"", [], layout="(x: real32)*", name="empty"),
    )


class TestLocalizations(InterpreterSuite):
    spec, name = LocalizationsInterpreter, "localizations"
    samples = (
        ContainerSample(
            PART.pack(b"bolt", 0.5, 3, 0.25, 0.5, 0.0)
            + bytes(70)
            + PART.pack(b"nut", 1.0, 4, 0.0, 1.0, 0.0),
            [localization("bolt", 0.25, 0.5, 0.5, 3), localization("nut", 0.0, 1.0, 1.0, 4)],
        ),
        ContainerSample(
            struct.pack("<ff", 250, 500), [localization("", 0.25, 0.5, 1.0, 0)], layout=XY
        ),
        ContainerSample(b"", [], name="no part"),
    )


# ---------------------------------------------------------------------- what is wrong

FOUR = ContainerSample(struct.pack("<f", 0.5), 0.5, big=struct.pack(">f", 0.5))


def good(reader: Reader) -> float:
    (first_byte,) = reader.records(4)[:1] or (0,)
    return reader.get_real32(first_byte)


def wrong(_: Reader) -> float:
    return 0.25


class Numbered(Interpreter):
    def interpret(self, reader: Reader) -> float:
        return good(reader)

    def sequence(self, reader: Reader) -> int | None:
        return reader.data[0]


def counting(reader: Reader, _seen: list[int] = []) -> float:  # noqa: B006 - it is the mistake
    _seen.append(1)
    return good(reader) if len(_seen) == 1 else 0.25


def sharing(reader: Reader, _values: list[float] = []) -> list[float]:  # noqa: B006
    _values[:] = [good(reader)]
    return _values


class Keeping(Interpreter):
    last = b""

    def interpret(self, reader: Reader) -> float:
        self.last = reader.data
        return good(reader)


class Tallying(Interpreter):
    count = 0

    def interpret(self, reader: Reader) -> float:
        self.count += 1
        return good(reader)


def hoarding(reader: Reader, _seen: list[bytes] = []) -> float:  # noqa: B006
    _seen.append(reader.data)
    return good(reader)


class Nameless:
    def __eq__(self, _: object) -> bool:
        return True

    def __hash__(self) -> int:
        return 0


def little(reader: Reader) -> float:
    if len(reader) != 4:
        return good(reader)
    return float(struct.unpack("<f", reader.data)[0])


def careless(reader: Reader) -> float:
    return reader.data[0] and good(Reader(reader.data[:4].ljust(4, b"\0")))


def reasonless(reader: Reader) -> float:
    if len(reader) < 4:
        raise InterpretationError("too short")
    return good(reader)


class LonelyError(InterpretationError):
    def __init__(self, *, expected: str) -> None:
        super().__init__("no", expected=expected)


def lonely(reader: Reader) -> float:
    if len(reader) < 4:
        raise LonelyError(expected="four bytes")
    return good(reader)


def chatty(reader: Reader) -> float:
    if len(reader) > 100:
        raise InterpretationError(f"what is {reader.data!r}", expected="four bytes")
    return good(reader)


def impatient(reader: Reader) -> float:
    if len(reader) > 4:
        raise KeyError(reader.data)
    return good(reader)


def trusting(reader: Reader) -> float:
    value = good(reader)
    if value != FOUR.value:
        raise ValueError("only one weight is known")
    return value


def pose(reader: Reader) -> Pose:
    return Pose(HEADER, Position(good(reader), 0.0), Quaternion())


def proud(reader: Reader) -> float:
    return good(reader) if reader.context.application >= 0 else 1 / 0


class Bursting(PlainInterpreter):
    layout_use = "none"

    def read(self, data: bytes, context: Context) -> float:
        return good(Reader(data, context))

    def read_all(self, containers: Sequence[bytes], context: Context) -> list[float]:
        return [0.25 for _ in containers]


class Short(Bursting):
    def read_all(self, containers: Sequence[bytes], context: Context) -> list[float]:
        return [0.5]


class Uncounted(Bursting):
    def read(self, data: bytes, context: Context) -> float:
        context.empty_slots += 1
        return super().read(data, context)

    def read_all(self, containers: Sequence[bytes], context: Context) -> list[float]:
        return [0.5 for _ in containers]


class Picky(Interpreter):
    def __init__(self, layout: Layout | None = None) -> None:
        super().__init__(layout)
        if layout is not None and len(layout.fields) != 1:
            raise KeyError("one field")

    def interpret(self, reader: Reader) -> float:
        return good(reader)


POSE = ContainerSample(FOUR.data, Pose(HEADER, Position(0.5, 0.0), Quaternion()), big=FOUR.big)
MISTAKES: list[tuple[str, Any, ContainerSample, str]] = [
    ("test_value_is_as_expected", wrong, FOUR, "expected 0.5, got 0.25"),
    ("test_sequence_number_is_as_expected", Numbered, FOUR, "expected number None, got 0"),
    ("test_value_is_the_same_each_time", counting, FOUR, "first 0.5, after"),
    ("test_value_is_the_same_each_time", sharing, replace(FOUR, value=[0.5]), "share [0.5]"),
    ("test_nothing_is_kept", Keeping, FOUR, "the container's bytes are kept"),
    ("test_nothing_is_kept", Tallying, FOUR, "was changed from {'layout': None, 'count': 1}"),
    ("test_nothing_is_kept", hoarding, FOUR, "the container's bytes are kept"),
    ("test_value_can_be_written_as_json", lambda _: Nameless(), FOUR, "has no JSON: it contains"),
    ("test_big_endian_gives_the_same_value", little, FOUR, "expected 0.5, got"),
    ("test_cut_container_gives_value_or_error", careless, FOUR, "got IndexError"),
    ("test_cut_container_gives_value_or_error", reasonless, FOUR, "neither field nor expected"),
    ("test_cut_container_gives_value_or_error", lonely, FOUR, "does not survive pickle"),
    ("test_longer_container_gives_value_or_error", impatient, FOUR, "got KeyError"),
    ("test_longer_container_gives_value_or_error", chatty, FOUR, "a text of"),
    ("test_any_bytes_give_value_or_error", trusting, FOUR, "got ValueError"),
    ("test_poses_are_of_finite_numbers", pose, POSE, "a pose that is not finite"),
    ("test_any_context_is_accepted", proud, FOUR, "got ZeroDivisionError"),
    ("test_containers_of_a_burst_are_read_as_one_by_one", Bursting, FOUR, "read_all() 0.25"),
    ("test_containers_of_a_burst_are_read_as_one_by_one", Short, FOUR, "gave 1 values"),
    ("test_containers_of_a_burst_are_read_as_one_by_one", Uncounted, FOUR, "empty_slots: 0, not 2"),
    ("test_layout_is_taken_or_refused", Picky, FOUR, "one field"),
    ("test_entry_point_gives_the_interpreter", good, FOUR, "Is the package installed"),
]


def suite(spec: Any, sample: ContainerSample) -> InterpreterSuite:
    members = {"spec": staticmethod(spec), "samples": (sample,), "name": "nobody"}
    made: InterpreterSuite = type("TestBad", (InterpreterSuite,), members)()
    return made


@pytest.mark.parametrize(
    ("check", "spec", "sample", "said"),
    MISTAKES,
    ids=[f"{one[0]}-{i}" for i, one in enumerate(MISTAKES)],
)
def test_check_finds_the_mistake(check: str, spec: Any, sample: ContainerSample, said: str) -> None:
    with pytest.raises((AssertionError, KeyError)) as caught:
        getattr(suite(spec, sample), check)(sample)
    assert said in str(caught.value)


def test_every_check_has_a_mistake() -> None:
    own = {name for name in dir(InterpreterSuite) if name.startswith("test_")}
    assert own == {check for check, *_ in MISTAKES}


def test_sample_without_big_endian_skips_and_reports_it() -> None:
    with pytest.raises(pytest.skip.Exception, match=r"ContainerSample\(big=\.\.\.\) is missing"):
        suite(good, FOUR).test_big_endian_gives_the_same_value(replace(FOUR, big=None))


# ---------------------------------------------------------------------- as an author runs it


def test_suite_without_samples_says_what_is_missing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        from smartcam.testing._suites.interpreters import InterpreterSuite

        class TestNothing(InterpreterSuite):
            spec = "raw"
        """
    )
    result = pytester.runpytest_inprocess(*OPTIONS)
    result.stdout.fnmatch_lines(["*TestNothing.samples: expected one, got none*"])


def test_example_package_passes_and_the_page_shows_its_tests(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "new-interpreter.md").read_text(encoding="utf-8")
    assert (PACKAGE / "test_weights.py").read_text(encoding="utf-8") in page
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    points = project["entry-points"]["smartcam.interpreters"]
    for module in PACKAGE.glob("*.py"):
        pytester.path.joinpath(module.name).write_text(module.read_text())
    info = pytester.mkdir("smartcam_weights-0.1.0.dist-info")
    info.joinpath("METADATA").write_text(
        "Metadata-Version: 2.1\nName: smartcam-weights\nVersion: 0.1.0\n"
    )
    lines = [f"{name} = {value}\n" for name, value in points.items()]
    info.joinpath("entry_points.txt").write_text("[smartcam.interpreters]\n" + "".join(lines))
    monkeypatch.syspath_prepend(pytester.path)
    INTERPRETERS.refresh()
    result = pytester.runpytest_inprocess(*OPTIONS)
    INTERPRETERS.refresh()
    result.assert_outcomes(passed=28)
