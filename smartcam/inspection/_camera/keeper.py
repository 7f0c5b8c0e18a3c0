"""Keep inspected pictures in a folder, with their findings."""

from __future__ import annotations

import asyncio
import collections
import json
import logging
import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import SmartCamError
from smartcam.inspection._camera.pictures import png_of
from smartcam.models import jsonable

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.inspection._camera.frame_inspector import InspectedPicture
    from smartcam.inspection._cell import Keep

_log: Final = logging.getLogger("smartcam.inspection")

MAX_WAITING_PICTURES: Final = 16
"""Largest number of pictures that wait to be written; more are dropped and counted."""

# characters that names of files cannot have
_FORBIDDEN: Final = re.compile(r'[\x00-\x1f/\\:*?"<>|]')


class PictureKeeper:
    """Write inspected pictures into a folder as PNG files, each with a JSON file.

    The camera's oldest pictures in the folder are deleted to make room; other files are not
    touched. If the folder cannot be written, pictures are lost, but inspection goes on.

    Args:
        name: name of the camera, for logs.
        folder: folder for the pictures, which is created if needed.
        keep: settings of keeping.

    Attributes:
        dropped_count: number of pictures that were dropped because too many others waited.
    """

    def __init__(self, name: str, folder: Path, keep: Keep) -> None:
        self._name, self._folder, self._keep = name, folder, keep
        self._file_prefix = _FORBIDDEN.sub("-", name)
        self._own_names = re.compile(
            rf"\d{{8}}-\d{{6}}-\d{{6}}-{re.escape(self._file_prefix)}-\d+-(ok|bad)\.png"
        )
        self.dropped_count: int = 0
        self._waiting: collections.deque[InspectedPicture] = collections.deque()
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._has_failed = False

    def start(self) -> None:
        """Start the writer of queued pictures."""
        if self._task is None:
            self._task = asyncio.create_task(self._write_all(), name=f"pictures of {self._name}")

    async def stop(self) -> None:
        """Write the queued pictures, and end the writer. Idempotent."""
        task, self._task = self._task, None
        if task is None:
            return
        task.cancel()
        await asyncio.wait({task})
        while self._waiting:
            await asyncio.to_thread(self._write, self._waiting.popleft())

    def add_picture(self, inspected: InspectedPicture) -> None:
        """Queue a picture, unless it is ok and only bad pictures are kept."""
        ok = inspected.inspection is not None and inspected.inspection.ok
        if ok and self._keep.which == "bad":
            return
        if len(self._waiting) >= MAX_WAITING_PICTURES:
            self.dropped_count += 1
            return
        self._waiting.append(inspected)
        self._wake.set()

    async def _write_all(self) -> None:
        while True:
            self._wake.clear()
            while self._waiting:
                await asyncio.to_thread(self._write, self._waiting[0])
                self._waiting.popleft()
            await self._wake.wait()

    def _write(self, inspected: InspectedPicture) -> None:
        """Write a picture, and delete the oldest beyond the limit."""
        inspection = inspected.inspection
        ok = inspection is not None and inspection.ok
        captured_at = datetime.fromtimestamp(inspected.frame.utc, UTC)
        verdict = "ok" if ok else "bad"
        name = f"{self._file_prefix}-{inspected.application}-{verdict}"
        stem = f"{captured_at:%Y%m%d-%H%M%S-%f}-{name}"
        record: dict[str, Any] = {
            "camera": self._name,
            "application": inspected.application,
            "number": inspected.number,
            "captured": captured_at.isoformat(),
            "ok": ok,
            "value": None if inspection is None else jsonable(inspection.value),
        }
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / f"{stem}.png").write_bytes(png_of(inspected, drawn=False))
            text = json.dumps(record, indent=1)
            (self._folder / f"{stem}.json").write_text(text + "\n", encoding="utf-8")
            pictures = sorted(
                path for path in self._folder.iterdir() if self._own_names.fullmatch(path.name)
            )
            for oldest in pictures[: max(0, len(pictures) - self._keep.most)]:
                oldest.unlink(missing_ok=True)
                oldest.with_suffix(".json").unlink(missing_ok=True)
        except (OSError, ValueError, SmartCamError) as exc:
            if not self._has_failed:  # log the first failure only
                _log.error("%s ! pictures are not kept: %s", self._name, exc)
            self._has_failed = True
        else:
            self._has_failed = False
