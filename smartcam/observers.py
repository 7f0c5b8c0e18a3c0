"""Observers: a class to derive from, whose methods a client calls, for monitoring tools."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._arguments import check_iterable, wrong_argument
from smartcam._user_code import ENDS_PROGRAM

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from datetime import datetime

    from smartcam import protocols
    from smartcam.exceptions import SmartCamError
    from smartcam.frames import Frame as Picture
    from smartcam.models import CameraEvent, Result
    from smartcam.protocols import Dialect
    from smartcam.protocols.messages import Sender

__all__ = ["Observer", "RawFrame", "TraceEntry"]

logger: logging.Logger = logging.getLogger("smartcam.client")

_HOOKS = ("on_frame", "on_state", "on_result", "on_picture", "on_error")


_FAILED = "! an observer failed: %r"


class TraceEntry(NamedTuple):
    """One decoded frame, as ``--trace`` writes it.

    Attributes:
        at: time, UTC.
        camera: name of the camera.
        direction: ``>`` out, ``<`` in, ``!`` for broken bytes: they broke the protocol, or are part
            of a frame that was unfinished when the link ended.
        message_id: id on the wire; None for broken bytes, and if the protocol has no ids.
        message: name of the message, or the error's text for broken bytes.
        fields: decoded body, None if it cannot be decoded.
        hex: the bytes.
    """

    at: datetime
    camera: str
    direction: str
    message_id: int | None
    message: str
    fields: Any
    hex: str


class RawFrame(NamedTuple):
    """One frame that went over the wire, not yet decoded.

    Attributes:
        at: time, UTC; frames that came or went together share it.
        camera: name of the camera.
        dialect: dialect that the frame is decoded in.
        sender: side that sent the frame.
        frame: the frame; for broken bytes, a TraceEntry.
    """

    at: datetime
    camera: str
    dialect: Dialect
    sender: Sender
    frame: protocols.Frame | TraceEntry

    @property
    def size(self) -> int:
        """Bytes of the frame's body."""
        frame = self.frame
        return len(frame.hex) // 2 if isinstance(frame, TraceEntry) else len(frame.payload)

    def entry(self) -> TraceEntry:
        """Decode the frame; any thread may call this."""
        frame = self.frame
        if isinstance(frame, TraceEntry):
            return frame
        message_id, message, fields, data = self.dialect.make_readable(self.sender, frame)
        direction = ">" if self.sender.value == "client" else "<"
        return TraceEntry(self.at, self.camera, direction, message_id, message, fields, data.hex())


class Observer:
    """Base of classes that observe a client; a subclass overrides the methods that it needs.

    Give one or more to :func:`smartcam.connect` (``observers=[...]``). They are called in the
    event loop, in order, and must return at once; errors that one raises are only logged.
    """

    def on_frame(self, entry: TraceEntry) -> None:
        """Handle a frame that went over the wire, or bytes that make no frame.

        Frames are decoded only if an observer overrides this method, and not ``on_raw_frame``.
        """

    def on_raw_frame(self, frame: RawFrame) -> None:
        """Handle a frame as ``on_frame`` does, before it is decoded.

        An observer that overrides this method gets every frame here, and ``on_frame`` is not called
        unless a class derived from that observer overrides ``on_frame``. Another thread may call
        ``frame.entry()``.
        """
        self.on_frame(frame.entry())

    def on_raw_frames(self, frames: Sequence[RawFrame]) -> None:
        """Handle frames that came or went together, in order: one or more; do not change them.

        An observer that overrides this method gets every frame here, and ``on_raw_frame`` is not
        called. If another observer wants single frames, there is one in each call.
        """
        for frame in frames:
            self.on_raw_frame(frame)

    def on_state(self, event: CameraEvent) -> None:
        """Handle an event of ``camera.events()``, in the same order.

        Events are made for this only if an observer overrides the method.
        """

    def on_result(self, result: Result) -> None:
        """Handle an interpreted result: for a trigger, a stream or ``next_result()``.

        Results that came together are counted and interpreted before the first call. A status that
        came between them may be reported after the last result.

        The result of a trigger has ``triggered_at`` and ``latency``. A container that no
        caller and no subscriber waits for is counted, but not interpreted.
        """

    def on_results(self, results: Sequence[Result]) -> None:
        """Handle results that came together, in order: one or more; do not change the sequence.

        An observer that overrides it gets every result here, and ``on_result`` is not called. If
        another observer wants single results, there is one in each call.
        """
        for result in results:
            self.on_result(result)

    def on_picture(self, result: Result, frame: Picture) -> None:
        """Handle the picture that a result was made of, right before the result.

        Only software cameras have such pictures, and call this.
        """

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        """Handle an error.

        Args:
            camera: name of the camera.
            error: a trigger without a result, a container that does not fit its layout, a lost
               link, a reconnect that failed.
            triggered_at: time of the call of ``trigger()`` that failed, UTC; None if none did.
        """


