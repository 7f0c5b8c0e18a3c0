"""Draw codes as in a camera's picture: module size, angle, blur, noise, perspective, dots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import zxingcpp

if TYPE_CHECKING:
    from numpy.typing import NDArray

OVERSAMPLING = 4
"""Number of samples along each side of a pixel."""

ROOM_PX = 24
"""Width of the border around a code, pixels."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """Size, pose and quality of a code in a picture.

    Attributes:
        px: pixels of a module.
        degrees: turn of the code, clockwise.
        blur_px: standard deviation of the blur.
        noise: standard deviation of the noise, grey levels.
        perspective: how much shorter the upper edge is than the lower one, as a share.
        dots: diameter of a dot over a module, 0: squares.
        inverted: light on dark.
        levels: grey levels of dark and light.
        shade: grey levels by which the light rises from the left to the right.
    """

    px: float = 4.0
    degrees: float = 0.0
    blur_px: float = 0.5
    noise: float = 2.0
    perspective: float = 0.0
    dots: float = 0.0
    inverted: bool = False
    levels: tuple[float, float] = (40.0, 210.0)
    shade: float = 0.0


def modules_of(kind: str, content: str | bytes) -> NDArray[np.bool_]:
    """Return the dark modules of a code with its quiet zone, (rows, columns)."""
    code = zxingcpp.create_barcode(content, getattr(zxingcpp.BarcodeFormat, kind))
    image = np.array(code.to_image(scale=1, add_quiet_zones=True))
    dark: NDArray[np.bool_] = image < 128
    return dark


def draw_code(
    kind: str, content: str | bytes, look: Look, random: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the picture (H, W) of a code as :class:`Look` describes, between two pixels."""
    dark = modules_of(kind, content)
    rows, columns = dark.shape
    to_picture = _to_picture(rows, columns, look, random)
    corners = np.array([[(0, 0), (columns, 0), (columns, rows), (0, rows)]], np.float64)
    places = cv2.perspectiveTransform(corners, to_picture)[0]
    low = places.min(axis=0) - ROOM_PX
    width, height = np.ceil(places.max(axis=0) + ROOM_PX - low).astype(int)
    shift = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1.0]])
    back = np.linalg.inv(shift @ to_picture)
    steps = (np.arange(OVERSAMPLING) + 0.5) / OVERSAMPLING
    x = (np.arange(width)[:, None] + steps).ravel()
    y = (np.arange(height)[:, None] + steps).ravel()
    grid = np.stack([*np.meshgrid(x, y), np.ones((len(y), len(x)))], axis=-1)
    at = grid @ back.T
    column, row = at[..., 0] / at[..., 2], at[..., 1] / at[..., 2]
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    i, j = np.clip(row, 0, rows - 1).astype(int), np.clip(column, 0, columns - 1).astype(int)
    covered = dark[i, j] & inside
    if look.dots:
        covered &= np.hypot(row - i - 0.5, column - j - 0.5) <= look.dots / 2
    share = covered.reshape(height, OVERSAMPLING, width, OVERSAMPLING).mean(axis=(1, 3))
    if look.inverted:
        share = 1.0 - share
    black, white = look.levels
    levels = white + (black - white) * share
    levels += look.shade * np.linspace(-0.5, 0.5, width)
    if look.blur_px:
        levels = cv2.GaussianBlur(levels, (0, 0), look.blur_px)
    levels += random.normal(0.0, look.noise, levels.shape)
    picture: NDArray[np.uint8] = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return picture


def _to_picture(rows: int, columns: int, look: Look, random: np.random.Generator) -> NDArray[Any]:
    """Return the homography from modules to pixels."""
    cos, sin = math.cos(math.radians(look.degrees)), math.sin(math.radians(look.degrees))
    dx, dy = random.uniform(0.0, 1.0, 2)
    turn = np.array([[cos, -sin, dx], [sin, cos, dy], [0, 0, 1.0]])
    scale = np.diag([look.px, look.px, 1.0])
    edge = look.perspective / 2 * columns
    source = np.array([(0, 0), (columns, 0), (columns, rows), (0, rows)], np.float32)
    target = np.array([(edge, 0), (columns - edge, 0), (columns, rows), (0, rows)], np.float32)
    tilt = cv2.getPerspectiveTransform(source, target)
    turned: NDArray[Any] = turn @ scale @ tilt
    return turned
