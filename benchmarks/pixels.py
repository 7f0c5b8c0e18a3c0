"""Pixel formats: a picture's colours, brightness and JPEG, beside OpenCV called alone.

The yardstick is the fastest of what OpenCV has at smartcam's accuracy, at most one level from the
formulas of ITU-R: ``cvtColor`` where it knows the format, else ``transform`` with U and V brought
to the size of Y. It gets its planes as it likes them best, and its result is not looked at.
Pictures have 1280 x 1024 pixels. Both run on one thread; the CPU time is the process'.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import simplejpeg  # type: ignore[import-untyped]

from benchmarks.measure import Comparison, Cost, Goal, cpu_microseconds, take_turns
from smartcam import frames
from smartcam.frames._codecs.pictures import to_jpeg

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from benchmarks.measure import Plan

__all__ = ["run"]

WIDTH, HEIGHT = 1280, 1024
PICTURES = 20
QUALITY = 85

KNOWN = {
    "YUV422_8": cv2.COLOR_YUV2RGB_YUY2,
    "YUV422_8_UYVY": cv2.COLOR_YUV2RGB_UYVY,
    "NV12": cv2.COLOR_YUV2RGB_NV12,
    "I420": cv2.COLOR_YUV2RGB_I420,
    "BGR8": cv2.COLOR_BGR2RGB,
    "RGBa8": cv2.COLOR_RGBA2RGB,
    "BGRa8": cv2.COLOR_BGRA2RGB,
    "RGBa16": cv2.COLOR_RGBA2RGB,
    "Mono8": cv2.COLOR_GRAY2RGB,
    "Mono16": cv2.COLOR_GRAY2RGB,
    "BayerRG8": cv2.COLOR_BayerBG2RGB,
    "BayerRG16": cv2.COLOR_BayerBG2RGB,
}
"""The formats that OpenCV converts to RGB by itself."""

BY_MATRIX = (
    *("YCbCr422_8", "YCbCr709_422_8", "YUV422_8_709_full", "NV12_709", "NV12_full", "I420_709"),
    *("I420_2020", "I422", "I422_709", "I444", "I444_709_full"),
    *("I420_10", "I422_12_709", "I444_16_2020"),
)
"""The formats that OpenCV converts to RGB with a matrix."""

GREYS = {
    "RGB8": cv2.COLOR_RGB2GRAY,
    "BGR8": cv2.COLOR_BGR2GRAY,
    "RGBa8": cv2.COLOR_RGBA2GRAY,
    "BGRa8": cv2.COLOR_BGRA2GRAY,
    "BayerRG8": cv2.COLOR_BayerBG2GRAY,
}

ANY_MATRIX = np.array([[1.2, 0.0, 1.6, -200], [1.2, -0.4, -0.8, 140], [1.2, 2.0, 0.0, -280]])
LIMITED = np.arange(256).clip(16, 235).astype(np.uint8)


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure each format."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for name, code in KNOWN.items():
            yield _compared(plan, name, "to RGB", _known(name, code))
        yield _compared(plan, "YUV422_8", "with Y below 16 to RGB", _by_matrix("YUV422_8"), low=0)
        yield _compared(plan, "NV12", "with Y below 16 to RGB", _by_matrix("NV12"), low=0)
        for name in BY_MATRIX:
            yield _compared(plan, name, "to RGB", _by_matrix(name))
        yield _compared(plan, "RGB8_limited", "to RGB", _looked_up())
        for name, code in GREYS.items():
            yield _compared(plan, name, "to grey", _known(name, code))
        for name in ("YUV422_8", "NV12"):
            yield _compared(plan, name, f"to JPEG q{QUALITY}", _jpeg(name), jpeg=True)
    finally:
        cv2.setNumThreads(before)


def _picture(name: str, low: int = 16) -> frames.Frame:
    """Return a frame of random samples, Y at least ``low``."""
    found, random = frames.find_format(name), np.random.default_rng(1)
    stride = found.stride(WIDTH)
    data = bytearray(random.bytes(found.size(WIDTH, HEIGHT)))
    if hasattr(found.layout, "matrix"):
        y = found.planes(data, WIDTH, HEIGHT, stride)[0]
        y.flags.writeable = True
        np.maximum(y, low << (found.depth - 8), out=y)
    return frames.Frame(
        data=bytes(data),
        format=found,
        width=WIDTH,
        height=HEIGHT,
        stride=stride,
        captured=time.monotonic(),
        utc=time.time(),
        moment=frames.Moment.EXPOSURE_START,
        sequence=1,
        source="benchmark",
    )


def _compared(
    plan: Plan, name: str, to: str, alone: Callable[[], Any], *, low: int = 16, jpeg: bool = False
) -> Comparison:
    frame = _picture(name, low)
    convert = {"to grey": frame.grey}.get(to, frame.rgb)
    if jpeg:
        convert = lambda: to_jpeg(frame, QUALITY).data  # type: ignore[assignment,return-value]  # noqa: E731
    count = plan.operations(PICTURES, least=1)

    def cost(work: Callable[[], Any]) -> Callable[[], Cost]:
        def measured() -> Cost:
            begin = time.process_time()
            for _ in range(count):
                work()
            return cpu_microseconds(begin, count)

        return measured

    sides = {"smartcam": cost(convert), "OpenCV": cost(alone)}
    series = take_turns(plan, sides)
    return Comparison(
        "pixels",
        f"{name} {to}, over {'cvtColor and simplejpeg' if jpeg else 'OpenCV'} alone",
        series["smartcam"],
        series["OpenCV"],
        "ratio",
        Goal("at most", 2.0),
    )


def _known(name: str, code: int) -> Callable[[], Any]:
    frame = _picture(name)
    samples: NDArray[Any] = frame.array()
    if samples.ndim == 1:  # planes
        samples = samples.reshape(-1, WIDTH)
    return lambda: cv2.cvtColor(samples, code)


def _by_matrix(name: str) -> Callable[[], Any]:
    frame = _picture(name)
    planes = frame.format.planes(frame.data, WIDTH, HEIGHT, frame.stride)
    y, u, v = (np.ascontiguousarray(one) for one in planes)

    def convert() -> Any:
        chroma: list[Any] = [u, v]
        if u.shape != y.shape:
            size, nearest = (WIDTH, HEIGHT), cv2.INTER_NEAREST
            chroma = [cv2.resize(one, size, interpolation=nearest) for one in chroma]
        made = cv2.transform(cv2.merge([y, *chroma]), ANY_MATRIX)
        if frame.format.depth in (8, 16):
            return made
        return cv2.threshold(made, 2**frame.format.depth - 1, 0, cv2.THRESH_TRUNC)

    return convert


def _looked_up() -> Callable[[], Any]:
    samples = _picture("RGB8_limited").array()
    return lambda: cv2.LUT(samples, LIMITED)


def _jpeg(name: str) -> Callable[[], bytes]:
    convert = _known(name, KNOWN[name])
    return lambda: simplejpeg.encode_jpeg(convert(), QUALITY, "RGB", "420")
