"""Other times, sizes and machines for the reading of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest import mock

from tests.protocols.inside import Machine, frame_age, framing

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    import pytest


def give_frames(monkeypatch: pytest.MonkeyPatch, **times: float) -> None:
    """Set how long a frame that does not end may take, such as ``HINT_TIME`` in seconds."""
    for name, value in times.items():
        monkeypatch.setattr(frame_age, name, value)


def small_reads(**sizes: Any) -> AbstractContextManager[object]:
    """Make a framer read into small buffers, such as ``FIRST_READ_BYTES=16`` bytes."""
    patched: AbstractContextManager[object] = mock.patch.multiple(
        framing, MIN_OWN_BUFFER_BYTES=32, **sizes
    )
    return patched


class JudgingMachine(Machine):
    """A machine that reads and writes each frame by itself."""

    def _use_dialect(self, dialect: Any) -> None:
        super()._use_dialect(dialect)
        self._recognizes = False


class ShortMachine(Machine):
    """A machine that counts the deliveries that it takes as a whole."""

    taken = 0

    def _receive_known_delivery(self) -> bool:
        taken = super()._receive_known_delivery()
        ShortMachine.taken += taken
        return taken
