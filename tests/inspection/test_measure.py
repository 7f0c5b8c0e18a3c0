"""The tool `measure` in programs: values and sigmas, verdicts, frames of reference, millimetres."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import smartcam.inspection
from smartcam.calibration import CameraModel, calibrate_sheet, fit_plane
from smartcam.exceptions import ConfigurationError
from smartcam.frames import Frame, Moment, find_format
from smartcam.inspection import Inspection, Picture
from tests.calibration.sheetkit import CAMERA, SEEN, SIGMA, TARGET, truth
from tests.calibration.test_sheet import seen, touched
from tests.inspection.inside import (
    PIXELS,
    CurveEdges,
    Edge,
    Edges,
    FoundPoint,
    NotMeasuredError,
    NoValueReason,
    Plane,
    Value,
    distance,
    fit_line_in_plane,
    measure_with_calibration,
    measuring_plane,
    point_in_plane,
    strip_between,
    width,
)
from tests.inspection.measurekit import HOLE, RADIUS, WIDE, plate, program

ACROSS = "{across: [[40, 170], [170, 170]]}"
WIDTH = f"{{width: {ACROSS}, tolerance: 92.40 +- 0.10 px}}"
LEFT = "{line: {along: [[73, 70], [57, 180]], search: 24}}"
RIGHT = "{line: {along: [[164, 80], [149, 190]], search: 24}}"
CIRCLE = "{circle: {centre: [118, 124], radius: 21}}"


def inspected(folder: Path, measure: str, picture: Any = None, before: str = "") -> Inspection:
    return program(folder, measure, before).inspect(plate() if picture is None else picture)


def test_width_is_measured_square_to_its_edges(tmp_path: Path) -> None:
    found = inspected(tmp_path, WIDTH)
    assert found.ok, found.reason
    assert abs(found.values["width"] - WIDE) < 4 * found.values["sigma"] < 0.2
    assert found.layout.text == "ok: bool, reason: string[80], width: real32 px, sigma: real32 px"
    assert found.value.width == pytest.approx(WIDE, abs=0.1)


def test_width_in_16_bits_is_the_same(tmp_path: Path) -> None:
    found = inspected(tmp_path, WIDTH, plate(bits=16))
    assert abs(found.values["width"] - WIDE) < 4 * found.values["sigma"] < 0.2
    tens = Picture(plate(bits=10), depth=10)
    found = inspected(tmp_path, WIDTH, tens)
    assert abs(found.values["width"] - WIDE) < 4 * found.values["sigma"] < 0.2


def test_width_outside_of_its_tolerance_has_a_reason(tmp_path: Path) -> None:
    found = inspected(tmp_path, f"{{width: {ACROSS}, tolerance: 92.00 +- 0.10 px}}")
    assert not found.ok
    assert "px is above 92.10" in found.reason
    assert found.values["width"] == pytest.approx(WIDE, abs=0.1)


def test_width_near_its_limit_is_good_only_without_a_guard(tmp_path: Path) -> None:
    limit = "at most 92.42 px"
    guarded = inspected(tmp_path, f"{{width: {ACROSS}, tolerance: {limit}, guard: 5}}")
    assert not guarded.ok
    assert "too near to the limit" in guarded.reason


def test_circle_gives_its_diameter_and_centre(tmp_path: Path) -> None:
    found = inspected(tmp_path, CIRCLE)
    assert found.ok, found.reason
    turn = math.radians(8)
    ahead = np.array([math.cos(turn), math.sin(turn)])
    x, y = np.array([110.2, 118.7]) + HOLE[0] * ahead + HOLE[1] * ahead[::-1] * [-1, 1]
    assert abs(found.values["diameter"] - 2 * RADIUS) < 4 * found.values["sigma"] < 0.1
    assert found.values["x"] == pytest.approx(x, abs=0.02)
    assert found.values["y"] == pytest.approx(y, abs=0.02)
    assert (found.values["edges"], found.values["left_out"]) == (24, 0)


def test_scratch_across_a_circle_is_an_outlier(tmp_path: Path) -> None:
    picture = plate()
    picture[97:107, 110:124] = 30  # over the hole's rim, at the top
    found = inspected(tmp_path, CIRCLE, picture)
    assert found.ok, found.reason
    assert found.values["left_out"] + len(found.findings["measure"].details.missed) >= 2
    assert abs(found.values["diameter"] - 2 * RADIUS) < 5 * found.values["sigma"]
    left_out = found.findings["measure"].details.left_out
    assert (left_out[:, 1] < 110).all()


def test_line_gives_its_direction_from_the_frame_of_reference(tmp_path: Path) -> None:
    found = inspected(tmp_path, LEFT)
    assert found.ok, found.reason
    assert abs(found.values["angle"] - math.radians(98)) < 4 * found.values["sigma"] < 0.01


def test_distance_and_angle_of_lines(tmp_path: Path) -> None:
    far = inspected(tmp_path, f"{{distance: {{first: {LEFT}, second: {RIGHT}}}}}")
    assert far.ok, far.reason
    assert abs(far.values["distance"] - WIDE) < 4 * far.values["sigma"] < 0.05
    between = inspected(tmp_path, f"{{angle: {{first: {LEFT}, second: {RIGHT}}}}}")
    assert between.values["angle"] < 4 * between.values["sigma"] < 0.01


def test_distance_of_a_circle_from_a_line_and_from_an_edge(tmp_path: Path) -> None:
    found = inspected(tmp_path, f"{{distance: {{first: {CIRCLE}, second: {LEFT}}}}}")
    assert abs(found.values["distance"] - (WIDE / 2 + HOLE[0])) < 4 * found.values["sigma"] < 0.05
    edge = "{edge: {across: [[44, 119], [80, 119]]}}"
    found = inspected(tmp_path, f"{{distance: {{first: {edge}, second: {CIRCLE}}}}}")
    assert found.ok, found.reason
    assert found.values["distance"] == pytest.approx(WIDE / 2 + HOLE[0], abs=1.0)


def test_lines_that_are_not_parallel_have_no_distance(tmp_path: Path) -> None:
    top = "{line: {along: [[100, 103], [136, 103]], search: 16}}"  # the rim of the hole
    found = inspected(tmp_path, f"{{distance: {{first: {LEFT}, second: {top}}}}}")
    assert not found.ok
    assert math.isnan(found.value.distance)


def test_place_of_an_edge_counts_from_the_start_of_its_strip(tmp_path: Path) -> None:
    found = inspected(tmp_path, "{edge: {across: [[44, 119], [80, 119]]}, tolerance: 15 to 25 px}")
    assert found.ok, found.reason
    assert found.values["x"] == pytest.approx(44 + found.values["place"], abs=1e-9)


PLATE = "present: {grey: [90, 255], area: [4000, 60000]}, "


def test_measurement_follows_an_earlier_tool(tmp_path: Path) -> None:
    width_of_plate = "{follow: present, width: {across: [[45, -66], [45, 66]], strip: 8}}"
    one = program(tmp_path, width_of_plate, PLATE)
    for middle, degrees in (((110.2, 118.7), 4.0), ((104.6, 112.1), -9.0)):
        found = one.inspect(plate(middle, math.radians(degrees)))
        assert found.findings["measure"].ok, found.reason
        assert found.values["measure_width"] == pytest.approx(WIDE, abs=0.15)


def test_measurement_needs_the_finding_it_follows(tmp_path: Path) -> None:
    dark = np.full((240, 220), 20, dtype=np.uint8)
    found = program(tmp_path, f"{{follow: present, width: {ACROSS}}}", PLATE).inspect(dark)
    assert not found.findings["measure"].ok
    assert math.isnan(found.values["measure_width"])


@pytest.mark.parametrize(
    ("measure", "why", "said"),
    [
        (f"{{width: {ACROSS}}}", NoValueReason.NO_EDGE, "no edge"),
        ("{width: {across: [[44, 170], [400, 170]]}}", NoValueReason.OUTSIDE, "outside"),
        ("{line: {along: [[73, 70], [57, 180]]}}", NoValueReason.NO_EDGE, "no edge"),
        (CIRCLE, NoValueReason.NO_EDGE, "no edge"),
    ],
)
def test_empty_picture_has_a_reason(
    tmp_path: Path, measure: str, why: NoValueReason, said: str
) -> None:
    flat = np.full((240, 220), 90, dtype=np.uint8)
    found = inspected(tmp_path, measure, flat)
    assert not found.ok
    assert found.reason.startswith(said)
    assert found.findings["measure"].details.trouble is why
    assert math.isnan(found.findings["measure"].details.value)


def test_two_edges_instead_of_one_have_a_reason(tmp_path: Path) -> None:
    found = inspected(tmp_path, f"{{edge: {ACROSS}}}")
    assert found.findings["measure"].details.trouble is NoValueReason.SEVERAL_EDGES
    assert math.isnan(found.value.place)


def test_saturated_picture_has_a_reason(tmp_path: Path) -> None:
    bright = np.minimum(plate().astype(int) * 2, 255).astype(np.uint8)
    found = inspected(tmp_path, WIDTH, bright)
    assert found.findings["measure"].details.trouble is NoValueReason.SATURATED


def test_colour_picture_is_measured_by_its_brightness(tmp_path: Path) -> None:
    colour = np.repeat(plate()[:, :, None], 3, axis=2)
    found = inspected(tmp_path, WIDTH, colour)
    assert found.values["width"] == pytest.approx(WIDE, abs=0.1)


def test_saturated_colour_has_a_reason_unless_allowed(tmp_path: Path) -> None:
    colour = np.repeat(plate()[:, :, None], 3, axis=2)
    colour[:, :, 0] = np.minimum(colour[:, :, 0].astype(int) * 2, 255)
    found = inspected(tmp_path, WIDTH, colour)
    assert found.findings["measure"].details.trouble is NoValueReason.SATURATED
    allowed = f"{{width: {ACROSS[:-1]}, allow_saturated: true}}}}"
    found = inspected(tmp_path, allowed, colour)
    assert found.findings["measure"].details.trouble is None


def limited(least: float, most: float, bits: int = 8, noise: float = 0.3) -> Any:
    """Return a plate with very little noise, in video range.

    ``least``, ``most``: levels of 8 bits of the dark and the bright side, before they are cut off.
    """
    step = 2 ** (bits - 8)
    levels = least + (most - least) * (
        plate(noise=0.0, bits=16).astype(float) / 65535 - 45 / 255
    ) / (150 / 255)
    levels += np.random.default_rng(3).normal(0, noise, levels.shape)
    kind = np.uint8 if bits == 8 else np.uint16
    return np.rint(step * levels.clip(16, 235)).astype(kind)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    ("least", "most", "end"),
    [(-10, 200, "black"), (60, 260, "white"), (14, 180, "black"), (60, 200, ""), (17.5, 233, "")],
)
def test_levels_saturated_by_video_range_have_a_reason(
    tmp_path: Path, least: float, most: float, end: str, bits: int
) -> None:
    found = inspected(tmp_path, WIDTH, limited(least, most, bits))
    details = found.findings["measure"].details
    if end:
        assert details.trouble is NoValueReason.SATURATED
        assert f"{end} to the limit" in found.reason
    else:
        assert abs(details.value - WIDE) < 4 * details.sigma


def test_one_saturated_colour_has_a_reason_in_every_kind_of_frame(tmp_path: Path) -> None:
    red = np.minimum(1.6 * limited(20, 200), 255)
    colours = np.stack([red, limited(20, 120), limited(20, 90)], axis=2).round().astype(np.uint8)
    y, u, v = (
        (colours.astype(float) @ one + offset).clip(0, 255).round()
        for one, offset in (
            ([0.299, 0.587, 0.114], 0.0),
            ([-0.168736, -0.331264, 0.5], 128.0),
            ([0.5, -0.418688, -0.081312], 128.0),
        )
    )
    height, width = red.shape
    pairs = np.stack([y[:, ::2], u[:, ::2], y[:, 1::2], v[:, ::2]], axis=2)
    bayer = colours[:, :, 1].copy()
    bayer[::2, ::2], bayer[1::2, 1::2] = colours[::2, ::2, 0], colours[1::2, 1::2, 2]
    tool = program(tmp_path, WIDTH)
    for name, wire, a_pixel in (
        ("RGB8", colours, 3),
        ("YCbCr422_8", pairs.astype(np.uint8), 2),
        ("BayerRG8", bayer, 1),
    ):
        frame = Frame(
            data=wire.tobytes(),
            format=find_format(name),
            width=width,
            height=height,
            stride=a_pixel * width,
            captured=0.0,
            utc=0.0,
            moment=Moment.ARRIVAL,
            sequence=1,
            source="cam",
        )
        found = tool.inspect(frame)
        assert found.findings["measure"].details.trouble is NoValueReason.SATURATED, name


def test_colour_clipped_at_zero_has_a_reason(tmp_path: Path) -> None:
    colours = np.stack([limited(20, 200), limited(20, 90), limited(20, 60)], axis=2)
    assert inspected(tmp_path, WIDTH, colours).findings["measure"].details.trouble is None
    colours[:, :, 2] = np.where(colours[:, :, 0] > 180, 0, colours[:, :, 2])
    found = inspected(tmp_path, WIDTH, colours)
    assert found.findings["measure"].details.trouble is NoValueReason.SATURATED


def test_picture_of_another_size_is_not_measured(tmp_path: Path) -> None:
    found = inspected(tmp_path, WIDTH, plate()[:100, :100])
    assert found.findings["measure"].details.trouble is NoValueReason.OUTSIDE


def test_drawings_show_edges_regions_and_the_value(tmp_path: Path) -> None:
    found = inspected(tmp_path, WIDTH)
    marks = found.findings["measure"].drawings
    assert {one.kind for one in marks} == {"polygon", "points", "text"}
    assert any(one.text.startswith("92.") for one in marks)
    assert found.drawn().shape == (240, 220, 3)


@pytest.mark.parametrize(
    ("measure", "said"),
    [
        ("{}", "expected one of width, edge, line, circle, distance, angle, got none"),
        (f"{{width: {ACROSS}, edge: {ACROSS}}}", "got width and edge"),
        (f"{{width: {ACROSS}, region: [0, 0, 9, 9]}}", "expected no region"),
        (f"{{width: {ACROSS}, tolerance: wide}}", "expected a tolerance such as"),
        (f"{{width: {ACROSS}, tolerance: 5 +- 1 deg}}", "expected a unit of length"),
        ("{line: {along: [[0, 0], [9, 9]]}, tolerance: 5 +- 1 px}", "expected deg"),
        ("{line: {along: [[0, 0], [9, 9]]}, tolerance: at most 5 deg}", "expected both limits"),
        (f"{{width: {ACROSS}, tolerance: 9 +- 1 mm}}", "does not give the size of a pixel"),
        (f"{{width: {ACROSS}, unit: mm, tolerance: 9 +- 1 px}}", "expected mm"),
        ("{width: {across: [[1, 1], [1, 1]]}}", "a pixel or more apart"),
        ("{width: {across: [[1, 1], [.nan, 1]]}}", "across"),
        ("{circle: {centre: [9, 9], radius: 5, search: 20}}", "cross the centre"),
        ("{circle: {centre: [99, 99], radius: 50, arc: [90, 0]}}", "expected an arc"),
        (f"{{distance: {{first: {LEFT}, second: {{}}}}}}", "expected one of edge, line and circle"),
        (f"{{width: {ACROSS}, tolerence: 9 +- 1 px}}", "tolerance"),
        ("{width: {across: [[1, 1], [9, 1]], which: nearest}}", "outermost"),
    ],
)
def test_wrong_settings_are_refused(tmp_path: Path, measure: str, said: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        program(tmp_path, measure)
    assert said in str(caught.value)
    assert "cell.yaml, line" in str(caught.value)


# ------------------------------------------------------------------------- in millimetres


def tilted(pixels: Any) -> Any:
    """Return the robot's points (N, 3), metres, of pixels of a tilted camera without distortion."""
    at = np.column_stack([pixels, np.ones(len(pixels))])
    matrix = np.array([[1e-4, 8e-6, 0.2], [6e-6, -1.05e-4, 0.4], [1e-5, 2e-5, 1.0]])
    mapped = at @ matrix.T
    return np.column_stack([mapped[:, :2] / mapped[:, 2:], np.full(len(at), 0.1)])


