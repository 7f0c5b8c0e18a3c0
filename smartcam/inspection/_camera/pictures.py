"""Encode inspected pictures as files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.inspection._camera.frame_inspector import InspectedPicture


def png_of(inspected: InspectedPicture, *, drawn: bool) -> bytes:
    """Return an inspected picture as a PNG's bytes; ``drawn``: with the marks of the tools.

    Levels of 9 to 15 bits are scaled to 16 bits, so that white is white in every viewer.

    Raises:
        FrameFormatError: the frame's bytes are wrong.
        MissingExtraError: OpenCV is not installed.
    """
    pixels: NDArray[Any]
    inspection = inspected.inspection
    if inspection is not None and drawn:
        pixels = inspection.drawn()
    elif inspection is not None:
        picture = inspection.picture
        pixels = picture.rgb if picture.has_colours else _full_range(picture.levels, picture.depth)
    else:
        pixels = _full_range(inspected.frame.rgb(), inspected.frame.format.depth)
    cv2 = load("cv2", "inspection needs")
    if pixels.ndim == 3:
        pixels = pixels[:, :, ::-1]
    _, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return bytes(data)


def _full_range(levels: NDArray[Any], depth: int) -> NDArray[Any]:
    """Return levels of ``depth`` bits scaled to the full range of their type."""
    if levels.dtype != np.uint16 or depth >= 16:
        return levels
    depth = max(depth, 8)
    levels = np.minimum(levels, 2**depth - 1)
    spread: NDArray[Any] = (levels << (16 - depth)) | (levels >> (2 * depth - 16))
    return spread
