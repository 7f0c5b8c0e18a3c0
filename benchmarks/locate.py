"""Locating a taught part in 1.3 megapixels, full circle, beside OpenCV's template matching.

Times are CPU time of one thread. OpenCV's ``matchTemplate`` looks for the part in steps of 2
degrees in a picture of a quarter of the size along each side, then in steps of half a degree around
the best one in the whole picture; it has a pixel and half a degree then, and no error.
"""

from __future__ import annotations

import statistics
import time
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from benchmarks.measure import Comparison, Goal, Series
from smartcam.inspection import PartModel, Picture
from smartcam.inspection._locate.find import PartSearch, locate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from benchmarks.measure import Plan

__all__ = ["run"]

SIZE = (1280, 1024)
PICTURES = 20
CORNERS = np.array([(-60, -35), (40, -35), (40, -5), (0, 5), (0, 40), (-60, 40)], float)
SHIFT = 8


def picture_of(*poses: tuple[float, float, float], size: tuple[int, int] = SIZE) -> NDArray[Any]:
    """Return a picture of brackets with two holes; poses are pixels and radians."""
    picture = np.full((size[1], size[0]), 60, np.uint8)
    for x, y, angle in poses:
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, sin], [-sin, cos]])
        corners = np.rint((CORNERS @ turn + (x, y)) * (1 << SHIFT)).astype(np.int32)
        cv2.fillPoly(picture, [corners], 180, cv2.LINE_AA, SHIFT)
        for place, radius in (((-38, 18), 12), ((20, -20), 7)):
            u, v = ((np.array(place) @ turn + (x, y)) * (1 << SHIFT)).round().astype(int).tolist()
            cv2.circle(picture, (u, v), radius << SHIFT, 60, -1, cv2.LINE_AA, SHIFT)
    noise = np.random.default_rng(1).normal(0, 3, picture.shape)
    drawn: NDArray[np.uint8] = np.clip(
        cv2.GaussianBlur(picture, (0, 0), 0.8) + noise, 0, 255
    ).astype(np.uint8)
    return drawn


def run(plan: Plan) -> Iterator[Comparison]:
    """Measure pictures with a part, and without one."""
    model = PartModel.teach(picture_of((100, 100, 0.0), size=(200, 200)), name="bracket")
    others = [
        PartModel.teach(picture_of((100, 100, 0.0), size=(200, 200)), name=f"other{k}")
        for k in range(3)
    ]
    part, nothing = picture_of((700.3, 500.6, 1.234)), picture_of()
    _ = model.bands_at(1.0), model.coarse
    count = plan.operations(PICTURES, least=2)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        there = [_took(lambda: _find([model], part), count) for _ in range(plan.rounds)]
        empty = [_took(lambda: _find([model], nothing), count) for _ in range(plan.rounds)]
        four = [_took(lambda: _find([model, *others], nothing), count) for _ in range(plan.rounds)]
        matched = [_took(lambda: match(part), 1) for _ in range(plan.rounds)]
    finally:
        cv2.setNumThreads(threads)
    yield Comparison(
        "locate",
        "a part in 1.3 MP, full circle, median",
        Series("smartcam", "ms", there),
        Series("OpenCV matchTemplate", "ms", matched),
        "alone",
        Goal("at most", 40.0, "ms"),
        "to 0.01 px with its error; OpenCV to a pixel",
    )
    yield Comparison(
        "locate",
        "nothing in 1.3 MP, full circle, median",
        Series("smartcam", "ms", empty),
        None,
        "alone",
        Goal("at most", 30.0, "ms"),
    )
    yield Comparison(
        "locate",
        "four models beside one, nothing there",
        Series("smartcam", "ms", four),
        Series("one model", "ms", empty),
        "ratio",
        Goal("at most", 4.0),
    )


def _find(models: Sequence[PartModel], picture: NDArray[Any]) -> None:
    locate(Picture(picture), models, PartSearch(seconds=30.0))


def _took(work: Callable[[], object], count: int) -> float:
    """Return the median of the CPU milliseconds of some work."""
    took = []
    for _ in range(count):
        begin = time.process_time()
        work()
        took.append(1e3 * (time.process_time() - begin))
    return statistics.median(took)


def match(picture: NDArray[Any]) -> tuple[float, float, float]:
    """Return the place and the angle in degrees that ``matchTemplate`` finds."""
    taught = picture_of((100, 100, 0.0), size=(200, 200))[20:180, 20:180]
    small = cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    coarse = max(
        (_best(small, taught, degrees, 0.25) for degrees in np.arange(0, 360, 2.0)),
        key=lambda a: a[0],
    )
    x, y = (4 * one for one in coarse[1:3])
    left, top = max(round(x) - 100, 0), max(round(y) - 100, 0)
    cut = picture[top : top + 200, left : left + 200]
    fine = max(
        (_best(cut, taught, coarse[3] + off, 1.0) for off in np.arange(-2, 2.1, 0.5)),
        key=lambda a: a[0],
    )
    return left + fine[1], top + fine[2], fine[3]


def _best(
    picture: NDArray[Any], taught: NDArray[Any], degrees: float, scale: float
) -> tuple[float, float, float, float]:
    """Return the score, the place and the angle of the taught picture at one angle."""
    middle = (taught.shape[1] - 1) / 2
    turn = cv2.getRotationMatrix2D((middle, middle), -degrees, 1.0)
    turned = cv2.warpAffine(taught, turn, taught.shape[::-1], borderValue=60)
    turned = cv2.resize(turned, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    scores = cv2.matchTemplate(picture, turned, cv2.TM_CCOEFF_NORMED)
    _, score, _, (x, y) = cv2.minMaxLoc(scores)
    half = (turned.shape[1] - 1) / 2
    return score, x + half, y + half, degrees
