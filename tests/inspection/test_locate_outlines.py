"""Parts that are taught by outlines in DXF and SVG: where they are found, and files that fail."""

from __future__ import annotations

import contextlib
import math
import random
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.inspection import PartModel, Picture, TeachingError
from tests.inspection.cells import programs
from tests.inspection.drawn_parts import PARTS, Look, PlacedPart, photograph, shares
from tests.inspection.inside import TeachingTrouble
from tests.inspection.proofs.locate import PartSearch, locate

ezdxf: Any = pytest.importorskip("ezdxf", reason="needs the extra inspection")

if TYPE_CHECKING:
    from pathlib import Path

TEE = PARTS["tee"]
"""Its outline and its hole are of the levels 1 and 0; lengths are pixels."""

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" width="100mm" height="100mm" viewBox="0 0 100 100">'


def svg(path: Path, body: str, head: str = HEAD) -> Path:
    """Write a file of SVG."""
    path.write_text(f"{head}{body}</svg>", encoding="utf-8")
    return path


def tee_svg(folder: Path) -> Path:
    """Write the tee at a quarter of its size, 50 to the right and 40 down, in odd ways."""
    corners = " ".join(f"{-y / 4:g},{x / 4:g}" for x, y in TEE[0].corners)
    hole = TEE[1]
    x, y = (one / 4 for one in hole.centre)
    radius = hole.radius / 4
    arc = f"a{radius} {radius} 0 0 1"
    body = (
        f'<g transform="translate(50,40)"><polygon transform="rotate(-90)" points="{corners}"/>'
        f'<path d="M{x - radius} {y}{arc} {2 * radius} 0{arc} {-2 * radius} 0z"/></g>'
    )
    return svg(folder / "tee.svg", body)


def tee_dxf(folder: Path) -> Path:
    """Write the tee at a quarter of its size, in lines of any order and direction, y up."""
    drawing = ezdxf.new(units=4)
    space = drawing.modelspace()
    corners = [(x / 4, -y / 4) for x, y in TEE[0].corners]
    lines = list(zip(corners, [*corners[1:], corners[0]], strict=True))
    for number, (begin, end) in enumerate([*lines[::2], *lines[1::2]]):
        space.add_line(*((end, begin) if number % 3 else (begin, end)))
    x, y = TEE[1].centre
    space.add_circle((x / 4, -y / 4), TEE[1].radius / 4)
    drawing.saveas(folder / "tee.dxf")
    return folder / "tee.dxf"


@pytest.fixture(params=[tee_svg, tee_dxf])
def model(request: pytest.FixtureRequest, tmp_path: Path) -> PartModel:
    return PartModel.from_outline(request.param(tmp_path), 4.0, name="tee")


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("angle", [0.0, 2.3])
def test_part_of_an_outline_is_found_where_its_drawing_lies(
    model: PartModel, angle: float, request: pytest.FixtureRequest
) -> None:
    scene = PlacedPart(TEE, 150.3, 128.6, angle)
    picture = photograph(shares((260, 300), [scene], 0.9), Look(), np.random.default_rng(3))
    (found,) = locate(Picture(picture), [model], PartSearch(seconds=30.0)).parts
    assert found.score > 0.95
    origin = (0.0, 0.0) if "dxf" in request.node.name else (200.0, 160.0)
    at = found.pose.to_picture(np.subtract(origin, model.reference))
    np.testing.assert_allclose(at, (scene.x, scene.y), atol=0.02)
    assert abs(math.remainder(found.pose.angle - angle, 2 * math.pi)) < math.radians(0.02)
    assert max(found.sigmas[:2]) < 0.01


def test_dark_part_of_an_outline_in_a_cell_file_is_found(tmp_path: Path) -> None:
    tee_svg(tmp_path)
    settings = "outline: tee.svg, pixels_per_mm: 4, bright: false"
    program = programs(tmp_path, f"7: {{locate: {{{settings}}}}}")[7]
    scene = PlacedPart(TEE, 100, 110, 0.4)
    look = Look(dark=180, contrast=-120)
    picture = photograph(shares((220, 220), [scene], 0.9), look, np.random.default_rng(3))
    assert program.inspect(picture).value.count == 1
    bright = photograph(shares((220, 220), [scene], 0.9), Look(), np.random.default_rng(3))
    assert program.inspect(bright).reason.startswith("0 found")


