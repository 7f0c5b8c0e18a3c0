"""Read an agent's message about a result: its value, and all of it as JSON."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import localizations_of, new_tuple
from smartcam._json import plain
from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import InterpretationError
from smartcam.fleet._bus.errors import to_fields
from smartcam.models import Result
from smartcam.protocols.messages import ResultContainer

if TYPE_CHECKING:
    from collections.abc import Iterator
    from datetime import datetime

    from smartcam._client._inside import Interpretation, Interpreted
    from smartcam.fleet._bus.wire import ResultRun


def singles(run: ResultRun) -> Iterator[ResultRun]:
    """Yield each container of a run as its own run."""
    for place in range(len(run.payloads)):
        yield run._replace(number=run.number + place, payloads=run.payloads[place : place + 1])


def interpreted(
    run: ResultRun, interpretation: Interpretation, camera: str, at: datetime | None = None
) -> Interpreted:
    """Return the contents of the one container of ``run``.

    Args:
        run: run of one container.
        interpretation: interpretation of the container.
        camera: name of the camera.
        at: time of receipt, if it is known already.

    Raises:
        InterpretationError: the container does not fit the interpretation.
    """
    cells = fault = None
    if run.cells:
        content: dict[str, Any] = json.loads(run.cells)
        fault, given = content.get("fault"), content.get("cells")
        cells = None if given is None else tuple(given)
    (data,) = run.payloads
    container = ResultContainer(application=run.application, data=data, cells=cells, fault=fault)
    # by the method's name: a call of the object itself costs four times as much
    return interpretation.__call__(
        container, run.endian, camera=camera, number=run.number, at=at or run.received_at
    )


def as_result(
    run: ResultRun, camera: str, value: Any, sequence: int | None, at: datetime | None = None
) -> Result[Any]:
    """Return the one container of ``run`` as a result with this value; ``at``: time of receipt."""
    latency = None if math.isnan(run.latency) else run.latency
    number, triggered_at, received_at = run.number, run.trigger_time, at or run.received_at
    times = number, triggered_at, received_at, latency
    fields = (camera, run.application, sequence, *times, run.payloads[0], value)
    result: Result[Any] = new_tuple(Result, fields)
    return result


def result_fields(
    run: ResultRun, interpretation: Interpretation | None, camera: str
) -> dict[str, Any]:
    """Return the JSON fields of the one container of ``run``, with its ``error`` if there is one.

    The value is None with an error, and without an interpretation.
    """
    value = sequence = None
    outcome: dict[str, Any] = {"error": ""}
    if interpretation is not None:
        try:
            value, sequence, _ = interpreted(run, interpretation, camera)
            if localizations_of(value) is None:  # there is a faster way for localizations
                value = plain(value)
        except InterpretationError as error:
            value, outcome = None, failure(error)
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:  # noqa: BLE001 - a plug-in's value cannot become JSON
            value, outcome = (
                None,
                failure(InterpretationError(f"the value is no JSON: {exc!r:.200}")),
            )
    return {**as_result(run, camera, value, sequence)._asdict(), **outcome}


def failure(error: BaseException) -> dict[str, Any]:
    """Return an error for answers and results in JSON: ``error`` is never empty."""
    described = to_fields(error, 0)
    fields: dict[str, Any] = {
        "error": described["text"] or described["kind"],
        "kind": described["kind"],
    }
    if "attributes" in described:
        fields["attributes"] = described["attributes"]
    return fields
