"""The wizard that checks whether a calibration still holds: touch some marks again, and compare.

If the camera was knocked, it sees all points shifted, and a few touches show the shift. The offsets
are compared with the noise of the new touches and of the calibration's touches.
"""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._extras import load
from smartcam.calibration._files.store import read_document
from smartcam.calibration._plane.calibration import STALE_LEVEL, PlaneCalibration
from smartcam.calibration._verdict import CalibrationVerdict
from smartcam.calibration.wizards._journal import Journal
from smartcam.calibration.wizards._marks import MarkCamera
from smartcam.calibration.wizards._sequence import Wizard, ask
from smartcam.calibration.wizards._steps import Option, Step
from smartcam.calibration.wizards._touch_previews import compare_touches
from smartcam.calibration.wizards._touches import SIGMA, UNIT, Touches
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike

    from smartcam.calibration._plane.calibration import Drift
    from smartcam.calibration.wizards._marks import Localize
    from smartcam.calibration.wizards._sequence import StepAnswer
    from smartcam.calibration.wizards._steps import Answers
    from smartcam.calibration.wizards._touches import ReadRobot
    from smartcam.geometry._inside import Array

VERIFICATION_WIZARD = "drift"
"""Name of the wizard."""

CHECKS_FORMAT = "smartcam.checks/1"
"""Name of the format of a file of checks, in its first line."""

KNOCK_M = 0.001
"""Shift of a knocked camera, metres, in the direction that is hardest to notice."""

NOTICED_SHARE = 0.95
"""Share of all checks that should notice such a knock."""

MAX_TOUCHES = 100
"""Largest number of touches of a check; more touches hardly help, since the calibration has an
error of its own."""


