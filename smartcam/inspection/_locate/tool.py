"""The tool `locate`: taught parts, with their poses and the errors of the poses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.frames._inside import Drawing
from smartcam.inspection._finding import Finding
from smartcam.inspection._locate.find import Located, LocatedPart, PartSearch, locate
from smartcam.inspection._locate.model import PartModel
from smartcam.inspection._locate.settings import MAX_PARTS, LocateSettings
from smartcam.inspection._measure.planes import PIXELS, robot_plane
from smartcam.inspection._measure.troubles import NotMeasuredError
from smartcam.inspection._picture import Picture
from smartcam.inspection._tool import Tool

if TYPE_CHECKING:
    from smartcam.frames._inside import Role
    from smartcam.geometry._inside import Array
    from smartcam.inspection._measure.planes import Plane
    from smartcam.inspection._tool import ToolSetup, View

MAX_DRAWN: Final = 80
"""Largest number of edges of a part that are drawn."""

POSE_STEPS: Final = np.array([0.5, 0.5, 1e-3])
"""Steps, pixels and radians, of the numerical derivative of a pose in the plane."""


class PlanePose(NamedTuple):
    """A part's pose in the plane: millimetres and radians, or pixels."""

    values: Array  # (3,), x, y, theta
    covariance: Array  # (3, 3)

    def fields(self, si: float) -> dict[str, float]:
        """Return the fields of a result in SI units; ``si``: metres per unit of length."""
        units = np.array([si, si, 1.0])
        x, y, theta = (self.values * units).tolist()
        sigmas = np.sqrt(np.diag(self.covariance))
        divisors = np.maximum(sigmas, 1e-300)
        correlation = self.covariance / np.outer(divisors, divisors)
        sigma_x, sigma_y, sigma_theta = (sigmas * units).tolist()
        return {
            "x": x,
            "y": y,
            "theta": theta,
            "sigma_x": sigma_x,
            "sigma_y": sigma_y,
            "sigma_theta": sigma_theta,
            "correlation_xy": float(correlation[0, 1]),
            "correlation_xt": float(correlation[0, 2]),
            "correlation_yt": float(correlation[1, 2]),
        }


