"""An exactly drawn part for measuring: a plate with two straight sides, and a hole."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from smartcam.inspection import Program, load_cell
from tests.inspection.rendering import Array, disc, half_plane, photographed, pixel_means

WIDE = 92.4
"""Width of the plate, pixels."""

HOLE, RADIUS = np.array([8.3, 4.6]), 21.7
"""Centre of the hole from the plate's middle, along and across it, and its radius; pixels."""

SIZE = (240, 220)
"""Rows and columns of a picture."""


def plate(
    middle: tuple[float, float] = (110.2, 118.7),
    turn: float = math.radians(8),
    *,
    noise: float = 2.0,
    seed: int = 1,
    bits: int = 8,
) -> Any:
    """Return the picture of a bright plate with a dark hole, turned clockwise."""
    ahead = np.array([math.cos(turn), math.sin(turn)])
    at = np.array(middle)

    def side(place: float) -> Any:
        x, y = at + place * ahead
        return half_plane((x, y), turn, 0.8)

    left, right = side(-WIDE / 2), side(WIDE / 2)
    aside = ahead[::-1] * [-1.0, 1.0]
    x, y = at + HOLE[0] * ahead + HOLE[1] * aside
    hole = disc((x, y), RADIUS, 0.8)

    def scene(u: Array, v: Array) -> Array:
        shares: Array = left(u, v) - right(u, v) - hole(u, v)
        return shares

    scale = (2**bits - 1) / 255
    levels = scale * (45 + 150 * pixel_means(SIZE, scene, 4))
    return photographed(levels, noise * scale, np.random.default_rng(seed), bits)


def program(folder: Path, measure: str, before: str = "", more: str = "") -> Program:
    """Return the program of one `measure` entry of a cell file."""
    path = folder / "cell.yaml"
    path.write_text(
        f"cameras:\n  cam:\n    software:\n      frames: .\n{more}      applications:\n"
        f"        1: {{{before}measure: {measure}}}\n",
        encoding="utf-8",
    )
    return load_cell(path)["cam"].program(1)
