"""Convert images to the grey levels, from 0 to 255, in which targets are searched."""

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
"""OpenCV searches a grid first in an image whose longest side has this many pixels: a larger image
takes seconds, and fewer grids are found."""


Level = TypeVar("Level", np.uint8, np.float32)


@runtime_checkable
class HasGrey(Protocol):
    """An object that gives its brightness, such as a frame of a camera."""

    def grey(self) -> NDArray[Any]:
        """Return the brightness, (H, W), uint8 or uint16."""
        ...


class GreyImage(NamedTuple):
    """The grey levels of an image."""

    levels: NDArray[np.float32]  # (H, W), float32, 0 to 255; for refinement
    uint8_levels: NDArray[np.uint8]  # (H, W), ``levels`` as uint8; for OpenCV's detectors

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        height, width = self.uint8_levels.shape
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
    dtype = getattr(image, "dtype", None)
    has_image_shape = len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)
    if not (
        isinstance(image, np.ndarray)
        and has_image_shape
        and dtype in (np.uint8, np.uint16)
        and all(MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in shape[:2])
    ):
        received = f"{dtype} of shape {shape}" if dtype is not None else type(image).__name__
        raise Code.SHAPE.error_with_value(
            "image: expected an array of uint8 or uint16, (H, W) or (H, W, 3), "
            f"{MIN_SIDE_PX} to {MAX_SIDE_PX} pixels wide and high",
            "uint8 or uint16, (H, W) or (H, W, 3)",
            received,
        )
    cv2 = load("cv2")
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if len(shape) == 3 else image
    grey = np.ascontiguousarray(grey)
    if grey.dtype == np.uint8:
        return GreyImage(grey.astype(np.float32), grey)
    levels = grey.astype(np.float32) * np.float32(255 / max(1, int(grey.max())))
    return GreyImage(levels, np.rint(levels).astype(np.uint8))


def resize_image(image: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    """Return the image ``scale`` times as wide and high.

    A place ``p`` in the result is ``(p + 0.5) / scale - 0.5`` in the given image.
    """
    if scale == 1.0:
        return image
    cv2 = load("cv2")
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    resized: NDArray[np.uint8] = cv2.resize(
        image, None, fx=scale, fy=scale, interpolation=interpolation
    )
    return resized


def shrink_image(levels: NDArray[Level], factor: int) -> NDArray[Level]:
    """Return grey levels (H, W) whose pixels are means of ``factor`` by ``factor`` given pixels.

    A place ``p`` in the result is ``(p + 0.5) * factor - 0.5`` in the given image.
    """
    if factor == 1:
        return levels
    cv2 = load("cv2")
    height, width = (side // factor for side in levels.shape)
    cropped = levels[: height * factor, : width * factor]
    smaller: NDArray[Level] = cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA)
    return smaller
