"""The tool `locate`: teaching, finding, refusing, and what a pose's error is said to be."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from smartcam.calibration import fit_plane
from smartcam.exceptions import ConfigurationError
from smartcam.inspection import PartModel, Picture, Region, TeachingError, load_cell
from smartcam.interpreters import Context
from smartcam.layout import Layout
from smartcam.registry import INTERPRETERS
from tests.inspection.cells import programs
from tests.inspection.drawn_parts import PARTS, Look, PlacedPart, disc, photograph, shares
from tests.inspection.inside import LocatedPart, TeachingTrouble
from tests.inspection.proofs.locate import PartSearch, locate

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

TAUGHT = (100.3, 99.6)
LOOK = Look(noise=2.0)

LARGE = [("bracket", 1), ("hexagon", 6), ("washer", 0)]
"""Parts that take long to teach, and the turns at which each is the same."""


def drawn(*parts: PlacedPart, look: Look = LOOK, side: int = 200, seed: int = 1) -> Any:
    """Return a picture of parts."""
    light = shares((side, side), parts, look.blur)
    return photograph(light, look, np.random.default_rng(seed))


@functools.cache
def model_of(name: str) -> PartModel:
    """Return the model of a drawn part, which was taught at 0 degrees."""
    return PartModel.teach(drawn(PlacedPart(PARTS[name], *TAUGHT)), name=name)


def truth(name: str, part: PlacedPart) -> tuple[float, float]:
    """Return the place of a model's reference."""
    x, y = np.array(model_of(name).reference) - TAUGHT
    cos, sin = part.scale * math.cos(part.angle), part.scale * math.sin(part.angle)
    return part.x + cos * x - sin * y, part.y + sin * x + cos * y


def one_of(picture: NDArray[np.generic], name: str, **search: Any) -> LocatedPart:
    """Return the one part in a picture."""
    (found,) = locate(Picture(picture), [model_of(name)], PartSearch(seconds=30.0, **search)).parts
    return found


def assert_right(found: LocatedPart, name: str, part: PlacedPart) -> None:
    """Check a pose against the truth, by its own sigmas."""
    x, y = truth(name, part)
    off = math.remainder(found.pose.angle - part.angle, model_of(name).symmetry.period)
    errors = found.pose.x - x, found.pose.y - y, off, found.pose.scale - part.scale
    for error, sigma in zip(errors, found.sigmas, strict=True):
        assert abs(error) <= 5 * sigma + 1e-9, (errors, found.sigmas)
    assert max(found.sigmas[:2]) < 0.03


# ---------------------------------------------------------------------- teaching


@pytest.mark.parametrize(
    ("name", "fold"),
    [
        ("bolt", 1),
        ("square", 4),
        *(pytest.param(*one, marks=pytest.mark.long) for one in LARGE),
    ],
)
def test_symmetry_is_found_and_said(name: str, fold: int) -> None:
    model = model_of(name)
    assert model.symmetry.fold == fold
    said = {0: "no angle", 1: "one angle", 4: "every 90 degrees", 6: "every 60 degrees"}
    assert said[fold] in model.symmetry.text()
    place, angle = model.predicted_sigma()
    assert 0.001 < place < 0.02
    assert math.isnan(angle) == (fold == 0)


@pytest.mark.long
def test_symmetric_part_turns_about_its_middle() -> None:
    for name in ("square", "hexagon", "washer"):
        assert math.dist(model_of(name).reference, TAUGHT) < 0.02


@pytest.mark.long
@pytest.mark.parametrize(
    ("levels", "region", "why"),
    [
        ("plain", None, TeachingTrouble.FEW_EDGES),
        ("plain", [500, 500, 20, 20], TeachingTrouble.EMPTY),
        ("stripes", [8, 10, 130, 140], TeachingTrouble.ONE_DIRECTION),
        ("part", [18, 45, 95, 40], TeachingTrouble.BORDER),
    ],
)
def test_what_cannot_be_taught_is_told(
    levels: str, region: list[int] | None, why: TeachingTrouble
) -> None:
    picture = drawn(seed=3)
    if levels == "stripes":
        picture[20:130, 40:120] = 200  # its upper and lower ends are covered by the mask below
    elif levels == "part":
        picture = drawn(PlacedPart(PARTS["hexagon"], 65, 65))
    taught: Any = region and Region(_corners(*region))
    if levels == "stripes":
        taught = np.zeros(picture.shape, bool)
        taught[30:120, 10:190] = True
        taught[30:120, 75:85] = False
    with pytest.raises(TeachingError) as caught:
        PartModel.teach(picture, taught)
    assert caught.value.reason is why
    assert str(caught.value).startswith(why.value)