GRID = np.array([[u, v] for u in (20.0, 110.0, 200.0) for v in (20.0, 120.0, 220.0)])
ENDS = np.array([[64.0, 118.0], [155.0, 124.0]])


def plane(seed: int, sigma: float = 2e-4) -> Any:
    touches = tilted(GRID) + np.random.default_rng(seed).normal(0, sigma, (len(GRID), 3))
    return fit_plane(GRID, touches, model="homography", touch_sigma=sigma)


def exact_pair() -> tuple[FoundPoint, FoundPoint]:
    """Return two edges with exact places."""
    strip = strip_between(ENDS[0], ENDS[1], 9.0)
    nothing = 1e-12 * np.eye(2)
    return tuple(  # type: ignore[return-value]
        FoundPoint(strip, Edge(side * strip.length / 2, nothing, 0, 1e-6, 100.0, 0.8, 0.0, 0.0))
        for side in (-1, 1)
    )


@pytest.mark.long
def test_sigma_of_a_width_in_millimetres_has_the_calibrations_own_error() -> None:
    true = width(*exact_pair(), measuring_plane(plane(0, 1e-9)))
    errors, sigmas = [], []
    for seed in range(40):
        found = measure_with_calibration(
            lambda one: width(*exact_pair(), one), measuring_plane(plane(seed))
        )
        errors.append(found.value - true.value)
        sigmas.append(found.sigma)
    predicted = float(np.sqrt(np.mean(np.square(sigmas)) / np.mean(np.square(errors))))
    assert 0.78 < predicted < 1.3  # chance does 11 %
    ends = tilted(ENDS)
    assert true.value == pytest.approx(1e3 * float(np.linalg.norm(ends[1] - ends[0])), rel=1e-2)


