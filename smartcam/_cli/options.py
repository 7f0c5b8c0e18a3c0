"""Common options of commands, and the cameras and texts that commands make with them."""

from __future__ import annotations

import functools
import math
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypeVar

import click

from smartcam._cli.terminal import coloured
from smartcam._cli.usage import INTERRUPTED, exiting_on_interrupt
from smartcam._extras import from_part
from smartcam.exceptions import ConfigurationError, UnsupportedError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator, Mapping

    from smartcam.calibration._inside import AnyCalibration
    from smartcam.camera import Camera
    from smartcam.models import Result
    from smartcam.observers import Observer, TraceEntry

DIALECTS = ("handbook", "thesis", "b16", "bid")
"""The dialects of the protocol ``bvs``, the default first."""

F = TypeVar("F", bound="Callable[..., Any]")

CONNECT_WARNING = (
    "Connecting takes the camera from another client, if it serves one: the newcomer wins. A "
    "camera of a fleet is shared."
)


class _Seconds(click.FloatRange):
    """Seconds within bounds; NaN is refused, too, since it passes every check of a bound."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        seconds = super().convert(value, param, ctx)
        if math.isnan(seconds):
            self.fail(f"{value!r} is not a number.", param, ctx)
        return seconds


SECONDS = _Seconds(min=0, min_open=True, max=86_400)

INTERPRET_AS = (
    "An interpreter, a layout, or both: localizations; 'x: real32 mm, y: real32 mm'; "
    "'table: (x: real32)*'. Default raw: bytes, shown as hex."
)

_OPTIONS: Mapping[str, Mapping[str, Any]] = {
    "--application": {
        "type": click.IntRange(0, 0xFFFFFFFF),
        "help": "Run this application first (stop, switch, start as needed).",
    },
    "--interpret-as": {"metavar": "SPEC", "help": INTERPRET_AS},
    "--y-down": {"is_flag": True, "help": "The camera's y axis points down."},
    "--calibration": {
        "metavar": "FILE",
        "type": click.Path(dir_okay=False),
        "help": "Show localizations in the robot's frame, by a file of smartcam calibrate.",
    },
    "--name": {
        "metavar": "NAME",
        "help": "The camera's name: in results, and as the frame of poses; default HOST:PORT, or "
        "that in the fleet.",
    },
    "--units": {
        "metavar": "UNITS",
        "help": "Show values in these units instead of SI, such as mm,deg; --json always has SI "
        "units.",
    },
    "--count": {"type": click.IntRange(min=1), "help": "End after so many results."},
    "--seconds": {"type": SECONDS, "help": "End after so many seconds."},
    "--timeout": {
        "type": SECONDS,
        "help": "Longest time for each step: connect (default 10), switch (10), trigger (5).",
    },
    "--trace": {
        "type": click.Path(dir_okay=False),
        "help": "Write every frame, decoded and hex, as JSON lines.",
    },
    "--json": {
        "is_flag": True,
        "help": "One JSON object a line on stdout; an error is a JSON object on stderr.",
    },
    "--debug": {
        "is_flag": True,
        "help": "Log events and show tracebacks, on stderr.",
    },
    "--output": {"type": click.Path(dir_okay=False), "help": "The file to write."},
    "--force": {"is_flag": True, "help": "Replace an existing file."},
}
"""Options that several commands have."""

OUTPUT_OPTIONS = ("--json", "--debug")
"""Options of the commands that print."""

CAMERA_OPTIONS = ("--timeout", "--trace", *OUTPUT_OPTIONS)
"""Options of the commands that connect to a camera and print."""

RESULT_OPTIONS = (
    *("--application", "--interpret-as", "--y-down", "--calibration", "--name", "--units"),
    *("--count", "--seconds"),
    *CAMERA_OPTIONS,
)
"""Options of the commands that connect to a camera and print results."""


def option(name: str, **changes: Any) -> Callable[[F], F]:
    """Declare a common option; ``changes`` replace some of its properties for this command."""
    names = {"--json": (name, "as_json"), "--output": ("-o", name)}.get(name, (name,))
    return click.option(*names, **{**_OPTIONS[name], **changes})


def async_command(
    *names: str,
    program: str = "smartcam",
    interrupt_code: int = INTERRUPTED,
    terminate_code: int = 143,
) -> Callable[[Callable[..., Coroutine[Any, Any, None]]], Callable[..., None]]:
    """Make a coroutine function the function of a command; its ``options`` are the common options.

    ``names``: common options of the command, in addition to the decorators above it. ``program``:
    name of the program in the error line. ``interrupt_code``: exit code after Ctrl-C; 0 if that is
    the usual end, as for a page. ``terminate_code``: exit code after SIGTERM.
    """

    def decorate(main: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
        @functools.wraps(main)
        def run_command(*args: Any, **arguments: Any) -> None:
            with exiting_on_interrupt():
                from smartcam._cli.running import run

            common = {field.name for field in fields(Options)} & arguments.keys()
            options = Options(**{name: arguments.pop(name) for name in common})
            has_page = "web" in arguments and arguments["web"].is_wanted
            run(
                main(*args, options=options, **arguments),
                program=program,
                debug=options.debug,
                as_json=options.as_json,
                interrupt_code=0 if has_page else interrupt_code,
                terminate_code=terminate_code,
            )

        for name in reversed(names):
            run_command = option(name)(run_command)
        return run_command

    return decorate


@contextmanager
def label_file_errors(label: str) -> Iterator[None]:
    """Turn an OSError in the block into a ConfigurationError that begins with ``label``."""
    try:
        yield
    except OSError as exc:
        raise ConfigurationError(f"{label}: {exc.strerror}") from exc


def from_hex(text: str, label: str) -> bytes:
    """Return the bytes of hex text, which may have spaces.

    Raises ConfigurationError: it is not hex; the text begins with ``label``.
    """
    try:
        return bytes.fromhex(text)
    except ValueError as exc:
        raise ConfigurationError(
            f"{label}: {text[:64]!r} is no hex: expected two of 0-9 and a-f for each byte"
        ) from exc


def parse_application(text: str) -> int | str:
    """Return the application's id if the text is a number, or the text, which is a file's name.

    Raises click.BadParameter: the number is out of range; ValueError: it has several signs.
    """
    if not text.lstrip("+-").isdecimal():
        return text
    number = int(text)
    if not 0 <= number <= 0xFFFFFFFF:
        raise click.BadParameter(f"{text} is not in the range 0<=x<=4294967295.")
    return number


@dataclass(slots=True)
class Options:
    """The common options as a command uses them."""

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
    units: str | None = None

    def step_timeout(self, default: float) -> float:
        """Return the longest time for a step, seconds: ``--timeout``, or ``default`` without it."""
        return default if self.timeout is None else self.timeout

    def check_y_down(self, calibration: AnyCalibration, option: str) -> None:
        """Raise ConfigurationError if ``--y-down`` differs from a calibration's direction of y.

        ``option``: the option that names the calibration.
        """
        if calibration.y_down is not None and calibration.y_down != self.y_down:
            done, to_do = ("with", "give") if calibration.y_down else ("without", "omit")
            raise ConfigurationError(
                f"{option}: the calibration was made {done} --y-down: {to_do} it here, too, or "
                "poses are mirrored"
            )

    async def locate_url(self, url: str) -> str:
        """Return the URL; for HOST[:PORT], search for a camera there and return its URL.

        Raises ConnectFailedError: no camera answers in any registered protocol; errors of
        :meth:`interpret_options`, before any camera is asked.
        """
        from smartcam.settings import is_software

        if "://" in url or is_software(url):
            return url
        if self.calibration is not None:
            self._load_calibration(f"--calibration {self.calibration}", check_y_down=True)
        from smartcam.doctor._inside import locate

        return await locate(url, timeout=self.step_timeout(10.0))

    @contextmanager
    def camera(self, url: str, **other: Any) -> Iterator[Camera]:
        """Yield an unopened camera with these options; for the arguments see :meth:`cameras`."""
        with self.cameras(url, **other) as make_camera:
            yield make_camera()

    @contextmanager
    def cameras(self, url: str, **other: Any) -> Iterator[Callable[[], Camera]]:
        """Yield a function that makes unopened cameras; the block keeps the trace file open.

        ``other``: options of :func:`smartcam.connect` that the command line does not have. Raises
        CalibrationError: the calibration's file is damaged, newer, or of another kind;
        ConfigurationError: a file cannot be opened, or an option is not possible.
        """
        from smartcam.connecting import connect
        from smartcam.settings import is_fleet

        with self.open_trace(url) as trace:
            options: dict[str, Any] = {
                **self.interpret_options(fleet=is_fleet(url)),
                "observers": self._observers(trace),
                "reconnect": None,
                "name": self.name or "",
                "application": self.application,
                "connect_timeout": self.step_timeout(10.0),
                "switch_timeout": self.step_timeout(10.0),
            }
            yield functools.partial(connect, url, **{**options, **other})

    @staticmethod
    def _observers(trace: Callable[[TraceEntry], None] | None) -> list[Observer]:
        if trace is None:
            return []
        from smartcam.doctor._inside import FrameObserver

        return [FrameObserver(trace)]

    def interpret_options(self, *, fleet: bool) -> dict[str, Any]:
        """Return the options for the interpretation of results.

        ``fleet``: the agent of a fleet may know missing options, such as ``y_down``. Raises
        CalibrationError: the calibration's file is damaged, newer, or of another kind;
        ConfigurationError: the calibration cannot be opened, or was made with another ``--y-down``.
        """
        options: dict[str, Any] = {"interpret_as": self.interpret_as}
        if self.y_down or not fleet:
            options["y_down"] = self.y_down
        if self.calibration is not None:
            option = f"--calibration {self.calibration}"
            # without "y_down" the camera gets the agent's value, and checks it then
            calibration, doubt = self._load_calibration(option, check_y_down="y_down" in options)
            options["calibration"] = calibration
            if doubt:
                click.echo(f"{coloured('error', 'warning:')} {option}: {doubt}", err=True)
        return options

    def _load_calibration(self, option: str, *, check_y_down: bool) -> tuple[AnyCalibration, str]:
        """Return the calibration, and the reason to doubt it; "" if there is none."""
        with from_part("calibration", "--calibration needs"):
            from smartcam.calibration import load_calibration
            from smartcam.calibration._inside import doubt_text
        with label_file_errors(option):
            calibration = load_calibration(self.calibration or "")
        if check_y_down:
            self.check_y_down(calibration, option)
        return calibration, doubt_text(calibration)

    @contextmanager
    def open_trace(self, url: str) -> Iterator[Callable[[TraceEntry], None] | None]:
        """Open the trace file; yield the function that writes an entry, None without ``--trace``.

        Raises UnsupportedError: the camera at ``url`` is a camera of a fleet; ConfigurationError:
        the file cannot be written.
        """
        if self.trace is None:
            yield None
            return
        import json
        from pathlib import Path

        from smartcam.models import jsonable
        from smartcam.settings import is_fleet

        if is_fleet(url):
            raise UnsupportedError(
                f"--trace: frames of {url} are between the camera and its agent; a trace needs the "
                "camera's own address, such as bvs://HOST"
            )
        with label_file_errors(f"--trace {self.trace}"):
            stream = Path(self.trace).open("w", encoding="utf-8", buffering=1)  # noqa: SIM115
        failed: list[OSError] = []

        def write(entry: TraceEntry) -> None:
            # called from the link, which would handle an OSError as an error of the link
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

    @property
    def unit_names(self) -> list[str] | None:
        """Names of the units in which values are shown; None: SI units.

        Raises ConfigurationError: --units has an unknown unit.
        """
        if self.units is None:
            return None
        from smartcam.layout._inside import ShownUnits

        names = [name.strip() for name in self.units.split(",")]
        ShownUnits(names)
        return names

    def result_text(self) -> Callable[[Camera, Result], str]:
        """Return a function that formats a camera's result as text, with units.

        Raises ConfigurationError: --units has an unknown unit.
        """
        from smartcam._cli.texts import result_text
        from smartcam._client._inside import camera_interpreter
        from smartcam.layout._inside import ShownUnits

        units = ShownUnits(self.unit_names or ())

        def make_text(camera: Camera, result: Result) -> str:
            interpreter = camera_interpreter(camera, result.application)
            layout = None if interpreter is None else interpreter.layout
            return result_text(result, units, layout)

        return make_text

    def value_text(self, value: object) -> str:
        """Return the text of a value interpreted by --interpret-as, with units.

        Raises ConfigurationError: --units has an unknown unit.
        """
        from smartcam._cli.texts import value_text
        from smartcam.interpreters import resolve
        from smartcam.layout._inside import ShownUnits

        layout = None if self.interpret_as is None else resolve(self.interpret_as).layout
        return value_text(value, ShownUnits(self.unit_names or ()), layout)

    def show_remarks(self, camera: Camera) -> None:
        """Print on stderr what users of results should know about the camera's dialect, if any."""
        from smartcam._client._inside import dialect_remarks

        for text in dialect_remarks(camera.settings.address):
            click.echo(f"note: {text}", err=True)

    def show(self, value: object, text: str | Callable[[Any], str]) -> None:
        """Print ``value`` as a line of JSON with ``--json``, else ``text``; flush.

        ``text``: the text, or a function that makes it of ``value``.
        """
        if self.as_json:
            import json

            from smartcam.models import jsonable

            click.echo(json.dumps(jsonable(value)))
        else:
            click.echo(text if isinstance(text, str) else text(value))
