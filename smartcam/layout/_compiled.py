"""Work a layout's text out, once for all equal layouts that are in use."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

from smartcam.layout._codec import RecordCodec
from smartcam.layout._text import parse_text, to_text

if TYPE_CHECKING:
    from smartcam.layout._text import LayoutSpec
    from smartcam.models import ByteOrder


class CompiledLayout:
    """The parts of a layout that follow from its text alone, not from a container; never changed.

    Args:
        spec: what the text says.
        text: the canonical text.
        lenient: take any byte but zero for a true bool.

    Attributes:
        spec: spec that was given.
        text: text that was given.
        codecs: codecs of the head and of a record, by byte order.
        fixed: number of records, None where the container tells.
        to_end: records, and nothing else.
        is_list: whether the value is a plain list of records.
        record_word: what an error calls a record, "" where there is one.
        sequence_index: index of the field with the sequence number, None without one.
    """

    __slots__ = (
        *("__weakref__", "codecs", "fixed", "is_list", "record_word", "sequence_index"),
        *("spec", "text", "to_end"),
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
        self.fixed: int | None = repeat if isinstance(repeat, int) else None
        self.to_end: bool = repeat == "*" and not spec.head
        self.is_list: bool = spec.is_list
        self.record_word: str = "" if spec.repeat is None else "record"
        fields = (*spec.head, *spec.fields)
        self.sequence_index: int | None = next(
            (i for i, f in enumerate(fields) if f.sequence), None
        )


_in_use: weakref.WeakValueDictionary[tuple[str, bool], CompiledLayout] = (
    weakref.WeakValueDictionary()
)
"""By text and ``lenient``, as long as there is a layout: under its canonical text, and under the
one that it was first made of. So there are two for each at most."""


def compile_text(text: str, start: int, *, lenient: bool) -> CompiledLayout:
    """Return the compiled form of a layout text; keep it in a cache for the next caller.

    Args:
        text: the layout text.
        start: index of the character at which the layout begins.
        lenient: True if any byte but zero is a true bool.

    Raises:
        LayoutError: a mistake in the text, with its position.
    """
    key = text[start:], lenient
    found = _in_use.get(key)
    if found is None:
        spec = parse_text(text, start)
        canonical = to_text(spec), lenient
        found = _in_use.get(canonical)
        if found is None:  # two threads may come here at once: one is as good as the other
            found = CompiledLayout(spec, canonical[0], lenient=lenient)
            _in_use[key] = _in_use[canonical] = found
    return found
