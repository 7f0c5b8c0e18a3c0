"""``connect(calibration=...)``: what a client gives is in the robot's frame, or an error."""

from __future__ import annotations

import asyncio
import dataclasses
import math
import struct
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any, ClassVar

import numpy as np
import pytest

import smartcam
from smartcam import (
    CalibrationError,
    ConfigurationError,
    InterpretationError,
    Layout,
    Localization,
    Observer,
    Result,
    WrongApplicationError,
)
from smartcam._client._inside import Interpretation
from smartcam.calibration import MovingCamera, PlaneCalibration, Transform, chain_of, fit_plane
from smartcam.emulator import EmulatedCamera, TablePose, TableScene
from smartcam.emulator._inside import PIECES
from smartcam.interpreters import Context, Reader
from smartcam.interpreters._inside import LocalizationsInterpreter
from smartcam.models import Calibration
from smartcam.registry import INTERPRETERS
from tests.client.clientkit import balance, by_hand, emulated, steps

CORNERS = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.2], [0.3, 0.2]])
TURN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The table stands upright: its x is the robot's y, its y the robot's z."""

SHIFT = np.array([0.5, -0.1, 0.2])
CALIBRATION = fit_plane(CORNERS, CORNERS @ TURN[:, :2].T + SHIFT, model="rigid")
SPATIAL = "x: real32, y: real32, z: real32"
LIFTED = {
    "id": 30,
    "layout": SPATIAL,
    "input": SPATIAL,
    "generator": "input",
    "load_time": 0.0,
    "processing_time": 0.0,
}
FREE = {
    "id": 32,
    "layout": "(x: real64, y: real64)*",
    "constant": [{"x": 0.1 * n, "y": 0.05} for n in range(3)],
    "rate": 50.0,
    "load_time": 0.0,
    "processing_time": 0.001,
}
PIXELS = (
    "localizations: (feature_id: string[50], quality: real32, photo_index: int32, "
    "x: real32 px, y: real32 px, theta: real32)*"
)
BOLT = struct.pack("<50sfifff", b"bolt", 0.5, 1, 0.25, -0.5, 1.0)
NUT = struct.pack("<50sfifff", b"nut", 1.0, 2, 0.125, 2.0, 3.0)
FAR = struct.pack("<50sfifff", b"far", 1.0, 2, 4.0, 0.0, 0.0)


def poses(parts: Iterable[Localization]) -> list[Any]:
    """Return all of them but the header, which has the time."""
    return [(*part[:3], *part.pose[1:]) for part in parts]


def place(x: float, y: float) -> Any:
    """Return where the robot finds a point of the table."""
    return pytest.approx((TURN[:, :2] @ [x, y] + SHIFT).tolist(), abs=1e-9)


class Nearby:
    """A calibration of ones own: refuses what is far, and fails where it shall."""

    def __init__(self, fails: object = None) -> None:
        self.fails = fails

    def to_robot(self, localizations: list[Localization], /) -> list[Localization]:
        if isinstance(self.fails, Exception):
            raise self.fails
        if self.fails is not None:
            return self.fails  # type: ignore[return-value]
        if any(part.pose.position.x > 1 for part in localizations):
            raise CalibrationError("too far", code="OUT_OF_FIELD", expected=1, got=4)
        return CALIBRATION.to_robot(localizations)


async def _tangram(calibration: Calibration | None, **options: Any) -> Result:
    """Return the first result of the emulator's table; the noise is the same each time."""
    async with (
        EmulatedCamera(active=7, seed=3) as emulator,
        smartcam.connect(
            emulator.url,
            name="cell",
            application=7,
            interpret_as="localizations",
            calibration=calibration,
            reconnect=None,
            **options,
        ) as camera,
    ):
        result = await camera.trigger()
        balance(camera.statistics())
        return result


# ---------------------------------------------------------------------- values


