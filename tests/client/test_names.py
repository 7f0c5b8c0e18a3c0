"""Applications by their names, beside their numbers."""

from __future__ import annotations

from typing import Any

import pytest

import smartcam
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError, UnsupportedError

NAMES = {"bolts": 5, "nuts": 7}
APPLICATIONS = [
    {"id": one, "layout": "n: int32", "generator": "sequence", "processing_time": 0.0}
    for one in NAMES.values()
]


def options(**given: Any) -> Any:
    return {"application_names": NAMES, "interpret_as": "n: int32", **given}


@pytest.mark.asyncio
async def test_name_stands_wherever_an_id_may() -> None:
    async with EmulatedCamera(APPLICATIONS) as emulator:
        each = {"bolts": "n: int32", 7: "m: int32"}
        given = options(application="bolts", interpret_as=each)
        async with smartcam.connect(emulator.url, **given) as camera:
            result = await camera.trigger()
            assert (result.application, result.value._fields) == (5, ("n",))
            await camera.switch_application("nuts")
            assert camera.active_application == 7
            assert (await camera.trigger()).value._fields == ("m",)
            async with camera.application("bolts"):
                assert camera.active_application == 5
            assert (await camera.trigger("bolts")).application == 5
            assert camera.active_application == 7


@pytest.mark.parametrize(
    "given", [{"application": "bolt"}, {"interpret_as": {"bolt": "n: int32"}}], ids=str
)
def test_unknown_name_is_a_mistake_that_names_the_known_ones(given: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=r"bolts, nuts.*bolts"):
        smartcam.connect("bvs://camera", **options(**given))


def test_name_of_no_id_is_a_mistake() -> None:
    with pytest.raises(ConfigurationError, match="application_names"):
        smartcam.connect("bvs://camera", application_names={"bolts": -1})


@pytest.mark.asyncio
async def test_name_that_is_not_known_may_be_a_files_only() -> None:
    async with (
        EmulatedCamera(APPLICATIONS) as emulator,
        smartcam.connect(emulator.url, **options(application=5)) as camera,
    ):
        with pytest.raises(UnsupportedError, match="LoadFile"):
            await camera.switch_application("screws.job")
        with pytest.raises(ConfigurationError, match="screws"):
            await camera.trigger("screws")
        assert (await camera.trigger()).application == 5