class Observers:
    """All observers of one client; never raises.

    Args:
        observers: observers in the order in which they are called.

    Attributes:
        handles_states: True if an observer handles events.
        handles_results: True if an observer handles results, single or together.
        handles_single_results: True if an observer handles single results.
        handles_pictures: True if an observer handles the pictures of results.
    """

    def __init__(self, observers: Iterable[Observer] = ()) -> None:
        self._all: tuple[Observer, ...] = ()
        self._on_state: tuple[Callable[..., None], ...] = ()
        # each hook for results, and whether it takes several at once
        self._on_result: list[tuple[Callable[..., None], bool]] = []
        self._on_picture: tuple[Callable[..., None], ...] = ()
        self.handles_pictures: bool = False
        self.handles_states: bool = False
        self.handles_results: bool = False
        self.handles_single_results: bool = False
        if type(observers) is not tuple or observers:
            self._add_observers(observers)

    def _add_observers(self, observers: Iterable[Observer]) -> None:
        self._all = check_iterable(observers, "observers", "a list of observers")
        for observer in self._all:
            hooks = (getattr(observer, hook, None) for hook in _HOOKS)
            if isinstance(observer, type) or not all(map(callable, hooks)):
                raise wrong_argument("observers", "objects of classes of Observer", observer)
        self._on_state = self._overriding("on_state")
        result_hooks = self._overridden_hooks("on_results", "on_result")
        self._on_result = [(hook, name == "on_results") for hook, name in result_hooks]
        self._on_picture = self._overriding("on_picture")
        self.handles_pictures = bool(self._on_picture)
        self.handles_states = bool(self._on_state)
        self.handles_results = bool(self._on_result)
        self.handles_single_results = not all(takes_several for _, takes_several in self._on_result)

    def __bool__(self) -> bool:
        return bool(self._all)

    @property
    def trace(self) -> Callable[[Sequence[RawFrame]], None] | None:
        """Function to call with frames that came or went together; None without such observers."""
        hooks = list(self._overridden_hooks("on_raw_frames", "on_raw_frame", "on_frame"))
        if not hooks:
            return None

        def on_frames(frames: Sequence[RawFrame]) -> None:
            if all(name == "on_raw_frames" for _, name in hooks):
                for hook, _ in hooks:
                    self._call(hook, frames)
                return
            for frame in frames:
                entry: TraceEntry | None = None
                for hook, name in hooks:
                    if name == "on_frame":
                        entry = frame.entry() if entry is None else entry
                        self._call(hook, entry)
                    else:
                        self._call(hook, frame if name == "on_raw_frame" else (frame,))

        return on_frames

    def state(self, event: CameraEvent) -> None:
        """Report an event to all observers."""
        for hook in self._on_state:
            self._call(hook, event)

    def result(self, result: Result) -> None:
        """Report a result to all observers."""
        for hook, takes_several in self._on_result:
            self._call(hook, (result,) if takes_several else result)

    def results(self, results: Sequence[Result]) -> None:
        """Report results that came together; one by one if an observer wants single results."""
        if self.handles_single_results:
            for _ in self.each(results):
                pass
            return
        for hook, _ in self._on_result:
            self._call(hook, results)

    def each(self, results: Sequence[Result]) -> Iterator[Result]:
        """Report results one by one, and yield each after all observers were called with it."""
        hooks = self._on_result
        for result in results:
            for hook, takes_several in hooks:
                try:
                    hook((result,) if takes_several else result)
                except ENDS_PROGRAM:
                    raise
                except BaseException:  # an observer must not end the receive task
                    logger.exception(_FAILED, hook)
            yield result

    def picture(self, result: Result, frame: Picture) -> None:
        """Report the picture that a result was made of to all observers."""
        for hook in self._on_picture:
            self._call(hook, result, frame)

    def error(
        self, camera: str, error: SmartCamError, triggered_at: datetime | None = None
    ) -> None:
        """Report an error to all observers."""
        for observer in self._all:
            self._call(observer.on_error, camera, error, triggered_at)

    def _overriding(self, name: str) -> tuple[Callable[..., None], ...]:
        """Return this method of the observers that override it, in order."""
        hooks = [_own_hook(observer, name) for observer in self._all]
        return tuple(hook for hook in hooks if hook is not None)

    def _overridden_hooks(self, *names: str) -> Iterator[tuple[Callable[..., None], str]]:
        """Yield one overridden method of each observer, and its name; nothing if it overrides none.

        Of several overridden methods, it is the one of the most derived class; of several in one
        class, the first in ``names``.
        """
        for observer in self._all:
            hooks = [
                (name, hook) for name in names if (hook := _own_hook(observer, name)) is not None
            ]
            depths = [_depth(observer, name) for name, _ in hooks]
            if hooks:
                name, hook = hooks[depths.index(min(depths))]
                yield hook, name

    def _call(self, hook: Callable[..., None], *arguments: Any) -> None:
        try:
            hook(*arguments)
        except ENDS_PROGRAM:
            raise
        except BaseException:  # an observer must not end the receive task
            logger.exception(_FAILED, hook)


def _own_hook(observer: Observer, name: str) -> Callable[..., None] | None:
    """Return an observer's method if it overrides the method of Observer, else None."""
    hook: Callable[..., None] | None = getattr(observer, name, None)
    return None if getattr(hook, "__func__", None) is getattr(Observer, name) else hook


def _depth(observer: Observer, name: str) -> int:
    """Return the index in the MRO of the class that defines a method; -1: the object itself."""
    if name in getattr(observer, "__dict__", ()):
        return -1
    classes = type(observer).__mro__
    return next((i for i, class_ in enumerate(classes) if name in vars(class_)), len(classes))