def test_splines_blocks_layers_and_inches_are_read(tmp_path: Path) -> None:
    drawing = ezdxf.new(units=1)
    block = drawing.blocks.new("PART")
    block.add_lwpolyline([(0, 0), (1, 0), (1, 0.5, 0, 0, 0.3), (0, 0.5)], close=True)
    block.add_spline([(0.2, 0.2), (0.5, 0.15), (0.8, 0.25), (0.5, 0.35), (0.2, 0.2)])
    block.add_ellipse((0.12, 0.12), (0.05, 0), 0.6)
    drawing.layers.add("notes")
    space = drawing.modelspace()
    space.add_blockref("PART", (3, 2), {"rotation": 90, "layer": "part"})
    space.add_text("bracket", dxfattribs={"layer": "notes"})
    drawing.saveas(tmp_path / "part.dxf")
    with pytest.raises(TeachingError, match="got TEXT in the layer 'notes': name the layers"):
        PartModel.from_outline(tmp_path / "part.dxf", 4.0)
    model = PartModel.from_outline(tmp_path / "part.dxf", 4.0, layers=["0", "part"])
    width, height = np.ptp(model.outline, axis=0)
    assert height == pytest.approx(25.4 * 4, abs=1)  # one inch, turned by 90 degrees
    assert width == pytest.approx(0.65 * 25.4 * 4, abs=1)  # the bulge is 0.3 of half an inch
    middle = np.array(model.reference)
    np.testing.assert_allclose(middle, (2.75 * 101.6, -2.5 * 101.6), atol=12)


def test_curves_and_groups_of_svg_are_read(tmp_path: Path) -> None:
    ring = '<path d="M10 30 C10 15 50 15 50 30 S10 45 10 30 Z M20 30 q10 8 20 0 z"/>'
    notes = '<g id="notes"><text x="1" y="2">bracket</text></g>'
    whole = f'<g transform="scale(1.5) skewX(10)" id="part">{ring}</g>'
    path = svg(tmp_path / "ring.svg", f"<defs><rect rx='2'/></defs>{whole}{notes}")
    with pytest.raises(TeachingError, match="got 'text': name the groups"):
        PartModel.from_outline(path, 3.0)
    model = PartModel.from_outline(path, 3.0, layers=["part"])
    # the loop reaches 11.25 up and down at its middle, so 22.5 in all
    assert np.ptp(model.outline, axis=0)[1] == pytest.approx(22.5 * 1.5 * 3, abs=1.5)
    again = PartModel.from_outline(path, 3.0 / 25.4, layers=["part"], unit="inch")
    np.testing.assert_allclose(again.reference, model.reference, atol=0.02)


def test_box_with_round_corners_is_read(tmp_path: Path) -> None:
    box = (
        '<rect x="10" y="10" width="30" height="20" rx="6" ry="8"/><circle cx="18" cy="20" r="4"/>'
    )
    # the same in arcs, from another corner
    arcs = "M40 22 A6 8 0 0 1 34 30 H16 A6 8 0 0 1 10 22 V18 A6 8 0 0 1 16 10 H34 A6 8 0 0 1 40 18Z"
    path = f'<path d="{arcs}"/><circle cx="18" cy="20" r="4"/>'
    first, second = (
        PartModel.from_outline(svg(tmp_path / f"{n}.svg", one), 3.0)
        for n, one in enumerate((box, path))
    )
    np.testing.assert_allclose(first.reference, second.reference, atol=0.02)
    np.testing.assert_allclose(np.ptp(first.outline, axis=0), (90, 60), atol=1)
    assert len(first.outline) == pytest.approx(len(second.outline), rel=0.02)


SQUARE = '<rect x="10" y="10" width="30" height="20"/>'
NO_UNIT = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 100">'
STRETCHED = NO_UNIT.replace("viewBox", 'width="10mm" height="20mm" viewBox')


