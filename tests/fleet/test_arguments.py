"""Values from other programs on the bus are checked like users' values."""

from __future__ import annotations

import asyncio
from typing import Any

import smartcam
import smartcam.fleet
from smartcam import ConfigurationError
from smartcam.emulator import EmulatedCamera
from smartcam.fleet import FleetCamera

ODD: dict[str, Any] = {
    "1.5": 1.5,
    "-1": -1,
    "2**64": 1 << 64,
    "10**400": 10**400,
    "empty text": "",
    "text of a megabyte": "x" * 1_000_000,
    "list": [],
    "dict": {},
    "True": True,
    "None": None,
}
"""Values that JSON has, by their names."""

TRIGGER: dict[str, Any] = {"results": 1, "wait": True}

CALLS: dict[str, dict[str, tuple[dict[str, Any], set[str]]]] = {
    "switch_application": {"application": ({}, set())},
    "ensure_application": {"application": ({}, set())},
    "enter_application": {"application": ({}, set())},
    "leave_application": {"entered": ({}, {"2**64", "10**400"})},
    "set_clock": {"when": ({}, set())},
    "set_sequence_number": {"number": ({}, set())},
    "request": {
        "message_id": ({}, set()),
        "answered": ({"message_id": 0x30}, {"True", "None"}),
    },
    "trigger": {
        "application": (TRIGGER, {"None"}),
        "expected": (TRIGGER, {"None", "-1"}),
        "results": (TRIGGER, set()),
        "wait": (TRIGGER, {"True"}),
        "by_application": (TRIGGER, {"True", "None"}),
        "layouts": (TRIGGER, {"None", "empty text", "dict"}),
    },
    "frame": {
        "encoding": ({}, {"None", "empty text"}),
        "quality": ({"encoding": "jpeg"}, {"None"}),
        "max_age": ({}, {"None", "1.5", "2**64"}),
        "fresh": ({}, {"True", "None"}),
    },
    "results": {"first": ({}, {"2**64", "10**400"})},
    "find_first_result": {"since": ({}, {"1.5", "-1", "2**64"})},
    "release": {"reservation": ({}, {"2**64", "10**400"})},
}
"""Of each call its arguments; of each what is said beside it, and which odd values it takes."""


async def test_odd_arguments_over_the_bus_are_refused_and_nothing_is_sent() -> None:
    found: list[str] = []
    async with EmulatedCamera(active=21, running=True) as emulator:
        file = smartcam.fleet.FleetFile.model_validate(
            {"fleet": "plant", "cameras": {"cam": {"url": emulator.url}}}
        )
        async with smartcam.fleet.open(file) as fleet:
            camera: FleetCamera[Any] = fleet["cam"]
            await camera.wait_connected(60.0)
            sent, loop = len(emulator.log), asyncio.get_running_loop()
            for do, arguments in CALLS.items():
                for argument, (beside, good) in arguments.items():
                    for odd in ODD.keys() - good:
                        said = {**beside, argument: ODD[odd]}
                        try:
                            await camera._caller.call(do, loop.time() + 60.0, said)
                        except ConfigurationError:
                            continue
                        except Exception as exc:  # noqa: BLE001 - whatever it is is judged
                            found.append(f"{do}({argument}={odd}): {exc!r:.120}")
                        else:
                            found.append(f"{do}({argument}={odd}): done")
            assert found == []
            for timeout in (1e300, -1.0, True):
                with_timeout: Any = timeout
                try:
                    await camera._caller.call(
                        "query_status", loop.time() + 60.0, timeout=with_timeout
                    )
                except ConfigurationError:
                    continue
                found.append(f"timeout={timeout}")
            assert found == []
            assert len(emulator.log) == sent
            assert (await camera.trigger()).application == 21
