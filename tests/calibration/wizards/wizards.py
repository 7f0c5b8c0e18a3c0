"""A small wizard for tests of sequences, which as a program reads its standard input."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from smartcam.calibration.wizards import (
    Flag,
    Number,
    Option,
    Step,
    Text,
    Wizard,
    WizardSession,
    ask,
)
from smartcam.exceptions import CalibrationError
from tests.calibration.inside import Journal

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping


NAME = Step(
    id="name",
    title="Name",
    inputs=(
        Text(name="name", label="Name", pattern="[a-z]+", expected="small letters"),
        Option(name="unit", label="Unit", options={"mm": "millimetres", "m": "metres"}),
        Flag(name="fixed", label="Fixed", default=True),
    ),
)
PICTURE = Step(id="picture", title="Picture", button="Trigger", timeout=60.0)
MORE = Step(
    id="more",
    title="More",
    inputs=(Number(name="count", label="How many", integer=True, minimum=0, maximum=3),),
)


def survey(trigger: Callable[[Any], Awaitable[Any]]) -> Wizard:
    """Return a wizard that asks for a name, takes a picture, and asks for some numbers."""

    async def script(parameters: Mapping[str, Any]) -> Any:
        name = await ask(NAME)
        picture = await ask(PICTURE, trigger)
        count = (await ask(MORE))["count"]
        values: list[float] = []
        for index in range(count):
            step = Step(
                id=f"value-{index}",
                title=f"Value {index + 1} of {count}",
                inputs=(Number(name="value", label="Value", unit="mm"),),
            )
            value = (await ask(step))["value"]
            if value in values:
                raise CalibrationError(f"{value:g} came before", code="COINCIDENT")
            values.append(value)
        return {**parameters, **name, "picture": picture.outcome, "values": values}

    return Wizard(name="survey", version=1, script=script)


class Trigger:
    """An action that counts its calls, and raises the first of ``errors``."""

    def __init__(self, *errors: BaseException) -> None:
        self.count = 0
        self.errors = list(errors)

    async def __call__(self, answers: Mapping[str, Any]) -> Any:
        self.count += 1
        if self.errors:
            raise self.errors.pop(0)
        return {"shot": self.count, "at": (0.1, 1e-05)}


ANSWERS: list[dict[str, Any]] = [
    {"name": "bench"},
    {},
    {"count": 2},
    {"value": 1.5},
    {"value": 2.5},
]
"""An answer for each step of the survey."""


async def answer_all(
    session: WizardSession, answers: list[dict[str, Any]] = ANSWERS, until: int | None = None
) -> dict[str, Any]:
    """Answer from the current step on, as a front-end does; return the last view."""
    view = session.current
    for one in answers[view["number"] - 1 : until]:
        view = await session.submit(view["token"], one)
        assert view["errors"] == {}
    return view


async def _main(path: Path) -> None:
    """Resume the journal; each line of stdin is an answer, each line of stdout the next step."""
    trigger = Trigger()
    session = WizardSession(survey(trigger), Journal(path))
    read: Callable[[], str] = sys.stdin.readline
    view = session.current
    while True:
        say = {"number": view["number"], "type": view["type"], "triggers": trigger.count}
        sys.stdout.write(json.dumps(say) + "\n")
        sys.stdout.flush()
        line = read()
        if not line:
            break
        work: Awaitable[dict[str, Any]] = session.submit(session.token, json.loads(line))
        view = await work
    session.close()


if __name__ == "__main__":
    asyncio.run(_main(Path(sys.argv[1])))