def drift_wizard(
    *,
    localize: Localize,
    find: Callable[[str], Path],
    record_to: Callable[[str], Path],
    read_robot: ReadRobot | None = None,
    y_down: bool | None = None,
) -> Wizard:
    """Return the wizard that checks a calibration.

    Its parameters: ``name`` (of the calibration), ``feature`` (only marks with this name count),
    and as defaults of the first step ``unit`` (mm, m) and ``touch_sigma`` (mm).

    Its result has the entries ``name``, ``stale``, ``touches``, ``offsets_mm`` (length of each
    touch's offset), ``rms_mm``, ``expected_mm``, ``z``, ``chance`` (p-value), ``needed`` (see
    :func:`touches_needed`; at the best mark), ``needed_at`` (number of this mark's touch) and
    ``file``.

    Each finished check is a line of a file, whose first line names its format: so the file shows a
    drift that is too slow for a single check. The calibration's own file is not changed. The number
    of checks in a file has the same limit as the number of entries in a journal.

    Args:
        localize: function that takes a picture and localizes marks in it.
        find: function that returns the file of a calibration by its name, or raises
            CalibrationError.
        record_to: function that returns, by a calibration's name, the file of its checks.
        read_robot: function that reads the robot's pose; None: the pose is typed.
        y_down: whether the camera's own y axis points down; ``localize`` then reverses y; None: not
            known. A calibration with another direction of y is refused.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        name = str(parameters.get("name", "plane"))
        feature = str(parameters.get("feature") or "")
        camera = MarkCamera(localize=localize, feature=feature, y_down=y_down)
        step = _about_step(name, pose_is_entered=read_robot is None).with_defaults(parameters)
        about = await ask(step, partial(_load_calibration, find, name, camera))
        return await _DriftCheck(about, read_robot, camera, name, record_to).run()

    return Wizard(name=VERIFICATION_WIZARD, version=1, script=script, steps=5)


def touches_needed(calibration: PlaneCalibration, camera_point: ArrayLike) -> int | None:
    """Return the number of touches of one mark that are needed to notice a knock.

    The result is None if :data:`MAX_TOUCHES` are not enough, since the calibration itself is too
    uncertain at the mark. ``camera_point`` (2,): place of the mark for the camera. Raises SHAPE or
    NOT_FINITE; UNVERIFIED if the touches' sigma is not known; MissingExtraError: SciPy is not
    installed.
    """
    own_variance = float(
        np.linalg.eigvalsh(calibration.covariance_at(np.atleast_2d(camera_point))[0])[-1]
    )
    sigma = calibration.touch_sigma or 0.0
    freedom = None if calibration.sigma_given else calibration.freedom
    for count in range(1, MAX_TOUCHES + 1):
        # variance of the difference between the mean touched position and the calibrated one
        variance = own_variance + sigma**2 / count
        noncentrality = min(
            KNOCK_M**2 / max(variance, KNOCK_M**2 / _MAX_NONCENTRALITY), _MAX_NONCENTRALITY
        )
        if (
            _detection_probability(
                STALE_LEVEL if count == 1 else 0.5 * STALE_LEVEL, freedom, noncentrality
            )
            >= NOTICED_SHARE
        ):
            return count
    return None


_MAX_NONCENTRALITY = 1e4
"""Ratio of a squared shift to its variance, above which a shift is always noticed."""


def _detection_probability(level: float, freedom: int | None, noncentrality: float) -> float:
    """Return the probability that a test notices a shift of three coordinates.

    ``level``: probability that the test reports a shift that does not exist. ``freedom``: degrees
    of freedom of the noise; None: it is known. ``noncentrality``: squared shift over its variance.
    """
    special = load("scipy.special")
    if freedom is None:
        return 1.0 - float(special.chndtr(special.chdtri(3, level), 3, noncentrality))
    limit = special.fdtri(3, freedom, 1.0 - level)
    return 1.0 - float(special.ncfdtr(3, freedom, noncentrality, limit))


def _about_step(name: str, *, pose_is_entered: bool) -> Step:
    sigma = replace(
        SIGMA, label="How well a touch repeats, standard deviation; empty: as the calibration says"
    )
    return Step(
        id="about",
        title=f"Is {name} still true?",
        description="Touch a mark or several again, with the same tool held the same way. Offsets "
        "are compared with the noise of the new touches and of the calibration's.",
        inputs=(UNIT, sigma) if pose_is_entered else (sigma,),
    )


async def _load_calibration(
    find: Callable[[str], Path], name: str, camera: MarkCamera, answers: Answers
) -> dict[str, Any]:
    """Read a calibration into the journal, so that a resumed check uses the same calibration."""
    file = find(name)
    calibration = PlaneCalibration.load(file)
    camera.check_y_down(calibration.y_down, name)
    if calibration.touch_sigma is None and answers["touch_sigma"] is None:
        raise Code.WRONG_ANSWERS.error(
            f"{name} has no standard deviation of its touches: expected the touches' sigma",
            got={"touch_sigma": "no answer, and the calibration has none: expected one"},
        )
    document = read_document(file)
    return {
        "data": calibration.to_data(),
        "written_at": document.written_at,
        "tool": str(document.context.get("tool", "")),
        "camera_unit": str(document.context.get("camera_unit", "m")),
    }


class _DriftCheck(Touches):
    """Touches that are compared with a calibration."""

    def __init__(
        self,
        about: StepAnswer,
        read_robot: ReadRobot | None,
        camera: MarkCamera,
        name: str,
        record_to: Callable[[str], Path],
    ) -> None:
        super().__init__(about, read_robot)
        self.name = name
        self.camera_unit = about.outcome.get("camera_unit", "m")
        self._camera = camera
        self._record_to = record_to
        calibration = PlaneCalibration.from_data(about.outcome["data"])
        if self.sigma is not None:
            calibration = replace(calibration, touch_sigma=self.sigma, sigma_given=True)
        self.calibration = calibration

    async def run(self) -> dict[str, Any]:
        while True:
            await self._touch_marks()
            if not self.touches:
                continue
            drift = self.calibration.check(self._touched_marks(), self.tip_positions)
            figures = self._figures(drift)
            choice = await ask(
                self._verdict_step(drift, figures), partial(self._record_check, drift, figures)
            )
            if choice["next"] == "finish":
                return {"name": self.name, **figures, **choice.outcome}

    def _touched_marks(self) -> Array:
        return np.array([(touch.mark.x, touch.mark.y) for touch in self.touches])

    async def _take_checked_picture(self, answers: Answers) -> list[dict[str, Any]]:
        self._camera.check_y_down(self.calibration.y_down, self.name)
        rows = await self._camera.take_marks(answers)
        wanted = self.calibration.camera_frame
        frames = {row["frame_id"] for row in rows} - {wanted}
        if wanted is not None and frames:
            raise Code.WRONG_FRAME.error(
                f"the camera's localizations are in frame {min(frames)!r}, the calibration "
                f"expected {wanted!r}",
                wanted,
                min(frames),
            )
        self.calibration.transform([(row["x"], row["y"]) for row in rows])
        return rows

    async def _touch_marks(self) -> None:
        tool = self.about.outcome["tool"]
        step = Step(
            id="picture",
            title="Marks in the camera's field",
            description="Lay one mark or several where the camera sees them, at the height where "
            "parts lie, far from each other; the robot must not hide them. They must not move "
            "until they have been touched.",
            button="Take a picture",
            notes=(
                f"{self.name} was made at {self.about.outcome['written_at'][:19]} UTC"
                + (f", with the tool {tool!r}" if tool else ""),
                *((f"{_touches_text(len(self.touches))} so far",) if self.touches else ()),
            ),
        )
        await self.add_marks(
            (await ask(step, self._take_checked_picture)).outcome, MAX_TOUCHES, "touches"
        )

    def _verdict_step(self, drift: Drift, figures: Mapping[str, Any]) -> Step:
        stale, offsets = figures["stale"], figures["offsets_mm"]
        return Step(
            id="verdict",
            title=f"{self.name} {'is stale' if stale else 'still holds'}",
            description="Take a touch back if it went wrong. If the next touches say the same, "
            "calibrate again."
            if stale
            else "",
            notes=tuple(_notes(figures)),
            verdict=CalibrationVerdict("poor", f"Stale: {figures['rms_mm']:.1f} mm rms off")
            if stale
            else CalibrationVerdict("good", f"Still true: {figures['rms_mm']:.1f} mm rms off"),
            button="Go on",
            inputs=(
                Option(
                    name="next",
                    label="What next",
                    options={
                        "finish": "finish, and note it in the file of its checks",
                        "more": "take another picture, to touch more",
                    },
                ),
            ),
            preview=compare_touches(
                self.calibration,
                self.touches,
                self._touched_marks(),
                drift.offsets,
                worst=offsets.index(max(offsets)),
            ),
        )

    def _figures(self, drift: Drift) -> dict[str, Any]:
        offsets = 1e3 * np.linalg.norm(drift.offsets, axis=1)
        needed = [touches_needed(self.calibration, point) for point in self._touched_marks()]
        possible_counts = [count for count in needed if count is not None]
        return {
            "stale": drift.stale,
            "touches": len(self.touches),
            "offsets_mm": np.round(offsets, 6).tolist(),
            "rms_mm": math.sqrt(float((offsets**2).mean())),
            "expected_mm": 1e3 * drift.expected,
            "z": drift.z,
            "chance": drift.chance,
            "needed": min(possible_counts, default=None),
            "needed_at": 1 + needed.index(min(possible_counts)) if possible_counts else None,
        }

    async def _record_check(
        self, drift: Drift, figures: Mapping[str, Any], answers: Answers
    ) -> dict[str, str] | None:
        """Write the check to its file if the user finishes; this is the action of the last step."""
        if answers["next"] != "finish":
            return None
        file = self._record_to(self.name)
        with Journal(file) as checks:
            if checks.header is None:
                checks.start({"schema": CHECKS_FORMAT, "name": self.name})
            elif checks.header.get("schema") != CHECKS_FORMAT:
                raise Code.BROKEN_FILE.error(
                    f"{file.name}: schema {checks.header.get('schema')!r}, expected "
                    f"{CHECKS_FORMAT!r}",
                    CHECKS_FORMAT,
                    checks.header.get("schema"),
                )
            checks.append(
                {
                    "at": datetime.now(UTC).isoformat(),
                    "calibration": self.about.outcome["written_at"],
                    **figures,
                    "samples": [
                        {
                            "feature_id": touch.mark.feature,
                            "camera": [touch.mark.x, touch.mark.y],
                            "robot": list(touch.robot),
                            "offset": offset,
                        }
                        for touch, offset in zip(self.touches, drift.offsets.tolist(), strict=True)
                    ],
                }
            )
        return {"file": file.name}


def _notes(figures: Mapping[str, Any]) -> list[str]:
    """Return the notes of the verdict's step, a line each."""
    count, offsets = figures["touches"], figures["offsets_mm"]
    knock = f"a knock of {1e3 * KNOCK_M:g} mm is noticed in {100 * NOTICED_SHARE:g} of 100 checks"
    needed = figures["needed"]
    return [
        f"{_touches_text(count)}: {figures['rms_mm']:.3f} mm rms off, where noise explains "
        f"{figures['expected_mm']:.3f} mm; the furthest is touch "
        f"{1 + offsets.index(max(offsets))}, {max(offsets):.3f} mm",
        f"noise alone gives as much in {100 * figures['chance']:.2g} % of checks "
        f"(z = {figures['z']:.2f})",
        f"{knock} with {_touches_text(needed)} of the mark of touch {figures['needed_at']}"
        if needed is not None
        else f"{knock} with no number of touches of these marks: the calibration is too "
        "uncertain there",
    ]


def _touches_text(count: int) -> str:
    return f"{count} touch{'es' if count != 1 else ''}"
