"""What a monitoring tool hooks into: one interface, no dependencies."""

from __future__ import annotations

import logging
from asyncio import CancelledError
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from datetime import datetime

    from smartcam.exceptions import SmartCamError
    from smartcam.models import CameraEvent, Result

__all__ = ["Observer", "TraceEntry"]

logger: logging.Logger = logging.getLogger("smartcam.client")


class TraceEntry(NamedTuple):
    """One frame as ``--trace`` writes it.

    Attributes:
        at: when, UTC.
        camera: name of the camera.
        direction: ``>`` out, ``<`` in, ``!`` bytes that broke the protocol, or that were left of an
            unfinished frame when the link ended.
        message_id: id on the wire, None for broken bytes and where there are no such ids.
        message: name of the message, or the error's text for broken bytes.
        fields: decoded body, None where it cannot be decoded.
        hex: the bytes.
    """

    at: datetime
    camera: str
    direction: str
    message_id: int | None
    message: str
    fields: Any
    hex: str


class Observer:
    """Sees what a client sees; override what is of interest.

    Give one or more to :func:`smartcam.connect` (``observers=[...]``). They are called in the
    event loop, in order, and must return at once; what one raises is logged and goes no further.
    """

    def on_frame(self, entry: TraceEntry) -> None:
        """See a frame that went over the wire, or bytes that make none.

        Frames are decoded for this only where an observer overrides it.
        """

    def on_state(self, event: CameraEvent) -> None:
        """See what happened to the camera: the items of ``camera.events()``, in the same order."""

    def on_result(self, result: Result) -> None:
        """See a result that was interpreted: for a trigger, a stream or ``next_result()``.

        The result of a trigger has ``triggered_at`` and ``latency``. A container that nobody waits
        for is counted and not interpreted.
        """

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        """See an error.

        Args:
            camera: its name.
            error: a trigger without a result, a container that does not fit its layout, a lost
                link, a reconnect that failed.
            triggered_at: when ``trigger()`` was called, UTC; None where it was no trigger's end.
        """


class Observers:
    """All observers of one client; never raises.

    Args:
        observers: in the order in which they are called.
    """

    def __init__(self, observers: Iterable[Observer] = ()) -> None:
        self._all = tuple(observers)

    def __bool__(self) -> bool:
        return bool(self._all)

    @property
    def trace(self) -> Callable[[TraceEntry], None] | None:
        """What is to be called with every frame; None where no observer looks at frames."""
        watching = [o for o in self._all if type(o).on_frame is not Observer.on_frame]
        if not watching:
            return None

        def on_frame(entry: TraceEntry) -> None:
            for one in watching:
                self._call(one.on_frame, entry)

        return on_frame

    def state(self, event: CameraEvent) -> None:
        """Tell all of an event."""
        for one in self._all:
            self._call(one.on_state, event)

    def result(self, result: Result) -> None:
        """Tell all of a result."""
        for one in self._all:
            self._call(one.on_result, result)

    def error(
        self, camera: str, error: SmartCamError, triggered_at: datetime | None = None
    ) -> None:
        """Tell all of an error."""
        for one in self._all:
            self._call(one.on_error, camera, error, triggered_at)

    def _call(self, hook: Callable[..., None], *arguments: Any) -> None:
        try:
            hook(*arguments)
        except (Exception, CancelledError):  # neither is to end the receive task
            logger.exception("! an observer failed: %r", hook)
