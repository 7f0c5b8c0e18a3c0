"""Colours: the pixels of a range, and regions in the shape of a block."""

from __future__ import annotations

import colorsys
import json
import math
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam.depth import ColourRange, find_regions
from smartcam.exceptions import ConfigurationError, FrameFormatError, MissingExtraError
from smartcam.frames import find_format
from tests.frames.drivers import frame

cv2 = pytest.importorskip("cv2", reason="needs the extra depth")

RED, GREEN, BLACK, GREY = (200, 20, 30), (30, 180, 40), (20, 22, 21), (150, 150, 152)


def flat(colour: tuple[int, int, int], shape: tuple[int, int] = (40, 60)) -> NDArray[np.uint8]:
    return np.full((*shape, 3), colour, np.uint8)


def rectangle(
    centre: tuple[float, float], sides: tuple[float, float], degrees: float, size: int = 300
) -> NDArray[np.bool_]:
    """Return the pixels with centres in a rectangle."""
    y, x = np.mgrid[:size, :size].astype(float)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    along, across = (
        c * (x - centre[0]) + s * (y - centre[1]),
        c * (y - centre[1]) - s * (x - centre[0]),
    )
    inside: NDArray[np.bool_] = (np.abs(along) < sides[0] / 2) & (np.abs(across) < sides[1] / 2)
    return inside


# ---------------------------------------------------------------------- a range


def within(low: int, high: int, value: float, off: float) -> bool:
    return low - off <= value <= high + off


@pytest.mark.parametrize(
    "given",
    [
        ColourRange(hue=(35, 85), saturation=(80, 255), value=(40, 255)),
        ColourRange(hue=(165, 12), saturation=(60, 255)),
        ColourRange(value=(0, 60)),
        ColourRange(),
    ],
)
def test_mask_has_the_pixels_of_the_range(given: ColourRange) -> None:
    random = np.random.default_rng(1)
    picture = random.integers(0, 256, (40, 50, 3), np.uint8)
    found = given.mask(picture)
    assert found.shape == (40, 50)
    assert found.dtype == bool
    sure = 0
    for (y, x), inside in np.ndenumerate(found):
        h, s, v = colorsys.rgb_to_hsv(*(int(one) / 255 for one in picture[y, x]))
        values = (180 * h, 255 * s, 255 * v)
        verdicts = []
        for off in (1.0, -1.0):  # OpenCV rounds, and a hue of 179.6 is 0
            low, high = given.hue
            hue = any(
                within(*ends, values[0] + turn, off)
                for turn in (-180, 0, 180)
                for ends in ([(low, high)] if low <= high else [(low, high + 180)])
            )
            full = given.hue == (0, 179)
            verdicts.append(
                (hue or full)
                and within(*given.saturation, values[1], off if given.saturation != (0, 255) else 1)
                and within(*given.value, values[2], off if given.value != (0, 255) else 1)
            )
        if verdicts[0] == verdicts[1]:
            sure += 1
            assert inside == verdicts[0], (picture[y, x], values)
    assert sure > 1700


def test_red_goes_over_the_end_of_the_hues() -> None:
    reds = ColourRange(hue=(170, 10), saturation=(100, 255), value=(100, 255))
    for colour, inside in (
        (RED, True),
        ((200, 30, 20), True),
        (GREEN, False),
        ((0, 0, 255), False),
    ):
        assert reds.mask(flat(colour)).all() == inside
        assert reds.mask(flat(colour)).any() == inside


def test_frames_of_any_format_have_a_mask() -> None:
    dark = ColourRange(value=(0, 60))
    picture = flat((200, 180, 90))
    picture[10:20, 30:50] = BLACK
    expected = (picture == BLACK).all(axis=2)
    size = {"width": 60, "height": 40}
    rgb = frame(data=picture.tobytes(), format=find_format("RGB8"), stride=180, **size)
    bgr = frame(data=picture[..., ::-1].tobytes(), format=find_format("BGR8"), stride=180, **size)
    grey = frame(data=picture.max(axis=2).tobytes(), format=find_format("Mono8"), stride=60, **size)
    deep = frame(
        data=(picture.max(axis=2).astype("<u2") << 2).tobytes(),
        format=find_format("Mono10"),
        stride=120,
        **size,
    )
    for one in (picture, rgb, bgr, grey, deep):
        np.testing.assert_array_equal(dark.mask(one), expected)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((4, 4), np.uint8),
        np.zeros((4, 4, 3)),
        np.zeros((0, 4, 3), np.uint8),
        frame(data=b"xy"),
    ],
)
def test_wrong_picture_is_refused(wrong: Any) -> None:
    with pytest.raises(FrameFormatError, match="expected"):
        ColourRange().mask(wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"hue": (0, 180)},
        {"hue": (-1, 5)},
        {"saturation": (200, 100)},
        {"value": (0, 256)},
        {"value": (0.0, 60.0)},
        {"value": 60},
        {"value": (1, 2, 3)},
        {"hue": (True, 5)},
    ],
)
def test_invalid_range_is_refused(wrong: dict[str, Any]) -> None:
    (name,) = wrong
    with pytest.raises(ConfigurationError, match=rf"ColourRange: {name}: expected .* got"):
        ColourRange(**wrong)


