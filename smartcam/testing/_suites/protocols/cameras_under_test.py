"""Cameras for a suite: how to open one, and its applications.

A :class:`CameraKind` is one kind of camera; a :class:`LiveCamera` is an open camera. Neither knows
the checks. The client knows what a camera can do in its dialect: ``camera.capabilities``.

Each camera has the same applications; :class:`LiveCamera` has their ids.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NoReturn

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

COUNTER, OTHER, SLOW, ECHO, FREE = 7, 3, 4, 5, 9
UNUSED_APPLICATION_ID = 99
"""An id that no application has."""

SLOW_TIME = 0.15
"""Seconds that an inspection of ``SLOW`` takes."""


class LiveCamera:
    """A camera that is up, with ``COUNTER`` active and ready to run.

    A subclass implements ``url``, and each of the other methods that its camera supports. A check
    that needs a missing method is skipped, and the report names the method.

    Attributes:
        COUNTER: id of the application that answers each trigger with the number of the run, from 0.
        OTHER: id of a second application that answers as ``COUNTER`` does.
        SLOW: id of an application like ``COUNTER`` whose inspection takes ``SLOW_TIME``.
        ECHO: id of the application that sends the number in its input data, if the camera accepts
            input data.
        FREE: id of the application that runs free, about 200 times per second, and sends the number
            of the run, if the camera sends results without a trigger.
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
        """The camera's URL with the value of every option, as a client's ``url`` shows it."""
        raise NotImplementedError

    @property
    def url_without_dialect(self) -> str:
        """The camera's URL without the options that a client can find out."""
        return self.url.partition("?")[0]

    @property
    def has_session(self) -> bool:
        """True while a client is connected to the camera."""
        self._skip_check("tell whether a client has the camera")

    @property
    def inspects(self) -> bool:
        """True while an inspection is running."""
        self._skip_check("tell whether an inspection is under way")

    def trigger(self) -> None:
        """Trigger by the digital input; do nothing on a camera without one."""

    def switch(self, application: int) -> None:
        """Load and run another application, as an operator can at the camera."""
        self._skip_check("switch as an operator does")

    async def restart(self) -> None:
        """Disconnect every client; the camera is available again at once, in its initial state."""
        self._skip_check("restart the camera")

    async def kill(self) -> None:
        """Stop the camera for good."""
        self._skip_check("stop the camera for good")

    def _skip_check(self, action: str) -> NoReturn:
        pytest.skip(f"{type(self).__name__} cannot {action}")


@dataclass(frozen=True, kw_only=True)
class CameraKind:
    """One kind of camera.

    Attributes:
        name: name of the kind for people.
        open: function that opens a camera of this kind.
        applications: ids of the applications on the camera, ``COUNTER`` among them.
        numbers: interpretation of the applications' results: a record whose field ``n`` is the
            number.
        numbers_with_sequence: ``numbers`` with the number marked as the sequence number, if
            that can be set.
        raw_request: id of a request that has an answer, None if there is none.
        foreign_request: an id of a wrong Python type: text if the request ids are numbers.
        silent_request: id of a request that the camera leaves without an answer, None if there is
            none; unused if there are result codes.
        datagrams: True for a camera over UDP: messages may be lost, and the client gets no end of
            a connection.
        exclusive: True if a first client loses the camera as soon as a second one connects.
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
