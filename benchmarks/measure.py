"""What a benchmark is made of: sides that take turns, figures of both, a goal.

The machine is shared and its clock rate moves, so a figure alone says little. Each round measures
every side once, one right after the other; a comparison is made within a round, and what is shown
of all rounds is the median and the middle half.
"""

from __future__ import annotations

import gc
import statistics
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

__all__ = [
    "Comparison",
    "Cost",
    "Curve",
    "Goal",
    "Instructions",
    "Plan",
    "Series",
    "cpu_microseconds",
    "instructions_of",
    "take_turns",
    "take_turns_awaiting",
]

Cost = float
"""What one operation costs, in the unit of its series."""

How = Literal["ratio", "speed", "more", "alone"]


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is to be done.

    Attributes:
        rounds: how often each side is measured.
        scale: of the number of operations; 1.0 in full, less where it is only to be seen that it
            works.
        processes: how often the whole is measured, each time in a new process; what varies with a
            process, such as where its memory lies, varies in no rounds of one.
        instructions: whether they are counted as well.
    """

    rounds: int
    scale: float
    processes: int = 1
    instructions: bool = False

    @property
    def quick(self) -> bool:
        """Whether it is only to be seen that it works."""
        return self.scale < 1.0

    def operations(self, count: int, *, least: int = 1) -> int:
        """Return how many operations a round has, ``count`` in full."""
        return max(least, round(count * self.scale))


@dataclass(frozen=True, slots=True)
class Series:
    """The figures of one side, one a round.

    Attributes:
        name: what was measured.
        unit: of the figures.
        values: one for each round.
    """

    name: str
    unit: str
    values: list[float]

    @property
    def median(self) -> float:
        """The figure in the middle."""
        return statistics.median(self.values)


@dataclass(frozen=True, slots=True)
class Goal:
    """What is to be reached.

    Attributes:
        relation: to the value.
        value: in ``unit``.
        unit: ``x`` for times the yardstick, otherwise that of the figures.
    """

    relation: Literal["at most", "at least"]
    value: float
    unit: str = "x"

    def met(self, figure: float) -> bool:
        """Whether a figure reaches it."""
        return figure <= self.value if self.relation == "at most" else figure >= self.value

    def __str__(self) -> str:
        unit = "x" if self.unit == "x" else f" {self.unit}"
        return f"{self.relation} {self.value:g}{unit}"


class Instructions(NamedTuple):
    """How many instructions an operation takes, in the process that is measured.

    Attributes:
        subject: smartcam's.
        yardstick: the other side's.
    """

    subject: float
    yardstick: float


def instructions_of(
    counts: Mapping[str, float], subject: str, yardstick: str
) -> Instructions | None:
    """Return those of two sides; None where they were not counted."""
    if subject not in counts or yardstick not in counts:
        return None
    return Instructions(counts[subject], counts[yardstick])


@dataclass(frozen=True, slots=True)
class Comparison:
    """One line of the table: what was measured, its yardstick, the goal.

    Attributes:
        benchmark: which one it belongs to.
        case: what was done.
        subject: smartcam's figures.
        yardstick: the other side's; None where the figure stands alone.
        how: ``ratio``: subject through yardstick; ``speed``: of two costs, how many times the
            yardstick's speed; ``more``: subject minus yardstick; ``alone``: the subject.
        goal: None where it is only shown.
        note: what the reader needs to know.
        instructions: of both, where they were counted.
        processes: in how many processes it was measured; beyond one, each figure is a process'
            median.
    """

    benchmark: str
    case: str
    subject: Series
    yardstick: Series | None = None
    how: How = "ratio"
    goal: Goal | None = None
    note: str = ""
    instructions: Instructions | None = None
    processes: int = 1

    @property
    def figures(self) -> list[float]:
        """What is compared with the goal, of each round."""
        if self.yardstick is None or self.how == "alone":
            return self.subject.values
        pairs = zip(self.subject.values, self.yardstick.values, strict=True)
        match self.how:
            case "ratio":
                return [subject / yardstick for subject, yardstick in pairs]
            case "speed":
                return [yardstick / subject for subject, yardstick in pairs]
            case _:
                return [subject - yardstick for subject, yardstick in pairs]

    @property
    def unit(self) -> str:
        """Unit of the figures."""
        return "x" if self.how in {"ratio", "speed"} else self.subject.unit

    @property
    def median(self) -> float:
        """The figure in the middle."""
        return statistics.median(self.figures)

    @property
    def spread(self) -> tuple[float, float]:
        """From and to: the middle half of a process' rounds; of several processes, all of them."""
        figures = self.figures
        if len(figures) < 2 or self.processes > 1:
            return min(figures), max(figures)
        low, _, high = statistics.quantiles(figures, n=4, method="inclusive")
        return low, high

    @property
    def met(self) -> bool | None:
        """Whether the goal is reached; None without one."""
        return None if self.goal is None else self.goal.met(self.median)


@dataclass(frozen=True, slots=True)
class Curve:
    """Figures over a size, for a plot.

    Attributes:
        benchmark: which one it belongs to.
        title: of the plot.
        x: what grows, with its unit.
        y: what is measured, with its unit.
        lines: points by the side's name.
    """

    benchmark: str
    title: str
    x: str
    y: str
    lines: dict[str, list[tuple[float, float]]] = field(
        default_factory=dict[str, list[tuple[float, float]]]
    )


def cpu_microseconds(begin: float, operations: int) -> Cost:
    """Return the CPU time of this process since ``begin`` (``time.process_time()``), for each."""
    return (time.process_time() - begin) / operations * 1e6


def take_turns(
    plan: Plan,
    sides: Mapping[str, Callable[[], Cost]],
    *,
    unit: str = "us",
    warm_up: bool = True,
) -> dict[str, Series]:
    """Measure every side once a round; a first round warms up and is dropped.

    Args:
        plan: how many rounds.
        sides: what returns the cost of an operation, by name.
        unit: of these costs.
        warm_up: false where each measurement is a process of its own.
    """
    values: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(0 if warm_up else 1, plan.rounds + 1):
        for name in _order(list(sides), number):
            gc.collect()
            cost = sides[name]()
            if number:
                values[name].append(cost)
    return {name: Series(name, unit, costs) for name, costs in values.items()}


async def take_turns_awaiting(
    plan: Plan,
    sides: Mapping[str, Callable[[], Awaitable[Cost]]],
    *,
    unit: str = "us",
) -> dict[str, Series]:
    """Measure every side once a round, in a running loop; otherwise as :func:`take_turns`."""
    values: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(plan.rounds + 1):
        for name in _order(list(sides), number):
            gc.collect()
            cost = await sides[name]()
            if number:
                values[name].append(cost)
    return {name: Series(name, unit, costs) for name, costs in values.items()}


def _order(names: Sequence[str], number: int) -> list[str]:
    """Who comes first changes from round to round."""
    return list(names) if number % 2 else list(reversed(names))
