"""Make the grey levels, from 0 to 255, that detectors work on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np

from smartcam._extras import load
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from numpy.typing import NDArray

MIN_SIDE_PX = 16
"""An image has at least this width and height, pixels."""

MAX_SIDE_PX = 20_000
"""An image has at most this width and height, pixels."""

USUAL_SIDE_PX = 1600
"""OpenCV looks for a grid first in an image whose longest side has this many pixels: in a larger
one it takes seconds and finds less.
"""


Level = TypeVar("Level", np.uint8, np.float32)


@runtime_checkable
class HasGrey(Protocol):
    """An object that gives its brightness, such as a frame of a camera."""

    def grey(self) -> NDArray[Any]:
        """Return the brightness, (H, W), uint8 or uint16."""
        ...


class GreyImage(NamedTuple):
    """An image without its colours."""

    levels: NDArray[np.float32]  # (H, W), float32, 0 to 255; for refinement
    bytes: NDArray[np.uint8]  # (H, W), uint8, the same; for OpenCV's detectors

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        height, width = self.bytes.shape
        return width, height


def grey_image(image: Any) -> GreyImage:
    """Return an image's grey levels.

    ``image``: uint8 or uint16, (H, W) or (H, W, 3) with blue, green, red, or an object with
    ``grey`` levels; anything else raises SHAPE. The brightest level of uint16 becomes 255, whether
    the camera fills 10, 12 or 16 bits.
    """
    if isinstance(image, HasGrey):
        image = image.grey()
    shape = np.shape(image) if isinstance(image, np.ndarray) else ()
    kind = getattr(image, "dtype", None)
    fits = len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)
    if not (
        isinstance(image, np.ndarray)
        and fits
        and kind in (np.uint8, np.uint16)
        and all(MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in shape[:2])
    ):
        received = f"{kind} of shape {shape}" if kind is not None else type(image).__name__
        raise Code.SHAPE.unexpected(
            "image: expected an array of uint8 or uint16, (H, W) or (H, W, 3), "
            f"{MIN_SIDE_PX} to {MAX_SIDE_PX} pixels wide and high",
            "uint8 or uint16, (H, W) or (H, W, 3)",
            received,
        )
    cv2 = load("cv2")
    flat = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if len(shape) == 3 else image
    flat = np.ascontiguousarray(flat)
    if flat.dtype == np.uint8:
        return GreyImage(flat.astype(np.float32), flat)
    levels = flat.astype(np.float32) * np.float32(255 / max(1, int(flat.max())))
    return GreyImage(levels, np.rint(levels).astype(np.uint8))


def scaled(image: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    """Return the image ``scale`` times as wide and high.

    A place ``p`` in the result is ``(p + 0.5) / scale - 0.5`` in the given image.
    """
    if scale == 1.0:
        return image
    cv2 = load("cv2")
    kind = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    other: NDArray[np.uint8] = cv2.resize(image, None, fx=scale, fy=scale, interpolation=kind)
    return other


def reduced(levels: NDArray[Level], times: int) -> NDArray[Level]:
    """Reduce grey levels (H, W): each new one is the mean of ``times`` by ``times`` given ones.

    A place ``p`` in the result is ``(p + 0.5) * times - 0.5`` in the given image.
    """
    if times == 1:
        return levels
    cv2 = load("cv2")
    height, width = (side // times for side in levels.shape)
    cut = levels[: height * times, : width * times]
    smaller: NDArray[Level] = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)
    return smaller