async def test_calibration_of_a_trigger_gives_the_same_bits_as_to_robot() -> None:
    seen, found = await _tangram(None), await _tangram(CALIBRATION)
    assert seen.raw == found.raw
    assert poses(found.value) == poses(CALIBRATION.to_robot(seen.value))
    header = found.value[0].pose.header
    assert (header.seq, header.stamp, header.frame_id) == (1, found.received_at, "robot")


async def test_calibration_puts_the_pieces_where_the_robot_finds_them() -> None:
    found = await _tangram(CALIBRATION)
    for part in found.value:
        true = PIECES[part.feature_id]
        expected = TURN[:, :2] @ [true.x, true.y] + SHIFT
        assert math.dist(part.pose.position, expected) < 5e-4


async def test_calibration_of_a_moving_camera_is_its_chain_for_the_present_pose() -> None:
    static = chain_of(CALIBRATION)
    here = Transform.from_quaternion("robot", "flange", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    there = Transform.from_quaternion("robot", "flange", [0.0, 0.1, 0.0], [0.0, 0.0, 0.0, 1.0])
    moving = MovingCamera(static, here, field=CALIBRATION.robot_points)
    still, moved = await _tangram(static), await _tangram(moving.at_pose(there))
    for one, other in zip(still.value, moved.value, strict=True):
        assert other.pose.position.y - one.pose.position.y == pytest.approx(0.1)


async def test_calibration_stands_behind_y_down() -> None:
    scene = TableScene(scale=2000.0, offset=(20.0, 700.0), rotation=0.3, pixel_noise=0, y_down=True)
    application = {"id": 31, "layout": PIXELS.partition(": ")[2], "generator": "tangram_pixels"}
    corners = [scene.to_pixels(TablePose(x, y, 0.0)) for x, y in CORNERS.tolist()]
    calibration = fit_plane(
        [(u, -v) for u, v, _ in corners],
        [(*corner, 0.0) for corner in CORNERS],
        tool_z=(0.0, 0.0, -1.0),
        camera_frame="cell",
        y_down=True,
    )
    async with EmulatedCamera([application], active=31) as emulator:
        emulator.device.scene = scene
        async with smartcam.connect(
            emulator.url,
            name="cell",
            application=31,
            interpret_as=PIXELS,
            y_down=True,
            calibration=calibration,
        ) as camera:
            for part in (await camera.trigger()).value:
                true = PIECES[part.feature_id]
                assert part.pose.position == pytest.approx((true.x, true.y, 0.0), abs=1e-6)
                turned = part.pose.orientation.theta - true.theta
                assert math.remainder(turned, math.tau) == pytest.approx(0.0, abs=1e-6)


async def test_calibration_of_an_empty_table_gives_no_poses() -> None:
    async with by_hand(interpret_as="localizations", calibration=Nearby()) as (box, camera):
        box.container = b""
        assert (await camera.trigger()).value == []


async def test_calibration_applies_to_the_interpreter_of_one_trigger() -> None:
    options: dict[str, Any] = {"interpret_as": "localizations", "calibration": CALIBRATION}
    async with by_hand(**options) as (box, camera):
        box.container = struct.pack("<ff", 0.25, 0.5)
        spec = "localizations: (x: real32, y: real32)*"
        (part,) = (await camera.trigger(interpret_as=spec)).value
        assert part.pose.position == place(0.25, 0.5)
        assert (await camera.trigger(interpret_as="raw")).value == box.container


async def test_calibration_goes_before_an_observer_sees_a_result() -> None:
    seen: list[Result] = []

    class Watch(Observer):
        def on_result(self, result: Result) -> None:
            seen.append(result)

    await _tangram(CALIBRATION, observers=[Watch()])
    assert {part.pose.header.frame_id for part in seen[0].value} == {"robot"}


# ---------------------------------------------------------------------- streams


async def test_calibration_of_a_stream_a_batch_and_a_single_wait_is_the_same() -> None:
    async with emulated(
        box={"applications": [FREE], "active": 32},
        interpret_as="localizations: (x: real64, y: real64)*",
        calibration=CALIBRATION,
    ) as (_, clock, camera):
        await camera.start()
        single, batch = camera.results(), camera.results(batch=True)
        waiting = asyncio.ensure_future(camera.next_result())
        await steps(1)
        clock.advance(1.0)
        results = [await anext(single) for _ in range(40)]
        expected = [place(0.0, 0.05), place(0.1, 0.05), place(0.2, 0.05)]
        for result in results:
            assert [part.pose.position for part in result.value] == expected
        assert await waiting in results
        assert (await anext(batch))[0] in results
        balance(camera.statistics())


async def test_calibration_keeps_a_burst_together() -> None:
    reads: list[int] = []

    class Counting(LocalizationsInterpreter):
        def read_all(self, containers: Sequence[bytes], context: Context) -> Sequence[object]:
            reads.append(len(containers))
            return super().read_all(containers, context)

    async with by_hand(interpret_as=Counting, calibration=Nearby()) as (box, camera):
        batch = camera.results(batch=True)
        box.send(box.result_frame(BOLT) * 3)
        results = await anext(batch)
        assert reads == [3]
        assert [part.feature_id for result in results for part in result.value] == ["bolt"] * 3
        assert [result.value[0].pose.header.seq for result in results] == [1, 2, 3]
        assert results[0].value[0].pose.position == place(0.25, -0.5)


async def test_calibration_that_refuses_one_of_a_burst_leaves_the_others() -> None:
    async with by_hand(interpret_as="localizations", calibration=Nearby()) as (box, camera):
        results = camera.results()
        box.send(box.result_frame(BOLT) + box.result_frame(FAR) + box.result_frame(NUT))
        assert (await anext(results)).value[0].feature_id == "bolt"
        with pytest.raises(InterpretationError, match=r"^calibration: too far$"):
            await anext(results)
        assert (await anext(results)).value[0].feature_id == "nut"
        statistics = camera.statistics()
        assert (statistics.streamed, statistics.uninterpretable) == (2, 1)
        balance(statistics)


# ---------------------------------------------------------------------- refusals


async def test_calibration_refuses_a_pose_out_of_the_plane_and_the_account_balances() -> None:
    async with (
        EmulatedCamera([LIFTED], active=30) as emulator,
        smartcam.connect(
            emulator.url,
            application=30,
            interpret_as=f"localizations: {SPATIAL}",
            calibration=CALIBRATION,
        ) as camera,
    ):
        flat = await camera.trigger(input=struct.pack("<3f", 0.25, 0.0, 0.0))
        assert flat.value[0].pose.position == place(0.25, 0.0)
        with pytest.raises(InterpretationError) as caught:
            await camera.trigger(input=struct.pack("<3f", 0.25, 0.0, 0.5))
        assert str(caught.value).startswith("calibration: expected a pose in the camera's plane")
        assert caught.value.got == 0.5
        assert isinstance(caught.value.__cause__, CalibrationError)
        assert caught.value.__cause__.code == "OUT_OF_PLANE"
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.uninterpretable) == (1, 1)
        balance(statistics)