def test_calibration_without_a_known_error_is_remarked() -> None:
    found = fit_plane(GRID[[0, 2, 6]], tilted(GRID)[[0, 2, 6]], model="affine")
    assert found.touch_sigma is None
    assert measuring_plane(found).remark == "sigma does not include the touches' error: unknown"


def test_line_that_a_lens_bends_is_straight_in_the_calibrated_plane() -> None:
    calibration = calibrate_sheet(seen(), touched(), camera=CAMERA)
    start, end = TARGET.points[[0, 8]]
    points = np.linspace(start, end, 25)
    pixels = CAMERA.project(points @ SEEN.rotation.T + SEEN.translation)
    way = np.gradient(pixels, axis=0)
    normals = way[:, ::-1] * [-1.0, 1.0] / np.linalg.norm(way, axis=1)[:, None]
    found = CurveEdges(Edges(pixels, normals, np.full(25, 0.01)), (), 0.8, 0.0)
    in_plane = fit_line_in_plane(found, pixels[[0, -1]], measuring_plane(calibration))
    in_picture = fit_line_in_plane(found, pixels[[0, -1]], PIXELS)
    assert in_plane.inliers.all()
    assert np.abs(in_plane.residuals).max() < 1e-6  # millimetres
    assert in_picture.excess > 3.0 or not in_picture.inliers.all()


