"""The judge of locating: errors against predicted ones, against the bound, and false finds.

``python -m tests.inspection.proofs.locate [--scenes N] [--kind TEXT] [--photographs FOLDER]
[--others]``

Draws parts at exact poses in scenes of 31 kinds, five pictures of each drawing, locates them by a
model that was taught from another picture, and compares. No estimate without a bias can be better
than the Cramer-Rao bound, which is worked out here from the drawing alone: of the pixels beside the
edges that were used, where both levels of each piece of an edge are unknown, and of a texture no
more than its statistics is known. A kind is good where
predicted over observed errors are between 0.85 and 1.15, and the mean over the kinds between 0.95
and 1.05; where the error is at most 1.2 times the bound; and where nothing is missed or found
beside its place.

FOLDER of ``--photographs`` has JPEG or PNG files without any of the parts, such as
``BSDS500/data/images`` of github.com/BIDS/BSDS500, or EliSchwartz/imagenet-sample-images there,
with which nothing was chosen: nothing may be found there. ``--others`` puts
OpenCV's ways of finding a part beside it, in the same scenes.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.inspection import PartModel, Picture
from smartcam.inspection._locate.segments import find_band_pixels
from tests.inspection.drawn_parts import (
    PARTS,
    SAMPLES,
    Array,
    Look,
    PlacedPart,
    photograph,
    polygon,
    shares,
    slopes,
)
from tests.inspection.inside import PartSearch, locate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from tests.inspection.inside import LocatedPart


__all__ = ["PartSearch", "locate"]

SIDE = 260
"""Width and height of a scene, pixels."""

TAUGHT_AT = PlacedPart((), 100.3, 99.6, 0.2)
"""Pose of a part in the picture that is taught."""

SCENES_PER_MODEL = 4
"""Drawings between two teachings."""

PICTURES_PER_SCENE = 5
"""Pictures of each drawing, each with noise of its own."""

BOUNDS = 3
"""Scenes of a kind for which the bound is worked out, at most."""

BLOTCH_PX = 6.0
"""Standard deviation of the Gaussian that makes a texture of noise."""

FALSE_PX, FALSE_DEGREES = 3.0, 3.0
"""Error from which on a pose is that of something else."""

PHOTOGRAPHS = {".jpg", ".jpeg", ".png"}

KIND_RANGE, MEAN_RANGE, WORST_OVER_BOUND = (0.85, 1.15), (0.95, 1.05), 1.2


LOOK, QUIET = Look(), Look(noise=0.3)


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of scenes.

    Attributes:
        name: what is varied.
        part: name of the part.
        look: how the scene is photographed.
        taught: how the taught picture is photographed.
        scales: from and to, as they are drawn.
        one_size: whether the taught size is looked for, whatever is drawn.
        covered: part of the part that something covers.
        clutter: number of other parts around it.
        texture: levels of a texture behind it.
        straight: whether the part is not turned, as in most feeders.
        any_polarity: whether dark and bright may be exchanged.
        samples: samples along each side of a pixel of the drawing; more where little noise hides
            what the drawing is off.
        taught_anew: whether each drawing has a model of its own, as models have errors, too.
    """

    name: str
    part: str = "bracket"
    look: Look = LOOK
    taught: Look = QUIET
    scales: tuple[float, float] = (1.0, 1.0)
    one_size: bool = False
    covered: float = 0.0
    clutter: int = 0
    texture: float = 0.0
    straight: bool = False
    any_polarity: bool = False
    samples: int = SAMPLES
    taught_anew: bool = False

    @property
    def search(self) -> PartSearch:
        """The search for the part."""
        least = 0.7 - self.covered
        return PartSearch(
            scales=(1.0, 1.0) if self.one_size else self.scales,
            min_score=least,
            any_polarity=self.any_polarity,
            seconds=30.0,
        )


