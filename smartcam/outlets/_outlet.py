"""Define the base class of outlets, from which plug-ins derive their own outlet."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence
    from pathlib import Path

    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._settings import OutletSettings
    from smartcam.outlets._stored import StoredResults, StoreQuery

SettingsT = TypeVar("SettingsT", bound="OutletSettings")


class OutletContext:
    """Functions that an outlet may call; the process that runs the cameras provides them.

    Args:
        columns: function that returns names, types and units of the values of a camera's
            application, by its layout; empty if they are not known.
        command: function that carries out a command and returns the answer; None if commands are
            not allowed.
        cameras: function that returns the names of the cameras, and whether each is emulated; None
            if that is not known.
        application_names: function that returns a camera's applications' numbers by their names.
    """

    def __init__(
        self,
        columns: Callable[[str, int], Sequence[Column]],
        command: Callable[[str, str, Mapping[str, Any]], Awaitable[dict[str, Any]]] | None = None,
        cameras: Callable[[], Mapping[str, bool | None]] = dict,
        application_names: Callable[[str], Mapping[str, int]] = lambda _camera: {},
    ) -> None:
        self.columns = columns
        self.command = command
        self.cameras = cameras
        self.application_names = application_names


Column = tuple[str, str, str]
"""Name, type as in a layout, and SI unit ("" for none) of a value."""


class Outlet(ABC, Generic[SettingsT]):
    """The base class of outlets; derive from it, and name the class in an entry point.

    An outlet only delivers entries to a receiver, the *far end*, such as a broker or a database.
    Its caller queues, counts and repeats: the caller calls :meth:`open`, then :meth:`deliver` for
    one batch after the other. If a method raises an exception, the far end counts as unreachable:
    the caller calls :meth:`close`, after a delay :meth:`open`, and delivers the same batch again.

    Args:
        name: name of the outlet.
        settings: settings of the outlet.
        folder: folder to which relative paths refer.
        context: callbacks into the process that has the cameras.

    Attributes:
        settings_class: model of the settings, a class of ``OutletSettings``.
        max_batch: largest number of entries of one batch.
    """

    settings_class: ClassVar[type[Any]]
    max_batch: ClassVar[int] = 200

    def __init__(
        self, name: str, settings: SettingsT, folder: Path, context: OutletContext
    ) -> None:
        self.name = name
        self.settings = settings
        self.folder = folder
        self.context = context

    async def open(self) -> None:
        """Connect to the far end."""

    @abstractmethod
    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Deliver entries, and return when the far end has stored all of them.

        If it is unknown whether a batch arrived, the caller delivers the batch again. So send the
        ``id`` of each entry, by which the far end recognizes a repetition.

        Raises:
            EntryRefusedError: the far end will never accept one of the entries.
            Exception: the far end cannot be reached; the caller will deliver the batch again.
        """

    def state_changed(self, camera: str, state: Mapping[str, Any]) -> None:
        """Handle a camera's state: ``connected``, ``application``, ``reason``; return at once."""

    def stored(self, query: StoreQuery) -> StoredResults | None:
        """Return results that the far end has stored; None if it cannot be queried.

        Called in a thread.
        """
        return None

    async def watch(self) -> None:
        """Wait while there is nothing to deliver; raise when the far end is lost."""
        await asyncio.Event().wait()

    async def close(self) -> None:
        """Disconnect from the far end; called after each :meth:`open`, also after a failed one."""
