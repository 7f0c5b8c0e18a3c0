"""The search in any image without a target ends after bounded work."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from smartcam.calibration import Charuco, Checkerboard, CircleGrid, find_target
from smartcam.calibration._detection import boards, circle_grids
from smartcam.calibration._detection.saddles import (
    MAX_SADDLES_EXAMINED,
    MAX_SADDLES_KEPT,
    find_saddles,
)
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests.calibration.inside import (
    MAX_MEAN_OUTLINES,
    MAX_OUTLINES,
    MAX_SEEDS_TRIED,
    WINDOWS_PX,
    _GridGrower,
    _outlines,
    charucos,
    corners,
    marker_finder,
)
from tests.calibration.scenes import STRAIGHT, drawn, refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from smartcam.calibration._inside import Target
    from tests.calibration.scenes import Drawn

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
    """Draw objects with corners on each other."""
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
    """Count the slow steps of a search."""
    counted: Counter[str] = Counter()

    def count(place: Any, name: str) -> None:
        inner: Callable[..., Any] = getattr(place, name)

        def counting(*args: Any, **options: Any) -> Any:
            counted[name] += 1
            return inner(*args, **options)

        monkeypatch.setattr(place, name, counting)

    count(_GridGrower, "grow")
    count(boards, "find_saddles")
    count(boards, "refine_corners")
    count(charucos, "_search_image")
    count(circle_grids, "find_dark_pieces")
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
    assert calls["grow"] <= 2 * MAX_SEEDS_TRIED
    assert calls["refine_corners"] == 0


@scenes
def test_search_for_a_charuco_board_looks_once(
    scene: Callable[[np.random.Generator], Picture], calls: Counter[str]
) -> None:
    given_up(scene, CHARUCO)
    assert calls["_search_image"] == 1
    assert calls["grow"] <= MAX_SEEDS_TRIED


@scenes
def test_search_for_dots_looks_for_dark_and_light_ones_twice(
    scene: Callable[[np.random.Generator], Picture], calls: Counter[str]
) -> None:
    given_up(scene, DOTS)
    assert calls["find_dark_pieces"] == 4
    assert calls["grow"] <= 6 * MAX_SEEDS_TRIED


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
def test_search_in_an_image_of_another_target_tries_few_sizes(
    shown: Target, wanted: Target, calls: Counter[str]
) -> None:
    with refused(Code.TARGET_NOT_FOUND):
        find_target(drawn(shown, tilt=25, roll=70).image, wanted)
    assert calls["_search_image"] <= 2
    assert calls["find_dark_pieces"] <= 6


# ---------------------------------------------------------------------- parts of a board


def half_hidden(picture: Drawn) -> None:
    picture.image[:, int(np.median(picture.pixels[:, 0])) :] = 128


def cut(picture: Drawn) -> None:
    """Let the image end in the outermost column."""
    right = int(np.quantile(picture.pixels[:, 0], 0.97))
    picture.image[:, right:] = 120


def glare(picture: Drawn) -> None:
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    squares = (u - picture.pixels[20, 0]) ** 2 + (v - picture.pixels[20, 1]) ** 2
    picture.image[:] = levels(picture.image + 400 * np.exp(-squares / (2 * 13**2)))


def finger(picture: Drawn) -> None:
    u, v = np.rint(picture.pixels[30]).astype(int)
    cv2.circle(picture.image, (int(u), int(v)), 32, (90.0,), -1)


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count the corners of each step of a fit."""
    counted: list[int] = []
    inner = corners._evaluate

    def counting(windows: Any, values: Any, **options: Any) -> Any:
        counted.append(len(values))
        return inner(windows, values, **options)

    monkeypatch.setattr(corners, "_evaluate", counting)
    return counted


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("hide", [half_hidden, cut, glare, finger], ids=lambda hide: hide.__name__)
def test_search_for_a_board_in_part_takes_few_times_the_work_of_a_whole_one(
    hide: Callable[[Drawn], None], calls: Counter[str], fits: list[int]
) -> None:
    whole = drawn(BOARD, camera=STRAIGHT, tilt=20, roll=12, noise=2)
    find_target(whole.image, BOARD)
    steps, work = len(fits), sum(fits)
    fits.clear()
    calls.clear()
    hide(whole)
    try:
        view = find_target(whole.image, BOARD)
    except CalibrationError as exc:
        assert exc.code == Code.TARGET_NOT_FOUND  # noqa: PT017 - or what can be numbered
        assert hide is half_hidden
    else:
        assert len(view.ids) >= 0.75 * len(BOARD.points)
        assert whole.off(view).max() < 1.0  # beside the glare, whose rim is no edge
        assert np.median(whole.off(view)) < 0.02
    assert sum(fits) <= 3 * work
    assert len(fits) <= 20 * steps
    assert calls["find_saddles"] <= 2
    assert calls["grow"] <= 2 * MAX_SEEDS_TRIED


