"""Interpret results in an agent's messages, and return them as objects or as fields for JSON."""

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


def split_run(run: ResultRun) -> Iterator[ResultRun]:
    """Yield each container of a run as a run of one container."""
    for index in range(len(run.payloads)):
        yield run._replace(number=run.number + index, payloads=run.payloads[index : index + 1])


def interpret_run(
    run: ResultRun, interpretation: Interpretation, camera: str, at: datetime | None = None
) -> Interpreted:
    """Return the interpreted contents of a run that has one container.

    Args:
        run: run of one container.
        interpretation: interpretation of the container.
        camera: name of the camera.
        at: time of receipt; None: compute it from the run.

    Raises:
        InterpretationError: the container does not fit the interpretation.
    """
    cells = fault = None
    if run.cells:
        content: dict[str, Any] = json.loads(run.cells)
        fault, cell_list = content.get("fault"), content.get("cells")
        cells = None if cell_list is None else tuple(cell_list)
    (data,) = run.payloads
    container = ResultContainer(application=run.application, data=data, cells=cells, fault=fault)
    # calling __call__ by its name takes a quarter of the time of calling the object
    return interpretation.__call__(
        container, run.endian, camera=camera, number=run.number, at=at or run.received_at
    )


def to_result(
    run: ResultRun, camera: str, value: Any, sequence: int | None, at: datetime | None = None
) -> Result[Any]:
    """Return a result with this value for a run of one container; ``at``: time of receipt."""
    latency = None if math.isnan(run.latency) else run.latency
    number, triggered_at, received_at = run.number, run.trigger_time, at or run.received_at
    times = number, triggered_at, received_at, latency
    fields = (camera, run.application, sequence, *times, run.payloads[0], value)
    result: Result[Any] = new_tuple(Result, fields)
    return result


def result_fields(
    run: ResultRun, interpretation: Interpretation | None, camera: str
) -> dict[str, Any]:
    """Return the fields for JSON of a run that has one container.

    The value is None if there is an error, or no interpretation; ``error`` is empty without error.
    """
    value = sequence = None
    outcome: dict[str, Any] = {"error": ""}
    if interpretation is not None:
        try:
            value, sequence, _ = interpret_run(run, interpretation, camera)
            if localizations_of(value) is None:  # localizations can be encoded as they are
                value = plain(value)
        except InterpretationError as error:
            value, outcome = None, error_fields(error)
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:  # noqa: BLE001 - a plug-in's value cannot become JSON
            value, outcome = (
                None,
                error_fields(InterpretationError(f"the value is no JSON: {exc!r:.200}")),
            )
    return {**to_result(run, camera, value, sequence)._asdict(), **outcome}


def error_fields(error: BaseException) -> dict[str, Any]:
    """Return the fields for JSON that describe an error; ``error`` is never empty."""
    described = to_fields(error, 0)
    fields: dict[str, Any] = {
        "error": described["text"] or described["kind"],
        "kind": described["kind"],
    }
    if "attributes" in described:
        fields["attributes"] = described["attributes"]
    return fields
