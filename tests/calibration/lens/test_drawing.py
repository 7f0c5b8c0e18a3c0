"""Pictures of calibrations from images have the right contents without overlaps."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from typing import TYPE_CHECKING, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest

from smartcam.calibration import (
    HandEyeCalibration,
    IntrinsicCalibration,
    StereoCalibration,
    compare_lenses,
    draw_scene,
    draw_uncertainty,
    draw_views,
)
from smartcam.calibration._drawing.bars import short_names
from smartcam.calibration._stereo.calibration import PairFit
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from tests.calibration import lenskit
from tests.calibration.lens.estimates import Bench, spread_poses
from tests.calibration.scenes import SHEET, scene

if TYPE_CHECKING:
    from tests.calibration.inside import Setup

BENCH = Bench(lenskit.LEFT, spread_poses(lenskit.LEFT, 12))
LENS = BENCH.calibration()
SVG = "{http://www.w3.org/2000/svg}"


def with_bad_view() -> IntrinsicCalibration:
    fits = list(LENS.views)
    fits[4] = dataclasses.replace(fits[4], used=False, rms=20.0, held_out=25.0)
    return dataclasses.replace(LENS, views=tuple(fits))


def many(count: int) -> IntrinsicCalibration:
    fits = [
        dataclasses.replace(
            LENS.views[number % 12],
            view=dataclasses.replace(LENS.views[number % 12].view, name=f"image {number}.png"),
            transform=pose,
        )
        for number, pose in enumerate(lenskit.poses(count))
    ]
    return dataclasses.replace(LENS, views=tuple(fits))


def pair(count: int = 6) -> StereoCalibration:
    lefts, rights = lenskit.pairs(count)
    fits = [
        PairFit(
            left=left,
            right=None if number == 2 else right,
            used=(True, number != 2),
            transform=pose,
            rms=(0.05, math.nan if number == 2 else 0.06),
            held_out=math.nan if number == 2 else 1e-4,
            epipolar=math.nan if number == 2 else 0.05,
        )
        for number, (left, right, pose) in enumerate(
            zip(lefts, rights, lenskit.poses(count, name="left"), strict=True)
        )
    ]
    return StereoCalibration(
        left=lenskit.LEFT,
        right=lenskit.RIGHT,
        transform=lenskit.RIG,
        covariance=np.eye(6),
        pairs=tuple(fits),
        rms=0.05,
        sigma=0.0,
        epipolar=0.05,
        held_out=1e-4,
        held_out_epipolar=0.05,
        sheet=None,
        warnings=(),
    )


def hand(setup: Setup, *, count: int = 8, views: bool = True) -> HandEyeCalibration:
    truth = scene(setup, poses=count, seed=7)
    seen = [truth.target_in_camera(pose) for pose in truth.robot_poses]
    return HandEyeCalibration(
        setup=setup,
        camera_pose=truth.camera_pose,
        target_pose=truth.target_pose,
        camera=truth.camera if views else None,
        target_scale=1.0,
        method="closed form",
        candidate_errors={"closed form": 1e-4},
        errors=np.linspace(1e-4, 2e-4, count),
        mean_error=1.5e-4,
        leave_one_out=np.linspace(2e-4, 3e-4, count),
        held_out_error=2.5e-4 if views else None,
        covariance=np.eye(12),
        robot_sigmas=None,
        robot_poses=tuple(truth.robot_poses),
        used=tuple(number != 3 for number in range(count)),
        views=tuple(lenskit.seen(truth.camera, seen, target=SHEET)) if views else (),
        target_poses=tuple(seen),
    )


PICTURES = {
    "views": lambda: draw_views(LENS, title="A <lens> & its views"),
    "views, one bad": lambda: draw_views(with_bad_view()),
    "views, many": lambda: draw_views(many(70)),
    "scene": lambda: draw_scene(LENS, title="Scene"),
    "scene, one bad": lambda: draw_scene(with_bad_view()),
    "scene, many": lambda: draw_scene(many(40)),
    "map": lambda: draw_uncertainty(LENS, distance=0.5, title="Map"),
    "map, of a map": lambda: draw_uncertainty(LENS.uncertainty(shape=(4, 6))),
    "comparison": lambda: draw_uncertainty(
        compare_lenses(BENCH.calibration(1), BENCH.calibration(2))
    ),
    "pair": lambda: draw_scene(pair()),
    "pair's views": lambda: draw_views(pair()),
    "eye in hand": lambda: draw_scene(hand("eye-in-hand")),
    "eye to hand": lambda: draw_scene(hand("eye-to-hand")),
    "of poses": lambda: draw_scene(hand("eye-to-hand", views=False)),
    "robot's views": lambda: draw_views(hand("eye-in-hand")),
    "robot's poses": lambda: draw_views(hand("eye-in-hand", views=False)),
}


def parsed(svg: str) -> ElementTree.Element:
    return ElementTree.fromstring(svg)  # noqa: S314 - our own


class Written(NamedTuple):
    said: str
    left: float
    top: float
    right: float
    bottom: float


def written(svg: str) -> list[Written]:
    """Return the texts of a picture and their approximate boxes."""
    found = []
    for one in parsed(svg).iter(f"{SVG}text"):
        kind = one.get("class", "")
        letter = {"title": 8.0, "small": 5.5}.get(kind, 6.5)
        said, x, y = one.text or "", float(one.get("x", "0")), float(one.get("y", "0"))
        wide = letter * len(said)
        x -= {"middle": wide / 2, "end": wide}.get(one.get("text-anchor", ""), 0.0)
        found.append(Written(said, x, y - 1.4 * letter, x + wide, y + 2))
    return found


@pytest.mark.parametrize("name", PICTURES)
def test_texts_of_a_picture_are_in_it_and_none_on_another(name: str) -> None:
    svg = PICTURES[name]()
    width, height = map(float, re.findall(r'(?:width|height)="(\d+)"', svg)[:2])
    texts = written(svg)
    assert len(texts) > 4
    for one in texts:
        assert 0 <= one.left < one.right <= width, one
        assert 0 <= one.top < one.bottom <= height, one
    for one, other in itertools.combinations(texts, 2):
        apart = (
            one.right <= other.left
            or other.right <= one.left
            or one.bottom <= other.top
            or other.bottom <= one.top
        )
        assert apart, (one, other)


@pytest.mark.parametrize("name", PICTURES)
def test_picture_has_no_number_that_is_none_and_no_part_elsewhere(name: str) -> None:
    svg = PICTURES[name]()
    parsed(svg)
    places = re.findall(r'(?:x|y|x1|x2|y1|y2|points|width|height)="([^"]*)"', svg)
    assert "nan" not in " ".join(places)
    assert "href" not in svg
    assert "prefers-color-scheme: dark" in svg
    assert svg == PICTURES[name]()
    assert svg.endswith("</svg>\n")


def rectangles(svg: str, kind: str) -> list[float]:
    """Return the heights of the bars of a class that have a title."""
    found = parsed(svg).iter(f"{SVG}rect")
    return [
        float(one.get("height", "0"))
        for one in found
        if one.get("class") == kind and one.find(f"{SVG}title") is not None
    ]


def test_bars_are_as_high_as_the_errors() -> None:
    fits = [
        dataclasses.replace(one, rms=0.01 * (1 + number), held_out=0.02 * (1 + number))
        for number, one in enumerate(LENS.views)
    ]
    svg = draw_views(dataclasses.replace(LENS, views=tuple(fits)))
    first, second = rectangles(svg, "first"), rectangles(svg, "second")
    assert np.array(first) / first[0] == pytest.approx(np.arange(1, 13), rel=1e-2)
    assert np.array(second) / first == pytest.approx(np.full(12, 2.0), rel=1e-2)


def test_bar_of_a_bad_view_is_cut_and_has_its_value() -> None:
    svg = draw_views(with_bad_view())
    assert len(rectangles(svg, "off")) == 2
    assert max(rectangles(svg, "first")) > 0.25 * max(rectangles(svg, "off"))
    assert "20" in [one.said for one in written(svg)]
    assert "04, left out: residuals 20 px" in svg


def test_scene_has_a_board_for_each_view_and_both_cameras() -> None:
    svg = draw_scene(pair())
    assert svg.count('class="board"') == 6
    assert {"left", "right", *(f"{n:02d}" for n in range(6))} <= {one.said for one in written(svg)}
    assert draw_scene(with_bad_view()).count('class="board-off"') == 1


@pytest.mark.parametrize(
    ("setup", "boards", "cameras"), [("eye-in-hand", 1, 8), ("eye-to-hand", 7, 1)]
)
def test_scene_of_a_robot_has_its_poses(setup: Setup, boards: int, cameras: int) -> None:
    svg = draw_scene(hand(setup))
    assert svg.count('class="board"') == boards
    assert svg.count("<polygon points") - svg.count('class="board') == cameras
    assert {"base", "x", "y", "z"} <= {one.said for one in written(svg)}


def test_map_has_its_figures_and_marks_places_without_a_value() -> None:
    found = LENS.uncertainty(distance=0.5)
    svg = draw_uncertainty(found)
    assert f"centre {found.figures.centre:.2g}, corners {found.figures.corners:.2g}" in svg
    covariance = found.covariance.copy()
    covariance[0, 0] = np.nan
    svg = draw_uncertainty(dataclasses.replace(found, covariance=covariance))
    assert "beyond the lens model" in svg
    assert "the lens model does not reach 0.1% of the image" in svg


def test_map_of_a_calibration_shows_the_points_that_were_seen() -> None:
    (dots,) = re.findall(r'<path d="([^"]*)" class="seen"/>', draw_uncertainty(LENS, distance=0.5))
    assert dots.count("M") == sum(len(one.view.ids) for one in LENS.views)


def test_map_of_a_lens_that_is_exact_is_drawn() -> None:
    exact = dataclasses.replace(LENS, covariance=np.zeros((9, 9)))
    assert "centre 0, corners 0" in draw_uncertainty(exact)


@pytest.mark.parametrize("draw", [draw_views, draw_scene, draw_uncertainty])
def test_objects_that_cannot_be_drawn_are_refused(draw: object) -> None:
    with pytest.raises(
        CalibrationError, match=r"expected a calibration .*, got CameraModel"
    ) as one:
        draw(lenskit.LEFT)  # type: ignore[operator]
    assert one.value.code == Code.WRONG_KIND


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (["view 1", "view 10", "view 11"], ["1", "10", "11"]),
        (["left01.png", "left02.png", "left12.png"], ["01", "02", "12"]),
        (["a", "b"], ["a", "b"]),
        (["same", "same"], ["same", "same"]),
        (["only"], ["only"]),
        ([], []),
        (["x", "x1"], ["x", "1"]),
    ],
)
def test_names_are_shortened_to_their_different_parts(names: list[str], short: list[str]) -> None:
    assert short_names(names) == short