def test_lengths_on_a_sheet_match_the_paper() -> None:
    calibration = calibrate_sheet(seen(sigma=0.05), touched(SIGMA), camera=CAMERA)
    flat = measuring_plane(calibration)
    pixels = CAMERA.project(TARGET.points[[0, 8]] @ SEEN.rotation.T + SEEN.translation)
    found = ends_on_sheet(pixels, flat)
    assert abs(found.value - 200.0) < 4 * found.sigma < 2.0


def ends_on_sheet(pixels: Any, plane: Plane) -> Value:
    """Return the distance of two exact pixels in a plane."""
    strip = strip_between(pixels[0], pixels[1], 9.0)
    nothing = 1e-12 * np.eye(2)
    ends = [
        FoundPoint(strip, Edge(s * strip.length / 2, nothing, 0, 1e-6, 99.0, 0.8, 0.0, 0.0))
        for s in (-1, 1)
    ]
    return measure_with_calibration(
        lambda one: distance(*(point_in_plane(end, one) for end in ends)), plane
    )


def wrong_lens(off: Any) -> CameraModel:
    """Return the camera with errors (9,) of fx, fy, cx, cy and coefficients."""
    shift = np.array([[off[0], 0.0, off[2]], [0.0, off[1], off[3]], [0.0, 0.0, 0.0]])
    return replace(CAMERA, matrix=CAMERA.matrix + shift, distortion=CAMERA.distortion + off[4:])