async def test_calibration_for_another_camera_refuses_its_frame() -> None:
    calibration = dataclasses.replace(CALIBRATION, camera_frame="other cell")
    with pytest.raises(
        InterpretationError, match="in the frame 'other cell', got one in 'cell'"
    ) as caught:
        await _tangram(calibration)
    assert (caught.value.expected, caught.value.got) == ("other cell", "cell")
    ours = dataclasses.replace(CALIBRATION, camera_frame="cell")
    assert len((await _tangram(ours)).value) == 7


@pytest.mark.parametrize(
    ("fails", "text"),
    [
        (KeyError("tool"), "the calibration failed with KeyError: 'tool'"),
        ("poses", "calibration: expected to_robot to return 1 localizations, got str"),
        ([], "calibration: expected to_robot to return 1 localizations, got 0"),
        ([1], "calibration: expected to_robot to return 1 localizations, got list"),
    ],
)
async def test_calibration_of_ones_own_that_fails_is_an_outcome(fails: object, text: str) -> None:
    async with by_hand(interpret_as="localizations", calibration=Nearby(fails)) as (box, camera):
        box.container = BOLT
        with pytest.raises(InterpretationError) as caught:
            await camera.trigger()
        assert str(caught.value) == text
        assert camera.connected
        assert camera.statistics().uninterpretable == 1


