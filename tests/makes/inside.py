"""Private names of smartcam.makes that the helpers or several tests use."""

from __future__ import annotations

from smartcam.makes._ifm.chunks import ImageChunk, read_chunks
