"""Other times and sizes for the reading of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest import mock

from smartcam.protocols._framed import frame_age, framing

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    import pytest


def give_frames(monkeypatch: pytest.MonkeyPatch, **times: float) -> None:
    """Set how long a frame that does not end may take, such as ``HINT_TIME`` in seconds."""
    for name, value in times.items():
        monkeypatch.setattr(frame_age, name, value)


def small_reads(**sizes: Any) -> AbstractContextManager[object]:
    """Have a framer read into small buffers, such as ``FIRST_READ=16`` bytes."""
    patched: AbstractContextManager[object] = mock.patch.multiple(
        framing, MIN_OWN_BUFFER_BYTES=32, **sizes
    )
    return patched
