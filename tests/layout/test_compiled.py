"""Equal layouts are worked out once, and share nothing that a user can change."""

from __future__ import annotations

import gc
import threading
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam.exceptions import InterpretationError, LayoutError
from smartcam.interpreters import resolve
from smartcam.layout import Layout
from smartcam.layout._codec import RecordCodec
from tests.layout.inside import _compiled as compiled

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.layout._inside import Field
    from smartcam.models import ByteOrder

TEXT = "n: int32, (x: real32 mm, y: real32 mm)[n]"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Field, ...]]:
    """Collect the fields whose codecs are made."""
    found: list[tuple[Field, ...]] = []

    class Counted(RecordCodec):
        def __init__(
            self, fields: tuple[Field, ...], byte_order: ByteOrder, *, lenient: bool
        ) -> None:
            found.append(fields)
            super().__init__(fields, byte_order, lenient=lenient)

    monkeypatch.setattr(compiled, "RecordCodec", Counted)
    return found


@pytest.mark.parametrize(
    "again",
    [
        lambda: Layout(TEXT.replace(" ", "  ") + " # the same"),
        lambda: Layout("table: " + TEXT, start=len("table: ")),
        lambda: Layout.from_dict(Layout(TEXT).to_dict()),
        lambda: Layout.from_yaml(Layout(TEXT).to_yaml()),
        lambda: resolve(f"table: {TEXT}").layout,
    ],
)
def test_layouts_that_are_equal_are_worked_out_once(
    again: Callable[[], Layout], made: list[object]
) -> None:
    first = Layout(TEXT)
    assert len(made) == 4  # head and record, in two byte orders
    second = again()
    assert second == first
    assert len(made) == 4


def test_layout_that_is_lenient_is_another_one() -> None:
    strict, lenient = Layout("passed: bool"), Layout("passed: bool", lenient=True)
    assert lenient.parse(b"\x01").passed is True
    with pytest.raises(InterpretationError, match="0x00 or 0xFF"):
        strict.parse(b"\x01")


def test_layouts_of_several_cameras_share_no_dtype_and_no_model() -> None:
    first, second = Layout("a: int32, b: int32"), Layout("a: int32, b: int32")
    data = bytes(range(8))
    first.parse_table(data).dtype.names = ("left", "right")
    assert first.dtype is not second.dtype
    assert second.parse_table(data).dtype.names == ("a", "b")
    assert second.parse(data) == (0x03020100, 0x07060504)
    assert first.model is not second.model


def test_layout_mistake_is_reported_with_its_own_place_each_time() -> None:
    for start in (0, 7, 0):
        text = "x" * start + "a: int32, b: nothing"
        with pytest.raises(LayoutError) as caught:
            Layout(text, start=start)
        assert caught.value.position == text.index("nothing")
        assert caught.value.text == text


def test_layouts_that_nobody_has_are_forgotten() -> None:
    gc.collect()
    before = len(compiled._in_use)
    kept = [Layout(f"({name}: int32)*") for name in ("forgotten_1", "forgotten_2")]
    for blanks in range(20):
        assert Layout(f"({' ' * blanks}forgotten_1:int32)*") == kept[0]
    assert len(compiled._in_use) == before + len(kept)  # each other spelling is not kept
    spelled = Layout("(forgotten_3:int32)*")
    assert len(compiled._in_use) == before + len(kept) + 2
    del kept, spelled
    gc.collect()
    assert len(compiled._in_use) == before


def test_layouts_made_in_several_threads_at_once_are_equal() -> None:
    texts = [f"(thread_{number}: int32, y: real32 mm)*" for number in range(50)]
    begin = threading.Barrier(4)
    found: list[list[Layout]] = []

    def make() -> None:
        begin.wait(30)
        found.append([Layout(text) for text in texts])

    threads = [threading.Thread(target=make) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert len(found) == len(threads)
    data = np.array([(1, 2.0)], dtype="<i4,<f4").tobytes()
    for layouts in zip(*found, strict=True):
        assert len(set(layouts)) == 1
        assert {tuple(layout.parse(data)[0]) for layout in layouts} == {(1, 0.002)}
