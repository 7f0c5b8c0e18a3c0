"""Cameras that a suite runs against: how to put one up, and what stands on it.

A :class:`CameraKind` is one kind of camera; a :class:`LiveCamera` is the camera while it is up.
Neither knows anything of the checks. What a camera can do in its dialect is asked of the client:
``camera.capabilities``.

On each camera stand the same applications: :class:`LiveCamera` has their ids.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NoReturn

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

COUNTER, OTHER, SLOW, ECHO, FREE = 7, 3, 4, 5, 9
NOBODYS = 99
"""No application has this id."""

SLOW_TIME = 0.15
"""Seconds that an inspection of ``SLOW`` takes."""


class LiveCamera:
    """A camera that is up, with ``COUNTER`` active and ready to run.

    A subclass has ``url`` and what else can be done with the camera. A check that needs what a
    subclass leaves out is skipped, and says so.

    Attributes:
        COUNTER: id of the application that answers each trigger with the number of the run, from 0.
        OTHER: id of a second application that answers as ``COUNTER`` does.
        SLOW: id of the application that answers so after ``SLOW_TIME``.
        ECHO: id of the application that sends the number that came as input data, where the camera
            takes any.
        FREE: id of the application that runs free, some 200 times per second, and sends the number
            of the run, where the camera sends unasked.
        SLOW_TIME: seconds that an inspection of ``SLOW`` takes.
    """

    COUNTER: Final = COUNTER
    OTHER: Final = OTHER
    SLOW: Final = SLOW
    ECHO: Final = ECHO
    FREE: Final = FREE
    SLOW_TIME: Final = SLOW_TIME

    @property
    def url(self) -> str:
        """Its URL, with everything pinned that can be, as a client's ``url`` shows it."""
        raise NotImplementedError

    @property
    def unpinned(self) -> str:
        """The same without what a client can find out."""
        return self.url.partition("?")[0]

    @property
    def has_session(self) -> bool:
        """True while a client has the camera."""
        self._cannot("tell whether a client has the camera")

    @property
    def inspects(self) -> bool:
        """True while an inspection is under way."""
        self._cannot("tell whether an inspection is under way")

    def trigger(self) -> None:
        """Trigger by the digital input; a camera that has none does nothing."""

    def switch(self, application: int) -> None:
        """Load and run another application, as an operator does."""
        self._cannot("switch as an operator does")

    async def restart(self) -> None:
        """Lose every client and be there again at once, as it was at first."""
        self._cannot("restart the camera")

    async def kill(self) -> None:
        """Be gone, and stay so."""
        self._cannot("have the camera gone")

    def _cannot(self, what: str) -> NoReturn:
        pytest.skip(f"{type(self).__name__} cannot {what}")


@dataclass(frozen=True, kw_only=True)
class CameraKind:
    """One kind of camera.

    Attributes:
        name: name of the kind for people.
        open: function that opens a camera of this kind.
        applications: ids of the applications on the camera, ``COUNTER`` among them.
        numbers: how to interpret what the applications send: a record whose field ``n`` is the
            number.
        numbers_with_sequence: ``numbers`` with the number marked as the sequence number, where
            that can be set.
        raw_request: id of a request that is answered by something, None if there is none.
        foreign_request: an id of another kind than the protocol's.
        silent_request: id of a request that the camera leaves without an answer, None if there is
            not valid; unused where there are result codes.
        datagrams: True if messages may be lost, and nobody is told that the camera is gone.
        exclusive: True if a second client takes the camera from the first.
        has_zero: True if an application may have the id 0.
    """

    name: str
    open: Callable[[], AbstractAsyncContextManager[LiveCamera]]
    applications: frozenset[int] = frozenset({COUNTER, OTHER, SLOW, ECHO, FREE})
    numbers: str = "n: uint32"
    numbers_with_sequence: str = "n: uint32 @sequence"
    raw_request: int | str | None = 0x30
    foreign_request: int | str = "text"
    silent_request: int | str | None = 0x77
    datagrams: bool = False
    exclusive: bool = True
    has_zero: bool = False

    def __str__(self) -> str:
        return self.name