FAR, ACROSS_ALL = [[100.0, 100.0], [700.0, 500.0]], [[60.0, 300.0], [740.0, 300.0]]
"""Pixels of two points on the sheet."""


@pytest.mark.parametrize(
    ("pixels", "number", "least", "most"),
    [
        (FAR, 6, 0.4, 2.5),
        *(
            pytest.param(one, 100, 0.8, 1.25, marks=[pytest.mark.long, pytest.mark.widest])
            for one in (FAR, ACROSS_ALL)
        ),
    ],
)
def test_sigma_on_a_sheet_has_the_lens_error_in_it(
    pixels: Any, number: int, least: float, most: float
) -> None:
    """Compare sigmas with the scatter of lenses drawn from the covariance, within 7 % of chance."""
    spread = np.array([1.5, 1.5, 1.0, 1.0, 3e-3, 5e-3, 1e-4, 1e-4, 0.0])
    mixed = np.eye(9)
    mixed[0, 1] = mixed[1, 0] = 0.9  # of the focal lengths
    mixed[4, 5] = mixed[5, 4] = -0.8  # of k1 and k2
    covariance = mixed * np.outer(spread, spread)
    at = np.array(pixels)
    true = 1e3 * float(np.linalg.norm(np.diff(truth(at), axis=0)))
    errors, sigmas, without = [], [], []
    for seed in range(number):
        off = np.random.default_rng([seed, 7]).multivariate_normal(np.zeros(9), covariance)
        calibration = calibrate_sheet(
            seen(sigma=0.05, seed=seed),
            replace(touched(1e-5, seed), touch_sigma=1e-5),
            camera=wrong_lens(off),
            lens_covariance=covariance,
        )
        found = ends_on_sheet(at, measuring_plane(calibration))
        errors.append(found.value - true)
        sigmas.append(found.sigma)
        unknown = replace(calibration, lens_covariance=None)
        if not seed:
            without.append(ends_on_sheet(at, measuring_plane(unknown)).sigma)
            assert "the lens' error" in measuring_plane(unknown).remark
    observed = float(np.sqrt(np.mean(np.square(errors))))
    assert least < float(np.sqrt(np.mean(np.square(sigmas)))) / observed < most
    assert without[0] < 0.5 * observed


