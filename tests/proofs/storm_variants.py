"""The kinds of storm, and the cameras for them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from storm_camera import CONTAINER, EXTERNAL, FIELDS, Habits, Sent, StormCamera

from smartcam.emulator import Application, EmulatedCamera
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from random import Random

    from smartcam.emulator import Run
    from smartcam.emulator.links import Link

__all__ = ["PATIENCE", "VARIANTS", "Camera", "Variant", "make_camera"]

PATIENCE = (0.005, 0.02)
"""Shortest and longest timeout of a trigger, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """One kind of storm.

    Attributes:
        name: in the table.
        promised: no result may be another trigger's; else they are counted and shown.
        exact: each container's fate is known beforehand, so the counts must agree.
        share: of the calls that it gets: some take their time.
        mark: of the layout's number: ``" @sequence"`` or nothing.
        narrow: the number has 8 bits only.
        results: asked for per trigger.
        order: of an emulator, whose quirk it is; None is the camera made by hand.
        pushed: of an emulator with ``bid``: a status comes with every change, too.
    """

    name: str
    promised: bool = True
    exact: bool = True
    share: float = 1.0
    transport: Literal["tcp", "udp"] = "tcp"
    dialect: str = "handbook"
    mark: Literal["", " @sequence"] = ""
    narrow: bool = False
    results: int | None = None
    habits: Habits = field(default_factory=Habits)
    order: Literal["result first", "waiting first"] | None = None
    pushed: bool = False

    @property
    def layout(self) -> str:
        """What the client is told of the container."""
        text = FIELDS.format(mark=self.mark)
        if self.narrow:
            text = text.replace("int32 @sequence", "uint8 @sequence, above: uint8, more: uint16")
        return text


NUMBERED: Literal[" @sequence"] = " @sequence"
HELD = Habits(held=0.3)
TIDY = Habits(waiting_first=0.0)
"""It waits for a trigger again when it has sent everything: what ``bid`` rests on."""

VARIANTS = (
    Variant(
        name="tcp extra slow link",
        exact=False,
        share=0.4,
        # shorter pauses than a trigger's way: the second container always comes before it counts
        habits=Habits(second=0.5, second_apart=True, longest_pause=0.0015, latency=0.002),
    ),
    Variant(name="tcp slow link", share=0.4, habits=Habits(latency=0.002)),
    Variant(name="tcp"),
    Variant(name="tcp thesis", dialect="thesis"),
    Variant(name="tcp number", mark=NUMBERED),
    Variant(name="tcp number thesis", mark=NUMBERED, dialect="thesis"),
    Variant(name="tcp number of 8 bits", mark=NUMBERED, narrow=True),
    Variant(name="udp number", mark=NUMBERED, transport="udp"),
    Variant(name="udp number thesis", mark=NUMBERED, transport="udp", dialect="thesis"),
    Variant(name="udp number held", mark=NUMBERED, transport="udp", habits=Habits(held=0.3)),
    Variant(name="tcp input", habits=Habits(reads_input=True)),
    Variant(
        name="udp input number", transport="udp", mark=NUMBERED, habits=Habits(reads_input=True)
    ),
    Variant(name="tcp extra", exact=False, habits=Habits(second=0.3)),
    Variant(
        name="tcp extra number",
        exact=False,
        mark=NUMBERED,
        habits=Habits(second=0.3, second_apart=True),
    ),
    Variant(name="tcp two results", exact=False, results=2, habits=Habits(second=0.9)),
    Variant(
        name="tcp two results number",
        exact=False,
        results=2,
        mark=NUMBERED,
        habits=Habits(second=0.9, second_apart=True),
    ),
    Variant(name="tcp external number", exact=False, mark=NUMBERED, habits=Habits(external=3.0)),
    Variant(
        name="udp external number",
        exact=False,
        mark=NUMBERED,
        transport="udp",
        habits=Habits(external=3.0, held=0.1),
    ),
    Variant(name="emulator", order="result first"),
    Variant(name="emulator waiting first", order="waiting first"),
    Variant(name="emulator number", mark=NUMBERED, order="waiting first"),
    Variant(name="emulator udp number", mark=NUMBERED, order="result first", transport="udp"),
    Variant(name="tcp b16", dialect="b16"),
    Variant(name="tcp b16 number", dialect="b16", mark=NUMBERED),
    Variant(name="udp b16 number held", dialect="b16", mark=NUMBERED, transport="udp", habits=HELD),
    Variant(name="tcp bid", dialect="bid", share=0.4, habits=TIDY),
    Variant(
        name="tcp bid slow link",
        dialect="bid",
        share=0.4,
        habits=replace(TIDY, latency=0.002),
    ),
    Variant(name="tcp bid input", dialect="bid", share=0.4, habits=replace(TIDY, reads_input=True)),
    Variant(
        name="tcp bid extra",
        dialect="bid",
        share=0.4,
        exact=False,
        habits=replace(TIDY, second=0.3, second_apart=True),
    ),
    Variant(
        name="tcp bid two results",
        dialect="bid",
        share=0.4,
        exact=False,
        results=2,
        habits=replace(TIDY, second=0.9, second_apart=True),
    ),
    Variant(name="emulator bid", dialect="bid", order="result first"),
    Variant(name="emulator bid pushed", dialect="bid", order="waiting first", pushed=True),
    Variant(
        name="best effort: udp bid",
        dialect="bid",
        promised=False,
        exact=False,
        transport="udp",
        habits=TIDY,
    ),
    Variant(
        name="best effort: udp bid held",
        dialect="bid",
        promised=False,
        exact=False,
        transport="udp",
        habits=replace(TIDY, held=0.3),
    ),
    Variant(
        name="best effort: tcp bid external",
        dialect="bid",
        promised=False,
        exact=False,
        habits=replace(TIDY, external=3.0),
    ),
    Variant(name="best effort: tcp bid waiting first", dialect="bid", promised=False, exact=False),
    Variant(name="best effort: udp", promised=False, exact=False, transport="udp"),
    Variant(
        name="best effort: udp held",
        promised=False,
        exact=False,
        transport="udp",
        habits=Habits(held=0.3),
    ),
    Variant(
        name="best effort: tcp external",
        promised=False,
        exact=False,
        habits=Habits(external=3.0),
    ),
    Variant(
        name="best effort: tcp external tidy",
        promised=False,
        exact=False,
        habits=Habits(external=3.0, waiting_first=0.0, apart=0.0),
    ),
    Variant(
        name="best effort: tcp external slow link",
        share=0.4,
        promised=False,
        exact=False,
        habits=Habits(external=3.0, latency=0.002),
    ),
    Variant(
        name="best effort: udp external",
        promised=False,
        exact=False,
        transport="udp",
        habits=Habits(external=3.0, held=0.1),
    ),
    Variant(
        name="best effort: tcp extra apart",
        promised=False,
        exact=False,
        habits=Habits(second=0.3, second_apart=True),
    ),
)


