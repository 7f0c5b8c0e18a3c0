"""Images without a target: given up after work that is bounded, whatever they show."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from smartcam.calibration._codes import Code
from smartcam.calibration._detection import boards, charucos, checkerboards, circle_grids
from smartcam.calibration._detection.find import find_target
from smartcam.calibration._detection.grid_growing import MOST_TRIES, _Grown
from smartcam.calibration._detection.saddles import MOST_KEPT, MOST_LOOKED_AT, find_saddles
from smartcam.calibration._targets import Charuco, Checkerboard, CircleGrid
from tests.calibration.scenes import drawn, refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smartcam.calibration._targets import Target

    Picture = NDArray[np.uint8]

SIZE = (480, 640)
BOARD = Checkerboard(columns=9, rows=6, square=0.025)
CHARUCO = Charuco(columns=8, rows=6, square=0.03, marker=0.02)
DOTS = CircleGrid(columns=10, rows=8, spacing=0.02, diameter=0.01, origin_diameter=0.016)


def levels(image: NDArray[Any]) -> Picture:
    return np.asarray(np.rint(image).clip(0, 255), dtype=np.uint8)


def uniform(_: np.random.Generator) -> Picture:
    return np.full(SIZE, 128, dtype=np.uint8)


def noise(random: np.random.Generator) -> Picture:
    return levels(random.normal(128, 40, SIZE))


def texture(random: np.random.Generator) -> Picture:
    """Draw noise whose amplitude falls with its frequency, as that of pictures of nature does."""
    frequency = np.hypot(np.fft.fftfreq(SIZE[0])[:, None], np.fft.fftfreq(SIZE[1]))
    frequency[0, 0] = 1.0
    image = np.fft.ifft2(np.fft.fft2(random.normal(size=SIZE)) / frequency).real
    return levels(128 + 45 * image / image.std())


def desk(random: np.random.Generator) -> Picture:
    """Draw things with corners on each other."""
    image = np.full(SIZE, 200, dtype=np.uint8)
    for _ in range(250):
        middle = random.uniform((0, 0), SIZE[::-1])
        corners = (middle + random.uniform(-45, 45, (4, 2))).astype(np.int32)
        cv2.fillConvexPoly(image, cv2.convexHull(corners), (random.uniform(0, 255),))
    return image


def text(random: np.random.Generator) -> Picture:
    image = np.full(SIZE, 230, dtype=np.uint8)
    for row in range(20, SIZE[0], 15):
        line = "".join(map(chr, random.integers(33, 126, 90)))
        cv2.putText(image, line, (5, row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20.0,), 1, cv2.LINE_AA)
    return image


SCENES = [uniform, noise, texture, desk, text]
scenes = pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.__name__)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count what takes time in a search."""
    counted: Counter[str] = Counter()

    def count(place: Any, name: str) -> None:
        inner: Callable[..., Any] = getattr(place, name)

        def counting(*args: Any, **options: Any) -> Any:
            counted[name] += 1
            return inner(*args, **options)

        monkeypatch.setattr(place, name, counting)

    count(_Grown, "grow")
    count(boards, "find_saddles")
    count(boards, "refine_corners")
    count(checkerboards, "_opencvs")
    count(charucos, "_look")
    count(circle_grids, "dark_pieces")
    return counted


def given_up(scene: Callable[[np.random.Generator], Picture], target: Target) -> None:
    with refused(Code.TARGET_NOT_FOUND):
        find_target(scene(np.random.default_rng(7)), target)


@scenes
def test_search_for_a_checkerboard_looks_at_two_sizes_and_fits_nothing(
    scene: Callable[[np.random.Generator], Picture], calls: Counter[str]
) -> None:
    given_up(scene, BOARD)
    assert calls["find_saddles"] == 2
    assert calls["grow"] <= 2 * MOST_TRIES
    assert calls["refine_corners"] == calls["_opencvs"] == 0


@scenes
def test_search_for_a_charuco_board_looks_once(
    scene: Callable[[np.random.Generator], Picture], calls: Counter[str]
) -> None:
    given_up(scene, CHARUCO)
    assert calls["_look"] == 1
    assert calls["grow"] <= MOST_TRIES


@scenes
def test_search_for_dots_looks_for_dark_and_light_ones_twice(
    scene: Callable[[np.random.Generator], Picture], calls: Counter[str]
) -> None:
    given_up(scene, DOTS)
    assert calls["dark_pieces"] == 4
    assert calls["grow"] <= 6 * MOST_TRIES


@pytest.mark.parametrize(
    ("shown", "wanted"),
    [
        (DOTS, BOARD),
        (Checkerboard(columns=10, rows=7, square=0.02), BOARD),
        (BOARD, CHARUCO),
        (BOARD, DOTS),
        pytest.param(Checkerboard(columns=8, rows=5, square=0.02), BOARD, marks=pytest.mark.long),
        pytest.param(CHARUCO, BOARD, marks=pytest.mark.long),
        pytest.param(DOTS, CHARUCO, marks=pytest.mark.long),
        pytest.param(CHARUCO, DOTS, marks=pytest.mark.long),
    ],
    ids=lambda target: f"{target.kind} {target.columns} x {target.rows}",
)
def test_search_where_another_target_is_seen_asks_no_slower_detector(
    shown: Target, wanted: Target, calls: Counter[str]
) -> None:
    with refused(Code.TARGET_NOT_FOUND):
        find_target(drawn(shown, tilt=25, roll=70).image, wanted)
    assert calls["_opencvs"] == 0
    assert calls["_look"] <= 2
    assert calls["dark_pieces"] <= 6


def test_search_where_a_part_of_the_board_is_seen_asks_the_slower_detectors(
    calls: Counter[str],
) -> None:
    picture = drawn(BOARD)
    u, v = np.rint(picture.pixels[22]).astype(int)
    cv2.circle(picture.image, (int(u), int(v)), 40, (90.0,), -1)
    with refused(Code.TARGET_NOT_FOUND, "found one of about 9 x 6"):
        find_target(picture.image, BOARD)
    assert calls["_opencvs"] == 1


def test_saddles_of_noise_are_no_more_than_the_most() -> None:
    image = np.random.default_rng(3).integers(0, 255, (1500, 1500), dtype=np.uint8)
    assert 100 < len(find_saddles(image).points) <= MOST_KEPT < MOST_LOOKED_AT
