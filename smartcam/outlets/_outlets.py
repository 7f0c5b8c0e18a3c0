"""Run all outlets of a process, and pass the cameras' results, errors and states to them."""

from __future__ import annotations

import contextlib
import sqlite3
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._arguments import check_callable, check_kind, check_path
from smartcam._json import object_json
from smartcam._server import Server
from smartcam._switch_interval import restore_switch_interval, shorten_switch_interval
from smartcam._user_code import ENDS_PROGRAM, text_of
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.interpreters._inside import LocalizationsInterpreter
from smartcam.outlets._outlet import Column, OutletContext
from smartcam.outlets._pump import Pump
from smartcam.outlets._settings import mistakes_of, outlet_class
from smartcam.outlets._spool import Spool, read_outlet_counts
from smartcam.outlets._stored import StoreQuery

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence
    from datetime import datetime
    from pathlib import Path

    from smartcam.interpreters import Interpreter
    from smartcam.models import Result
    from smartcam.outlets._entry import OutletCounts
    from smartcam.outlets._settings import OutletSettings, Section
    from smartcam.outlets._stored import StoredResults

SWITCH_INTERVAL = 0.0005
"""Python's switch interval between threads while outlets run, seconds. With Python's default of
5 ms, a result that arrives while a thread writes a spool could wait for 5 ms."""

RESULT_BYTES = 600
"""Approximate number of bytes of a result in memory, without its container."""


class OutletState(NamedTuple):
    """The state of one outlet.

    Attributes:
        counts: counts of the outlet.
        trouble: reason why entries are not delivered, or not spooled, now; "" without one.
    """

    counts: OutletCounts
    trouble: str


class Outlets(Server):
    """The outlets of a section ``outlets:``, to be run by ``async with``.

    Args:
        section: settings by the outlet's name.
        folder: folder to which relative paths refer, such as paths of spools, secrets and stores.
        columns: function that returns names, types and units of an application's values, by its
            layout.
        command: function that carries out a command from an outlet.
        on_trouble: function that is called with an outlet's name and the reason why the outlet
            cannot deliver or spool, and with "" when it can again.
        cameras: function that returns the cameras' names, and whether each is emulated; None if
            that is not known.
        application_names: function that returns a camera's applications' numbers by their names.

    Raises:
        ConfigurationError: the section is wrong.
    """

    def __init__(
        self,
        section: Section,
        folder: str | Path,
        *,
        columns: Callable[[str, int], Sequence[Column]] = lambda _camera, _application: (),
        command: Callable[[str, str, Mapping[str, Any]], Awaitable[dict[str, Any]]] | None = None,
        on_trouble: Callable[[str, str], None] = lambda _name, _why: None,
        cameras: Callable[[], Mapping[str, bool | None]] = dict,
        application_names: Callable[[str], Mapping[str, int]] = lambda _camera: {},
    ) -> None:
        check_kind(
            section, dict, "section", "a mapping of settings by the outlet's name", "Outlets"
        )
        folder = check_path(folder, "folder", "Outlets")
        check_callable(columns, "columns", "Outlets")
        check_callable(on_trouble, "on_trouble", "Outlets")
        check_callable(cameras, "cameras", "Outlets")
        check_callable(application_names, "application_names", "Outlets")
        if command is not None:
            check_callable(command, "command", "Outlets")
        for keys, text in mistakes_of(section):
            raise ConfigurationError(f"{'.'.join(map(str, keys))}: {text}")
        context = OutletContext(columns, command, cameras, application_names)
        self._pumps: dict[str, Pump] = {}
        for name, fields in section.items():
            class_ = outlet_class(name, fields)
            settings: OutletSettings = class_.settings_class.model_validate(fields)
            spool = Spool(
                spool_path(folder, settings, name),
                int(settings.size),
                settings.full,
                durable=settings.durable,
            )
            self._pumps[name] = Pump(class_(name, settings, folder, context), spool, on_trouble)
        self._pumps_by_camera: dict[str, list[Pump]] = {}
        self._started: list[Pump] = []

    async def start(self) -> None:
        """Open the spools, and begin to deliver. An unreachable broker or database is no error.

        Raises:
            ConfigurationError: a spool cannot be opened, or another process has it.

        Cancellation: leaves it stopped.
        """
        if self._started:
            return
        shorten_switch_interval(self, SWITCH_INTERVAL)
        try:
            for pump in self._pumps.values():
                try:
                    await pump.start()
                except (sqlite3.Error, OSError) as exc:
                    raise ConfigurationError(
                        f"outlet {pump.outlet.name}: its spool {pump.spool.path}: {exc}"
                    ) from exc
                self._started.append(pump)
        except BaseException:
            await self.stop()
            raise

    async def stop(self) -> None:
        """Stop; undelivered entries stay in the spools. A second call does nothing."""
        while self._started:
            await self._started[-1].stop()
            self._started.pop()
        restore_switch_interval(self)

    @property
    def states(self) -> dict[str, OutletState]:
        """State of each outlet, by name."""
        return {
            name: OutletState(pump.counts, pump.disk_trouble or pump.trouble)
            for name, pump in self._pumps.items()
        }

    def stored(self, query: StoreQuery) -> dict[str, StoredResults]:
        """Return the results in the outlets' stores, by the outlet's name; blocks.

        Raises:
            ConfigurationError: one of the stores cannot be read now.
        """
        check_kind(query, StoreQuery, "query", "a StoreQuery", "stored")
        answers = {name: pump.outlet.stored(query) for name, pump in self._pumps.items()}
        return {name: answer for name, answer in answers.items() if answer is not None}

    # ------------------------------------------------------------------ from cameras

    def offer_result(
        self, result: Result[Any], read: Callable[[], tuple[Any, int | None]] | None = None
    ) -> None:
        """Pass a result to the outlets; return at once.

        Args:
            result: the result.
            read: function that returns value and sequence number; called in a thread. None: the
                result has them.
        """
        contents: list[tuple[Any, int | None, str]] = []

        def make_content() -> tuple[Any, int | None, str]:
            if not contents:  # made once for all outlets
                contents.append(_entry_content(result, read))
            return contents[0]

        size = len(result.raw) + RESULT_BYTES
        for pump in self._pumps_for(result.camera):
            pump.offer(result.camera, result.received_at.timestamp(), size, make_content)

    def offer_error(
        self, camera: str, at: datetime, error: str, kind: str, triggered_at: datetime | None = None
    ) -> None:
        """Pass an error to the outlets; return at once."""
        fields = {"camera": camera, "error": error, "kind": kind, "triggered_at": triggered_at}
        text = object_json(fields)
        for pump in self._pumps_for(camera):
            pump.offer(camera, at.timestamp(), len(text), lambda: ("error", None, text))

    def state_changed(self, camera: str, state: Mapping[str, Any]) -> None:
        """Pass a camera's state to the outlets; return at once."""
        for pump in self._pumps_for(camera):
            pump.outlet.state_changed(camera, state)

    def _pumps_for(self, camera: str) -> list[Pump]:
        pumps = self._pumps_by_camera.get(camera)
        if pumps is None:
            all_pumps = self._pumps.values()
            pumps = [pump for pump in all_pumps if pump.outlet.settings.chooses(camera)]
            self._pumps_by_camera[camera] = pumps
        return pumps