KINDS = (
    Kind(name="noise 1", look=Look(noise=1.0)),
    Kind(name="noise 2"),
    Kind(name="noise 5", look=Look(noise=5.0)),
    Kind(name="noise 10", look=Look(noise=10.0)),
    Kind(name="noise 20", look=Look(noise=20.0)),
    Kind(name="blur 0.5", look=Look(blur=0.5)),
    Kind(name="blur 1.2", look=Look(blur=1.2)),
    Kind(name="blur 1.8", look=Look(blur=1.8)),
    Kind(name="blur 2.5", look=Look(blur=2.5)),
    Kind(name="contrast 20", look=Look(contrast=20)),
    Kind(name="contrast 40", look=Look(contrast=40)),
    Kind(name="contrast 170", look=Look(contrast=170)),
    Kind(name="reversed light", look=Look(dark=200, contrast=-120), any_polarity=True),
    Kind(name="light falls off", look=Look(slope=60)),
    Kind(name="12 bits", look=Look(bits=12, noise=1.0)),
    Kind(name="covered 15 %", covered=0.15),
    Kind(name="covered 30 %", covered=0.3),
    Kind(name="clutter", clutter=6),
    Kind(name="texture", texture=15.0),
    Kind(name="straight", straight=True),
    Kind(name="scale 0.8 to 1.25", scales=(0.8, 1.25)),
    Kind(name="scale 0.5 to 0.7", scales=(0.5, 0.7)),
    Kind(name="scale 1.3 to 1.6", scales=(1.3, 1.6)),
    Kind(name="another size", scales=(0.98, 1.02), one_size=True),
    Kind(name="tee", part="tee"),
    Kind(name="bolt", part="bolt"),
    Kind(name="square", part="square"),
    Kind(name="hexagon", part="hexagon"),
    Kind(name="washer", part="washer"),
    Kind(name="noisy teaching", look=Look(noise=5.0), taught=Look(noise=5.0), taught_anew=True),
    Kind(name="clean", look=QUIET, taught=Look(noise=0.0), samples=8),
)
"""The kinds of scenes."""


class Scene(NamedTuple):
    """The light of a drawing with a part."""

    light: Array
    part: PlacedPart


class Trial(NamedTuple):
    """A part that was found."""

    errors: Array  # (4,), of x, y, angle, scale
    sigmas: Array  # (4,)
    over_bound: float  # predicted error in parts of the bound; NaN: not worked out


def taught_model(kind: Kind, random: np.random.Generator) -> PartModel:
    """Return a model, taught from a drawn picture."""
    part = dataclasses.replace(TAUGHT_AT, shapes=PARTS[kind.part])
    pixels = photograph(
        shares((200, 200), [part], kind.taught.blur, kind.samples), kind.taught, random
    )
    return PartModel.teach(Picture(pixels), name=kind.part)


def scene_of(kind: Kind, random: np.random.Generator) -> Scene:
    """Return a scene of a kind."""
    x, y = random.uniform(SIDE / 2 - 8, SIDE / 2 + 8, 2)
    angle = 0.2 if kind.straight else random.uniform(-math.pi, math.pi)
    scale = math.exp(random.uniform(*np.log(kind.scales)))
    part = PlacedPart(PARTS[kind.part], float(x), float(y), angle, scale)
    others = []
    for _ in range(kind.clutter):
        turn = random.uniform(0, 2 * math.pi)
        far = random.uniform(105, 150)
        name = str(random.choice([one for one in PARTS if one != kind.part]))
        at = x + far * math.cos(turn), y + far * math.sin(turn)
        others.append(PlacedPart(PARTS[name], *at, random.uniform(-3, 3)))
    light = shares((SIDE, SIDE), [*others, part], kind.look.blur, kind.samples)
    if kind.covered:
        light = _covered(light, part, kind, random)
    if kind.texture:
        light = _textured(light, part, kind, random)
    return Scene(light, part)


