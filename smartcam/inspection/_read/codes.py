"""Read barcodes and two-dimensional codes in a picture, by the library zxing-cpp."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from smartcam._extras import load
from smartcam._suggestions import did_you_mean
from smartcam.inspection._read.gs1 import split_elements

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

Point = tuple[float, float]
Corners = tuple[Point, Point, Point, Point]

PURPOSE: Final = "reading codes needs"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadCode:
    """A code that was read.

    Attributes:
        kind: kind of the code, such as ``DataMatrix``.
        data: bytes that the code holds; in a GS1 code with GS (0x1D) between elements.
        text: the bytes as text, by the character set that the code gives.
        gs1: application identifier and value of each GS1 element; empty for other codes.
        symbology: symbology identifier of ISO/IEC 15424, such as ``]d2``.
        corners: upper left, upper right, lower right and lower left corner of the printed code,
            pixels of the picture.
        angle: direction of the upper edge, radians from x towards y.
        unused_correction: share of the code's error correction that reading did not need, 0 to 1;
            None: zxing-cpp does not report it for this kind.
        level: error correction level, such as ``H``; "" if the kind has none.
        version: size of the symbol, such as ``12x26``; "" if the kind has none.
        prepared: name of the preparation of the picture in which the code was read; "": none.
    """

    kind: str
    data: bytes
    text: str
    gs1: tuple[tuple[str, str], ...]
    symbology: str
    corners: Corners
    angle: float
    unused_correction: float | None = None
    level: str = ""
    version: str = ""
    prepared: str = ""

    @property
    def centre(self) -> Point:
        """Mean of the corners, pixels of the picture."""
        return sum(x for x, _ in self.corners) / 4, sum(y for _, y in self.corners) / 4


@functools.cache
def readable_kinds() -> dict[str, Any]:
    """Return the kinds of codes that can be read, by name.

    Raises:
        MissingExtraError: zxing-cpp is not installed.
    """
    zxing = load("zxingcpp", PURPOSE)
    return {
        symbology.name: symbology
        for symbology in zxing.barcode_formats_list(zxing.BarcodeFormat.AllReadable)
    }


def formats_of(names: Sequence[str]) -> Any:
    """Return zxing-cpp's set of the named kinds; all kinds if there are no names.

    Raises:
        ValueError: a name is unknown.
        MissingExtraError: zxing-cpp is not installed.
    """
    zxing = load("zxingcpp", PURPOSE)
    known = readable_kinds()
    for name in names:
        if name not in known:
            raise ValueError(
                f"no kind of code is called {name!r:.40}; known are {', '.join(known)}"
                f"{did_you_mean(name, known)}"
            )
    chosen = [known[name] for name in names] or [zxing.BarcodeFormat.AllReadable]
    return zxing.BarcodeFormats(chosen)


def read_codes(
    grey: NDArray[np.uint8],
    formats: Any,
    to_picture: NDArray[np.float64],
    binarizer: str = "LocalAverage",
    prepared: str = "",
) -> list[ReadCode]:
    """Return the codes in a picture.

    Args:
        grey: picture, (H, W), contiguous.
        formats: kinds from :func:`formats_of`.
        to_picture: affine map (2, 3) from pixels of ``grey`` to the coordinates of the corners.
        binarizer: zxing-cpp's name of the binarizer.
        prepared: name of the preparation that ``grey`` has; "": none.
    """
    zxing = load("zxingcpp", PURPOSE)
    barcodes = zxing.read_barcodes(
        grey,
        formats=formats,
        text_mode=zxing.TextMode.Plain,
        binarizer=getattr(zxing.Binarizer, binarizer),
    )
    is_gs1 = zxing.ContentType.GS1
    return [
        _make_code(barcode, to_picture, prepared, gs1=barcode.content_type == is_gs1)
        for barcode in barcodes
    ]


def _make_code(
    barcode: Any, to_picture: NDArray[np.float64], prepared: str, *, gs1: bool
) -> ReadCode:
    position = barcode.position  # indices of pixels
    corners = [
        (float(x), float(y))
        for x, y in (
            to_picture[:, :2] @ (corner.x, corner.y) + to_picture[:, 2]
            for corner in (
                position.top_left,
                position.top_right,
                position.bottom_right,
                position.bottom_left,
            )
        )
    ]
    (x1, y1), (x2, y2) = corners[:2]
    extra = barcode.extra or {}
    text = barcode.text
    unused = extra.get("UEC")
    return ReadCode(
        kind=barcode.format.name,
        data=barcode.bytes,
        text=text,
        gs1=split_elements(text) if gs1 else (),
        symbology=barcode.symbology_identifier,
        corners=(corners[0], corners[1], corners[2], corners[3]),
        angle=math.atan2(y2 - y1, x2 - x1),
        unused_correction=None if unused is None else float(unused),
        level=barcode.ec_level or str(extra.get("ECLevel", "")),
        version=str(extra.get("Version", "")),
        prepared=prepared,
    )
