"""Draw picture pairs of scenes with known depth, without interpolation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartcam.calibration import CameraModel, Transform

SIZE = (256, 160)


class Scene(NamedTuple):
    """Two rectified pictures with their true disparity."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    truth: NDArray[np.float64]  # (H, W), disparity of the left picture, pixels
    seen: NDArray[np.bool_]  # (H, W), the right camera sees the point, too


class Texture:
    """A sum of waves in the plane, which can be drawn exactly at every place."""

    def __init__(self, seed: int, contrast: float = 30.0, finest: float = 4.0) -> None:
        rng = np.random.default_rng(seed)
        count = 40
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
    """Return a far wall with a near square in front of its middle."""
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


class Room(NamedTuple):
    """A textured wall and a textured board in front, in the left camera's frame."""

    wall: tuple[float, float, float]  # Z = z0 + zx X + zy Y of the wall, metres
    board: float | None  # distance of the board, metres, parallel to the picture
    half: tuple[float, float] = (0.12, 0.1)  # of the board's width and height, metres
    detail: float = 0.01  # the finest wave, metres
    seed: int = 1

    def rays(
        self, origin: NDArray[np.float64], rays: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the ends of rays (N, 3) from a point, (N, 3), and the brightness there (N,)."""
        z0, zx, zy = self.wall
        along = (z0 + zx * origin[0] + zy * origin[1] - origin[2]) / (
            rays[:, 2] - zx * rays[:, 0] - zy * rays[:, 1]
        )
        points = origin + along[:, None] * rays
        back = Texture(self.seed, finest=self.detail)
        brightness = back(points[:, 0], points[:, 1])
        if self.board is not None:
            near = origin + ((self.board - origin[2]) / rays[:, 2])[:, None] * rays
            hit = (abs(near[:, 0]) < self.half[0]) & (abs(near[:, 1]) < self.half[1])
            front = Texture(self.seed + 1, finest=self.detail)
            points[hit] = near[hit]
            brightness[hit] = front(near[hit, 0], near[hit, 1])
        return points, brightness

    def picture(
        self, camera: CameraModel, pose: Transform | None = None, *, noise: float = 0, seed: int = 1
    ) -> NDArray[np.uint8]:
        """Return the picture of a camera at the pose T_camera_left; None: the left camera."""
        width, height = camera.size
        v, u = np.mgrid[:height, :width]
        flat = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
        rays = np.column_stack([flat, np.ones(len(flat))])
        origin = np.zeros(3)
        if pose is not None:
            back = pose.inverse()
            rays, origin = rays @ back.rotation.T, back.translation
        brightness = self.rays(origin, rays)[1].reshape(height, width)
        return _seen(brightness, noise, np.random.default_rng(seed))

    def depth(self, camera: CameraModel, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the true depth for a camera without distortion, rotated from the left camera."""
        width, height = camera.size
        v, u = np.mgrid[:height, :width]
        flat = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
        rays = np.column_stack([flat, np.ones(len(flat))]) @ turn  # back into the left frame
        points = self.rays(np.zeros(3), rays)[0]
        return np.asarray((points @ turn.T)[:, 2].reshape(height, width))