def _covered(light: Array, part: PlacedPart, kind: Kind, random: np.random.Generator) -> Array:
    """Return a scene with a bar over a part of the part."""
    turn, level = random.uniform(0, 2 * math.pi), random.uniform(0.2, 0.8)
    edge = 52 * math.cos(math.pi * kind.covered)
    bar = polygon(level, (edge, -90), (90, -90), (90, 90), (edge, 90))
    cover = PlacedPart((bar,), part.x, part.y, turn, 1.0, 130.0)
    own = shares(light.shape, [cover], kind.look.blur) / level
    return light * (1 - own) + level * own


def _textured(light: Array, part: PlacedPart, kind: Kind, random: np.random.Generator) -> Array:
    """Return a scene with blotches behind the part."""
    import cv2

    blotches = cv2.GaussianBlur(random.normal(size=light.shape), (0, 0), BLOTCH_PX)
    blotches *= kind.texture / kind.look.contrast / blotches.std()
    return light + blotches * _behind(light.shape, part, kind)


def _behind(shape: tuple[int, ...], part: PlacedPart, kind: Kind) -> Array:
    """Return the share of each pixel (H, W) that is behind a part."""
    outline = tuple(one._replace(level=1.0) for one in part.shapes[:1])
    return 1 - shares(shape, [dataclasses.replace(part, shapes=outline)], kind.look.blur)


def truth(model: PartModel, part: PlacedPart) -> Array:
    """Return the pose (4,) that a model has in a scene."""
    x, y = np.array(model.reference) - (TAUGHT_AT.x, TAUGHT_AT.y)
    turn, scale = part.angle - TAUGHT_AT.angle, part.scale
    cos, sin = scale * math.cos(turn), scale * math.sin(turn)
    return np.array([part.x + cos * x - sin * y, part.y + sin * x + cos * y, turn, scale])


def trial_of(
    kind: Kind, model: PartModel, scene: Scene, found: LocatedPart, *, bound: bool
) -> Trial:
    """Return the errors of a part that was found."""
    true = truth(model, scene.part)
    pose = found.pose
    errors = np.array([pose.x, pose.y, pose.angle, pose.scale]) - true
    errors[2] = math.remainder(errors[2], model.symmetry.period)
    sigmas = np.array(found.sigmas)
    if model.symmetry.fold == 0:
        errors[2] = 0.0
    over = _over_bound(kind, model, scene, found) if bound else math.nan
    return Trial(errors, sigmas, over)


def _over_bound(kind: Kind, model: PartModel, scene: Scene, found: LocatedPart) -> float:
    """Return the predicted errors in parts of the bound."""
    fitted = [True, True, model.symmetry.fold != 0, kind.scales[1] > kind.scales[0]]
    x, y, angle, scale = truth(model, scene.part).tolist()
    cos, sin = scale * math.cos(angle), scale * math.sin(angle)
    pixels = find_band_pixels(
        model.bands_at(scale), np.array([[cos, -sin, x], [sin, cos, y]]), scene.light
    )
    columns, rows = pixels.points.astype(int).T
    gain = kind.look.contrast * (2**kind.look.bits - 1) / 255
    drawing = (SIDE, SIDE), scene.part, kind.look.blur, kind.samples
    light = shares(drawing[0], [scene.part], *drawing[2:])[rows, columns]
    by_pose = gain * slopes(*drawing)[:, rows, columns]
    by_pose = _about_reference(by_pose, scene.part, (x, y))
    unit = (2**kind.look.bits - 1) / 255
    variance = (kind.look.noise * unit) ** 2 + 1 / 12
    turn = np.array([[cos, sin], [-sin, cos]])
    middles = model.segments.middles @ turn + (x, y)
    # pieces of a part that looks like itself may lie one on the other
    near = np.linalg.norm(middles[:, None] - found.edges, axis=2).min(axis=1) <= 3
    used = near[pixels.owners] & (np.bincount(pixels.owners) >= 12)[pixels.owners]
    behind = None
    if kind.texture:
        behind = kind.texture * unit * _behind(drawing[0], scene.part, kind)[rows, columns][used]
    information = _information(
        pixels.points[used], pixels.owners[used], light[used], by_pose[:, used].T, variance, behind
    )
    which = np.flatnonzero(fitted)
    best = np.linalg.inv(information[np.ix_(which, which)])
    taught = (kind.taught.noise**2 + 1 / 12) * (unit**2) / variance
    taught *= (kind.look.contrast / kind.taught.contrast) ** 2
    ratio = np.diag(found.covariance)[which] / (np.diag(best) * (1 + taught))
    return float(np.sqrt(ratio).mean())