def test_range_survives_json_and_python() -> None:
    given = ColourRange(hue=(170, 10), saturation=(5, 6), value=(7, 8))
    assert ColourRange(**json.loads(given.as_json())) == given
    assert repr(given) == "ColourRange(hue=(170, 10), saturation=(5, 6), value=(7, 8))"


def test_without_opencv_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match="pip install"):
        ColourRange().mask(flat(RED))


# ---------------------------------------------------------------------- around a pixel


@pytest.mark.parametrize("colour", [RED, GREEN, BLACK, GREY, (200, 30, 20), (60, 40, 200)])
def test_range_around_a_pixel_has_its_colour_and_no_other(colour: tuple[int, int, int]) -> None:
    random = np.random.default_rng(2)
    colours = [RED, GREEN, BLACK, GREY]
    for other in colours:
        picture = flat(other).astype(float)
        picture[10:30, 20:40] = colour
        seen = np.clip(picture + random.normal(0, 3, picture.shape), 0, 255).astype(np.uint8)
        found = ColourRange.around(seen, 30, 20).mask(seen)
        assert found[10:30, 20:40].mean() > 0.97
        if math.dist(colour, other) > 100:
            found[10:30, 20:40] = False
            assert found.mean() < 0.01


def test_around_a_pixel_at_the_rim_and_outside() -> None:
    picture = flat(GREEN)
    assert ColourRange.around(picture, 0, 0).mask(picture).all()
    assert ColourRange.around(picture, 59, 39, radius=0, margin=0).mask(picture).all()
    for x, y in ((60, 0), (0, 40), (-1, 0)):
        with pytest.raises(ConfigurationError, match="expected a pixel within 60x40, got"):
            ColourRange.around(picture, x, y)
    with pytest.raises(ConfigurationError, match="radius of 0 to 1000"):
        ColourRange.around(picture, 0, 0, radius=-1)


# ---------------------------------------------------------------------- regions


@pytest.mark.parametrize("degrees", [0, 7, 30, 45, 61, 90, -30, -80])
def test_region_of_a_block_has_its_pose_and_size(degrees: float) -> None:
    centre, sides = (140.3, 161.8), (120.0, 40.0)
    (found,) = find_regions(rectangle(centre, sides, degrees))
    assert found.centre == pytest.approx(centre, abs=0.35)  # half a pixel at most
    assert found.sides == pytest.approx(sides, abs=1.5)
    assert found.area == pytest.approx(4800, rel=0.03)
    assert found.ratio == pytest.approx(3, rel=0.05)
    assert 0.93 < found.fullness < 1.03
    assert abs(math.remainder(found.orientation - math.radians(degrees), math.pi)) < 0.003
    assert -math.pi / 2 <= found.orientation <= math.pi / 2
    np.testing.assert_allclose(found.corners.mean(axis=0), centre, atol=1)
    first, second = (np.linalg.norm(found.corners[one] - found.corners[one - 1]) for one in (1, 2))
    assert sorted((first, second)) == pytest.approx(sorted(found.sides), abs=1e-3)
    np.testing.assert_array_equal(found.mask, rectangle(centre, sides, degrees))


def test_other_shapes_are_left_out() -> None:
    mask = rectangle((60, 60), (75, 25), 20)
    mask |= rectangle((200, 60), (45, 45), 10)  # as large, but a square
    mask |= rectangle((60, 150), (90, 10), 80)  # too long
    mask |= rectangle((200, 150), (30, 10), 0)  # of its shape, but small
    bent = rectangle((200, 220), (75, 25), 0) & ~rectangle((210, 215), (60, 20), 0)
    mask |= bent
    mask |= rectangle((0, 250), (75, 25), 90)  # half of it is outside
    wanted = {"area": (1200, 2600), "ratio": (2.4, 3.6), "fullness": 0.8, "whole": True}
    (found,) = find_regions(mask, **wanted)  # type: ignore[arg-type]
    assert found.centre == pytest.approx((60, 60), abs=0.3)
    assert len(find_regions(mask)) == 6
    areas = [one.area for one in find_regions(mask)]
    assert areas == sorted(areas, reverse=True)
    assert [one.area for one in find_regions(mask, max_regions=2)] == areas[:2]


def test_smallest_regions_have_sides() -> None:
    mask = np.zeros((20, 20), bool)
    mask[3, 4] = True
    mask[10, 5:9] = True
    line, dot = find_regions(mask)
    assert (line.sides, line.orientation, dot.sides) == ((4, 1), 0, (1, 1))
    assert dot.fullness == line.fullness == 1
    mask[4, 5] = True  # touches at a corner
    assert len(find_regions(mask)) == 2
    assert find_regions(np.zeros((3, 3), bool)) == []


def test_wrong_limits_and_masks_are_refused() -> None:
    mask = np.ones((4, 4), bool)
    for wrong in ({"area": (5, 2)}, {"ratio": (-1, 2)}, {"fullness": 1.5}):
        with pytest.raises(ConfigurationError, match=r"expected \(from, to\)"):
            find_regions(mask, **wrong)
    for bad in (mask.astype(np.uint8), np.ones(4, bool), np.ones((0, 3), bool)):
        with pytest.raises(FrameFormatError, match="expected a mask"):
            find_regions(bad)  # type: ignore[arg-type]
