"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.makes._ifm.chunks import ImageChunk, read_chunks
