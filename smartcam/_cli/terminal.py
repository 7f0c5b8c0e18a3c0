"""Colours, and a line that counts results; both on terminals only."""

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
"""The colour of each verdict; the word is shown, too, so no meaning depends on the colour."""

PERIOD = 1.0
"""Seconds between two updates of the counting line."""


def coloured(word: str, text: str | None = None) -> str:
    """Return ``text`` in the colour of a verdict; without a text, the verdict itself.

    There is no colour if NO_COLOR is set or the terminal is dumb, and :func:`click.echo` removes it
    if the output is a file.
    """
    text = word if text is None else text
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return click.style(text, fg=VERDICT_COLOURS[word], bold=word == "error" or None)


class CountingLine:
    """A line on stderr that shows the number of results, updated once a second.

    ::

        async with counting_line(camera) as line:  # shows it on terminals only
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
        last_count, last_change_at = self._camera.statistics().received, loop.time()
        while True:
            await asyncio.sleep(PERIOD)
            count = self._camera.statistics().received
            new_count, last_count = count - last_count, count
            last_change_at = loop.time() if new_count else last_change_at
            self._show(new_count, count, loop.time() - last_change_at)

    def _show(self, new_count: int, count: int, silence: float) -> None:
        rate = f"{new_count / PERIOD:.0f} a second" if new_count else f"nothing for {silence:.0f} s"
        connection = "" if self._camera.connected else ", not connected"
        text = f"{count} results, {rate}{connection}"
        self.clear()
        sys.stderr.write(text)
        sys.stderr.flush()
        self._width = len(text)


@contextlib.asynccontextmanager
async def counting_line(camera: Camera[Any]) -> AsyncIterator[CountingLine]:
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
