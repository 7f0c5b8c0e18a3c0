"""Keep the planes of a decoded picture separate until their bytes must be contiguous."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


class SeparatePlanes:
    """Planes in separate buffers, such as a decoder's Y, U and V.

    Joining the planes copies the whole picture. To read only the brightness, no copy is needed.

    Args:
        planes: buffers with the bytes of one plane each, which do not change.
    """

    __slots__ = ("_joined", "_planes")

    def __init__(self, planes: Sequence[Any]) -> None:
        self._planes: tuple[memoryview, ...] = tuple(
            memoryview(plane).toreadonly() for plane in planes
        )
        self._joined: bytes | None = None

    @property
    def first(self) -> bytes | memoryview:
        """Bytes that begin with the first plane; the other planes follow if they were joined."""
        planes = self._planes  # read first: another thread may join the planes
        return planes[0] if self._joined is None else self._joined

    def joined(self) -> bytes:
        """Return the bytes of all planes in order, and release the decoder's buffers."""
        planes, joined = self._planes, self._joined
        if joined is None:
            joined = self._joined = b"".join(planes)
            self._planes = ()
        return joined


class JoinedPlanes:
    """A descriptor for bytes that may be set as :class:`SeparatePlanes`; reading it joins them.

    Args:
        slot: descriptor that stores the value.
    """

    def __init__(self, slot: Any) -> None:
        self._slot = slot
        self.stored_value: Callable[[Any], Any] = slot.__get__
        """Function that returns an object's stored value, without joining planes."""

    def __get__(self, owner: Any, kind: type | None = None) -> Any:
        if owner is None:
            return self
        stored = self._slot.__get__(owner)
        return stored.joined() if type(stored) is SeparatePlanes else stored

    def __set__(self, owner: Any, value: object) -> None:
        self._slot.__set__(owner, value)