def _corners(x: float, y: float, width: float, height: float) -> list[tuple[float, float]]:
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]


@pytest.mark.long
def test_mask_chooses_what_is_taught() -> None:
    picture = drawn(PlacedPart(PARTS["hexagon"], 60, 60), PlacedPart(PARTS["bolt"], 150, 150))
    mask = np.zeros(picture.shape, bool)
    mask[5:112, 5:115] = True
    model = PartModel.teach(picture, mask)
    assert model.symmetry.fold == 6
    assert math.dist(model.reference, (60, 60)) < 0.02
    with pytest.raises(ConfigurationError, match="mask of bool"):
        PartModel.teach(picture, mask[1:])


def test_model_is_the_same_from_its_file(tmp_path: Path) -> None:
    model = model_of("bolt")
    model.write(tmp_path / "bolt.model")
    assert (tmp_path / "bolt.model").stat().st_size < 50_000
    again = PartModel.read(tmp_path / "bolt.model")
    assert (again.name, again.symmetry.fold, again.symmetry.alike) == ("bolt", 1, ())
    part = PlacedPart(PARTS["bolt"], 95.2, 103.7, 1.2)
    first, second = (
        locate(Picture(drawn(part)), [one], PartSearch()).parts[0] for one in (model, again)
    )
    assert np.allclose(first.pose, second.pose, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 1}, "version"),
        ({"kind": "else"}, "kind"),
        ({"segments": []}, "segments"),
        ({"moves": [[0.0] * 6] * 12}, "moves"),
        ({"levels": [[0], [9999]]}, "levels"),
        ({"fold": -1}, "fold"),
        ({"outline": [[0, 0], [20000, 0], [0, 20000]]}, "pixels at most"),
        ({"more": 1}, "more"),
    ],
)
def test_file_that_is_no_model_is_told(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    file = tmp_path / "bolt.model"
    model_of("bolt").write(file)
    file.write_text(json.dumps(json.loads(file.read_text("utf-8")) | change), "utf-8")
    with pytest.raises(ConfigurationError, match=said):
        PartModel.read(file)


def test_file_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.model"):
        PartModel.read(tmp_path / "none.model")
    (tmp_path / "bad.model").write_bytes(b"\xff\x00")
    with pytest.raises(ConfigurationError, match=r"bad\.model"):
        PartModel.read(tmp_path / "bad.model")
    with pytest.raises(ConfigurationError, match="cannot be written"):
        model_of("bolt").write(tmp_path / "no" / "folder.model")


# ---------------------------------------------------------------------- finding


@pytest.mark.parametrize(
    "name",
    [
        "bolt",
        "square",
        *(pytest.param(one, marks=pytest.mark.long) for one in ("bracket", "washer")),
    ],
)
@pytest.mark.parametrize("angle", [0.0, 2.1, -1.234])
def test_pose_is_right_by_its_own_sigma(name: str, angle: float) -> None:
    part = PlacedPart(PARTS[name], 98.37, 101.81, angle)
    found = one_of(drawn(part, seed=7), name)
    assert_right(found, name, part)
    assert found.score > 0.95
    assert not found.doubt


@pytest.mark.long
@pytest.mark.parametrize(
    ("scale", "scales"), [(1.17, (0.8, 1.25)), (0.5, (0.45, 0.55)), (1.9, (1.8, 2.2))]
)
def test_scale_is_found(scale: float, scales: tuple[float, float]) -> None:
    part = PlacedPart(PARTS["tee"], 120.0, 124.4, -0.7, scale)
    found = one_of(drawn(part, side=260), "tee", scales=scales)
    assert_right(found, "tee", part)
    assert 0 < found.sigmas[3] < 1e-3


@pytest.mark.parametrize(
    "scale", [1.02, *(pytest.param(one, marks=pytest.mark.long) for one in (0.98, 0.999))]
)
def test_part_of_another_size_is_right_by_its_own_sigma(scale: float) -> None:
    part = PlacedPart(PARTS["bolt"], 100.0, 104.4, -0.7, scale)
    found = one_of(drawn(part), "bolt")
    assert_right(found, "bolt", part)
    assert found.chi_square < 2


def test_part_of_a_size_that_was_not_asked_for_is_told() -> None:
    part = PlacedPart(PARTS["bolt"], 100.0, 104.4, -0.7, 1.045)
    found = locate(Picture(drawn(part)), [model_of("bolt")], PartSearch())
    assert not found.parts
    assert found.best_refused is not None
    assert found.best_refused.refusal == "its size is 1.045 of the taught one, expected 1"


@pytest.mark.long
@pytest.mark.parametrize(
    "look",
    [
        Look(dark=20, contrast=40),
        Look(noise=10),
        Look(blur=2.0),
        Look(slope=60),
        Look(bits=12, noise=1.0),
    ],
)
def test_light_noise_and_blur_may_change(look: Look) -> None:
    part = PlacedPart(PARTS["bracket"], 98.37, 101.81, 0.6)
    picture = Picture(drawn(part, look=look), depth=look.bits)
    (found,) = locate(picture, [model_of("bracket")], PartSearch(seconds=30.0)).parts
    assert math.dist(found.pose[:2], truth("bracket", part)) < 5 * max(found.sigmas[:2])


@pytest.mark.long
@pytest.mark.parametrize("contrast", [200, 300])
def test_light_beyond_the_largest_level_moves_edges_and_not_the_part(contrast: int) -> None:
    part = PlacedPart(PARTS["tee"], 104.2, 97.5, 0.6)
    (one,) = locate(
        Picture(drawn(part, look=Look(dark=100, contrast=contrast))),
        [model_of("tee")],
        PartSearch(),
    ).parts
    assert math.dist(one.pose[:2], truth("tee", part)) < 4 * max(one.sigmas[:2]) < 0.1
    assert one.pose.scale == pytest.approx(1, abs=4 * one.sigmas[3] + 0.002)


def test_part_that_is_seen_by_a_tilted_camera_is_right_by_its_own_sigma() -> None:
    part, narrow = PlacedPart(PARTS["tee"], 104.2, 97.5, 0.6), 0.985  # of 10 degrees
    light = shares((200, 200), [part], LOOK.blur)
    squeeze = np.array([[narrow, 0, part.x * (1 - narrow)], [0, 1, 0]])
    seen = cv2.warpAffine(light, squeeze, (200, 200), flags=cv2.INTER_CUBIC).astype(float)
    found = one_of(photograph(seen, LOOK, np.random.default_rng(1)), "tee")
    x, y = truth("tee", part)
    off = found.pose.x - (part.x + narrow * (x - part.x)), found.pose.y - y
    assert math.hypot(*off) < 4 * max(found.sigmas[:2]) < 0.04
    assert abs(found.pose.angle - part.angle) < 5 * found.sigmas[2] < 0.003
    assert found.score > 0.95


def test_edges_of_weak_contrast_count_by_their_own_taught_contrast() -> None:
    part = PlacedPart(PARTS["bolt"], 104.2, 97.5, 0.6)
    found = locate(Picture(drawn(part, look=Look(contrast=20))), [model_of("bolt")], PartSearch())
    assert found.parts[0].score > 0.7


def test_texture_beside_the_part_is_in_sigma() -> None:
    random = np.random.default_rng(7)
    part = PlacedPart(PARTS["tee"], 104.2, 97.5, 0.6)
    light = shares((200, 200), [part], LOOK.blur)
    blotches = cv2.GaussianBlur(random.normal(size=light.shape), (0, 0), 6.0)
    blotches *= 15 / 120 / blotches.std()
    own = shares((200, 200), [dataclasses.replace(part, shapes=part.shapes[:1])], LOOK.blur)
    picture = photograph(light + blotches * (1 - own), LOOK, random)
    plain, textured = (
        locate(Picture(one), [model_of("tee")], PartSearch()).parts[0]
        for one in (drawn(part), picture)
    )
    assert textured.sigmas[0] > 1.2 * plain.sigmas[0]
    assert math.dist(textured.pose[:2], truth("tee", part)) < 4 * max(textured.sigmas[:2]) < 0.1


def test_part_may_be_covered_in_part() -> None:
    part = PlacedPart(PARTS["bracket"], 98.37, 101.81, 0.6)
    picture = drawn(part)
    picture[:90, 110:] = 160
    found = one_of(picture, "bracket", min_score=0.5)
    assert 0.5 < found.score < 0.9
    assert len(found.missing)
    assert math.dist(found.pose[:2], truth("bracket", part)) < 0.1


@pytest.mark.long
def test_polarity_decides_whether_the_negative_is_found() -> None:
    part = PlacedPart(PARTS["bracket"], 98.37, 101.81, 0.6)
    picture = drawn(part, look=Look(dark=200, contrast=-120))
    assert_right(one_of(picture, "bracket", any_polarity=True), "bracket", part)
    assert not locate(Picture(picture), [model_of("bracket")], PartSearch()).parts


@pytest.mark.long
def test_most_and_overlap_limit_what_is_found() -> None:
    parts = [PlacedPart(PARTS["bolt"], x, y, x) for x, y in ((80, 80), (220, 90), (150, 220))]
    picture = Picture(drawn(*parts, side=300))
    for most in (1, 2, 3, 5):
        found = locate(picture, [model_of("bolt")], PartSearch(max_parts=most, seconds=30.0)).parts
        assert len(found) == min(most, 3)
    for one in found:
        assert min(math.dist(one.pose[:2], truth("bolt", part)) for part in parts) < 0.1


@pytest.mark.long
def test_several_models_are_told_apart() -> None:
    parts = {
        "bolt": PlacedPart(PARTS["bolt"], 80, 80, 1),
        "tee": PlacedPart(PARTS["tee"], 200, 180),
    }
    models = [model_of(name) for name in ("bolt", "tee", "square")]
    found = locate(
        Picture(drawn(*parts.values(), side=300)), models, PartSearch(seconds=30.0)
    ).parts
    assert sorted(one.name for one in found) == ["bolt", "tee"]
    for one in found:
        assert_right(one, one.name, parts[one.name])


def test_ranges_exclude_other_poses() -> None:
    picture = Picture(drawn(PlacedPart(PARTS["bolt"], 100, 100, 1.0)))
    for angles, count in (((0.8, 1.2), 1), ((-0.5, 0.5), 0), ((0.9 + 2 * math.pi, 7.5), 1)):
        found = locate(picture, [model_of("bolt")], PartSearch(angles=angles, seconds=30.0))
        assert len(found.parts) == count


def test_what_was_nearest_is_told_with_the_reason() -> None:
    picture = drawn(PlacedPart(PARTS["bolt"], 100, 100, 1.0))
    picture[100:, :] = 60
    found = locate(Picture(picture), [model_of("bolt")], PartSearch(seconds=30.0))
    assert not found.parts
    assert found.best_refused is not None
    assert "% of its edges" in found.best_refused.refusal
    assert found.best_refused.score < 0.7
    nothing = locate(Picture(drawn()), [model_of("bolt")], PartSearch())
    assert (nothing.parts, nothing.best_refused) == ((), None)


@pytest.mark.long
def test_part_that_may_be_turned_otherwise_is_in_doubt() -> None:
    shapes = (*PARTS["square"], disc(0.0, 28, 0, 6))
    taught = PartModel.teach(drawn(PlacedPart(shapes, *TAUGHT)), name="key")
    assert taught.symmetry.fold == 1
    assert taught.symmetry.alike
    assert "must be visible" in taught.symmetry.text()
    clear = drawn(PlacedPart(shapes, 98, 101, 0.3))
    (found,) = locate(Picture(clear), [taught], PartSearch(seconds=30.0)).parts
    assert not found.doubt
    assert abs(found.pose.angle - 0.3) < 0.01
    hidden = drawn(PlacedPart(PARTS["square"], 98, 101, 0.3))
    (found,) = locate(Picture(hidden), [taught], PartSearch(seconds=30.0)).parts
    assert "turned by" in found.doubt


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((1, 1), np.uint8),
        np.zeros((3, 500), np.uint8),
        np.full((200, 200), 255, np.uint8),
        np.random.default_rng(1).integers(0, 256, (200, 200)).astype(np.uint8),
        np.zeros((200, 200, 3), np.uint8),
        np.zeros((200, 200), np.uint16),
    ],
)
def test_picture_without_a_part_gives_none(picture: NDArray[np.generic]) -> None:
    assert not locate(Picture(picture), [model_of("bolt")], PartSearch(seconds=30.0)).parts


