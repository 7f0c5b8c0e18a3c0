"""The second client: it has the session and nothing behind it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.emulator.faults.wire_effects import Parcel
from smartcam.exceptions import LocalProtocolError

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.protocols import messages as m
    from smartcam.protocols.framed.dialect import FramedDialect

__all__ = ["Stranger"]


class Stranger:
    """Takes what the camera says to another client.

    Args:
        dialect: what is spoken.
        traced: told of everything the camera says to it; nothing of that is on a wire.
    """

    peer = "second client"

    def __init__(self, dialect: FramedDialect, traced: Callable[[Parcel], None]) -> None:
        self._dialect = dialect
        self._traced = traced

    def say(self, message: m.Message) -> None:
        """Take a message."""
        try:
            frame = self._dialect.to_frame(message)
            data = self._dialect.encode_frame(frame)
        except LocalProtocolError:
            return  # a link would not have sent it either
        self._traced(Parcel(frame, data, [], faults=["second_client"]))

    def flush(self) -> None:
        """Nothing waits."""

    def dismiss(self, reason: str) -> None:
        """Another client has the session; nothing is there to be closed."""
