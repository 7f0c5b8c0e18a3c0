"""A row of the table of parsers, and the ways to hand over bytes of a stream."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import random
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from smartcam.exceptions import SmartCamError

Make = Callable[[int], Any]
"""Makes a hostile input of about so many bytes."""


class Parser(NamedTuple):
    """A parser of foreign bytes.

    Attributes:
        name: as the table in ``results/budgets.md`` calls it.
        parse: reads an input.
        inputs: makers of hostile inputs, by what is hostile in them.
        largest: bytes of the largest input that is accepted.
        bound: the constants that say so, or the reason why there is none.
        size: bytes of the smallest input that is counted; four times as many must be accepted.
        short: the same for the short run of the tests.
        refuses: errors that an input may be refused with.
        needs: modules that are not in every installation.
        refused_from: bytes from which on an input is refused, by its kind: what an input stands
            for may be more than its size, up to a bound, and is counted beyond that bound only.
    """

    name: str
    parse: Callable[[Any], object]
    inputs: Mapping[str, Make]
    largest: int
    bound: str
    size: int = 4096
    short: int = 1000
    refuses: tuple[type[Exception], ...] = (SmartCamError,)
    needs: tuple[str, ...] = ()
    refused_from: Mapping[str, int] = MappingProxyType({})

    def start(self, kind: str) -> int:
        """Return the bytes of the smallest input of a kind that is counted."""
        return max(self.size, self.refused_from.get(kind, 0))

    @property
    def missing(self) -> list[str]:
        """Return the modules that are not here."""
        return [one for one in self.needs if importlib.util.find_spec(one) is None]

    def run(self, given: Any) -> None:
        """Read an input; a refusal is an answer, too."""
        with contextlib.suppress(*self.refuses):
            self.parse(given)


def whole(data: bytes) -> list[bytes]:
    """Hand a stream over in one piece."""
    return [data]


def bytewise(data: bytes) -> list[bytes]:
    """Hand a stream over byte by byte."""
    return [data[at : at + 1] for at in range(len(data))]


def torn(data: bytes) -> list[bytes]:
    """Hand a stream over in pieces of 1 to 1500 bytes, the same ones each time."""
    cut, at, found = random.Random(1), 0, list[bytes]()  # noqa: S311 - the same each time
    while at < len(data):
        size = cut.choice((1, 2, 3, 7, 40, 300, 1500))
        found.append(data[at : at + size])
        at += size
    return found


def streamed(makers: Mapping[str, Make]) -> dict[str, Make]:
    """Return each maker of bytes thrice: for one piece, single bytes and random pieces."""
    ways = (("at once", whole), ("byte by byte", bytewise), ("torn", torn))
    return {
        f"{kind}, {how}": functools.partial(_cut, make, cut)
        for kind, make in makers.items()
        for how, cut in ways
    }


def _cut(make: Make, cut: Callable[[bytes], list[bytes]], size: int) -> list[bytes]:
    return cut(make(size))


def fill(unit: bytes, head: bytes = b"", tail: bytes = b"") -> Make:
    """Return a maker that repeats a unit between a head and a tail."""

    def make(size: int) -> bytes:
        return head + unit * max(1, (size - len(head) - len(tail)) // len(unit)) + tail

    return make


def fill_text(unit: str, head: str = "", tail: str = "") -> Make:
    """Return a maker of texts that repeats a unit; ``{}`` in it is a number of its own."""

    def make(size: int) -> str:
        return "".join((head, *_numbered(unit, size), tail))

    return make


def _numbered(unit: str, size: int) -> Iterator[str]:
    length = number = 0
    while length < size:
        piece = unit.replace("{}", str(number))
        yield piece
        length, number = length + len(piece), number + 1


def grown(make: Callable[[int], Any], unit: int) -> Make:
    """Return a maker of an input of so many units of ``unit`` bytes each."""
    return lambda size: make(max(1, size // unit))


def drain(items: Iterable[object]) -> None:
    """Take all, and keep none."""
    for _ in items:
        pass


def from_file(read: Callable[[Path], object], name: str) -> Callable[[Any], None]:
    """Return what has a reader of files read an input."""

    def parse(given: str | bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(given.encode() if isinstance(given, str) else given)
            read(path)

    return parse


def size_of(given: Any) -> int:
    """Return the bytes of an input."""
    if isinstance(given, str):
        return len(given.encode())
    if isinstance(given, list):
        return sum(map(size_of, given))
    return len(given)
