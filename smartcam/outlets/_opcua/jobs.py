"""Define jobs (clients' orders to take one or more pictures), their results, and error numbers."""

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
"""The number in a method's output ``Error`` for each class of errors; the first match decides."""

NOT_FOUND = -7
"""Number of the error for a result, handle or picture that is unknown or no longer kept."""


def code_of(error: BaseException) -> int:
    """Return the number of an error in a method's outputs; -1 if its class has no number."""
    return next((code for kind, code in ERRORS if isinstance(error, kind)), -1)


@dataclass(slots=True, eq=False)
class VisionJob:
    """A job that a client has started.

    Attributes:
        id: id of the job.
        is_single: True for one trigger, False for continuous execution.
        meas: id of the measurement, as the client gave it; None without one.
        part: id of the part, as the client gave it; None without one.
        product: id of the product, as the client gave it; None without one.
        application: application that was ready when the job began.
        started_at: time of the job's start, UTC.
        triggered_at: time of the job's trigger, by which the job's result is recognized.
        result_published: event that is set when the job's result is published.
        ended_at: loop time of the job's end; None while the job runs.
        task: task that carries out the job.
    """

    id: str
    is_single: bool
    meas: Any
    part: Any
    product: Any
    application: int | None
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    triggered_at: datetime | None = None
    result_published: asyncio.Event = field(default_factory=asyncio.Event)
    ended_at: float | None = None
    task: asyncio.Task[None] | None = None


@dataclass(slots=True, frozen=True, eq=False)
class VisionResult:
    """A result as clients get it, or the end of a job without a result.

    Attributes:
        id: id of the result.
        camera: name of the camera.
        state: number of the result's state in the nodeset.
        application: application that made the result; None if it is not known.
        job: job that the result belongs to; None for a result without a job.
        created: time at which the result was received, UTC.
        fields: fields of the result's JSON object.
        error: reason why there are no values; "" if there are.
        picture: file of the result's picture; None without one.
        simulated: True for an emulated camera, False for a real one, None if this is not known.
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
        """Id of the result's job; "" without a job."""
        return "" if self.job is None else self.job.id
