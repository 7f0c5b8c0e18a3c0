"""Options that commands share, and what is made of them."""

from __future__ import annotations

import json
import math
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from smartcam.client import SmartCamera, connect
from smartcam.exceptions import ConfigurationError
from smartcam.models import jsonable
from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam._client.link import TraceEntry
    from smartcam.calibration.files.load import AnyCalibration

__all__ = [
    "CONNECTS",
    "Options",
    "application",
    "camera_options",
    "camera_url",
    "output_options",
    "result_options",
]

F = TypeVar("F", bound="Callable[..., Any]")

CONNECTS = (
    "Connecting takes the camera from another client, where it serves one: the newcomer wins."
)


class _Seconds(click.FloatRange):
    """Seconds; NaN, which is below no bound and above none, is refused too."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        seconds = super().convert(value, param, ctx)
        if math.isnan(seconds):
            self.fail(f"{value!r} is not a number.", param, ctx)
        return seconds


SECONDS = _Seconds(min=0, min_open=True, max=86_400)

_output = [
    click.option("--json", "as_json", is_flag=True, help="One JSON object a line on stdout."),
    click.option("--debug", is_flag=True, help="Log what happens and show tracebacks, on stderr."),
]
_camera = [
    click.option(
        "--timeout",
        type=SECONDS,
        help="Bound of each step: connect (default 10), switch until ready (10), trigger (5).",
    ),
    click.option(
        "--trace",
        type=click.Path(dir_okay=False),
        help="Write every frame, decoded and hex, as JSON lines.",
    ),
]
_result = [
    click.option(
        "--application",
        type=click.IntRange(0, 0xFFFFFFFF),
        help="Have this application running and ready first (stop, switch, start as needed).",
    ),
    click.option(
        "--interpret-as",
        metavar="SPEC",
        help="An interpreter, a layout, or both: localizations; 'x: real32 mm, y: real32 mm'; "
        "'table: (x: real32)*'. Default raw: bytes, shown as hex.",
    ),
    click.option("--y-down", is_flag=True, help="The camera's y axis points down."),
    click.option(
        "--calibration",
        metavar="FILE",
        type=click.Path(dir_okay=False),
        help="Show localizations in the robot's frame, by what smartcam calibrate wrote.",
    ),
    click.option(
        "--name",
        metavar="NAME",
        help="The camera's name: in results, and as the frame of poses; default HOST:PORT.",
    ),
    click.option("--count", type=click.IntRange(min=1), help="End after so many results."),
    click.option("--seconds", type=SECONDS, help="End after so many seconds."),
]


def _apply(options: list[Any], function: F) -> F:
    for option in reversed(options):
        function = option(function)
    return function


def output_options(function: F) -> F:
    """Decorate a command with ``--json`` and ``--debug``."""
    return _apply(_output, function)


def camera_options(function: F) -> F:
    """Decorate a command that connects."""
    return _apply([*_camera, *_output], function)


def result_options(function: F) -> F:
    """Decorate a command that prints results."""
    return _apply([*_result, *_camera, *_output], function)


def application(text: str) -> int | str:
    """Return an application's id, or the name of its file: whatever is no number.

    Raises:
        click.BadParameter: an id that none can have.
        ValueError: signs and digits that make no number.
    """
    if not text.lstrip("+-").isdecimal():
        return text
    number = int(text)
    if not 0 <= number <= 0xFFFFFFFF:
        raise click.BadParameter(f"{text} is not in the range 0<=x<=4294967295.")
    return number


def camera_url(text: str) -> str:
    """Return a camera's URL; a bare host is one that speaks BVS over TCP."""
    return text if "://" in text else f"bvs://{text}"


class _Frames(Observer):
    """Gives every frame to a function."""

    def __init__(self, write: Callable[[TraceEntry], None]) -> None:
        self._write = write

    def on_frame(self, entry: TraceEntry) -> None:
        self._write(entry)


def _calibration(path: str) -> AnyCalibration:
    """Return what a calibration's file holds."""
    from smartcam.calibration.files.load import load_calibration

    try:
        return load_calibration(path)
    except OSError as exc:
        raise ConfigurationError(f"--calibration {path}: {exc.strerror}") from exc


@dataclass(slots=True)
class Options:
    """The shared options as a command uses them."""

    as_json: bool = False
    debug: bool = False
    timeout: float | None = None
    trace: str | None = None
    application: int | None = None
    interpret_as: str | None = None
    y_down: bool = False
    calibration: str | None = None
    name: str | None = None
    count: int | None = None
    seconds: float | None = None

    def step(self, default: float) -> float:
        """Return the bound of a step, seconds."""
        return default if self.timeout is None else self.timeout

    def check_y_down(self, calibration: AnyCalibration, what: str) -> None:
        """Raise where ``--y-down`` is not as it was when a calibration was made.

        Args:
            calibration: the calibration.
            what: the option that names it.

        Raises:
            ConfigurationError: says what to do with ``--y-down``.
        """
        if calibration.y_down is not None and calibration.y_down != self.y_down:
            made, then = ("with", "give it") if calibration.y_down else ("without", "leave it out")
            raise ConfigurationError(
                f"{what}: it was made {made} --y-down: {then} here, too, or poses are mirrored"
            )

    @contextmanager
    def camera(self, url: str) -> Iterator[SmartCamera]:
        """Give an unopened camera; the trace file is open around it.

        Raises:
            CalibrationError: the calibration's file is damaged, newer, or holds something else.
            ConfigurationError: a file cannot be opened, or an option cannot work.
        """
        calibration = None if self.calibration is None else _calibration(self.calibration)
        if calibration is not None:
            self.check_y_down(calibration, f"--calibration {self.calibration}")
        with self.tracing() as trace:
            yield connect(
                camera_url(url),
                observers=[_Frames(trace)] if trace is not None else [],
                reconnect=None,
                name=self.name or "",
                application=self.application,
                interpret_as=self.interpret_as,
                calibration=calibration,
                y_down=self.y_down,
                connect_timeout=self.step(10.0),
                switch_timeout=self.step(10.0),
            )

    @contextmanager
    def tracing(self) -> Iterator[Callable[[TraceEntry], None] | None]:
        """Give what writes the trace file, None where none is wanted."""
        if self.trace is None:
            yield None
            return
        try:
            stream = Path(self.trace).open("w", encoding="utf-8", buffering=1)  # noqa: SIM115
        except OSError as exc:
            raise ConfigurationError(f"--trace {self.trace}: {exc.strerror}") from exc
        failed: list[OSError] = []

        def write(entry: TraceEntry) -> None:
            # called from the link, which would take an OSError for one of its own
            if not failed:
                try:
                    stream.write(json.dumps(jsonable(entry)) + "\n")
                except OSError as exc:
                    failed.append(exc)

        try:
            yield write
        finally:
            try:
                stream.close()
            except OSError as exc:
                failed.append(exc)
        if failed:
            raise ConfigurationError(f"--trace {self.trace}: {failed[0].strerror}") from failed[0]

    def show(self, value: object, text: str | Callable[[Any], str]) -> None:
        """Print ``value`` as a line of JSON, or for people ``text`` (of it); flushed."""
        if self.as_json:
            click.echo(json.dumps(jsonable(value)))
        else:
            click.echo(text if isinstance(text, str) else text(value))
