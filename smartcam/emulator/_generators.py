"""Generators: functions, known by name, that make the values of an application's results.

A generator gets a :class:`Run` and returns a value for ``Layout.build``: a mapping for a record, a
list of mappings if it repeats, ``( ... )*``. :func:`register_generator` adds a generator
that scenario files can name, and so does a plug-in (entry points ``smartcam.generators``); in
Python the function itself can be given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError, PluginError
from smartcam.registry import GENERATORS

if TYPE_CHECKING:
    from smartcam.emulator._scene import Observation, TableScene
    from smartcam.layout import Layout
    from smartcam.layout._inside import Field

Values: TypeAlias = Mapping[str, Any] | Sequence[Any]


class Run(NamedTuple):
    """One inspection, with the facts that its application knows.

    Attributes:
        number: the run's sequence number.
        run_index: number of runs of this application before this run, since it was loaded.
        time: seconds since the device was made.
        layout: layout of the result.
        scene: the table that the camera sees.
        input: the input container's values, None for an application without one.
        parameters: ``parameters`` of the application.
    """

    number: int
    run_index: int
    time: float
    layout: Layout
    scene: TableScene
    input: Mapping[str, Any] | None
    parameters: Mapping[str, Any]


Generator: TypeAlias = Callable[[Run], Values]


def zeros(fields: Sequence[Field]) -> dict[str, Any]:
    """Return the values of a tool that did not run: zero, False or an empty string for each field.

    Source: HALCON script manual p. 2 (published).
    """
    empty: dict[str, Any] = {"string": "", "bool": False}
    return {field.name: empty.get(field.type, 0) for field in fields}


def wrap_number(field: Field, number: int) -> int:
    """Return a sequence number as ``field`` can hold it: after the largest number comes 0."""
    low, high = field.wire.low, field.wire.high
    if low is None or high is None:
        return number
    return (number - low) % (high - low + 1) + low


_LOADED: dict[str, Generator] = {}  # generators in use, since each run looks up its own


def find_generator(name: str) -> Generator:
    """Return the generator of that name.

    Raises:
        ConfigurationError: no generator has this name; the text lists the known names.
        PluginError: a plug-in's generator failed to load, or is no function.
    """
    generator = _LOADED.get(name)
    if generator is not None:
        return generator
    if name not in GENERATORS:
        raise ConfigurationError(
            f"generator {name!r} is unknown; known are {', '.join(generator_names())}"
            f"{did_you_mean(name, generator_names())}"
        )
    loaded = GENERATORS.load(name)
    if not callable(loaded):
        raise PluginError(f"generator {name!r}: {loaded!r} is no function", name=name)
    generator = _LOADED[name] = cast("Generator", loaded)
    return generator


def generator_names() -> list[str]:
    """Return the names of all generators, sorted, without loading plug-ins."""
    return [info.name for info in GENERATORS.available()]


def register_generator(name: str, function: Generator) -> None:
    """Let applications name ``function`` as their generator.

    Raises:
        PluginError: the name is taken by another function.
    """
    GENERATORS.register(name, function)


def _tangram(run: Run) -> Values:
    """The table's pieces as the camera's own calibration gives them: metres and radians."""

    def record(observation: Observation) -> dict[str, Any]:
        pose = run.scene.to_table(observation)
        return _localization(observation, x=pose.x, y=pose.y, theta=pose.theta)

    return _records(run, record)


def _tangram_pixels(run: Run) -> Values:
    """The table's pieces in pixels of the image; theta in radians."""

    def record(observation: Observation) -> dict[str, Any]:
        return _localization(observation, x=observation.u, y=observation.v, theta=observation.theta)

    return _records(run, record)


def _localization(observation: Observation, *, x: float, y: float, theta: float) -> dict[str, Any]:
    return {
        "feature_id": observation.name,
        "quality": observation.quality,
        "photo_index": 0,
        "x": x,
        "y": y,
        "theta": theta,
    }


def _records(run: Run, record: Callable[[Observation], dict[str, Any]]) -> Values:
    """Return the layout's fields; the parameter ``pieces`` gives the pieces and their order."""
    observations = {observation.name: observation for observation in run.scene.measure()}
    wanted: Sequence[str] = run.parameters.get("pieces", list(observations))
    names = {field.name for field in run.layout.fields}
    records = [
        {key: value for key, value in record(observations[name]).items() if key in names}
        for name in wanted
        if name in observations
    ]
    if run.layout.repeat is None:
        return records[0] if records else zeros(run.layout.fields)
    return records


def _sequence(run: Run) -> Values:
    """The run's number in the parameter ``field``, else in the ``@sequence`` or the first field."""
    fields = run.layout.head or run.layout.fields
    number_field = run.layout.sequence_field
    name = run.parameters.get(
        "field", number_field.name if number_field is not None else fields[0].name
    )
    values = zeros(run.layout.fields)
    for field in run.layout.fields:
        if field.name == name:
            values[name] = wrap_number(field, run.number)
    return values if run.layout.repeat is None else [values]


def _input(run: Run) -> Values:
    """The input container's values, in the fields of the same names."""
    values = zeros(run.layout.fields)
    values.update((key, value) for key, value in (run.input or {}).items() if key in values)
    return values if run.layout.repeat is None else [values]
