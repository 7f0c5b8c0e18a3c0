"""Jobs, their results, and the error numbers of methods."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import (
    CameraBusyError,
    CommandRejectedError,
    ConfigurationError,
    InterpretationError,
    LinkError,
    MissingExtraError,
    NotRunningError,
    SmartCamError,
    UnsupportedError,
)

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

COMPLETED, ABORTED, FAILED = 1, 3, 4
"""States of a result, as the nodeset numbers them."""


class UnknownRecipeError(ConfigurationError):
    """A client named an unknown recipe."""


class BusyError(SmartCamError):
    """Another call to the same camera is under way."""


ERRORS: tuple[tuple[type[BaseException], int], ...] = (
    (UnknownRecipeError, -2),
    (MissingExtraError, -1),
    (ConfigurationError, -9),
    (InterpretationError, -8),
    (NotRunningError, -10),
    (CommandRejectedError, -3),
    (UnsupportedError, -3),
    (BusyError, -6),
    (CameraBusyError, -6),
    (LinkError, -5),
    (TimeoutError, -4),
)
"""Numbers of errors in a method's argument ``Error``; the first class that fits decides."""

NOT_FOUND = -7
"""Number of the error for a result, handle or picture that is unknown or no longer kept."""


def code_of(error: BaseException) -> int:
    """Return the number of an error in a method's outputs; -1 for one without its own."""
    return next((code for kind, code in ERRORS if isinstance(error, kind)), -1)


@dataclass(slots=True, eq=False)
class VisionJob:
    """A job that a client has started.

    Attributes:
        id: id of the job.
        single: True for one trigger, False for continuous execution.
        meas: id of the measurement, as the client gave it; None without one.
        part: id of the part, as the client gave it; None without one.
        product: id of the product, as the client gave it; None without one.
        application: application that was ready when the job began.
        started: time of its start, UTC.
        trigger: time of its trigger, from the camera's client, by which its result is found.
        seen: event that is set when its result is published.
        ended_clock: clock of the event loop at its end; None while it is under way.
        task: task that carries out the job.
    """

    id: str
    single: bool
    meas: Any
    part: Any
    product: Any
    application: int | None
    started: datetime = field(default_factory=lambda: datetime.now(UTC))
    trigger: datetime | None = None
    seen: asyncio.Event = field(default_factory=asyncio.Event)
    ended_clock: float | None = None
    task: asyncio.Task[None] | None = None


@dataclass(slots=True, frozen=True, eq=False)
class VisionResult:
    """A result as clients get it, or the end of a job without one.

    Attributes:
        id: id of the result.
        camera: name of the camera.
        state: number of its state, as the nodeset numbers them.
        application: application that made it; None if that is not known.
        job: job that the result belongs to; None for a result without a job.
        created: time at which it came, UTC.
        fields: fields of its JSON object.
        error: text that says why there are no values; "" if there are.
        picture: file of its picture; None without one.
        simulated: True for an emulated camera, False for a real one, None if that is not known.
    """

    id: str
    camera: str
    state: int
    application: int | None
    job: VisionJob | None
    created: datetime
    fields: Mapping[str, Any]
    error: str = ""
    picture: Path | None = None
    simulated: bool | None = None

    @property
    def job_id(self) -> str:
        """Id of its job; "" without one."""
        return "" if self.job is None else self.job.id
