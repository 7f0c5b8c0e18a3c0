"""Colours, and a line that shows the progress of a wait, on terminals only."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.camera import Camera

VERDICT_COLOURS = {"ok": "green", "hint": "cyan", "warning": "yellow", "error": "red"}
"""The colour of each word of a verdict; the word alone has the full meaning."""

PERIOD = 1.0
"""Seconds between two updates of the counting line."""


def tinted(word: str, text: str | None = None) -> str:
    """Return a word, or a text, in the word's colour; :func:`click.echo` removes it in files.

    The text is plain if NO_COLOR is set or the terminal is dumb.
    """
    text = word if text is None else text
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return click.style(text, fg=VERDICT_COLOURS[word], bold=word == "error" or None)


class CountingLine:
    """A line on the terminal's stderr that counts results, once a second; none without a terminal.

    ::

        async with counting(camera) as line:
            result = await anext(results)
            line.clear()
            print(result)
    """

    def __init__(self, camera: Camera[Any]) -> None:
        self._camera = camera
        self._width = 0

    def clear(self) -> None:
        """Remove the line before something else is printed."""
        if self._width:
            sys.stderr.write(f"\r{'':{self._width}}\r")
            sys.stderr.flush()
            self._width = 0

    async def run(self) -> None:
        """Show the line until cancelled."""
        import asyncio

        loop = asyncio.get_running_loop()
        seen, last = self._camera.statistics().received, loop.time()
        while True:
            await asyncio.sleep(PERIOD)
            received = self._camera.statistics().received
            new, seen = received - seen, received
            last = loop.time() if new else last
            self._show(new, received, loop.time() - last)

    def _show(self, new: int, received: int, silent: float) -> None:
        rate = f"{new / PERIOD:.0f} a second" if new else f"nothing for {silent:.0f} s"
        lost = "" if self._camera.connected else ", not connected"
        text = f"{received} results, {rate}{lost}"
        self.clear()
        sys.stderr.write(text)
        sys.stderr.flush()
        self._width = len(text)


@contextlib.asynccontextmanager
async def counting(camera: Camera[Any]) -> AsyncIterator[CountingLine]:
    """Show a line that counts a camera's results, if stderr is a terminal."""
    line = CountingLine(camera)
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield line
        return
    import asyncio

    task = asyncio.create_task(line.run(), name="smartcam.counting")
    try:
        yield line
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        line.clear()
