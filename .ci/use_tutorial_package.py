"""Use the tutorial's interpreter package, installed beside smartcam, for a real trigger."""

import asyncio

import smartcam
from smartcam.emulator import EmulatedCamera

LAYOUT = "(name: string[10], weight: real32)*"
VALUES = [{"name": "bolt", "weight": 12.5}, {"name": "nut", "weight": 4.25}]


async def main() -> None:
    application = {"id": 5, "layout": LAYOUT, "constant": VALUES, "load_time": 0.01}
    async with (
        EmulatedCamera(applications=[application]) as emulator,
        smartcam.connect(emulator.url, application=5, interpret_as="weights") as camera,
    ):
        result = await camera.trigger()
    expected = {"bolt": 12.5, "nut": 4.25}
    if result.value != expected:
        raise SystemExit(f"expected {expected}, got {result.value}")
    print("the tutorial's interpreter gave", result.value)


asyncio.run(main())