# ---------------------------------------------------------------------- the emulator's truth


class TruthfulEmulator(EmulatedCamera):
    """An emulated camera that counts triggers and says in each container whose it is.

    Attributes:
        triggers, overtriggers, pace: as those of the camera made by hand.
    """

    def __init__(self, variant: Variant) -> None:
        self.pace = 0.01
        self.triggers = 0
        self.overtriggers = 0
        self._of = EXTERNAL
        self._sent: list[Sent] = []
        # it keeps one pace: here chance lies with the timeouts
        application = Application(
            id=1,
            layout=FIELDS.format(mark=variant.mark),
            generator=self._values,
            processing_time=sum(PATIENCE) / 4,
        )
        super().__init__(
            [application],
            transport=variant.transport,
            dialect=variant.dialect,
            running=True,
            quirks={
                "waiting_before_result": variant.order == "waiting first",
                "push_status": variant.pushed,
            },
        )

    @property
    def sent(self) -> list[Sent]:
        """The containers that were sent, as its log shows them."""
        while self.log:
            message = self.log.popleft().message
            if isinstance(message, m.ResultContainer):
                _, trigger, _, _, part = CONTAINER.unpack(message.data)
                self._sent.append(Sent(trigger, part))
        return self._sent

    def received(self, link: Link, message: m.Message) -> None:
        """Note whose the run is that a trigger begins."""
        idle = not self.device.processing
        if isinstance(message, m.Trigger):
            self.triggers += 1
        super().received(link, message)
        if isinstance(message, m.Trigger) and idle and self.device.processing:
            self._of = self.triggers

    def calm(self) -> None:
        """There are no runs that nobody asked for."""

    async def quiet(self) -> None:
        """What is under way is known by the status."""

    def _values(self, run: Run) -> dict[str, int]:
        return {"number": run.number, "trigger": self._of, "run": 0, "token": 0, "part": 0}


Camera = StormCamera | TruthfulEmulator


def make_camera(variant: Variant, chance: Random) -> Camera:
    """Return the camera of a variant."""
    if variant.order is not None:
        return TruthfulEmulator(variant)
    return StormCamera(
        dialect=variant.dialect,
        transport=variant.transport,
        habits=variant.habits,
        chance=chance,
    )
