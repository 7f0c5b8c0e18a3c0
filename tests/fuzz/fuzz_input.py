"""How a target reads its input: small choices from the front, what they are about behind them."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Choices", "text_of"]

T = TypeVar("T")


class Choices:
    """Takes choices from bytes, one byte each; where the bytes end, every choice is the first.

    Nothing is ever refused, so whatever a mutator does to an input, it stays one.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        """Return the next byte, 0 at the end."""
        taken = self.take(1)
        return taken[0] if taken else 0

    def pick(self, options: Sequence[T]) -> T:
        """Return one of ``options``."""
        return options[self.byte() % len(options)]

    def take(self, count: int) -> bytes:
        """Return the next ``count`` bytes, fewer at the end."""
        taken = self._data[self._at : self._at + count]
        self._at += len(taken)
        return taken

    def rest(self) -> bytes:
        """Return everything that is left."""
        return self.take(len(self._data))


def text_of(data: bytes) -> str:
    """Return bytes as a text; what is no UTF-8 becomes lone surrogates, as a ``str`` may have."""
    return data.decode("utf-8", "surrogateescape")