def test_part_half_outside_is_none() -> None:
    picture = drawn(PlacedPart(PARTS["bolt"], 2, 100, 1.0))
    assert not locate(Picture(picture), [model_of("bolt")], PartSearch(seconds=30.0)).parts


# ---------------------------------------------------------------------- the tool


def written(folder: Path, *names: str) -> str:
    """Write models, and return what a cell file says of them."""
    for name in names:
        model_of(name).write(folder / f"{name}.model")
    return f"model: [{', '.join(f'{name}.model' for name in names)}]"


def test_results_are_localizations(tmp_path: Path) -> None:
    said = written(tmp_path, "bolt")
    program = programs(tmp_path, f"7: {{locate: {{{said}, most: 3}}}}")[7]
    part = PlacedPart(PARTS["bolt"], 98.37, 101.81, 0.6)
    found = program.inspect(drawn(part))
    assert found.ok, found.reason
    kind: Any = INTERPRETERS.load("localizations")
    reader = kind(Layout(program.interpret_as))
    (one,) = reader.read(found.payload(), Context(camera="cam", number=1, y_down=True))
    assert (one.feature_id, round(one.quality, 1)) == ("bolt", 1.0)
    x, y = truth("bolt", part)
    assert abs(one.pose.position.x - x) < 0.05
    assert abs(one.pose.position.y + y) < 0.05
    assert abs(one.pose.orientation.theta + 0.6) < 0.01
    (record,) = found.value.locate
    assert 0 < record.sigma_x < 0.02
    assert 0 < record.sigma_theta < 0.001
    assert abs(record.correlation_xy) < 1
    sigma = one.pose.sigma
    assert sigma is not None
    assert sigma[:3] == pytest.approx((record.sigma_x, record.sigma_y, record.sigma_theta))
    assert sigma.correlation_xy == pytest.approx(-record.correlation_xy)
    assert sigma.correlation_yt == pytest.approx(record.correlation_yt)
    nothing = program.inspect(drawn())
    assert not nothing.ok
    assert nothing.reason == "0 found, expected 1 or more; nothing in the picture resembles it"
    assert reader.read(nothing.payload(), Context(camera="cam", number=2)) == []


