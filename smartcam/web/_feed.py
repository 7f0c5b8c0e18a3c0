"""Find the changes of an emulated camera, and new entries of its log, for an event stream."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.web import _serialize as serialize
from smartcam.web._streams import PERIOD, StreamEvent

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.emulator import WireCamera

MAX_LOG_NEWS = 200
"""Largest number of log entries in one event; with ten events a second, up to 2000 entries a
second are sent."""

MAX_FAULTS_TOLD = 100
"""Largest number of faults that one event reports."""

CHECKS_PER_CLOCK_REPORT = round(1.0 / PERIOD)
"""Number of checks for changes between two reports of the clock, so that a report is sent once a
second. Sending a report also detects that the reader is gone."""


class EmulatorWatcher:
    """Remembers what one reader has received about a camera, and finds later changes.

    ``since``: serial of the first log entry to send; None: only new entries.
    """

    def __init__(self, name: str, emulator: WireCamera, since: int | None = None) -> None:
        self._name = name
        self._emulator = emulator
        self._serial = serialize.log_count(emulator) if since is None else since
        self._last_values: dict[str, Any] = {}
        self._check_count = 0

    def find_events(self) -> Iterator[StreamEvent]:
        """Yield the changes since the last call; the first call yields the whole state."""
        emulator = self._emulator
        log = self._log_event()
        yield from self._event_if_changed("camera", serialize.camera_state(self._name, emulator))
        if emulator.table is not None:
            yield from self._event_if_changed(
                "scene", serialize.scene_state(emulator, emulator.table)
            )
        if self._faults_changed():
            yield StreamEvent("faults", serialize.faults_state(emulator, MAX_FAULTS_TOLD))
        if log is not None:
            yield log
        if self._check_count % CHECKS_PER_CLOCK_REPORT == 0:
            yield StreamEvent("clock", serialize.times(emulator))
        self._check_count += 1

    def _event_if_changed(self, kind: str, value: Any) -> Iterator[StreamEvent]:
        if self._last_values.get(kind) != value:
            self._last_values[kind] = value
            yield StreamEvent(kind, value)

    def _faults_changed(self) -> bool:
        fired = self._emulator.fired
        current = (self._emulator.faults, len(fired), fired[-1] if fired else None)
        previous, self._last_values["faults"] = self._last_values.get("faults"), current
        return current != previous

    def _log_event(self) -> StreamEvent | None:
        emulator = self._emulator
        part, entries = serialize.log_part(emulator, self._serial, MAX_LOG_NEWS)
        self._serial = part["next"]  # lower than before if the emulator was replaced
        if not entries and not part["missed"]:
            return None
        return StreamEvent("log", part, self._serial)
