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
    from smartcam.fleet._bus.wire import ResultGroup


def split_group(group: ResultGroup) -> Iterator[ResultGroup]:
    """Yield each container of a group as a group of one container."""
    for index in range(len(group.payloads)):
        payloads = group.payloads[index : index + 1]
        yield group._replace(number=group.number + index, payloads=payloads)


def interpret_single(
    group: ResultGroup, interpretation: Interpretation, camera: str, at: datetime | None = None
) -> Interpreted:
    """Return the interpreted contents of a group that has one container.

    Args:
        group: group of one container.
        interpretation: interpretation of the container.
        camera: name of the camera.
        at: time of receipt; None: take it from the group.

    Raises:
        InterpretationError: the container does not fit the interpretation.
    """
    cells = fault = None
    if group.cells:
        content: dict[str, Any] = json.loads(group.cells)
        fault, cell_list = content.get("fault"), content.get("cells")
        cells = None if cell_list is None else tuple(cell_list)
    (data,) = group.payloads
    container = ResultContainer(application=group.application, data=data, cells=cells, fault=fault)
    # calling __call__ by its name takes a quarter of the time of calling the object
    return interpretation.__call__(
        container, group.endian, camera=camera, number=group.number, at=at or group.received_at
    )


def to_result(
    group: ResultGroup, camera: str, value: Any, sequence: int | None, at: datetime | None = None
) -> Result[Any]:
    """Return a result with this value for a group of one container; ``at``: time of receipt."""
    latency = None if math.isnan(group.latency) else group.latency
    number, triggered_at, received_at = group.number, group.trigger_time, at or group.received_at
    times = number, triggered_at, received_at, latency
    fields = (camera, group.application, sequence, *times, group.payloads[0], value)
    result: Result[Any] = new_tuple(Result, fields)
    return result


def result_fields(
    group: ResultGroup, interpretation: Interpretation | None, camera: str
) -> dict[str, Any]:
    """Return the fields for JSON of a group that has one container.

    The value is None if there is an error, or no interpretation; ``error`` is empty without error.
    """
    value = sequence = None
    outcome: dict[str, Any] = {"error": ""}
    if interpretation is not None:
        try:
            value, sequence, _ = interpret_single(group, interpretation, camera)
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
    return {**to_result(group, camera, value, sequence)._asdict(), **outcome}


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