def _information(
    points: Array,
    owners: NDArray[np.intp],
    light: Array,
    by_pose: Array,
    variance: float,
    behind: Array | None,
) -> Array:
    """Return the information (4, 4) of pixels about a pose; both levels of each piece are unknown.

    ``behind``: the standard deviation of the texture in each pixel, which neighbours share.
    """
    from scipy.linalg import solve_triangular

    if behind is not None:
        squares = ((points[:, None] - points) ** 2).sum(axis=2)
        shared = np.exp(-squares / (4 * BLOTCH_PX**2)) * np.outer(behind, behind)
        root = np.linalg.cholesky(shared + variance * np.eye(len(points)))
        _, piece = np.unique(owners, return_inverse=True)
        own = np.eye(piece.max() + 1)[piece]
        levels = np.column_stack([own, own * light[:, None]])
        a, levels = (solve_triangular(root, one, lower=True) for one in (by_pose, levels))
        a = a - levels @ np.linalg.lstsq(levels, a, rcond=1e-9)[0]
        together: Array = a.T @ a
        return together
    information = np.zeros((4, 4))
    for owner in np.unique(owners).tolist():
        mine = owners == owner
        levels = np.column_stack([np.ones(mine.sum()), light[mine]])
        a = by_pose[mine]
        a = a - levels @ np.linalg.lstsq(levels, a, rcond=None)[0]
        information += a.T @ a / variance
    return information


def _about_reference(by_pose: Array, part: PlacedPart, at: tuple[float, float]) -> Array:
    """Return derivatives by a pose whose place is that of the model's reference."""
    # turned and scaled about the reference, the drawing's own origin moves
    u, v = part.x - at[0], part.y - at[1]
    turned = by_pose[2] - v * by_pose[0] + u * by_pose[1]
    scaled = by_pose[3] + (u * by_pose[0] + v * by_pose[1]) / part.scale
    return np.array([by_pose[0], by_pose[1], turned, scaled])


class Row(NamedTuple):
    """The figures of a kind."""

    kind: Kind
    scenes: int
    found: int
    false: int
    median_px: float = math.nan
    rms_px: float = math.nan
    rms_degrees: float = math.nan
    ratio: float = math.nan  # predicted over observed
    over_bound: float = math.nan  # observed over the bound
    milliseconds: float = math.nan

    @property
    def good(self) -> bool:
        """True if the kind is as it should be, but for chance."""
        values = max(1, self.found) * 3
        chance = 3 / math.sqrt(2 * values)
        return (
            self.false == 0
            and self.found == self.scenes
            and KIND_RANGE[0] - chance <= self.ratio <= KIND_RANGE[1] + chance
            and self.over_bound <= WORST_OVER_BOUND + chance
        )

    def __str__(self) -> str:
        return (
            f"| {self.kind.name} | {self.found} of {self.scenes} | {self.false} "
            f"| {self.median_px:.4f} | {self.rms_px:.4f} | {self.rms_degrees:.4f} "
            f"| {self.ratio:.2f} | {self.over_bound:.2f} | {self.milliseconds:.0f} |"
        )


