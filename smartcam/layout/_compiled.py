"""Compile a layout's text, once for all equal layouts in use."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

from smartcam.layout._codec import RecordCodec
from smartcam.layout._text import parse_text, to_text

if TYPE_CHECKING:
    from smartcam.layout._text import LayoutSpec
    from smartcam.models import ByteOrder


class CompiledLayout:
    """The parts of a layout that follow from its text alone; they never change.

    Args:
        spec: parsed form of the text.
        text: the canonical text.
        lenient: whether any byte except zero is a true bool.

    Attributes:
        spec: parsed form of the text.
        text: the canonical text.
        codecs: codecs of the head and of a record, by byte order.
        fixed_count: number of records; None if it depends on the container.
        fills_payload: whether the layout has nothing but records up to the end.
        is_list: whether the value is a plain list of records.
        record_word: word for a record in errors; "" if there is only one.
        sequence_index: index of the field with the sequence number; None without one.
    """

    __slots__ = (
        *("__weakref__", "codecs", "fixed_count", "is_list", "record_word", "sequence_index"),
        *("fills_payload", "spec", "text"),
    )

    def __init__(self, spec: LayoutSpec, text: str, *, lenient: bool) -> None:
        self.spec = spec
        self.text = text
        orders: tuple[ByteOrder, ByteOrder] = ("little", "big")
        self.codecs: dict[ByteOrder, tuple[RecordCodec, RecordCodec]] = {
            order: (
                RecordCodec(spec.head, order, lenient=lenient),
                RecordCodec(spec.fields, order, lenient=lenient),
            )
            for order in orders
        }
        repeat = 1 if spec.repeat is None else spec.repeat
        self.fixed_count: int | None = repeat if isinstance(repeat, int) else None
        self.fills_payload: bool = repeat == "*" and not spec.head
        self.is_list: bool = spec.is_list
        self.record_word: str = "" if spec.repeat is None else "record"
        fields = (*spec.head, *spec.fields)
        self.sequence_index: int | None = next(
            (i for i, f in enumerate(fields) if f.sequence), None
        )


_in_use: weakref.WeakValueDictionary[tuple[str, bool], CompiledLayout] = (
    weakref.WeakValueDictionary()
)
"""Compiled layouts by text and ``lenient``, while a layout uses them. Each has at most two entries:
one for its canonical text, and one for the text from which it was first made."""


def compile_text(text: str, start: int, *, lenient: bool) -> CompiledLayout:
    """Return the compiled form of a layout text, which is cached.

    Args:
        text: the layout text.
        start: index of the character at which the layout begins.
        lenient: whether any byte except zero is a true bool.

    Raises:
        LayoutError: the text has a mistake; the error gives its position.
    """
    key = text[start:], lenient
    compiled = _in_use.get(key)
    if compiled is None:
        spec = parse_text(text, start)
        canonical = to_text(spec), lenient
        compiled = _in_use.get(canonical)
        if compiled is None:  # two threads may come here at once; either result may be used
            compiled = CompiledLayout(spec, canonical[0], lenient=lenient)
            _in_use[key] = _in_use[canonical] = compiled
    return compiled
