"""An emulated In-Sight camera in a process of its own; what it sees is a picture of 1 MB."""

from __future__ import annotations

import asyncio

import numpy as np

from smartcam.emulator import EmulatedInSight

__all__: list[str] = []

WIDTH, HEIGHT = 1024, 976
"""Pixels of a byte each."""


async def main() -> None:
    """Serve until killed."""
    image = np.arange(WIDTH * HEIGHT, dtype=np.uint32).astype(np.uint8).reshape(HEIGHT, WIDTH)
    async with EmulatedInSight(image=image) as emulator:
        print(emulator.port, flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
