"""Programs: layout, following, verdicts, faults of tools."""

from __future__ import annotations

import contextlib
import math
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam import frames
from smartcam.exceptions import ConfigurationError, FrameFormatError, InspectionError, PluginError
from smartcam.inspection import (
    Finding,
    Picture,
    PixelPose,
    Tool,
    ToolSettings,
    View,
    load_cell,
    register_tool,
)
from smartcam.layout import Layout
from tests.argument_table import ODD
from tests.inspection.cells import board, inspected, programs, write_cell

if TYPE_CHECKING:
    from pathlib import Path

SPOT = "present: {grey: [200, 255], area: [10, 9000]}"


class BrightnessSettings(ToolSettings):
    """Allowed range of brightness."""

    least: float = 0.0


class Brightness(Tool[BrightnessSettings]):
    """A user's tool: mean brightness of a region."""

    settings_model = BrightnessSettings
    fields = "mean: real32"

    def inspect(self, view: View) -> Finding:
        """Return the mean; raise for an all black picture, as a faulty tool."""
        mean = float(view.grey.mean())
        if mean == 0:
            raise ZeroDivisionError("black")
        ok = mean >= self.settings.least
        reason = "" if ok else f"the mean is {mean:.0f}, expected {self.settings.least:g}"
        return Finding(ok=ok, reason=reason, values={"mean": mean})


@pytest.fixture(autouse=True)
def _brightness() -> None:
    register_tool("brightness", Brightness)


def test_own_tool_is_found_by_name_and_gives_its_fields(tmp_path: Path) -> None:
    found = inspected(tmp_path, "{brightness: {region: [0, 0, 10, 10]}}", board())
    assert found.layout == Layout("ok: bool, reason: string[80], mean: real32")
    assert found.value == (True, "", 100.0)


def test_payload_reads_back_by_the_programs_layout(tmp_path: Path) -> None:
    (program,) = programs(tmp_path, f"7: {{name: spot, {SPOT}}}").values()
    found = program.inspect(board((30, 20, 40, 10, 250)))
    assert Layout(program.interpret_as).parse(found.payload()) == found.value
    assert Layout(program.interpret_as).parse(found.payload("big"), "big") == found.value
    assert (found.value.count, found.value.x, found.value.y) == (1, 49.5, 24.5)


def test_several_tools_have_their_names_before_their_fields(tmp_path: Path) -> None:
    application = f"{{{SPOT}, brightness left: {{region: [0, 0, 20, 20], least: 120}}}}"
    found = inspected(tmp_path, application, board((30, 20, 40, 10, 250)))
    names = [field.name for field in found.layout.fields]
    assert names[:4] == ["ok", "reason", "present_ok", "present_count"]
    assert names[-2:] == ["left_ok", "left_mean"]
    assert (found.value.ok, found.value.present_ok, found.value.left_ok) == (False, True, False)
    assert found.reason == found.value.reason == "left: the mean is 100, expected 120"
    assert [*found.findings] == [*found.seconds] == ["present", "left"]


def test_field_without_a_value_is_nothing_by_its_type(tmp_path: Path) -> None:
    value = inspected(tmp_path, f"{{{SPOT}}}", board()).value
    assert (value.ok, value.count, value.area) == (False, 0, 0)
    assert math.isnan(value.x)


def test_reason_is_cut_at_a_whole_character(tmp_path: Path) -> None:
    class Complaining(Tool[ToolSettings]):
        settings_model = ToolSettings

        def inspect(self, view: View) -> Finding:
            return Finding(ok=False, reason="ä" * 100)

    register_tool("complaining", Complaining)
    found = inspected(tmp_path, "{complaining: {}}", board())
    assert found.reason == "ä" * 100
    assert found.value.reason == "ä" * 38 + "..."


def test_sequence_number_comes_first_if_wanted(tmp_path: Path) -> None:
    found = inspected(tmp_path, f"{{sequence: true, {SPOT}}}", board())
    assert found.layout.sequence(found.payload(sequence=-1001)) == -1001
    assert found.layout.sequence(found.payload()) == 0
    plain = inspected(tmp_path, f"{{{SPOT}}}", board())
    assert plain.payload(sequence=5) == plain.payload()


def test_tool_follows_an_earlier_tool(tmp_path: Path) -> None:
    application = (
        f"{{{SPOT}, present hole: {{follow: present, region: [-4, -4, 8, 8], grey: [0, 20], "
        "area: [4, 100]}}"
    )
    for x, y in ((30, 20), (110, 60)):
        picture = board((x, y, 40, 20, 250), (x + 18, y + 8, 4, 4, 0))
        found = inspected(tmp_path, application, picture)
        assert found.ok, found.reason
        assert (found.value.hole_x, found.value.hole_y) == (x + 19.5, y + 9.5)