def judge(kind: Kind, scenes: int, seed: int) -> Row:
    """Return the figures of a kind."""
    random = np.random.default_rng([seed, KINDS.index(kind)])
    trials: list[Trial] = []
    false, took = 0, []
    model, scene = taught_model(kind, random), scene_of(kind, random)
    for number in range(scenes):
        scenes_per_model = 1 if kind.taught_anew else SCENES_PER_MODEL
        if number and number % (scenes_per_model * PICTURES_PER_SCENE) == 0:
            model = taught_model(kind, random)
        if number and number % PICTURES_PER_SCENE == 0:
            scene = scene_of(kind, random)
        pixels = photograph(scene.light, kind.look, random)
        begin = time.process_time()
        found = locate(Picture(pixels, depth=kind.look.bits), [model], kind.search)
        took.append(time.process_time() - begin)
        bound = number % PICTURES_PER_SCENE == 0 and number < BOUNDS * PICTURES_PER_SCENE
        for part in found.parts:
            trial = trial_of(kind, model, scene, part, bound=bound)
            far = math.hypot(*trial.errors[:2]) > FALSE_PX
            if far or abs(math.degrees(trial.errors[2])) > FALSE_DEGREES:
                false += 1
            else:
                trials.append(trial)
    return _row(kind, scenes, trials, false, took, model)


def _row(
    kind: Kind,
    scenes: int,
    trials: Sequence[Trial],
    false: int,
    took: Sequence[float],
    model: PartModel,
) -> Row:
    if not trials:
        return Row(kind, scenes, 0, false)
    errors, sigmas = (np.array([one[which] for one in trials]) for which in (0, 1))
    fitted = [True, True, model.symmetry.fold != 0, kind.scales[1] > kind.scales[0]]
    ratio = 1 / math.sqrt(float(np.mean((errors[:, fitted] / sigmas[:, fitted]) ** 2)))
    places = np.hypot(errors[:, 0], errors[:, 1])
    over = np.nanmean([one.over_bound for one in trials])
    return Row(
        kind,
        scenes,
        len(trials),
        false,
        float(np.median(places)),
        float(np.sqrt(np.mean(places**2))),
        math.degrees(float(np.sqrt(np.mean(errors[:, 2] ** 2)))),
        ratio,
        float(over) / ratio,
        1e3 * float(np.median(took)),
    )


HEAD = (
    "| scenes | found | false | median px | rms px | rms degrees | predicted over observed "
    "| over the bound | ms |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
)


def photographs(folder: Path, seed: int) -> tuple[int, list[str]]:
    """Return how many photographs were looked at, and what was found in them."""
    random = np.random.default_rng(seed)
    models = [taught_model(Kind(name=name, part=name), random) for name in PARTS]
    files = sorted(one for one in folder.rglob("*") if one.suffix.lower() in PHOTOGRAPHS)
    found = []
    for file in files:
        parts = locate(Picture.read(file), models, PartSearch(seconds=30.0)).parts
        found += [f"{file}: {part.name} {part.score:.2f}" for part in parts]
    return len(files), found


def _kinds(text: str | None) -> Iterator[Kind]:
    yield from (one for one in KINDS if text is None or text in one.name)


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main() -> int:
    """Print the table; 1 where something is not as it should be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind")
    parser.add_argument("--photographs", type=Path)
    parser.add_argument("--others", action="store_true")
    given = parser.parse_args()
    _say(HEAD)
    rows = []
    for kind in _kinds(given.kind):
        rows.append(judge(kind, given.scenes, given.seed))
        _say(f"{rows[-1]}{'' if rows[-1].good else ' BAD'}")
    mean = float(np.nanmean([one.ratio for one in rows]))
    good = all(one.good for one in rows)
    chance = 3 / math.sqrt(6 * given.scenes * len(rows))
    good &= MEAN_RANGE[0] - chance <= mean <= MEAN_RANGE[1] + chance
    _say(f"\npredicted over observed, mean of {len(rows)} kinds: {mean:.3f}; seed {given.seed}")
    if given.photographs is not None:
        count, found = photographs(given.photographs, given.seed)
        _say(f"{len(found)} false finds of {len(PARTS)} parts in {count} photographs")
        _say("\n".join(found))
        good &= not found and count > 0
    if given.others:
        from tests.inspection.proofs import locating_of_others

        _say("| way | found | missed | false | median px | median degrees | ms |")
        _say("\n".join(["| --- " * 7 + "|", *locating_of_others.compare(given.scenes, given.seed)]))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
