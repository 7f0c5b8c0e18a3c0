"""Hypothesis strategies for the wire: messages, frames, broken bytes and how they are cut."""

from __future__ import annotations

import functools
import inspect
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from hypothesis import strategies as st

from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam.protocols import FramedDialect


def message_types(dialect: FramedDialect, sender: m.Sender) -> list[type[m.Message]]:
    """Return the messages of a dialect that ``sender`` may send."""
    return [row.type for row in dialect.table if row.type.sender is sender]


def bodies(
    dialect: FramedDialect, message_type: type[m.Message], max_data: int = 64
) -> st.SearchStrategy[m.Message]:
    """Messages of one type, any value that fits each field's place on the wire."""
    word = {"I": 0xFFFFFFFF, "H": 0xFFFF}[dialect.word]
    by_wire: dict[m.Wire, st.SearchStrategy[Any]] = {
        m.Wire.WORD: st.integers(0, word),
        m.Wire.UINT32: st.integers(0, 0xFFFFFFFF),
        m.Wire.DATA: st.binary(max_size=max_data),
    }
    names = dialect.fields(message_type)
    fields = {name: by_wire[wire] for name, wire in m.wire_fields(message_type) if name in names}
    if message_type is m.StatusReport:
        fields["status"] = fields["status"].map(dialect.status_bits.read)
    return st.builds(message_type, **fields)


def messages(
    dialect: FramedDialect, sender: m.Sender, max_data: int = 64
) -> st.SearchStrategy[m.Message]:
    """Every message that ``sender`` may send."""
    return st.one_of(
        *(bodies(dialect, one, max_data) for one in message_types(dialect, sender)),
    )


def garbage(dialect: FramedDialect, max_size: int = 96) -> st.SearchStrategy[bytes]:
    """Bytes without a whole magic number of ``dialect`` in them."""
    magic = dialect.header.magic
    pieces = st.one_of(st.binary(max_size=16), st.sampled_from([magic[:n] for n in range(4)]))
    joined = st.lists(pieces, max_size=8).map(lambda many: b"".join(many)[:max_size])
    return joined.filter(lambda data: not magic or magic not in data)


def streams(dialect: FramedDialect, sender: m.Sender) -> st.SearchStrategy[bytes]:
    """Anything a peer could write: frames, halves of them, wrong lengths, noise."""
    header = dialect.header
    number = st.integers(0, header.max_payload)
    small = st.integers(0, 80)
    frame = messages(dialect, sender).map(dialect.encode)
    return st.lists(
        st.one_of(
            frame,
            st.builds(lambda data, cut: data[:cut], frame, st.integers(0, 12)),
            st.builds(header.pack, st.integers(0, 0x50), st.one_of(small, number)),
            st.just(header.magic),
            st.binary(max_size=24),
        ),
        max_size=8,
    ).map(b"".join)


def chunkings(size: int) -> st.SearchStrategy[list[int]]:
    """Places where ``size`` bytes are cut."""
    return st.lists(st.integers(0, size), max_size=8).map(sorted)


def split(data: bytes, cuts: list[int]) -> list[bytes]:
    """Cut ``data`` at ``cuts``; empty pieces are left in, a socket's reader must bear them."""
    edges = [0, *cuts, len(data)]
    return [data[a:b] for a, b in pairwise(edges)]


def over(
    names: str, cells: Iterable[Any], label: Callable[[Any], object] = str
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test for each cell; a failure names its cell.

    Like ``pytest.mark.parametrize``, but one test and not thousands; ``label`` names a value.
    """
    keys, grid = names.split(", "), list(cells)
    assert grid

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def run(**given: Any) -> None:
            for cell in grid:
                values = cell if len(keys) > 1 else (cell,)
                try:
                    test(**dict(zip(keys, values, strict=True)), **given)
                except BaseException as exc:
                    exc.add_note(f"{names}: {', '.join(str(label(value)) for value in values)}")
                    raise

        signature = inspect.signature(test)
        others = [one for name, one in signature.parameters.items() if name not in keys]
        run.__signature__ = signature.replace(parameters=others)  # type: ignore[attr-defined]
        del run.__wrapped__  # pytest asks it for the arguments
        return run

    return decorate