def test_tool_that_follows_nothing_found_is_not_ok_and_not_asked(tmp_path: Path) -> None:
    application = f"{{{SPOT}, brightness: {{follow: present, region: [0, 0, 4, 4]}}}}"
    found = inspected(tmp_path, application, board())
    assert found.findings["brightness"].reason == "the tool follows present, which was not found"
    assert math.isnan(found.value.brightness_mean)


def test_application_follows_another_by_its_name(tmp_path: Path) -> None:
    made = programs(
        tmp_path,
        "20: {name: near, brightness: {follow: spot, region: [-2, -2, 4, 4]}}",
        f"7: {{name: spot, {SPOT}}}",
    )
    found = made[20].inspect(board((110, 60, 40, 20, 250)))
    assert (found.ok, found.value.mean) == (True, 250.0)
    assert [field.name for field in found.layout.fields] == ["ok", "reason", "mean"]
    lost = made[20].inspect(board())
    assert (lost.ok, lost.reason) == (False, "spot: 0 spots, expected 1 to 1000")


def test_region_out_of_the_picture_is_a_finding_with_a_reason(tmp_path: Path) -> None:
    for region in ("[190, 0, 20, 20]", "[-5, 0, 20, 20]", "[500, 500, 5, 5]"):
        found = inspected(tmp_path, f"{{brightness: {{region: {region}}}}}", board())
        assert not found.ok
        assert "px out of the picture of 200 x 100" in found.reason
    assert inspected(tmp_path, "{brightness: {region: [0, 0, 200, 100]}}", board()).ok


def test_exception_of_a_tool_names_application_and_tool(tmp_path: Path) -> None:
    with pytest.raises(
        InspectionError, match=r"application 7 \(7\): .*brightness.*black"
    ) as caught:
        inspected(tmp_path, "{brightness: {}}", np.zeros((20, 20), np.uint8))
    assert (caught.value.application, caught.value.tool) == (7, "brightness")


def test_pose_and_its_inverse_give_the_same_point() -> None:
    pose = PixelPose(30.0, -4.0, 0.7, 1.5)
    points = np.random.default_rng(1).uniform(-50, 50, (20, 2))
    assert np.allclose(pose.from_picture(pose.to_picture(points)), points)
    turned = PixelPose(10, 20, math.pi / 2).to_picture([[1, 0]])
    assert np.allclose(turned, [[10, 21]])  # from x towards y


def test_two_lists_in_one_program_are_refused(tmp_path: Path) -> None:
    many = "present{}: {{grey: [0, 9], most: 3}}"
    with pytest.raises(ConfigurationError, match=r"line 6: .*room for one list"):
        programs(tmp_path, f"7: {{{many.format('')}, {many.format(' more')}}}")


