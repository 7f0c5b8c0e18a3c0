"""Take pictures of marks that a camera localizes, and ask which of them are touched."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam.calibration.wizards._sequence import ask
from smartcam.calibration.wizards._steps import Flag, Step
from smartcam.geometry._inside import Code
from smartcam.models import Localization

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.calibration.wizards._steps import Answers

MAX_MARKS = 25
"""Largest number of marks in one picture that can be touched: 5 x 5."""

Localize = Callable[[], Awaitable[list[Localization]]]
"""Function that takes a picture and returns the localizations in it."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Mark:
    """A point that the camera sees and the robot will touch."""

    feature: str  # name of the mark; may be empty
    x: float  # x in the camera's unit; for a point of a sheet, metres on the sheet
    y: float  # y in the same unit
    theta: float  # angle, radians
    number: int | None = None  # number of the point on its target; None for a mark without a target

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Mark:
        """Return the mark of a row from :meth:`MarkCamera.take_marks`."""
        return cls(row["feature_id"], row["x"], row["y"], row["theta"])

    def text(self, unit: str) -> str:
        """Return the mark's name and place as a text; places in the ``unit`` m are shown in mm."""
        name = self.feature if self.feature.isprintable() else repr(self.feature)
        factor, unit = (1e3, "mm") if unit == "m" else (1.0, unit)
        return f"{name or 'mark'} at x {factor * self.x:.1f} {unit}, y {factor * self.y:.1f} {unit}"


@dataclass(frozen=True, slots=True)
class Touch:
    """A touch of a point by the robot's tip."""

    mark: Mark  # mark that the camera sees at the point; for a point on a ray, the rays' origin
    robot: Vector  # position of the tip in the robot's base, metres
    tool_z: Vector | None  # direction of the tool's axis; None if it is not known
    label: str = "mark"  # or ``O``, ``A``, ``B``: the sheet's origin, or a point on its ray A or B


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkCamera:
    """A camera that localizes marks."""

    localize: Localize
    feature: str = ""  # only localizations with this name are marks; empty for all
    # whether the camera's own y axis points down; ``localize`` then reverses y; None: not known
    y_down: bool | None = None

    async def take_marks(self, _answers: Answers) -> list[dict[str, Any]]:
        """Take a picture and return its marks, as the action of a step.

        Returns:
            A row for each mark: ``feature_id, quality, photo_index, frame_id, x, y, theta,
            y_down``.

        Raises:
            CalibrationError: TOO_FEW: there is no mark; SHAPE, the code of wrong arguments: there
                are more than :data:`MAX_MARKS`.

        Cancellation: as that of ``localize``.
        """
        localizations = await self.localize()
        rows = [
            {
                "feature_id": localization.feature_id,
                "quality": localization.quality,
                "photo_index": localization.photo_index,
                "frame_id": localization.pose.header.frame_id,
                "x": localization.pose.position.x,
                "y": localization.pose.position.y,
                "theta": localization.pose.orientation.theta,
                "y_down": self.y_down,
            }
            for localization in localizations
            if self.feature in {"", localization.feature_id}
        ]
        if not 0 < len(rows) <= MAX_MARKS:
            name_text = f"{self.feature!r} " if self.feature else ""
            raise (Code.SHAPE if rows else Code.TOO_FEW).error(
                f"the camera found {len(rows)} marks {name_text}among {len(localizations)} "
                f"localizations; expected 1 to {MAX_MARKS}",
                got=len(rows),
            )
        return rows

    def check_y_down(self, earlier: bool | None, label: str) -> None:
        """Raise MIRRORED if the direction of the y axis differs from ``earlier`` (None: unknown).

        ``label``: name, for people, of the earlier picture or calibration.
        """
        if None not in {earlier, self.y_down} and earlier != self.y_down:
            raise Code.MIRRORED.error(
                f"{label} has y_down={earlier}, now it is {self.y_down}, and everything would be "
                f"mirrored; expected y_down={earlier}",
                earlier,
                self.y_down,
            )


def clickable_preview(marks: Sequence[Mark], answers: Sequence[Answers]) -> dict[str, Any]:
    """Return a preview of marks; ``answers``: the answers that a click on each mark gives."""
    choices = [
        {"at": [mark.x, mark.y], "label": str(number), "answers": answer}
        for number, (mark, answer) in enumerate(zip(marks, answers, strict=True), 1)
    ]
    return {"points": [], "marks": [choice["at"] for choice in choices], "choices": choices}


async def ask_marks(marks: list[Mark], unit: str) -> list[Mark]:
    """Ask which of several marks will be touched; ``unit``: unit of the marks' places."""
    if len(marks) == 1:
        return marks
    flags = tuple(
        Flag(name=f"mark_{number}", label=f"{number}: {mark.text(unit)}", default=True)
        for number, mark in enumerate(marks, 1)
    )
    step = Step(
        id="which",
        title="Which ones will be touched?",
        inputs=flags,
        preview=clickable_preview(marks, [{flag.name: True} for flag in flags]),
    )
    answer = await ask(step)
    return [mark for flag, mark in zip(flags, marks, strict=True) if answer[flag.name]]
