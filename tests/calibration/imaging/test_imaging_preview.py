"""The picture of a step that looks at a target."""

from __future__ import annotations

import base64
import math
import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from smartcam.calibration.codes import Code
from smartcam.calibration.targets import Checkerboard
from smartcam.calibration.views import TargetView
from smartcam.calibration.wizards.target_drawing import MAX_SIDE, cell_counts, draw
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from numpy.typing import NDArray

GOLDEN = Path(__file__).with_name("preview.svg")
TARGET = Checkerboard(columns=4, rows=3, square=0.025)
GREY = np.full((480, 640), 128, dtype=np.uint8)
DATA = re.compile(r"(?<=base64,)[\w+/=]+")


def view(
    left: float = 100, low: float = 400, step: float = 60, size: tuple[int, int] = (640, 480)
) -> TargetView:
    """Return a view of the target upright before the camera."""
    points = [(left + step * x, low - step * y) for y in range(3) for x in range(4)]
    return TargetView(
        target=TARGET,
        size=size,
        ids=np.arange(12, dtype=np.intp),
        points=np.array(points),
        covariance=np.tile(0.01 * np.eye(2), (12, 1, 1)),
    )


def elements(picture: str, kind: str) -> list[ET.Element]:
    """Return the elements of a class."""
    found = ET.fromstring(picture).iter()  # noqa: S314
    return [one for one in found if kind in (one.get("class") or "").split()]


def legend(picture: str) -> str:
    texts: list[str] = re.findall(r"<text[^>]*>([^<]*)<", picture)
    return texts[-1]


def picture_in(picture: str) -> NDArray[Any]:
    (data,) = DATA.findall(picture)
    png = np.frombuffer(base64.b64decode(data), dtype=np.uint8)
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED))


def test_preview_is_the_one_that_was_looked_at() -> None:
    """To look at a new one: run this test with SMARTCAM_REWRITE=1 and open the file."""
    one = view()
    drawn = draw(
        GREY,
        view=one,
        earlier=[view(350, 200)],
        predicted=one.points + np.array([0.1, -0.2]),
        axes=[(100, 400), (160, 400), (100, 340), (90, 410)],
        suggested=[(400, 300), (600, 280), (620, 440), (410, 450)],
        title="View 2 <of 10>",
    )
    shown = DATA.sub("", drawn)  # a PNG depends on the version of zlib
    if os.environ.get("SMARTCAM_REWRITE"):
        GOLDEN.write_text(shown, encoding="utf-8", newline="\n")
    assert shown == GOLDEN.read_text(encoding="utf-8")


def test_preview_has_the_camera_s_picture_under_it() -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    image[100:200, 300:400] = (255, 255, 255)
    assert np.array_equal(picture_in(draw(image)), image[:, :, 0])


@pytest.mark.parametrize("size", [(2000, 3000), (3000, 20), (700, 16)])
def test_preview_of_a_large_image_is_bounded(size: tuple[int, int]) -> None:
    random = np.random.default_rng(1)
    drawn = draw(random.integers(0, 255, size, dtype=np.uint8))
    assert max(picture_in(drawn).shape) == MAX_SIDE
    assert len(drawn) < 1.5 * MAX_SIDE**2 + 5000


def test_preview_draws_points_where_the_picture_has_them() -> None:
    points = elements(draw(GREY, view=view()), "point")
    zoom = 900 / 640
    assert len(points) == 12
    assert points[0].get("class") == "point origin"
    # the picture begins half a pixel before the middle of its first pixel
    assert points[0].get("cx") == f"{20 + 100.5 * zoom:.2f}"
    assert points[0].get("cy") == f"{40 + 400.5 * zoom:.2f}"


def test_preview_without_the_origin_fills_no_point() -> None:
    part = view()
    hidden = TargetView(
        target=TARGET,
        size=part.size,
        ids=part.ids[1:],
        points=part.points[1:],
        covariance=part.covariance[1:],
    )
    drawn = draw(GREY, view=hidden)
    assert elements(drawn, "origin") == []
    assert legend(drawn).startswith("11 of 12 points; ")


def test_preview_residuals_are_as_much_larger_as_it_says() -> None:
    one = view()
    drawn = draw(GREY, view=one, predicted=one.points + np.array([0.3, 0.4]))
    (line, *rest) = elements(drawn, "residual")
    x1, y1, x2, y2 = (float(line.get(name, "")) for name in ("x1", "y1", "x2", "y2"))
    assert len(rest) == 11
    assert math.dist((x1, y1), (x2, y2)) == pytest.approx(50 * 0.5 * 900 / 640, abs=0.02)
    assert legend(drawn).endswith("residuals (red) 50 times larger than they are, 0.500 px rms")


def test_preview_of_a_perfect_fit_enlarges_nothing() -> None:
    one = view()
    assert "(red) 1 times larger than they are, 0.000 px rms" in legend(
        draw(GREY, view=one, predicted=one.points)
    )


def test_preview_counts_the_cells_of_all_views() -> None:
    drawn = draw(GREY, view=view(0, 479, 10), earlier=[view(0, 479, 10), view(600, 50, 10)])
    assert len(elements(drawn, "covered")) == 2
    assert legend(drawn) == "12 of 12 points; 2 of 48 cells seen by 3 views"


def test_preview_without_a_view_says_that_nothing_was_found() -> None:
    drawn = draw(GREY, earlier=[view()])
    assert elements(drawn, "point") == []
    assert legend(drawn).startswith("no target found; ")
    assert legend(drawn).endswith(" of 48 cells seen by 1 view")


def test_preview_names_the_axes_at_their_ends() -> None:
    drawn = draw(GREY, axes=[(100, 400), (160, 400), (100, 340), (90, 410)])
    assert [one.text for one in elements(drawn, "name")] == ["x", "y", "z"]
    (x,) = elements(drawn, "x")
    assert x.get("x2") == f"{20 + 160.5 * 900 / 640:.2f}"


def test_cell_counts_counts_points_in_cells_of_the_image() -> None:
    counts = cell_counts([view(-0.5, 479, 80)])  # one in each of four columns, in three rows
    assert counts.shape == (6, 8)
    assert counts[3:, :4].tolist() == [[1] * 4] * 3
    assert counts.sum() == 12


def test_cell_counts_leaves_out_what_is_outside_of_the_image() -> None:
    assert cell_counts([view(-5000)]).sum() == 0
    assert cell_counts([]).sum() == 0


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"view": view(size=(320, 240))}, "a view of an image of 640 x 480 pixels, got one of 320"),
        ({"view": view(), "predicted": [(1, 2)]}, "preview: expected 12 points, got 1"),
        ({"axes": [(1, 2)] * 3}, "preview: expected 4 points, got 3"),
        ({"suggested": [1, 2, 3]}, "suggested outline"),
    ],
)
def test_preview_of_what_does_not_belong_together_is_refused(
    options: dict[str, Any], text: str
) -> None:
    with pytest.raises(CalibrationError, match=text) as caught:
        draw(GREY, **options)
    assert caught.value.code == Code.SHAPE


def test_preview_of_no_image_is_refused() -> None:
    with pytest.raises(CalibrationError, match="image: expected an array of uint8 or uint16"):
        draw(np.zeros((4, 4)))