@pytest.mark.parametrize(
    ("spec", "kind"),
    [
        (lambda reader: reader.get_real32(0), "float"),
        (lambda _: ["a", "b"], "list"),
        (lambda _: None, "NoneType"),
    ],
)
async def test_calibration_of_no_localizations_never_gives_the_value(spec: Any, kind: str) -> None:
    async with by_hand(interpret_as=spec, calibration=CALIBRATION) as (box, camera):
        box.container = bytes(4)
        with pytest.raises(InterpretationError) as caught:
            await camera.trigger()
        assert str(caught.value) == (
            f"calibration: expected a list of localizations of application 7, got {kind}"
        )


# ---------------------------------------------------------------------- options


@pytest.mark.parametrize(
    "spec", [None, "raw", "x: real32, y: real32", "table: x: int8", "strings50"]
)
def test_calibration_with_values_that_never_are_localizations_is_refused(spec: Any) -> None:
    with pytest.raises(ConfigurationError, match="expected results to be localizations") as caught:
        smartcam.connect("bvs://h", interpret_as=spec, calibration=CALIBRATION)
    assert "interpret_as='localizations'" in str(caught.value)


async def test_calibration_takes_an_interpreter_made_from_a_built_in_one() -> None:
    record: Any = INTERPRETERS.load("record")

    class Parts(record):  # type: ignore[misc]
        def interpret(self, reader: Reader) -> object:
            return LocalizationsInterpreter().read(reader.data, reader.context)

    spec = Parts(Layout("n: int8"))
    async with by_hand(interpret_as=spec, calibration=CALIBRATION) as (box, camera):
        box.container = BOLT
        (part,) = (await camera.trigger()).value
        assert part.pose.header.frame_id == "robot"


class Waits:
    """A calibration that would wait."""

    async def to_robot(self, localizations: list[Localization]) -> list[Localization]:
        return localizations


@pytest.mark.parametrize("given", ["table.json", 7, PlaneCalibration, Waits(), {7: "table.json"}])
def test_calibration_that_is_none_is_refused(given: Any) -> None:
    with pytest.raises(ConfigurationError, match=r"expected an object with a method to_robot\("):
        smartcam.connect("bvs://h", interpret_as="localizations", calibration=given)


def test_calibration_mapping_from_something_else_is_refused() -> None:
    given: Any = {"7": CALIBRATION}
    with pytest.raises(ConfigurationError, match=r"^calibration: application: expected an integer"):
        smartcam.connect("bvs://h", interpret_as="localizations", calibration=given)


# ---------------------------------------------------------------------- mappings


async def test_calibration_mapping_takes_the_one_of_the_results_application() -> None:
    second = dataclasses.replace(CALIBRATION, robot_frame="second robot")
    async with by_hand(
        interpret_as={7: "localizations", 3: "localizations", 1: "raw"},
        calibration={7: CALIBRATION, 3: second, 1: None},
    ) as (box, camera):
        box.container = BOLT
        found = [(await camera.trigger(application)).value for application in (None, 3, 1)]
        assert [parts[0].pose.header.frame_id for parts in found[:2]] == ["robot", "second robot"]
        assert found[2] == BOLT


async def test_calibration_is_for_all_applications_of_a_mapping() -> None:
    specs = {7: "localizations", 3: "localizations: (x: real32, y: real32)*"}
    async with by_hand(interpret_as=specs, calibration=CALIBRATION) as (box, camera):
        box.container = BOLT
        assert (await camera.trigger()).value[0].pose.position == place(0.25, -0.5)
        box.container = struct.pack("<ff", 0.25, 0.5)
        assert (await camera.trigger(3)).value[0].pose.position == place(0.25, 0.5)


