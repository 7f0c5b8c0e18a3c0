"""The base class of emulated cameras of several makes, which evaluate one part after another."""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from smartcam.emulator._line_camera import LineCamera
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from smartcam.emulator._line_camera import LineClient

    Handler = Callable[..., str | None]

HandlerT = TypeVar("HandlerT", bound="Handler")
KindT = TypeVar("KindT")


def request(pattern: str) -> Callable[[HandlerT], HandlerT]:
    """Mark a method of an :class:`EvaluatingCamera` that answers the requests of a pattern.

    The method gets the client and the groups of the pattern, and returns the answer, or None for an
    answer that is sent later. The first line of its docstring explains the request.
    """

    def mark(method: HandlerT) -> HandlerT:
        method.request_pattern = re.compile(pattern, re.DOTALL)  # type: ignore[attr-defined]
        return method

    return mark


def applications_of(
    application_class: Callable[..., KindT],
    given: Iterable[int | Mapping[str, Any]],
    defaults: Mapping[str, Any] | None,
) -> list[KindT]:
    """Return applications made of their numbers, or of mappings of their fields.

    Raises:
        ConfigurationError: a field is unknown or wrong.
    """
    entries = [{"id": entry} if isinstance(entry, int) else entry for entry in given]
    try:
        return [application_class(**{**(defaults or {}), **fields}) for fields in entries]
    except TypeError as exc:
        raise ConfigurationError(f"applications: {exc}") from exc


class Operator:
    """The operator of an emulated camera: actions at the device itself."""

    def __init__(self, camera: EvaluatingCamera) -> None:
        self._camera = camera

    def trigger(self) -> None:
        """Trigger at the input; during an evaluation this is an overrun."""
        self._camera.overrun() if self._camera.busy else self._camera.begin_evaluation(None)

    def switch_application(self, application: int, running: bool = False) -> None:
        """Make another application the active one."""
        self._camera.activate(application)


class EvaluatingCamera(LineCamera):
    """An emulated camera with applications, each of which evaluates its parts in turn.

    A subclass calls :meth:`set_up` before ``super().__init__()``, and reports a result in
    :meth:`report_evaluation`.

    Attributes:
        active: number of the active application; 0 or another unused number if none is active.
        busy: True while an evaluation is running.
        parts: the parts of each application, one after the other.
    """

    requests: ClassVar[Mapping[re.Pattern[str], Handler]] = {}
    busy: bool = False

    def __init_subclass__(cls, **given: Any) -> None:
        """Collect the methods that answer requests, in order."""
        super().__init_subclass__(**given)
        methods = {
            m.request_pattern: m for m in vars(cls).values() if hasattr(m, "request_pattern")
        }
        cls.requests = {**cls.requests, **methods}

    def set_up(self, parts: Mapping[int, Sequence[Any]], active: int | None, *idle: int) -> None:
        """Set the parts of each application by its number.

        Args:
            parts: parts of each application, by its number.
            active: number of the active application; None for the first one.
            idle: numbers that mean that no application is active.

        Raises:
            ConfigurationError: there is no such application, or one has no parts.
        """
        self.active: int = next(iter(parts), 0) if active is None else active
        if self.active not in {*idle, *parts}:
            raise ConfigurationError(f"active: one of {[*parts]} was expected, got {active!r}")
        if not all(parts.values()):
            raise ConfigurationError("parts: at least one was expected")
        self.parts: dict[int, Iterator[Any]] = {
            number: itertools.cycle(sequence) for number, sequence in parts.items()
        }
        self._numbers_of_applications = [*parts]
        self._asking_client: LineClient | None = None  # client of the running evaluation
        # number of the last evaluation or switch: a switch ends a running evaluation
        self._run_number = 0
        self.device: Any = Operator(self)

    @classmethod
    def state_options(cls, active: int | None, *, running: bool) -> dict[str, Any]:
        """Return the options for a camera with an active application."""
        return {"active": active}

    @property
    def application_ids(self) -> list[int]:
        """Numbers of the camera's applications."""
        return list(self._numbers_of_applications)

    def hear(self, client: LineClient, line: str) -> None:
        """Answer a request of one of the patterns, unless its method answers later."""
        for pattern, method in self.requests.items():
            match = pattern.fullmatch(line)
            if match is not None:
                answer = method(self, client, *match.groups())
                if answer is not None:
                    client.answer(answer)
                return
        client.answer(self.unknown(line))

    def unknown(self, line: str) -> str:
        """Return the answer to a request that no pattern fits."""
        raise NotImplementedError

    # ------------------------------------------------------------------ evaluations

    async def start(self) -> None:
        """Open the port; begin to evaluate if the active application runs by itself."""
        await super().start()
        if not self.busy:
            self.activated()

    @property
    def evaluation_time(self) -> float:
        """Seconds of an evaluation."""
        raise NotImplementedError

    def report_evaluation(self, client: LineClient | None, part: Any) -> None:
        """Report the values of a part to the client that asked for them, and to others."""
        raise NotImplementedError

    def voided(self, client: LineClient) -> None:
        """Answer a request whose evaluation gives no result; nothing unless overridden."""

    def overrun(self) -> None:
        """Note a trigger that came too early; nothing unless overridden."""

    def activated(self) -> None:
        """Note that an application is active, or is active again; nothing unless overridden."""

    def _before_stop(self) -> None:
        """Forget the running evaluation, like a device that loses power."""
        super()._before_stop()
        self.busy, self._asking_client, self._run_number = False, None, self._run_number + 1

    def begin_evaluation(self, client: LineClient | None) -> None:
        """Begin an evaluation; ``client`` asked for it, None: a trigger input."""
        self.busy, self._run_number, self._asking_client = True, self._run_number + 1, client
        run_number = self._run_number
        self.after(self.evaluation_time, lambda: self._end(run_number))

    def _end(self, run_number: int) -> None:
        if run_number != self._run_number:
            return
        client, self._asking_client, self.busy = self._asking_client, None, False
        self.report_evaluation(
            None if client is None or client.is_closed else client, next(self.parts[self.active])
        )
        self.activated()

    def activate(self, application: int) -> None:
        """Make another application the active one; the running evaluation gives no result."""
        client, self._asking_client, self.busy = self._asking_client, None, False
        self.active, self._run_number = application, self._run_number + 1
        if client is not None and not client.is_closed:
            self.voided(client)
        self.activated()