@pytest.mark.parametrize(
    ("name", "text", "why", "said"),
    [
        ("a.svg", f"{NO_UNIT}{SQUARE}</svg>", "UNIT", "have no unit"),
        ("a.svg", f"{STRETCHED}{SQUARE}</svg>", "UNIT", "0.1 and 0.2 mm for a unit"),
        ("a.svg", f"{HEAD}</svg>", "NO_OUTLINE", "no line at all"),
        ("a.svg", f'{HEAD}<path d="M1 1H9V9"/></svg>', "NO_OUTLINE", "meets no other one"),
        ("a.svg", f'{HEAD}<use href="#a"/></svg>', "UNSUPPORTED", "got 'use'"),
        (
            "a.svg",
            f'{HEAD}<g style="fill:red; transform: scale(2)">{SQUARE}</g></svg>',
            "UNSUPPORTED",
            "in the style of a 'g'",
        ),
        ("a.svg", f'{HEAD}<g style="display: none">{SQUARE}</g></svg>', "NO_OUTLINE", "no line"),
        ("a.svg", f'{HEAD}<image href="a.png"/></svg>', "UNSUPPORTED", "got 'image'"),
        ("a.svg", f'{HEAD}<path d="M1 1L"/></svg>', "UNREADABLE", "a.svg"),
        ("a.svg", f'{HEAD}<g transform="turn(3)">{SQUARE}</g></svg>', "UNREADABLE", "turn"),
        ("a.svg", HEAD, "UNREADABLE", "no element found"),
        ("a.svg", "<html/>", "UNREADABLE", "expected SVG"),
        ("a.svg", f'<!DOCTYPE svg [<!ENTITY a "b">]>{HEAD}</svg>', "UNREADABLE", "entities"),
        ("a.svg", HEAD + "<g>" * 40 + SQUARE + "</g>" * 40 + "</svg>", "UNSUPPORTED", "30 groups"),
        (
            "a.svg",
            f'{HEAD}<rect x="1" y="1" width="5000" height="5000"/></svg>',
            "TOO_LARGE",
            "at this scale",
        ),
        ("a.svg", f'{HEAD}<rect width="1e400" height="1"/></svg>', "TOO_LARGE", "finite"),
        ("a.dxf", "0\nnothing\n", "UNREADABLE", "expected DXF"),
        ("a.dxf", "0\nSECTION\n2\nENTITIES\n0\n", "UNREADABLE", "a.dxf"),
        ("a.step", "ISO-10303-21;", "UNREADABLE", ".dxf or .svg"),
    ],
)
def test_file_that_is_no_outline_is_told(
    tmp_path: Path, name: str, text: str, why: str, said: str
) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(TeachingError, match=said) as caught:
        PartModel.from_outline(tmp_path / name, 10.0)
    assert caught.value.reason is TeachingTrouble[why]


def test_drawing_without_unit_or_in_space_is_told(tmp_path: Path) -> None:
    drawing = ezdxf.new(units=0)
    drawing.modelspace().add_lwpolyline([(0, 0), (9, 0), (9, 5), (0, 5)], close=True)
    drawing.saveas(tmp_path / "a.dxf")
    with pytest.raises(TeachingError, match="names no known unit") as caught:
        PartModel.from_outline(tmp_path / "a.dxf", 10.0)
    assert caught.value.reason is TeachingTrouble.UNIT
    assert PartModel.from_outline(tmp_path / "a.dxf", 10.0, unit="mm").symmetry.fold == 2
    drawing.modelspace().add_line((0, 0, 0), (3, 3, 9))
    drawing.saveas(tmp_path / "a.dxf")
    with pytest.raises(TeachingError, match="LINE whose z changes") as caught:
        PartModel.from_outline(tmp_path / "a.dxf", 10.0, unit="mm")
    assert caught.value.reason is TeachingTrouble.UNSUPPORTED


def test_arguments_and_settings_that_cannot_work_are_told(tmp_path: Path) -> None:
    path = tee_svg(tmp_path)
    with pytest.raises(TeachingError, match="No such file"):
        PartModel.from_outline(tmp_path / "none.svg", 4.0)
    for wrong in ({"pixels_per_mm": 0}, {"unit": "foot"}, {"layers": [3]}, {"bright": 1}):
        given: dict[str, Any] = {"pixels_per_mm": 4.0, **wrong}
        with pytest.raises(ConfigurationError, match=next(iter(wrong))):
            PartModel.from_outline(path, **given)
    for said, text in (
        ("outline: tee.svg", "outline: and pixels_per_mm: together"),
        ("outline: tee.svg, pixels_per_mm: 4, model: a.model", "got model and outline"),
        ("taught: a.png, unit: mm", "unit: expected it with an outline only"),
    ):
        with pytest.raises(ConfigurationError, match=text):
            programs(tmp_path, f"7: {{locate: {{{said}}}}}")


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("make", [tee_svg, tee_dxf])
def test_damaged_file_is_told_or_taught(make: Any, seed: int, tmp_path: Path) -> None:
    path = make(tmp_path)
    whole = path.read_bytes()
    chance = random.Random(f"{path.suffix}{seed}")  # noqa: S311 - of a test
    for _ in range(8):
        cut = bytearray(whole[: chance.randrange(len(whole))] if chance.random() < 0.3 else whole)
        for _ in range(chance.randrange(4) if cut else 0):
            at = chance.randrange(len(cut))
            cut[at : at + chance.randrange(1, 40)] = chance.randbytes(chance.randrange(8))
            if not cut:
                break
        path.write_bytes(cut)
        with contextlib.suppress(TeachingError):
            PartModel.from_outline(path, 4.0)
