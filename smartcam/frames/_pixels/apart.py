"""The planes of a picture where a decoder left them, joined when somebody asks for their bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


class PlanesApart:
    """Planes that stand in places of their own, such as a decoder's Y, U and V.

    Joining them costs a copy of the whole picture, which the brightness alone does not need.

    Args:
        planes: objects with the bytes of a plane each, which nobody writes into.
    """

    __slots__ = ("_joined", "_planes")

    def __init__(self, planes: Sequence[Any]) -> None:
        self._planes: tuple[memoryview, ...] = tuple(memoryview(one).toreadonly() for one in planes)
        self._joined: bytes | None = None

    @property
    def first(self) -> bytes | memoryview:
        """The bytes of the first plane, and of those behind it where they were joined."""
        planes = self._planes  # before the other one: another thread may join them meanwhile
        return planes[0] if self._joined is None else self._joined

    def joined(self) -> bytes:
        """Return the bytes of all planes, one behind the other; the decoder's own are let go."""
        planes, joined = self._planes, self._joined
        if joined is None:
            joined = self._joined = b"".join(planes)
            self._planes = ()
        return joined


class JoinedOnUse:
    """An attribute for bytes that may be given as :class:`PlanesApart`; who reads it gets bytes.

    Args:
        slot: descriptor that keeps what is given.
    """

    def __init__(self, slot: Any) -> None:
        self._slot = slot
        self.held: Callable[[Any], Any] = slot.__get__
        """Returns what was given."""

    def __get__(self, owner: Any, kind: type | None = None) -> Any:
        if owner is None:
            return self
        held = self._slot.__get__(owner)
        return held.joined() if type(held) is PlanesApart else held

    def __set__(self, owner: Any, value: object) -> None:
        self._slot.__set__(owner, value)
