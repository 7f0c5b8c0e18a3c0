"""Others' ways of finding a part, in the scenes of :mod:`tests.inspection.proofs.locate`.

OpenCV's are always there. ``linemod`` (of ``opencv-contrib-python-headless``), ``geofit`` and
``corrmatch`` are judged where they can be imported: install them into a folder by ``pip install
--target FOLDER --no-deps``, and name that folder first in ``PYTHONPATH``.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import math
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from smartcam.inspection import Picture
from tests.inspection.drawn_parts import PARTS, Look, PlacedPart, photograph, shares
from tests.inspection.proofs import locate as judge

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.inspection import PartModel

MIDDLE = 100
"""Column and row of the part in the picture that is taught."""

MIN_CORRELATION = 0.7
"""Correlation from which on ``matchTemplate`` counts as a find, as the score of `locate`."""

MIN_VOTES = 100
"""Votes from which on the generalized Hough transform counts as a find."""


class Pose(NamedTuple):
    """A pose: pixels and degrees."""

    x: float
    y: float
    degrees: float


MIN_SIMILARITY = 70.0
"""Per cent of the gradients from which on ``linemod`` counts as a find."""

PART_LEVEL = 90
"""Grey level above which a pixel of the taught picture is of the part."""

LINEMOD_PX = 80
"""Pixels that divide the sides of a picture for ``linemod``."""

MIN_SHAPE_SCORE = 0.55
"""Score from which on ``geofit`` counts as a find, as the score of `locate`."""


Way = Callable[["NDArray[np.uint8]"], "Pose | None"]


@functools.cache
def taught_picture() -> NDArray[np.uint8]:
    """Return the bracket without noise, 200 x 200 pixels."""
    part = PlacedPart(PARTS["bracket"], MIDDLE, MIDDLE)
    light = shares((200, 200), [part], 0.8)
    return photograph(light, Look(noise=0.0), np.random.default_rng(0)).astype(np.uint8)


def match_template(picture: NDArray[np.uint8]) -> Pose | None:
    """Find the part by correlation, in steps of 3 degrees at half the size, then of half one."""
    half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    small = np.asarray(half, np.uint8)
    rough = max(_correlated(small, one, 0.5) for one in np.arange(0.0, 360.0, 3.0))
    near = (_correlated(picture, rough[3] + one, 1.0) for one in np.arange(-2.0, 2.1, 0.5))
    score, x, y, degrees = max(near)
    return Pose(x, y, degrees) if score >= MIN_CORRELATION else None


def _correlated(
    picture: NDArray[np.uint8], degrees: float, scale: float
) -> tuple[float, float, float, float]:
    """Return the best correlation at one angle, with place and angle."""
    turned = _turned(degrees)
    part = cv2.resize(
        turned[30:171, 30:171], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
    )
    scores = cv2.matchTemplate(picture, part, cv2.TM_CCOEFF_NORMED)
    _, score, _, (x, y) = cv2.minMaxLoc(scores)
    half = 70 * scale
    return score, (x + half) / scale, (y + half) / scale, degrees


def _turned(degrees: float) -> NDArray[np.uint8]:
    turn = cv2.getRotationMatrix2D((MIDDLE, MIDDLE), -degrees, 1.0)
    turned = cv2.warpAffine(taught_picture(), turn, (200, 200), borderValue=60)
    return np.asarray(turned, np.uint8)


def ecc(picture: NDArray[np.uint8]) -> Pose | None:
    """Refine what ``matchTemplate`` finds by ``findTransformECC``."""
    return _refined(match_template(picture), picture)


def _refined(start: Pose | None, picture: NDArray[np.uint8]) -> Pose | None:
    """Return a pose as ``findTransformECC`` refines it; itself where that does not converge."""
    if start is None:
        return None
    angle = math.radians(start.degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    # from pixels of the taught picture, cut around the part, to the scene's
    taught, corner = taught_picture()[30:171, 30:171], 70.0
    motion = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]], np.float32)
    motion[:, 2] = np.array(start[:2]) - motion[:, :2] @ [corner, corner]
    end = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
    everywhere = np.full(picture.shape, 255, np.uint8)
    try:
        cv2.findTransformECC(taught, picture, motion, cv2.MOTION_EUCLIDEAN, end, everywhere, 5)
    except cv2.error:
        return start
    x, y = (motion[:, :2] @ [corner, corner] + motion[:, 2]).tolist()
    return Pose(x, y, math.degrees(math.atan2(motion[1, 0], motion[0, 0])))


@functools.cache
def _guil() -> Any:
    finder = cv2.createGeneralizedHoughGuil()
    finder.setMinDist(100)
    finder.setLevels(360)
    finder.setDp(2)
    finder.setMaxBufferSize(2000)
    finder.setMinAngle(0)
    finder.setMaxAngle(360)
    finder.setAngleStep(2)
    finder.setAngleThresh(600)
    finder.setMinScale(0.98)
    finder.setMaxScale(1.03)
    finder.setScaleStep(0.05)
    finder.setScaleThresh(100)
    finder.setPosThresh(MIN_VOTES)
    finder.setCannyLowThresh(60)
    finder.setCannyHighThresh(120)
    finder.setTemplate(taught_picture())
    return finder


def hough(picture: NDArray[np.uint8]) -> Pose | None:
    """Find the part by Guil's generalized Hough transform."""
    places, votes = _guil().detect(picture)
    if places is None:
        return None
    best = int(votes.reshape(-1, 3)[:, 0].argmax())
    x, y, _, degrees = places.reshape(-1, 4)[best].tolist()
    return Pose(x, y, degrees)


