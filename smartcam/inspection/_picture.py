"""A picture for tools, with grey levels and colours that are computed only once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._arguments import check_integer, check_kind, check_path, wrong_argument
from smartcam._extras import load
from smartcam._forks import cached_property
from smartcam.exceptions import FrameFormatError
from smartcam.frames import Frame

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

MAX_SIDE_PX: Final = 20_000
"""Largest width and height of a picture, in pixels."""

MAX_FILE_BYTES: Final = 1 << 28
"""Largest size of a picture's file, bytes."""

LIMITED_BLACK: Final = 16
"""Level of black in video's limited range of 8 bits (ITU-R BT.601)."""

LIMITED_WHITE: Final = 235
"""Level of white in video's limited range of 8 bits (ITU-R BT.601)."""


class Picture:
    """One picture to inspect.

    Args:
        pixels: uint8 or uint16, (H, W) grey or (H, W, 3) with red first. They must not change.
        depth: number of significant bits of a sample; None: all bits.
        frame: frame of the pixels.

    Raises:
        FrameFormatError: there are no pixels or too many, or type or shape are wrong.

    Attributes:
        frame: frame of the pixels; None: not from a frame.
        depth: number of significant bits of a sample.
        size: width and height, pixels.
    """

    def __init__(
        self, pixels: NDArray[Any], *, depth: int | None = None, frame: Frame | None = None
    ) -> None:
        if not isinstance(pixels, np.ndarray):
            raise wrong_argument("pixels", "an array of uint8 or uint16", pixels, "Picture")
        good_shape = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
        if pixels.dtype not in (np.uint8, np.uint16) or not good_shape:
            raise FrameFormatError(
                "picture: expected uint8 or uint16 of the shape (H, W) or (H, W, 3), "
                f"got {pixels.dtype} of the shape {pixels.shape}"
            )
        height, width = pixels.shape[:2]
        if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
            raise FrameFormatError(
                f"picture: expected 1 to {MAX_SIDE_PX} pixels along each side, "
                f"got {width} x {height}"
            )
        max_depth = 8 * pixels.dtype.itemsize
        self.depth: int = (
            max_depth if depth is None else check_integer(depth, "depth", 1, max_depth, "Picture")
        )
        if frame is not None:
            check_kind(frame, Frame, "frame", "a Frame, or None", "Picture")
        self.frame: Frame | None = frame
        self.size: tuple[int, int] = (width, height)
        self._pixels = pixels

    @classmethod
    def of(cls, source: Frame | Picture | NDArray[Any]) -> Picture:
        """Return the picture of a frame or an array of pixels.

        Raises:
            FrameFormatError: the frame's bytes are wrong, or no picture.
            MissingExtraError: the frame is compressed, and the extra ``frames`` is not installed.
        """
        if isinstance(source, Picture):
            return source
        if isinstance(source, np.ndarray):
            return cls(source)
        if not isinstance(source, Frame):
            raise wrong_argument("picture", "a Frame, a Picture or an array", source)
        sends_grey = source.format.grey_is_sent
        pixels = source.grey() if sends_grey else source.rgb()
        depth = min(source.format.depth, 8 * pixels.dtype.itemsize)
        picture = cls(pixels, depth=depth, frame=source)
        if sends_grey and source.format.name.startswith("Mono"):
            picture._has_colours = False
        return picture

    @classmethod
    def read(cls, path: str | Path) -> Picture:
        """Read a picture from a file: PNG, JPEG, BMP, TIFF or another format of OpenCV.

        Raises:
            FrameFormatError: the file cannot be read, is too large, or is no picture.
            MissingExtraError: OpenCV is not installed.
        """
        path = check_path(path, "path", "Picture.read")
        cv2 = load("cv2", "inspection needs")
        try:
            with path.open("rb") as file:
                data = file.read(MAX_FILE_BYTES + 1)
        except OSError as exc:
            raise FrameFormatError(f"picture {path}: {exc}", source=str(path)) from exc
        if len(data) > MAX_FILE_BYTES:
            raise FrameFormatError(f"picture {path}: expected {MAX_FILE_BYTES} bytes at most")
        flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except cv2.error:  # empty files, and more pixels than OpenCV's limit
            pixels = None
        if pixels is None:
            raise FrameFormatError(
                f"picture {path}: expected PNG, JPEG, BMP or TIFF, got {len(data)} bytes: "
                f"{data[:16].hex(' ')}",
                source=str(path),
            )
        return cls(pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, ::-1]))

    @property
    def has_colours(self) -> bool:
        """True if the camera sent colours."""
        return self._has_colours

    @cached_property
    def _has_colours(self) -> bool:
        return self._pixels.ndim == 3 or self.frame is not None

    @cached_property
    def levels(self) -> NDArray[Any]:
        """Brightness, (H, W), uint8 or uint16 with :attr:`depth` significant bits."""
        if self._pixels.ndim == 2:
            return self._pixels
        cv2 = load("cv2", "inspection needs")
        brightness: NDArray[Any] = cv2.cvtColor(self._pixels, cv2.COLOR_RGB2GRAY)
        return brightness

    @cached_property
    def saturation_levels(self) -> tuple[int, int]:
        """Saturation levels of black and white in :attr:`levels`.

        These are the least and the largest level that ``depth`` allows. But if the picture's least
        level is 16 (in 8 bits), or its largest level is 235, this limit of video is used instead.
        """
        return _saturation_levels(self.levels, self.depth)

    @cached_property
    def clipped(self) -> NDArray[np.bool_] | None:
        """Mask of pixels with a saturated colour, (H, W); None if there are no colours.

        A colour is saturated at the largest level, and at 0 if another colour is bright, since a
        camera's colour correction gives negative values there. Pixels that are black in all colours
        are not marked here: a caller finds them in :attr:`levels`.
        """
        if not self.has_colours:
            return None
        is_rgb = self._pixels.ndim == 3
        colours = self._pixels if is_rgb or self.frame is None else self.frame.rgb()
        depth = min(self.depth, 8 * colours.dtype.itemsize)
        tolerance = 0 if is_rgb else 1  # converted colours may be off by one level
        bright = colours.max(axis=2) > 2**depth // 4
        mask = np.zeros(bright.shape, dtype=bool)
        for channel in range(3):
            black, white = _saturation_levels(colours[:, :, channel], depth)
            mask |= colours[:, :, channel] >= white - tolerance
            mask |= bright & (colours[:, :, channel] <= black + tolerance)
        return mask

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """Brightness, (H, W), uint8: the upper eight significant bits of a sample."""
        return _eight_bits(self.levels, self.depth)

    @cached_property
    def rgb(self) -> NDArray[np.uint8]:
        """Colours, (H, W, 3), uint8, red first; for a grey picture three equal levels."""
        if self._pixels.ndim == 3:
            return _eight_bits(self._pixels, self.depth)
        if self.frame is not None and self.has_colours:
            colours = self.frame.rgb()
            return _eight_bits(colours, min(self.depth, 8 * colours.dtype.itemsize))
        return np.repeat(self.grey[:, :, np.newaxis], 3, axis=2)


def _saturation_levels(levels: NDArray[Any], depth: int) -> tuple[int, int]:
    """Return the saturation levels of samples of ``depth`` bits."""
    top, step = 2**depth - 1, 2 ** (depth - 8) if depth >= 8 else 0
    black, white = LIMITED_BLACK * step, LIMITED_WHITE * step
    darkest, brightest = int(levels.min()), int(levels.max())
    return (black if darkest == black else 0), (white if step and brightest == white else top)


def _eight_bits(pixels: NDArray[Any], depth: int) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return pixels
    shifted = pixels >> (depth - 8) if depth > 8 else pixels
    upper: NDArray[np.uint8] = np.minimum(shifted, 255).astype(np.uint8)
    return upper