def test_place_beyond_the_calibrated_plane_has_a_reason() -> None:
    calibration = calibrate_sheet(seen(), touched(), camera=CAMERA)
    with pytest.raises(NotMeasuredError) as caught:
        measuring_plane(calibration).map_points(np.array([[-50.0, 10.0]]))
    assert caught.value.reason is NoValueReason.OFF_CALIBRATION


def test_program_measures_in_millimetres_with_its_calibration(tmp_path: Path) -> None:
    calibration = plane(3)
    calibration.save(tmp_path / "table.json")
    more = "      calibration: table.json\n"
    found = program(tmp_path, f"{{width: {ACROSS}}}", more=more).inspect(plate())
    assert found.ok, found.reason
    assert "width: real32 mm, sigma: real32 mm" in found.layout.text
    assert found.values["width"] == pytest.approx(WIDE * 1e-4, rel=0.1)  # metres, as all values
    assert found.findings["measure"].details.unit == "mm"
    in_pixels = program(tmp_path, WIDTH, more=more).inspect(plate())
    assert in_pixels.values["width"] == pytest.approx(WIDE, abs=0.1)


def test_tool_is_found_by_its_name() -> None:
    from smartcam.registry import TOOLS

    assert issubclass(TOOLS.load("measure"), smartcam.inspection.Tool)  # type: ignore[arg-type]