@functools.cache
def _linemod() -> tuple[Any, dict[int, tuple[float, float]]]:
    """Return the detector with a template for every 3 degrees, and the part's place in each."""
    detector = importlib.import_module("cv2").linemod.getDefaultLINE()
    middles = {}
    for number in range(120):
        turned = _turned(3.0 * number)
        # it takes gradients along the mask's border alone
        mask = np.where(turned > PART_LEVEL, np.uint8(255), np.uint8(0))
        found, box = detector.addTemplate([cv2.merge([turned] * 3)], "part", mask)
        if found >= 0:
            middles[found] = (MIDDLE - box[0], MIDDLE - box[1])
    return detector, middles


def linemod(picture: NDArray[np.uint8]) -> Pose | None:
    """Find the part by LINE, whose places are those of pixels, then by ``findTransformECC``."""
    detector, middles = _linemod()
    below, right = (-one % LINEMOD_PX for one in picture.shape)
    wider = cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_REPLICATE)
    matches, _ = detector.match([cv2.merge([wider] * 3)], MIN_SIMILARITY)
    if not matches:
        return None
    best = max(matches, key=lambda one: one.similarity)
    x, y = middles[best.template_id]
    return _refined(Pose(best.x + x, best.y + y, 3.0 * best.template_id), picture)


@functools.cache
def _geofit() -> Any:
    return importlib.import_module("geofit").ShapeModel.create(taught_picture()[30:171, 30:171])


def geofit(picture: NDArray[np.uint8]) -> Pose | None:
    """Find the part by geofit, with one thread."""
    found = _geofit().find(picture, min_score=MIN_SHAPE_SCORE, num_threads=1)
    return Pose(found[0].x, found[0].y, -found[0].angle) if found else None


@functools.cache
def _corrmatch() -> Any:
    package = importlib.import_module("corrmatch")
    template = package.Template(np.ascontiguousarray(taught_picture()[30:171, 30:171]))
    compiled = template.compile(package.CompileConfig(max_levels=3, min_step_deg=0.5))
    settings = package.MatchConfig(rotation="enabled", min_score=MIN_CORRELATION)
    return compiled.matcher(settings)


def corrmatch(picture: NDArray[np.uint8]) -> Pose | None:
    """Find the part by corrmatch's correlation over angles."""
    try:
        found = _corrmatch().match_image(picture)
    except RuntimeError:  # it found none
        return None
    return Pose(found.x + 70, found.y + 70, found.angle_deg)


def smartcam(model: PartModel, search: Any, picture: NDArray[np.uint8]) -> Pose | None:
    """Find the part by `locate`."""
    found = judge.locate(Picture(picture), [model], search).parts
    if not found:
        return None
    pose = found[0].pose
    x, y = pose.to_picture(np.array([MIDDLE, MIDDLE]) - model.reference).tolist()
    return Pose(x, y, math.degrees(pose.angle))


def scenes(count: int, seed: int) -> Iterator[tuple[NDArray[np.uint8], PlacedPart | None]]:
    """Yield scenes with the bracket in noise, covered, and in clutter; and without it."""
    random = np.random.default_rng(seed)
    for number in range(count):
        name = ("noise 5", "covered 30 %", "clutter")[number % 3]
        kind = next(one for one in judge.KINDS if one.name == name)
        scene = judge.scene_of(dataclasses.replace(kind, look=Look(noise=5.0)), random)
        yield photograph(scene.light, Look(noise=5.0), random).astype(np.uint8), scene.part
        others = [one for one in PARTS if one not in {"bracket", "tee"}]
        places = random.uniform(50, judge.SIDE - 50, (3, 2)).tolist()
        parts = [
            PlacedPart(PARTS[str(random.choice(others))], x, y, float(number)) for x, y in places
        ]
        light = shares((judge.SIDE, judge.SIDE), parts, 0.8)
        yield photograph(light, Look(noise=5.0), random).astype(np.uint8), None


def compare(count: int, seed: int) -> list[str]:
    """Return the rows of a table, of so many scenes with the part and as many without it."""
    from smartcam.inspection import PartModel

    model = PartModel.teach(taught_picture(), name="bracket")
    search = dataclasses.replace(judge.KINDS[0].search, min_score=0.55)
    ways: dict[str, Way] = {
        "smartcam locate": functools.partial(smartcam, model, search),
        "OpenCV matchTemplate over angles": match_template,
        "the same, then findTransformECC": ecc,
        "OpenCV GeneralizedHoughGuil": hough,
    }
    if hasattr(cv2, "linemod"):
        ways["OpenCV linemod, then findTransformECC"] = linemod
    packages: dict[str, Way] = {"geofit": geofit, "corrmatch": corrmatch}
    ways |= {name: way for name, way in packages.items() if importlib.util.find_spec(name)}
    drawn = list(scenes(count, seed))
    return [_row(name, way, drawn) for name, way in ways.items()]


def _row(name: str, way: Way, drawn: list[tuple[NDArray[np.uint8], PlacedPart | None]]) -> str:
    found, missed, false, took = 0, 0, 0, []
    errors: list[tuple[float, float]] = []
    for picture, part in drawn:
        begin = time.process_time()
        pose = way(picture)
        took.append(1e3 * (time.process_time() - begin))
        if pose is None:
            missed += part is not None
            continue
        if part is None:
            false += 1
            continue
        off = math.dist(pose[:2], (part.x, part.y))
        turned = abs(math.remainder(pose.degrees - math.degrees(part.angle), 360))
        if off > judge.FALSE_PX or turned > judge.FALSE_DEGREES:
            false += 1
            missed += 1
        else:
            found += 1
            errors.append((off, turned))
    px, degrees = np.median(errors, axis=0).tolist() if errors else (math.nan, math.nan)
    return (
        f"| {name} | {found} | {missed} | {false} | {px:.3f} | {degrees:.3f} "
        f"| {np.median(took):.0f} |"
    )