@pytest.mark.parametrize(
    ("application", "message"),
    [
        ("7: {raed: {}}", r"line 6: .*no tool is called 'raed'.*did you mean 'read'"),
        ("7: {nane: x, present: {grey: [0, 9]}}", r"no tool is called 'nane'.*mean 'name'"),
        ("7: {present: {gray: [0, 9]}}", r"line 6: .*present.gray: .*did you mean 'grey'"),
        ("7: {present: {}}", "expected either grey or colour, got neither"),
        ("7: {present: {grey: [9, 0]}}", "expected the smaller number first"),
        ("7: {present: {grey: [0, 9], region: [0, 0, 0, 9]}}", "width and a height above 0"),
        ("7: {present: {grey: [0, 9], region: [0, 0, .nan, 9]}}", "expected .x, y, width, height."),
        ("7: {present: {grey: [0, 9], follow: x}}", "no application is called 'x'"),
        ("7: {name: a, present: {grey: [0, 9], follow: a}}", "follow each other in a circle"),
        ("7: {present: {grey: [0, 9]}, present Left: {}}", "small letters"),
        ("7: {name: empty}", "expected 1 to 50 tools"),
        ("-1: {present: {grey: [0, 9]}}", "expected a number from 0"),
        ("7: {read: {codes: [DataMatrx]}}", "did you mean 'DataMatrix'"),
        ("7: {read: {expect: '('}}", "expected a regular expression"),
        ("7: {read: {least: 3}}", "expected up to 1, as most is"),
        ("7: {compare: {taught: nowhere.png}}", "No such file"),
    ],
)
def test_mistake_in_a_cell_is_reported_with_its_line(
    tmp_path: Path, application: str, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        programs(tmp_path, application)
    assert "cell.yaml, line " in str(caught.value)


def test_circle_over_two_applications_is_refused(tmp_path: Path) -> None:
    tool = "present: {{grey: [0, 9], follow: {}}}"
    with pytest.raises(ConfigurationError, match="circle"):
        programs(
            tmp_path,
            f"7: {{name: one, {tool.format('other')}}}",
            f"8: {{name: other, {tool.format('one')}}}",
        )


def test_name_of_a_known_tool_cannot_be_taken() -> None:
    with pytest.raises(PluginError):
        register_tool("read", Brightness)
    odd: Any = object
    with pytest.raises(ConfigurationError, match="subclass"):
        register_tool("other", odd)
    with pytest.raises(ConfigurationError, match="small letters"):
        register_tool("No Name", Brightness)


def test_file_without_software_cameras_is_refused(tmp_path: Path) -> None:
    path = write_cell(tmp_path, head='cameras:\n  a: {url: "bvs://127.0.0.1"}\n')
    with pytest.raises(ConfigurationError, match=r"expected a camera with software:"):
        load_cell(path)


ODD_PICTURES: dict[str, np.ndarray[Any, Any]] = {
    "colour": np.zeros((60, 80, 3), np.uint8),
    "16 bits": np.full((60, 80), 40_000, np.uint16),
    "16 bits of colour": np.zeros((60, 80, 3), np.uint16),
    "one pixel": np.zeros((1, 1), np.uint8),
    "one row": np.zeros((1, 301), np.uint8),
    "odd": np.zeros((37, 53), np.uint8),
    "black": np.zeros((60, 80), np.uint8),
    "saturated": np.full((60, 80), 255, np.uint8),
    "view with strides": np.zeros((120, 160), np.uint8)[::2, ::-2],
}


@pytest.mark.parametrize("name", ODD_PICTURES)
def test_odd_picture_has_an_outcome_of_every_tool(tmp_path: Path, name: str) -> None:
    picture = ODD_PICTURES[name]
    for tool in ("read: {}", "present: {grey: [90, 110]}", "present: {colour: {hue: [5, 20]}}"):
        found = inspected(tmp_path, f"{{{tool}}}", picture)
        assert not found.ok
        assert found.reason
        assert found.drawn().shape == (*picture.shape[:2], 3)


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((0, 5), np.uint8),
        np.zeros((5, 0, 3), np.uint8),
        np.zeros((5, 5, 4), np.uint8),
        np.zeros((5, 5), np.float32),
        np.zeros(5, np.uint8),
        np.zeros((1, 20_001), np.uint8),
    ],
    ids=lambda one: f"{one.shape} {one.dtype}",
)
def test_wrong_array_is_refused(picture: np.ndarray[Any, Any]) -> None:
    with pytest.raises(FrameFormatError, match="picture: expected"):
        Picture.of(picture)


def test_sixteen_bits_are_judged_by_their_significant_bits() -> None:
    levels = np.array([[0, 1 << 11, (1 << 12) - 1]], np.uint16)
    assert Picture(levels, depth=12).grey.tolist() == [[0, 128, 255]]
    assert Picture(levels << 4).grey.tolist() == [[0, 128, 255]]


@pytest.mark.parametrize("name", ODD)
def test_odd_argument_is_refused_by_an_error_of_ours(tmp_path: Path, name: str) -> None:
    odd = ODD[name]
    cell = load_cell(write_cell(tmp_path, f"7: {{name: spot, {SPOT}}}"))["line1/cam1"]
    for call in (
        lambda: Picture.of(odd),
        lambda: Picture(odd),
        lambda: Picture(board(), depth=odd),
        lambda: Picture.read(odd),
        lambda: load_cell(odd),
        lambda: cell.program(odd),
        lambda: cell.program(7).inspect(board(), input=odd),
        lambda: register_tool(odd, Brightness),
        lambda: register_tool("odd", odd),
    ):
        with contextlib.suppress(ConfigurationError, FrameFormatError):
            call()


def test_programs_run_in_several_threads_at_once(tmp_path: Path) -> None:
    (program,) = programs(tmp_path, f"7: {{{SPOT}, read: {{codes: QRCode, seconds: 0}}}}").values()
    pictures = [board((10 + 5 * n, 20, 20, 10, 250)) for n in range(8)]
    alone = [program.inspect(one).payload() for one in pictures]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            assert [one.payload() for one in pool.map(program.inspect, pictures)] == alone


@pytest.mark.parametrize("name", ["Mono8", "YUYV", "RGB8", "MJPEG"])
async def test_frames_of_any_format_are_inspected(tmp_path: Path, name: str) -> None:
    pytest.importorskip("simplejpeg", reason="needs the extra frames")
    (program,) = programs(tmp_path, "7: {present: {grey: [0, 255]}}").values()
    async with frames.open(f"synthetic://?fps=200&format={name}") as source:
        frame = await source.newest()
    found = program.inspect(frame)
    assert found.value.area == 640 * 480
    assert found.picture.frame is frame
    assert found.drawn().shape == (480, 640, 3)
