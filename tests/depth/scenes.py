"""Two pictures of scenes whose depth is known, drawn without interpolation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SIZE = (320, 240)


class Scene(NamedTuple):
    """Two rectified pictures and what is true of them."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    truth: NDArray[np.float64]  # (H, W), disparity of the left picture, pixels
    seen: NDArray[np.bool_]  # (H, W), the right camera sees the point, too


class Texture:
    """A sum of waves in the plane: known at every place, so that it is drawn and never warped."""

    def __init__(self, seed: int, contrast: float = 30.0, finest: float = 4.0) -> None:
        rng = np.random.default_rng(seed)
        count = 60
        length = finest * np.exp(rng.uniform(0, np.log(12), count))
        angle = rng.uniform(0, np.pi, count)
        self.u = 2 * np.pi * np.cos(angle) / length
        self.v = 2 * np.pi * np.sin(angle) / length
        self.phase = rng.uniform(0, 2 * np.pi, count)
        self.size = contrast * np.sqrt(2 / count)

    def __call__(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the brightness at places of any shape."""
        whole = np.full(np.broadcast(u, v).shape, 128.0)
        for a, b, c in zip(self.u, self.v, self.phase, strict=True):
            whole += self.size * np.cos(a * u + b * v + c)
        return whole


def plane(
    disparity: tuple[float, float, float],
    *,
    noise: float,
    seed: int = 1,
    contrast: float = 30.0,
    finest: float = 4.0,
    size: tuple[int, int] = SIZE,
    brighter: float = 0.0,
) -> Scene:
    """Return a plane: disparity = d0 + du (u - W/2) + dv (v - H/2) of the left picture."""
    texture, rng = Texture(seed, contrast, finest), np.random.default_rng(seed + 1000)
    v, u = np.mgrid[: size[1], : size[0]].astype(float)
    d0, du, dv = disparity
    truth = d0 + du * (u - size[0] / 2) + dv * (v - size[1] / 2)
    # the right picture's column u' shows the left one's u = u' + d(u, v)
    there = (u + d0 - du * size[0] / 2 + dv * (v - size[1] / 2)) / (1 - du)
    left, right = texture(u, v), texture(there, v) + brighter
    return Scene(
        _seen(left, noise, rng), _seen(right, noise, rng), truth, (u - truth >= 0) & (truth > 0)
    )


def step(
    far: float, near: float, *, noise: float, seed: int = 1, size: tuple[int, int] = SIZE
) -> Scene:
    """Return a far wall and, before its middle, a near square."""
    rng = np.random.default_rng(seed + 1000)
    back, front = Texture(seed), Texture(seed + 1)
    v, u = np.mgrid[: size[1], : size[0]].astype(float)
    inside = (abs(u - size[0] / 2) < size[0] / 5) & (abs(v - size[1] / 2) < size[1] / 4)
    there = (abs(u + near - size[0] / 2) < size[0] / 5) & (abs(v - size[1] / 2) < size[1] / 4)
    left = np.where(inside, front(u, v), back(u, v))
    right = np.where(there, front(u + near, v), back(u + far, v))
    truth = np.where(inside, near, far)
    column = np.clip(np.round(u - truth).astype(int), 0, size[0] - 1)
    hidden = ~inside & np.take_along_axis(there, column, axis=1)
    return Scene(
        _seen(left, noise, rng), _seen(right, noise, rng), truth, (u - truth >= 0) & ~hidden
    )


def _seen(
    brightness: NDArray[np.float64], noise: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    noisy = brightness + rng.normal(0, noise, brightness.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)