@pytest.mark.parametrize("hidden", [[0], [8], [45], [53], [0, 53], [9, 10, 19], [22, 23, 30, 31]])
def test_find_checkerboard_leaves_out_the_corners_that_are_covered(hidden: list[int]) -> None:
    picture = drawn(BOARD, camera=STRAIGHT, tilt=15)
    for one in hidden:
        u, v = np.rint(picture.pixels[one]).astype(int)
        cv2.circle(picture.image, (int(u), int(v)), 14, (110.0,), -1)
    view = find_target(picture.image, BOARD)
    assert not set(view.ids.tolist()) & set(hidden)
    assert len(view.ids) >= len(BOARD.points) - len(hidden)
    assert picture.off(view).max() < 0.05


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("roll", [0, 35, 90, 200])
@pytest.mark.parametrize("shape", [(9, 7), (7, 6)])
def test_find_checkerboard_of_a_part_with_the_mark_has_its_numbers(
    shape: tuple[int, int], roll: int
) -> None:
    board = Checkerboard(columns=shape[0], rows=shape[1], square=0.025, origin_mark=True)
    picture = drawn(board, camera=STRAIGHT, tilt=15, roll=roll, away=0.4)
    # the third of the board that is farthest from the mark is covered
    place = board.points[:, :2] @ [1.0, 0.4]
    far = np.flatnonzero(place > np.quantile(place, 0.62))
    for u, v in np.rint(picture.pixels[far]).astype(int):
        cv2.circle(picture.image, (int(u), int(v)), 30, (100.0,), -1)
    view = find_target(picture.image, board)
    assert 12 <= len(view.ids) < 0.75 * len(board.points)
    assert picture.off(view).max() < 0.1
    assert view.margin is not None
    assert view.margin > 50


def test_find_checkerboard_of_a_part_without_the_mark_is_not_found() -> None:
    board = Checkerboard(columns=9, rows=7, square=0.025, origin_mark=True)
    picture = drawn(board, camera=STRAIGHT, tilt=15, away=0.4)
    hidden = int(np.median(picture.pixels[:, 0]))
    picture.image[:, :hidden] = 128
    with refused(Code.TARGET_NOT_FOUND, "9 x 7 inner corners"):
        find_target(picture.image, board)
    plain = Checkerboard(columns=9, rows=7, square=0.025)
    picture = drawn(plain, camera=STRAIGHT, tilt=15, away=0.4)
    picture.image[:, hidden:] = 128
    with refused(Code.TARGET_NOT_FOUND, "9 x 7 inner corners"):
        find_target(picture.image, board)


def test_saddles_of_noise_are_no_more_than_the_most() -> None:
    image = np.random.default_rng(3).integers(0, 255, (1500, 1500), dtype=np.uint8)
    assert 100 < len(find_saddles(image).points) <= MAX_SADDLES_KEPT < MAX_SADDLES_EXAMINED


def squares(size: tuple[int, int], step: int, side: int) -> Picture:
    """Draw dark squares in rows and columns."""
    y, x = np.indices(size)
    return np.where((x % step < side) & (y % step < side), 30, 220).astype(np.uint8)


@pytest.mark.parametrize(("step", "side"), [(28, 20), (14, 10), (20, 12)])
def test_many_squares_are_few_outlines_to_opencv(step: int, side: int) -> None:
    """This search compares each outline with each other one."""
    image = squares((1024, 1224), step, side)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    without = cv2.aruco.DetectorParameters()
    windows = {window: len(_outlines(image, window, without)) for window in WINDOWS_PX}
    assert sum(windows.values()) > len(windows) * MAX_MEAN_OUTLINES
    given = marker_finder(image, dictionary).getDetectorParameters()
    window = given.adaptiveThreshWinSizeMin
    assert window == given.adaptiveThreshWinSizeMax
    assert len(_outlines(image, window, given)) <= MAX_OUTLINES


def test_board_before_many_squares_is_found() -> None:
    image = squares((1024, 1280), 20, 12)
    board = charucos.charuco_board(CHARUCO).generateImage((640, 480), marginSize=30)
    image[300:780, 400:1040] = board
    found = find_target(image, CHARUCO)
    assert len(found.ids) == len(CHARUCO.points)
