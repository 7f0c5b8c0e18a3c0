"""The controls of a frames' device as parameters of the camera's node."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import pytest

import smartcam
import smartcam.frames
from smartcam.exceptions import FrameSourceError, ServiceCallError
from smartcam.ros2 import CameraNode, CameraNodeOptions, Node
from tests.frames.gige import camera as cameras
from tests.frames.gige.camera import camera
from tests.processes import free_place
from tests.ros2.nodekit import FAST, NAME, box
from tests.ros2.roskit import until

pytestmark = pytest.mark.real_time


def control(name: str, kind: str, value: int | None, **more: Any) -> Any:
    known = {"least": 0, "most": 255, "step": 1, "range": f"what {name} takes"}
    return SimpleNamespace(name=name, kind=kind, value=value, **{**known, **more})


class Device:
    """A driver with controls, as that of V4L2 has them."""

    def __init__(self) -> None:
        made = [
            control("brightness", "integer", 10, step=5),
            control("auto_exposure", "boolean", 1, most=1),
            control("push", "button", None),
            control("write_only", "integer", None),
            control("use_sim_time", "integer", 1),
            control("odd", "integer", 300),
            control("test_pattern", "menu", 2, most=3),
        ]
        self.known = {one.name: one for one in made}
        self.sets: list[tuple[str, int]] = []

    async def controls(self) -> dict[str, Any]:
        return self.known

    async def set_control(self, name: str, value: int) -> int:
        self.sets.append((name, value))
        if name == "test_pattern" and value > 3:
            raise FrameSourceError("test_pattern: 0 to 3", source="device")
        return min(value, 200)


@contextlib.asynccontextmanager
async def nodes(source: Any) -> AsyncIterator[tuple[CameraNode, Node]]:
    """Give a camera's node, and another one."""
    place, options = free_place(), CameraNodeOptions(get_frame_source=source)
    async with (
        Node("viewer", listen=place, domain=7) as viewer,
        box() as emulated,
        smartcam.connect(emulated.url, name=NAME, reconnect=FAST) as camera,
        CameraNode(
            camera, Node("cam3", namespace="line1", connect=place, domain=7), options=options
        ) as made,
    ):
        yield made, viewer


async def test_controls_are_parameters_that_set_the_device() -> None:
    device = Device()

    async def source() -> Any:
        return SimpleNamespace(driver=device)

    async with nodes(source) as (made, there), there.parameters_of("/line1/cam3") as client:
        here = made.node
        await until(lambda: "test_pattern" in here.parameters.names())
        names = ["brightness", "auto_exposure", "test_pattern"]
        found = await client.get(*names)
        assert found == {"brightness": 10, "auto_exposure": True, "test_pattern": 2}
        assert not {"push", "write_only", "odd"} & {*here.parameters.names()}
        assert here.parameters.describe("brightness").description == "what brightness takes"
        await client.set(brightness=25, auto_exposure=False)
        assert device.sets == [("brightness", 25), ("auto_exposure", 0)]
        for name, value, text in (
            ("brightness", 26, "26"),
            ("brightness", 255, "the device has 200"),
            ("test_pattern", 7, "0 to 3"),
        ):
            with pytest.raises(ServiceCallError, match=text):
                await client.set(**{name: value})
        assert here.parameters.get("test_pattern") == 2
        await made.stop()
        assert not {*names} & {*here.parameters.names()}
        assert here.parameters.get("use_sim_time") is False


async def test_features_of_a_gige_camera_are_parameters() -> None:
    async with (
        camera() as there,
        smartcam.frames.open(f"gige://127.0.0.1:{there.port}?packet_size=576") as device,
    ):

        async def source() -> Any:
            return device

        async with nodes(source) as (made, viewer), viewer.parameters_of("/line1/cam3") as client:
            here = made.node.parameters
            await until(lambda: "user_set_default" in here.names())
            assert await client.get("exposure_time", "reverse_x", "width", "trigger_mode") == {
                "exposure_time": 1000.0,
                "reverse_x": False,
                "width": 64,
                "trigger_mode": "Off",
            }
            assert here.describe("trigger_mode").description == "TriggerMode: Off, On."
            assert not {"gain", "trigger_software", "payload_size"} & {*here.names()}
            await client.set(exposure_time=2500.0, trigger_mode="On", width=128)
            assert await device.features["ExposureTime"].get() == 2500.0
            assert there.words[cameras.TRIGGERS] == 1
            assert device.format.width == 128
            await client.set(black_level=1.23)
            await until(lambda: here.get("black_level") == 1.2)
            for name, value, text in (
                ("width", 100, "in steps of 8, got 100"),
                ("trigger_mode", "Maybe", "expected Off, On, got 'Maybe'"),
            ):
                with pytest.raises(ServiceCallError, match=text):
                    await client.set(**{name: value})
            assert here.get("width") == 128


async def test_a_device_without_controls_or_away_gives_none(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with smartcam.frames.open("synthetic://") as synthetic:

        async def plain() -> Any:
            return synthetic

        async def away() -> Any:
            raise FrameSourceError("/dev/video7: it is not there", source="device")

        for source in (away, plain):
            async with nodes(source) as (made, _):
                await until(lambda: "it is not there" in caplog.text)
                assert "brightness" not in made.node.parameters.names()
