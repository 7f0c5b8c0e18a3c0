"""Find the changes of an emulated camera, and new entries of its log, for one event stream."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.web import _serialize as serialize
from smartcam.web._streams import PERIOD, News

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.emulator import WireCamera

MAX_LOG_NEWS = 200
"""Largest number of log entries in one event: 2000 messages per second at ten events a second."""

MAX_FAULTS_TOLD = 100
"""Largest number of faults that one event reports."""

CLOCK_LOOKS = round(1.0 / PERIOD)
"""Looks between two reports of the clock, one a second; a report also detects a closed reader."""


class Watcher:
    """The state of a camera as one reader knows it.

    ``since`` is the serial of the first log entry to send; None: only new entries.
    """

    def __init__(self, name: str, emulator: WireCamera, since: int | None = None) -> None:
        self._name = name
        self._emulator = emulator
        self._serial = serialize.log_count(emulator) if since is None else since
        self._last_values: dict[str, Any] = {}
        self._looks = 0

    def look(self) -> Iterator[News]:
        """Yield the changes since the last look; the first look yields everything but the log."""
        emulator = self._emulator
        log = self._log()
        yield from self._changed("camera", serialize.camera_state(self._name, emulator))
        if emulator.table is not None:
            yield from self._changed("scene", serialize.scene_state(emulator, emulator.table))
        if self._changed_faults():
            yield News("faults", serialize.faults_state(emulator, MAX_FAULTS_TOLD))
        if log is not None:
            yield log
        if self._looks % CLOCK_LOOKS == 0:
            yield News("clock", serialize.times(emulator))
        self._looks += 1

    def _changed(self, kind: str, value: Any) -> Iterator[News]:
        if self._last_values.get(kind) != value:
            self._last_values[kind] = value
            yield News(kind, value)

    def _changed_faults(self) -> bool:
        fired = self._emulator.fired
        now = (self._emulator.faults, len(fired), fired[-1] if fired else None)
        before, self._last_values["faults"] = self._last_values.get("faults"), now
        return now != before

    def _log(self) -> News | None:
        emulator = self._emulator
        part, entries = serialize.log_part(emulator, self._serial, MAX_LOG_NEWS)
        self._serial = part["next"]  # an earlier emulator's serial may have been higher
        if not entries and not part["missed"]:
            return None
        return News("log", part, self._serial)
