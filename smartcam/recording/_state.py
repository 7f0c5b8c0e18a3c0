"""The state of a camera at a point of a recording, for readers that skip earlier items."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Connected,
    Disconnected,
    Reconnected,
    Status,
    StatusChanged,
)
from smartcam.recording._mcap.form import MAX_NAME_CHARACTERS, time_of

if TYPE_CHECKING:
    from collections.abc import Mapping
    from datetime import datetime

STATE_METADATA = "smartcam.state"
"""Name of the metadata records with a camera's state: at the beginning of a file during a session,
and after a gap."""


class RecordedState(NamedTuple):
    """The state of a camera at a point of the file.

    Attributes:
        camera: name of the camera.
        connected: whether there was a session.
        application: id of the active application; None if it was not known.
        status: status of the camera; None if it was not known.
        endian: byte order of the last status.
        at: time of the state, UTC; None until the state is written.
    """

    camera: str
    connected: bool = False
    application: int | None = None
    status: Status | None = None
    endian: int = 0
    at: datetime | None = None

    def after(self, event: CameraEvent) -> RecordedState:
        """Return the state of the camera after an event."""
        match event:
            case Connected() | Reconnected():
                return self._replace(connected=True)
            case Disconnected():
                return RecordedState(self.camera)
            case StatusChanged(status=status):
                return self._replace(status=status)
            case ApplicationChanged(application=application):
                return self._replace(application=application)
            case _:
                return self

    def to_metadata(self, endian: int, at: datetime) -> dict[str, str]:
        """Return the texts of the camera's state at a time, for a metadata record.

        ``at`` is the time of the next record. The time of writing is later, since records wait for
        the disk, so with it a replay of a span would begin at a wrong time.
        """
        metadata = {
            "camera": self.camera,
            "at": at.isoformat(),
            "connected": "yes" if self.connected else "no",
            "endian": str(endian),
        }
        if self.application is not None:
            metadata["application"] = str(self.application)
        if self.status is not None:
            metadata["status"] = str(int(self.status))
        return metadata

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> RecordedState:
        """Return the state that a metadata record describes.

        Raises:
            ValueError: the texts contain no valid state.
        """
        application, status = metadata.get("application"), metadata.get("status")
        camera, endian = metadata.get("camera", ""), metadata.get("endian", "0")
        if not 1 <= len(camera) <= MAX_NAME_CHARACTERS or endian not in {"0", "1"}:
            raise ValueError(f"a state of camera {camera!r:.60}, endian {endian!r:.20}")
        return cls(
            camera,
            metadata.get("connected") == "yes",
            None if application is None else int(application),
            None if status is None else Status(int(status)),
            int(endian),
            time_of(metadata.get("at", "")),
        )