class Locate(Tool[LocateSettings]):
    """Taught parts in a region."""

    settings_model = LocateSettings
    needs_whole_region = False

    def __init__(self, settings: LocateSettings, setup: ToolSetup) -> None:
        super().__init__(settings, setup)
        # loaded now, since the first picture should not wait for it
        load("scipy.special", "locate needs")
        self.models = [PartModel.read(setup.folder / model) for model in settings.models]
        if settings.taught is not None:
            file = setup.folder / settings.taught
            model = PartModel.teach(Picture.read(file), settings.part, name=file.stem)
            self.models.append(model)
        if settings.outline is not None and settings.pixels_per_mm is not None:
            file = setup.folder / settings.outline
            self.models.append(
                PartModel.from_outline(
                    file,
                    settings.pixels_per_mm,
                    name=file.stem,
                    bright=settings.bright,
                    unit=settings.unit,
                )
            )
        for model in self.models:  # computed here, so that the first picture is as fast as others
            _ = model.bands_at(settings.scale[0]), model.coarse, model.contours
        kind = getattr(setup.calibration, "kind", None)
        has_plane = kind in {"plane", "sheet"}
        self._plane = robot_plane(setup.calibration) if has_plane else PIXELS
        self._search = PartSearch(
            angles=settings.angles,
            scales=settings.scale,
            max_parts=settings.most,
            min_score=settings.least_score,
            overlap=settings.overlap,
            any_polarity=settings.polarity == "any",
            contrast=settings.contrast,
            seconds=settings.seconds,
        )
        count = settings.count
        self._count_limits = (1, MAX_PARTS * len(self.models))
        if count is not None:
            self._count_limits = count if isinstance(count, tuple) else (count, count)

    @property
    def fields(self) -> str:
        """The number of parts, and the score of the best one, found or refused."""
        return "count: uint16, best_score: real32"

    @property
    def records(self) -> str:
        """Each part, as a localization with its errors."""
        unit = self._plane.unit
        lengths = ", ".join(f"{name}: real32 {unit}" for name in ("sigma_x", "sigma_y"))
        return (
            f"feature_id: string[50], quality: real32, x: real32 {unit}, y: real32 {unit}, "
            f"theta: real32 deg, scale: real32, {lengths}, sigma_theta: real32 deg, "
            "correlation_xy: real32, correlation_xt: real32, correlation_yt: real32"
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """Symmetry and edges of each model, and the error that its poses will have."""
        return tuple(self._remark(model) for model in self.models)

    def _remark(self, model: PartModel) -> str:
        sigma, angle = model.predicted_sigma()
        count = len(model.segments.half_lengths)
        text = (
            f"{model.name}: {model.symmetry.text()}; {count} pieces of edges; "
            f"a pose is good to {sigma:.2g} px"
        )
        try:
            jacobian = self._plane.jacobians(np.array([model.reference]))[0]
        except NotMeasuredError:
            pass  # an outline's reference need not be in the picture
        else:
            longest = float(np.linalg.norm(jacobian, 2))
            text += f", {longest * sigma:.2g} mm" if self._plane.unit == "mm" else ""
        if not math.isnan(angle):
            text += f" and {math.degrees(angle):.2g} degrees"
        return f"{text} in a picture like the taught one"

    def inspect(self, view: View) -> Finding:
        """Return the parts, the best first."""
        region = view.region
        box = (region.left, region.top, region.right, region.bottom)
        whole_picture = self.settings.region is None
        located = locate(
            view.picture,
            self.models,
            self._search,
            box=None if whole_picture else box,
            allowed=None if whole_picture else region.contains,
        )
        try:
            poses = [pose_in_plane(part, self._plane) for part in located.parts]
        except NotMeasuredError as trouble:
            return Finding(
                ok=False,
                reason=f"{trouble.reason.value}: {trouble.text}",
                values=_result_values(located),
                drawings=self._drawings(view, located, wrong=True),
                details=located,
            )
        reason = self._complaint(located, poses)
        return Finding(
            ok=not reason,
            reason=reason,
            values=_result_values(located),
            records=[
                _record(part, pose, self._plane.unit)
                for part, pose in zip(located.parts, poses, strict=True)
            ],
            drawings=self._drawings(view, located, wrong=bool(reason)),
            reference=located.parts[0].pose if located.parts else None,
            details=located,
        )

    def _complaint(self, located: Located, poses: list[PlanePose]) -> str:
        """Return the reason why the found parts are not ok; "" if they are ok."""
        least, most = self._count_limits
        count, best_refused = len(located.parts), located.best_refused
        if not least <= count <= most:
            wanted = f"{least}" if least == most else f"{least} to {most}"
            wanted = f"{least} or more" if self.settings.count is None else wanted
            text = f"{count} found, expected {wanted}"
            if count < least:
                text += _refusal_text(best_refused, len(self.models) > 1)
            return text
        for part, pose in zip(located.parts, poses, strict=True):
            if part.doubt:
                return f"{part.name}: {part.doubt}"
            sigma = math.sqrt(float(np.linalg.eigvalsh(pose.covariance[:2, :2])[-1]))
            limit = self.settings.sigma
            if limit is not None and sigma > limit:
                unit = self._plane.unit
                return f"{part.name}: sigma is {sigma:.3g} {unit}, {limit:g} {unit} are allowed"
        return ""

    def _drawings(self, view: View, located: Located, *, wrong: bool) -> list[Drawing]:
        marks = [Drawing("polygon", _points(view.region.corners), "region")]
        for part in located.parts:
            marks += _marks(part, "wrong" if wrong else "found")
        if not located.parts and located.best_refused is not None:
            refused = located.best_refused
            text = f"{refused.name}: {100 * refused.score:.0f} %"
            marks.append(Drawing("polygon", _points(refused.hull), "hint", text))
        return marks


def pose_in_plane(part: LocatedPart, plane: Plane) -> PlanePose:
    """Return a part's pose in a plane; its covariance includes the plane's errors."""
    start = np.array([part.pose.x, part.pose.y, part.pose.angle])
    values = _map_pose(start, plane)
    columns = []
    for step in np.diag(POSE_STEPS):
        difference = _map_pose(start + step, plane) - _map_pose(start - step, plane)
        difference[2] = math.remainder(difference[2], 2 * math.pi)
        columns.append(difference / (2 * step.max()))
    jacobian = np.column_stack(columns)
    covariance = jacobian @ part.covariance[:3, :3] @ jacobian.T
    for variant in plane.variants:
        difference = _map_pose(start, plane._replace(map=variant, variants=())) - values
        difference[2] = math.remainder(difference[2], 2 * math.pi)
        covariance = covariance + np.outer(difference, difference)
    return PlanePose(values, covariance)


def _map_pose(pose: Array, plane: Plane) -> Array:
    if plane is PIXELS:
        return pose
    pixel = pose[None, :2]
    direction = plane.jacobians(pixel)[0] @ [math.cos(pose[2]), math.sin(pose[2])]
    return np.array([*plane.map_points(pixel)[0], math.atan2(direction[1], direction[0])])


def _record(part: LocatedPart, pose: PlanePose, unit: str) -> dict[str, Any]:
    return {
        "feature_id": part.name,
        "quality": part.score,
        "scale": part.pose.scale,
        **pose.fields(1e-3 if unit == "mm" else 1.0),
    }


def _result_values(located: Located) -> dict[str, Any]:
    best = located.parts[0].score if located.parts else None
    if best is None and located.best_refused is not None:
        best = located.best_refused.score
    return {"count": len(located.parts), "best_score": 0.0 if best is None else best}


def _refusal_text(best_refused: LocatedPart | None, with_name: bool) -> str:
    if best_refused is None:
        return "; nothing in the picture resembles it"
    name = f"{best_refused.name} " if with_name else ""
    return (
        f"; {name}at {best_refused.pose.x:.0f}, {best_refused.pose.y:.0f}: {best_refused.refusal}"
    )


def _marks(part: LocatedPart, role: Role) -> list[Drawing]:
    """Return the drawings of a part: its outline, its axes, its visible and its missing edges."""
    pose = part.pose
    reach = 0.25 * float(np.linalg.norm(part.hull - (pose.x, pose.y), axis=1).max()) / pose.scale
    axes = pose.to_picture([(2 * reach, 0), (0, 0), (0, reach)])
    text = f"{part.name} {100 * part.score:.0f} %"
    marks = [
        Drawing("polygon", _points(contour), role, "" if number else text)
        for number, contour in enumerate(part.contours or (part.hull,))
    ]
    marks.append(Drawing("line", _points(axes), role))
    groups: list[tuple[Array, Role]] = [(part.edges, role), (part.missing, "hint")]
    for places, role_of_places in groups:
        if len(places):
            chosen = (
                np.linspace(0, len(places) - 1, min(len(places), MAX_DRAWN)).round().astype(int)
            )
            marks.append(Drawing("points", _points(places[chosen]), role_of_places))
    return marks


def _points(places: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in places)
