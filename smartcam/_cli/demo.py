"""``smartcam demo``: connect to an emulated camera, switch, trigger, localize, step by step."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import smartcam
from smartcam._cli.texts import table_text
from smartcam.emulator import EmulatedCamera
from smartcam.models import ApplicationChanged, StatusChanged

if TYPE_CHECKING:
    from smartcam._cli.options import Options

STREAMED_COUNT = 10
TANGRAM_ID, COUNTER_ID, HELLO_ID = 7, 9, 21


@dataclass(eq=False)
class Steps:
    """Prints numbered steps and their details, as text or JSON lines."""

    _options: Options
    _number: int = 0

    def step(self, text: str, **values: Any) -> None:
        """Print the next step, with its number; ``values`` are added in JSON."""
        self._number += 1
        number = self._number
        self._options.show({"step": number, "text": text, **values}, f"\n{number}. {text}")

    def detail(self, text: str, **values: Any) -> None:
        """Print a detail of the step."""
        self._options.show({"text": text, **values}, text)


async def demo(options: Options) -> None:
    """Connect, switch while BUSY, trigger, localize, stream, disconnect."""
    steps = Steps(options)
    async with EmulatedCamera(seed=1) as emulator:
        steps.step(f"An emulated BVS002C listens on real TCP: {emulator.url}", url=emulator.url)
        interpret_as = {
            TANGRAM_ID: "localizations",
            COUNTER_ID: "n: int32",
            HELLO_ID: "text: string[20]",
        }
        async with smartcam.connect(
            emulator.url, name="demo", application=HELLO_ID, interpret_as=interpret_as
        ) as camera:
            steps.step(f"Connected, application {camera.active_application} runs: {camera.status}")
            await _switch(camera, steps)
            await _localize(camera, emulator, steps)
            await _stream(camera, steps)
            counts = camera.statistics()
        steps.step("Disconnected. The counts of all results that arrived:")
        steps.detail(
            f"   received {counts.received} = triggered {counts.triggered} + streamed "
            f"{counts.streamed} + unclaimed {counts.unclaimed} + late {counts.late} + wrong "
            f"application {counts.wrong_application} + uninterpretable {counts.uninterpretable}",
            statistics=counts,
        )


async def _switch(camera: smartcam.Camera, steps: Steps) -> None:
    loop = asyncio.get_running_loop()
    steps.step(
        f"Switch to application {TANGRAM_ID}. The camera must be stopped, is BUSY, then runs again:"
    )
    started_at = loop.time()
    events = camera.events()
    switching = asyncio.create_task(camera.switch_application(TANGRAM_ID))
    await camera.wait_status(lambda status: smartcam.Status.BUSY in status)
    # requested while the camera is BUSY: it waits until the camera accepts a trigger
    result = await camera.trigger()
    await switching
    while events.statistics().queued:
        event = await anext(events)
        match event:
            case StatusChanged(status=status):
                steps.detail(f"   status: {status}", status=status)
            case ApplicationChanged(application=application):
                steps.detail(f"   application {application} is active", application=application)
            case _:
                pass
    steps.detail(
        f"   ready {1e3 * (loop.time() - started_at):.0f} ms after the order, with a trigger that "
        f"was asked for while BUSY: {len(result.value)} parts"
    )


async def _localize(camera: smartcam.Camera, emulator: EmulatedCamera, steps: Steps) -> None:
    result = await camera.trigger(timeout=2.0)
    steps.step(
        f"Triggered: {len(result.value)} parts after {1e3 * (result.latency or 0):.0f} ms. "
        "Found beside their true poses (metres, degrees):"
    )
    truth = emulator.scene.pieces
    rows: list[tuple[object, ...]] = []
    for part in result.value:
        piece, position = truth[part.feature_id], part.pose.position
        measured, true = part.pose.orientation.theta, piece.theta
        distance = 1e3 * math.hypot(position.x - piece.x, position.y - piece.y)
        rows.append(
            (
                part.feature_id,
                position.x,
                position.y,
                math.degrees(measured),
                piece.x,
                piece.y,
                math.degrees(math.remainder(true, 2 * math.pi)),
                f"{distance:.2f} mm",
            )
        )
    head = ("part", "x", "y", "theta", "true x", "true y", "true theta", "off by")
    steps.detail(table_text(head, rows), result=result)


async def _stream(camera: smartcam.Camera, steps: Steps) -> None:
    steps.step(f"Application {COUNTER_ID} runs free: {STREAMED_COUNT} results as they come:")
    async with camera.application(COUNTER_ID):
        numbers: list[int] = []
        async with camera.results() as results, asyncio.timeout(10):
            async for result in results:
                numbers.append(result.value.n)
                if len(numbers) == STREAMED_COUNT:
                    break
    steps.detail(f"   {', '.join(map(str, numbers))}", numbers=numbers)
    steps.detail(f"   and back in application {camera.active_application}")
