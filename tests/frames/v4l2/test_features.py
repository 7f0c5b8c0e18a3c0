"""Controls are features with SFNC's names and units, or else the device's own."""

from dataclasses import replace
from typing import Any, cast

import pytest

import smartcam.frames
from smartcam.exceptions import FrameSourceError
from smartcam.frames import DeviceFeatures, Feature
from tests.frames.v4l2 import scenarios
from tests.frames.v4l2.scenarios import DeviceControl, V4L2Driver, abi
from tests.frames.v4l2.test_driver import Player, begin, play  # noqa: F401 - a fixture

WEBCAM = [
    DeviceControl("brightness", 0x00980900, "integer", -64, 64, 1, 0, 3),
    DeviceControl("white_balance_automatic", 0x0098090C, "boolean", 0, 1, 1, 1, 1),
    DeviceControl("gain", 0x00980913, "integer", 0, 100, 5, 0, 10),
    DeviceControl("power_line_frequency", 0x00980918, "menu", 0, 2, 1, 1, 1,
                  {0: "Disabled", 1: "50 Hz", 2: "60 Hz"}),
    DeviceControl("auto_exposure", 0x009A0901, "menu", 0, 3, 1, 3, 3,
                  {1: "Manual Mode", 3: "Aperture Priority Mode"}),
    DeviceControl("exposure_time_absolute", 0x009A0902, "integer", 1, 5000, 1, 157, 157, {},
                  abi.CTRL_INACTIVE),
    DeviceControl("pan_reset", 0x009A0906, "button", 0, 0, 0, 0, None, {}, abi.CTRL_WRITE_ONLY),
    DeviceControl("temperature", 0x00F0F000, "integer", 0, 90, 1, 0, 41, {}, abi.CTRL_READ_ONLY),
]  # fmt: skip


class Webcam:
    """A device with the controls of a common webcam, which accepts the same values as a driver."""

    name = "webcam"

    def __init__(self) -> None:
        self.has = {one.name: one for one in WEBCAM}
        self.pressed: list[str] = []

    async def controls(self) -> dict[str, DeviceControl]:
        return dict(self.has)

    async def set_control(self, name: str, value: int | str) -> int:
        control = self.has[name]
        number = control.parse_value(value)
        assert number is not None
        if control.kind == "button":
            self.pressed.append(name)
        else:
            self.has[name] = replace(control, value=number)
        return number


@pytest.fixture
def webcam() -> Webcam:
    return Webcam()


@pytest.fixture
def features(webcam: Webcam) -> DeviceFeatures:
    made: DeviceFeatures = cast("Any", V4L2Driver).features.fget(webcam)
    return made


async def test_controls_that_sfnc_knows_have_its_names_and_units(features: DeviceFeatures) -> None:
    assert await features.names() == [
        "brightness", "BalanceWhiteAuto", "Gain", "power_line_frequency", "ExposureAuto",
        "ExposureTime", "pan_reset", "temperature",
    ]  # fmt: skip
    assert await features.describe("exposure_time") == Feature(
        name="ExposureTime",
        kind="float",
        access="rw",
        value=15700.0,
        minimum=100,
        maximum=500_000,
        step=100,
        unit="us",
        description="V4L2 control exposure_time_absolute",
    )
    exposure = await features.describe("ExposureAuto")
    assert (exposure.kind, exposure.value, exposure.entries) == (
        "enumeration", "Continuous", ("Off", "Continuous"),
    )  # fmt: skip
    assert (await features.describe("temperature")).access == "ro"
    assert str(await features.describe("Gain")) == "Gain = 10 (0 to 100 in steps of 5)"


@pytest.mark.parametrize(
    ("name", "value", "control", "number", "has"),
    [
        ("ExposureTime", 20_000, "exposure_time_absolute", 200, 20_000.0),
        ("ExposureTime", 20_040.0, "exposure_time_absolute", 200, 20_000.0),
        ("exposure_time_absolute", "500", "exposure_time_absolute", 5, 500.0),
        ("ExposureAuto", "Off", "auto_exposure", 1, "Off"),
        ("auto_exposure", "Continuous", "auto_exposure", 3, "Continuous"),
        ("BalanceWhiteAuto", "off", "white_balance_automatic", 0, "Off"),
        ("Gain", 15.0, "gain", 15, 15),
        ("PowerLineFrequency", "60 Hz", "power_line_frequency", 2, "60 Hz"),
        ("Brightness", "-3", "brightness", -3, -3),
    ],
)
async def test_values_are_the_controls_numbers(
    features: DeviceFeatures,
    webcam: Webcam,
    name: str,
    value: Any,
    control: str,
    number: int,
    has: Any,
) -> None:
    assert await features.set(name, value) == has
    assert webcam.has[control].value == number
    assert await features.get(name) == has


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("ExposureTime", 600_000, "expected 100 to 500000 us in steps of 100, got 600000"),
        ("ExposureTime", "long", "got 'long'"),
        ("ExposureAuto", "Once", "expected Off, Continuous, got 'Once'"),
        ("Gain", 12, "expected 0 to 100 in steps of 5, got 12"),
        ("Gain", 12.5, "expected 0 to 100"),
        ("pan_reset", 1, "it is a command"),
        ("Gian", 1, "did you mean 'Gain'"),
    ],
)
async def test_values_that_the_device_refuses_are_errors(
    features: DeviceFeatures, webcam: Webcam, name: str, value: Any, text: str
) -> None:
    with pytest.raises(FrameSourceError) as caught:
        await features.set(name, value)
    assert text in str(caught.value)
    assert webcam.has == {one.name: one for one in WEBCAM}


async def test_buttons_are_commands(features: DeviceFeatures, webcam: Webcam) -> None:
    await features.execute("pan_reset")
    assert webcam.pressed == ["pan_reset"]
    with pytest.raises(FrameSourceError, match="it is no command"):
        await features.execute("Gain")
    with pytest.raises(FrameSourceError, match="no value that can be read"):
        await features.get("pan_reset")


async def test_vivids_controls_are_features(play: Player) -> None:  # noqa: F811
    play("controls")
    async with smartcam.frames.open(scenarios.URL) as source:
        features = await source.features.describe()
    assert features["Gain"].kind == "integer"
    assert features["GainAuto"].entries == ("Off", "Continuous")
    assert features["ReverseX"].value is False
    assert features["menu"].entries == ("Menu Item 1", "Menu Item 3", "Menu Item 4")
    assert features["brightness"].maximum == 255
    assert features["button"].kind == "command"
