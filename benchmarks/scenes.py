"""Moving pictures that codecs are measured with: a table with blocks, in colour and in depth.

Drawn from a seed, so the same everywhere. The first half stands still but for the noise of the
sensor, in the second half the blocks move: video codecs get little for nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

__all__ = ["SIZE", "colour_scene", "depth_scene"]

SIZE = (640, 480)
BLOCKS = 7
STEP = 3
"""Pixels that a block moves from one frame to the next."""

NOISE = 1.5
"""Sensor noise, grey values; the same of all three colours."""

FAR = 800.0
"""Millimetres to the table."""

DEPTH_NOISE = 1.5
"""Millimetres at that distance; it grows with its square."""

HOLES = 0.02
"""Part of the depth picture that has none."""


def colour_scene(frames: int) -> Iterator[NDArray[np.uint8]]:
    """Yield pictures, (480, 640, 3)."""
    random = np.random.default_rng(3)
    table = 120 + 25 * _grain(random)[..., None] * np.array([1.0, 0.9, 0.7])
    colours = random.uniform(20, 230, (BLOCKS, 3))
    faces = [12 * _grain(random)[:60, :110, None] for _ in range(BLOCKS)]
    for places in _places(random, frames):
        picture = table.copy()
        for (x, y), colour, face in zip(places, colours, faces, strict=True):
            picture[y : y + 60, x : x + 110] = colour + face
        picture += random.normal(0, NOISE, (*picture.shape[:2], 1))
        yield picture.clip(0, 255).astype(np.uint8)


def depth_scene(frames: int) -> Iterator[NDArray[np.uint16]]:
    """Yield depths in millimetres, (480, 640); 0 is none."""
    random = np.random.default_rng(4)
    table = FAR + 60 * np.linspace(-1, 1, SIZE[1])[:, None] + 2 * _grain(random)
    heights = random.uniform(15, 90, BLOCKS)
    for places in _places(random, frames):
        depth = table.copy()
        for (x, y), height in zip(places, heights, strict=True):
            depth[y : y + 60, x : x + 110] -= height
        depth += random.normal(size=depth.shape) * DEPTH_NOISE * (depth / FAR) ** 2
        depth[random.random(depth.shape) < HOLES] = 0
        yield depth.round().astype(np.uint16)


def _places(random: np.random.Generator, frames: int) -> Iterator[list[tuple[int, int]]]:
    """Yield where the upper left corners of the blocks are."""
    room = np.array([SIZE[0] - 110, SIZE[1] - 60])
    places = random.uniform(0, room, (BLOCKS, 2))
    steps = np.array([[np.cos(a), np.sin(a)] for a in random.uniform(0, 2 * np.pi, BLOCKS)]) * STEP
    for number in range(frames):
        if number >= frames // 2:
            places = places + steps
            over = (places < 0) | (places > room)
            steps[over] *= -1
            places = places.clip(0, room)
        yield [(int(x), int(y)) for x, y in places]


def _grain(random: np.random.Generator) -> NDArray[np.float64]:
    """Return a soft texture of variance 1."""
    rows, columns = np.fft.fftfreq(SIZE[1])[:, None], np.fft.rfftfreq(SIZE[0])[None]
    weight = 1 / (0.01 + np.hypot(rows, columns)) ** 1.2
    grain: NDArray[Any] = np.fft.irfft2(
        np.fft.rfft2(random.normal(size=(SIZE[1], SIZE[0]))) * weight, s=(SIZE[1], SIZE[0])
    )
    even: NDArray[np.float64] = (grain - grain.mean()) / grain.std()
    return even
