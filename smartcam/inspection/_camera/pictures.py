"""Judged pictures as files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.inspection._camera.eyes import Judged


def png_of(judged: Judged, *, drawn: bool) -> bytes:
    """Return a judged picture as a PNG's bytes; ``drawn``: with the marks of the tools.

    Levels of 9 to 15 bits are spread over 16, so that white is white to whoever reads the file.

    Raises:
        FrameFormatError: the frame's bytes are wrong.
        MissingExtraError: OpenCV is not installed.
    """
    pixels: NDArray[Any]
    inspection = judged.inspection
    if inspection is not None and drawn:
        pixels = inspection.drawn()
    elif inspection is not None:
        picture = inspection.picture
        pixels = picture.rgb if picture.has_colours else _whole(picture.levels, picture.depth)
    else:
        pixels = _whole(judged.frame.rgb(), judged.frame.format.depth)
    cv2 = load("cv2", "inspection needs")
    if pixels.ndim == 3:
        pixels = pixels[:, :, ::-1]
    _, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return bytes(data)


def _whole(levels: NDArray[Any], depth: int) -> NDArray[Any]:
    """Return levels of so many bits with all bits of their type in use; 8 bits are as they are."""
    if levels.dtype != np.uint16 or depth >= 16:
        return levels
    depth = max(depth, 8)
    levels = np.minimum(levels, 2**depth - 1)
    spread: NDArray[Any] = (levels << (16 - depth)) | (levels >> (2 * depth - 16))
    return spread