async def test_calibration_mapping_that_lacks_the_application_raises() -> None:
    calibrations = {3: CALIBRATION, 1: None}
    async with by_hand(interpret_as="localizations", calibration=calibrations) as (box, camera):
        box.container = BOLT
        with pytest.raises(
            WrongApplicationError, match=r"result of application 7 came; calibration knows \[1, 3\]"
        ) as caught:
            await camera.trigger()
        assert (caught.value.expected, caught.value.got) == ([1, 3], 7)
        assert camera.statistics().uninterpretable == 1


@pytest.mark.parametrize(
    ("calibration", "text"),
    [
        (CALIBRATION, "expected results of application 5 to be localizations, .* 'record'"),
        ({7: CALIBRATION, 5: CALIBRATION}, "expected results of application 5 to be localizations"),
        (
            {7: CALIBRATION},
            r"expected a calibration of application 5, or None .* the mapping has \[7\]",
        ),
    ],
)
def test_calibration_that_does_not_go_with_the_interpreters_is_refused(
    calibration: Any, text: str
) -> None:
    specs = {7: "localizations", 5: "x: real32"}
    with pytest.raises(ConfigurationError, match=f"^calibration: {text}"):
        smartcam.connect("bvs://h", interpret_as=specs, calibration=calibration)


async def test_calibration_is_not_for_what_another_trigger_reads() -> None:
    options: dict[str, Any] = {"interpret_as": "localizations", "calibration": {7: CALIBRATION}}
    async with by_hand(**options) as (box, camera):
        box.container = b"bolt".ljust(50, b"\0")
        assert (await camera.trigger(interpret_as="strings50")).value == ["bolt"]
        assert (await camera.trigger(interpret_as="raw")).value == box.container
        box.container = BOLT
        for spec in (None, "localizations"):
            (part,) = (await camera.trigger(interpret_as=spec)).value
            assert part.pose.header.frame_id == "robot"
        box.container = bytes(4)
        with pytest.raises(InterpretationError, match="expected 50 bytes"):
            await camera.trigger()


_PLACES = CORNERS @ TURN[:, :2].T + SHIFT
_HERE = Transform.from_quaternion("robot", "flange", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize("y_down", [True, False])
@pytest.mark.parametrize(
    "make",
    [
        lambda one: one,
        lambda one: {5: None, 7: one},
        chain_of,
        lambda one: MovingCamera(chain_of(one), _HERE, field=one.robot_points).at_pose(_HERE),
    ],
)
def test_calibration_made_with_the_other_y_down_is_refused(make: Any, y_down: bool) -> None:
    calibration = make(fit_plane(CORNERS, _PLACES, y_down=y_down))
    options: dict[str, Any] = {"interpret_as": "localizations", "calibration": calibration}
    with pytest.raises(
        ConfigurationError,
        match=f"^calibration: it was made with y_down={y_down}, .* expected y_down={y_down}$",
    ):
        smartcam.connect("bvs://h", y_down=not y_down, **options)
    assert smartcam.connect("bvs://h", y_down=y_down, **options).settings.y_down is y_down


@pytest.mark.parametrize("calibration", [Nearby(), CALIBRATION])
@pytest.mark.parametrize("y_down", [True, False])
def test_calibration_that_does_not_know_its_y_down_is_taken(
    calibration: Calibration, y_down: bool
) -> None:
    camera = smartcam.connect(
        "bvs://h", interpret_as="localizations", calibration=calibration, y_down=y_down
    )
    assert camera.settings.calibration is calibration


# ---------------------------------------------------------------------- cost


class Kept(LocalizationsInterpreter):
    """Gives the same list for each burst."""

    values: ClassVar[list[list[Localization]]] = [[], []]

    def read_all(self, containers: Sequence[bytes], context: Context) -> Sequence[object]:
        return self.values


def test_interpretation_without_calibration_gives_a_burst_as_it_was_read() -> None:
    plain = Interpretation(Kept, lenient=False, y_down=False)
    noon = datetime(2026, 3, 4, 12, tzinfo=UTC)
    read = plain.burst(7, [BOLT, NUT], 0, camera="cell", number=1, at=noon)
    assert read is not None
    assert read[0] is Kept.values