def _entry_content(
    result: Result[Any], read: Callable[[], tuple[Any, int | None]] | None
) -> tuple[Any, int | None, str]:
    """Return kind, application and body of a result's entry."""
    application = result.application
    try:
        if read is not None:
            value, sequence = read()
            result = result._replace(value=value, sequence=sequence)
        fields = result._asdict()
        del fields["raw"]
        return "result", application, object_json(fields)
    except ENDS_PROGRAM:
        raise
    except BaseException as exc:  # noqa: BLE001 - an interpreter is a plug-in
        text = str(exc) if isinstance(exc, SmartCamError) else text_of(exc)
        failure = {"raw": result.raw, "error": text, "kind": type(exc).__name__}
        return "error", application, object_json({**result._asdict(), "value": None, **failure})


def spool_path(folder: Path, settings: OutletSettings, name: str) -> Path:
    """Return the file of an outlet's spool."""
    return folder / settings.spool / f"{name}.spool"


def stored_counts(section: Section, folder: Path) -> dict[str, OutletCounts | None]:
    """Return the counts of a section's spools, by the outlet's name; None without a spool."""
    counts: dict[str, OutletCounts | None] = {}
    for name, fields in section.items():
        settings = outlet_class(name, fields).settings_class.model_validate(fields)
        counts[name] = None
        with contextlib.suppress(FileNotFoundError):
            counts[name] = read_outlet_counts(spool_path(folder, settings, name))
    return counts


LOCALIZATION_COLUMNS: Sequence[Column] = (
    ("feature_id", "string", ""),
    ("quality", "real64", ""),
    ("photo_index", "int32", ""),
    ("x", "real64", "m"),
    ("y", "real64", "m"),
    ("z", "real64", "m"),
    ("qx", "real64", ""),
    ("qy", "real64", ""),
    ("qz", "real64", ""),
    ("qw", "real64", ""),
)
"""Values of a localization: its pose as a position and a quaternion."""

_SI_UNITS = {"deg": "rad", "rad": "rad", "px": "px"}


def columns_of(interpreter: Interpreter | None) -> Sequence[Column]:
    """Return names, types and SI units of an interpreter's values; empty if it has no layout."""
    if isinstance(interpreter, LocalizationsInterpreter):
        return LOCALIZATION_COLUMNS
    layout = None if interpreter is None else interpreter.layout
    if layout is None:
        return ()
    return [
        (
            part.name,
            "real64" if part.unit else part.type,
            _SI_UNITS.get(part.unit, "m") if part.unit else "",
        )
        for part in (*layout.head, *layout.fields)
    ]
