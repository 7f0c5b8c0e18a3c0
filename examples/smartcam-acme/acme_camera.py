"""The Acme camera, and an emulated one."""

import itertools
from collections.abc import Iterable
from typing import Any

from smartcam.emulator import LineCamera
from smartcam.models import Status
from smartcam.protocols import LineDialect, LineMachine, LineRow, Protocol, Transport
from smartcam.protocols import messages as m

RUNNING = Status.RUNNING | Status.WAITING_FOR_TRIGGER
GREETING = {"ACME": m.ConnectAnswer(version=1)}
STATES = {"run": m.StatusReport(status=RUNNING), "stop": m.StatusReport(status=Status(0))}


def program(line: str) -> m.QueryAnswer:
    """Return the id of the application."""
    return m.QueryAnswer(application=int(line))


def measured(line: str) -> m.ResultContainer:
    """Return the result of a trigger: each word is a cell, a value with a name."""
    cells = tuple(m.CellValue(str(i), text) for i, text in enumerate(line.split()))
    return m.ResultContainer(data=line.encode(), cells=cells)


LINES = LineDialect(
    name="lines",
    about="lines of text",
    source="this page",
    ids=range(1, 100),
    rows=(
        LineRow(m.Connect, "HELLO", m.ConnectAnswer, GREETING.__getitem__),
        LineRow(m.GetStatus, "STATE", m.StatusReport, STATES.__getitem__),
        LineRow(m.Query, "PROGRAM", m.QueryAnswer, program),
        LineRow(m.Trigger, "TRIGGER", m.ResultContainer, measured),
    ),
)

ACME = Protocol(
    name="acme",
    schemes={"acme": Transport.TCP},
    default_port=4711,
    models=("ACME1",),
    dialects={"lines": LINES},
    machine=LineMachine,
    emulator="acme_camera:AcmeCamera",
)


class AcmeCamera(LineCamera):
    """An Acme camera that measures the same parts over and over."""

    protocol = ACME

    def __init__(self, *, parts: Iterable[str] = ("12.5 bolt",), **options: Any) -> None:
        super().__init__(**options)
        self.says = {"HELLO": "ACME", "STATE": "run", "PROGRAM": "7"}
        self.parts = itertools.cycle(parts)

    def answer(self, line: str) -> str:
        """Return the answer to a line."""
        return next(self.parts) if line == "TRIGGER" else self.says.get(line, "what?")