@pytest.mark.long
def test_part_is_taught_from_a_picture_in_the_cell(tmp_path: Path) -> None:
    picture = drawn(
        PlacedPart(PARTS["bolt"], *TAUGHT), PlacedPart(PARTS["washer"], 250, 100), side=320
    )
    cv2.imwrite(str(tmp_path / "bolt.png"), picture)
    said = "taught: bolt.png, part: [30, 30, 150, 140], count: 1"
    program = programs(tmp_path, f"7: {{locate: {{{said}}}}}")[7]
    found = program.inspect(picture)
    assert found.ok, found.reason
    assert found.value.locate[0].feature_id == "bolt"
    assert abs(found.value.locate[0].theta) < 0.001


@pytest.mark.parametrize(
    ("said", "text"),
    [
        ("most: 1", "a model, a taught picture or an outline, got none"),
        ("model: none.model", r"none\.model"),
        ("taught: none.png", r"none\.png"),
        ("model: a.model, part: [0, 0, 9, 9]", "with a taught picture only"),
        ("model: a.model, angle: [10, -10]", "smaller number first"),
        ("model: a.model, angle: [-200, 200]", "360 degrees at most"),
    ],
)
def test_mistake_in_the_settings_is_told(tmp_path: Path, said: str, text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        programs(tmp_path, f"7: {{locate: {{{said}}}}}")


@pytest.mark.long
def test_region_and_number_are_kept_to(tmp_path: Path) -> None:
    said = written(tmp_path, "bolt")
    picture = drawn(*(PlacedPart(PARTS["bolt"], x, 80, x) for x in (80, 220)), side=300)
    app = f"7: {{locate: {{{said}, most: 5, count: %s, region: %s}}}}"
    assert programs(tmp_path, app % (2, [0, 0, 300, 300]))[7].inspect(picture).ok
    left = programs(tmp_path, app % (1, [20, 20, 120, 120]))[7].inspect(picture)
    assert left.ok, left.reason
    assert left.value.locate[0].x < 140
    assert not programs(tmp_path, app % ("[3, 5]", [0, 0, 300, 300]))[7].inspect(picture).ok


@pytest.mark.long
def test_other_tools_follow_the_part(tmp_path: Path) -> None:
    said = written(tmp_path, "bracket")
    model = model_of("bracket")
    # the rim of the hole, from the reference of the model
    x, y = TAUGHT[0] - 38 - model.reference[0], TAUGHT[1] + 18 - model.reference[1]
    app = (
        f"7: {{locate: {{{said}}}, "
        f"measure: {{follow: locate, circle: {{centre: [{x:.2f}, {y:.2f}], radius: 12}}}}}}"
    )
    part = PlacedPart(PARTS["bracket"], 105.2, 97.1, 2.5)
    found = programs(tmp_path, app)[7].inspect(drawn(part))
    assert found.ok, found.reason
    assert abs(found.value.measure_diameter - 24) < 0.1


def test_outline_is_drawn_along_the_edges(tmp_path: Path) -> None:
    program = programs(tmp_path, f"7: {{locate: {{{written(tmp_path, 'tee')}}}}}")[7]
    part = PlacedPart(PARTS["tee"], 98.37, 101.81, 0.6)
    found = program.inspect(drawn(part))
    lines = [one for one in found.findings["locate"].drawings if one.kind == "polygon"]
    outer, hole = (np.array(one.points) for one in lines if one.role == "found")
    cos, sin = math.cos(part.angle), math.sin(part.angle)
    for line, shape in zip((outer, hole), part.shapes, strict=True):
        x, y = (line - (part.x, part.y)).T
        off = shape.inside(cos * x + sin * y, cos * y - sin * x)
        assert np.abs(off).max() < 1.6
        assert 8 <= len(line) <= 150
    picture = found.drawn().astype(int)
    green = picture[:, :, 1] - picture[:, :, 0] > 40
    x, y = np.rint(outer).astype(int).T
    assert green[y, x].all()


@pytest.mark.long
def test_calibration_leads_to_the_robots_millimetres(tmp_path: Path) -> None:
    pixels = np.array([(0, 0), (200, 0), (200, 200), (0, 200), (100, 50)], float)
    robot = np.column_stack(
        [0.3 + 0.0005 * pixels[:, 1], 0.1 + 0.0005 * pixels[:, 0], 0 * pixels[:, 0]]
    )
    fit_plane(pixels, robot, touch_sigma=1e-6).save(tmp_path / "table.json")
    said = written(tmp_path, "bolt")
    head = (
        "cameras:\n  line1/cam1:\n    software:\n      frames: pictures\n"
        "      calibration: table.json\n      applications:\n"
    )
    cell = tmp_path / "cell.yaml"
    cell.write_text(f"{head}        7: {{locate: {{{said}, sigma: 0.05}}}}\n", "utf-8")
    program = load_cell(cell)["line1/cam1"].program(7)
    part = PlacedPart(PARTS["bolt"], 98.37, 101.81, 0.6)
    found = program.inspect(drawn(part))
    assert found.ok, found.reason
    (record,) = found.value.locate
    x, y = truth("bolt", part)
    assert abs(record.x - (0.3 + 0.0005 * y)) < 2e-5
    assert abs(record.y - (0.1 + 0.0005 * x)) < 2e-5
    assert abs(record.theta - (math.pi / 2 - 0.6)) < 0.003
    plain = one_of(drawn(part), "bolt").sigmas
    assert 0.0004 * plain[1] < record.sigma_x < 0.0005 * plain[1] + 5e-6
    strict = cell.read_text("utf-8").replace("sigma: 0.05", "sigma: 0.00001")
    cell.write_text(strict, "utf-8")
    found = load_cell(cell)["line1/cam1"].program(7).inspect(drawn(part))
    assert not found.ok
    assert "mm are allowed" in found.reason
