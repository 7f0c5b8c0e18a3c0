"""The judge of measuring: errors against the Cramer-Rao bound, sigmas against errors.

``python -m tests.inspection.proofs.calipers`` draws edges, bars, lines and circles whose places are
exact, with noise, and measures them many times. No estimate without a bias can be better than the
bound with unknown blur, levels and tilt, which is worked out here from the drawings alone, by the
pixels of the strips. A case is good where the error is at most 1.15 times the bound, and the
predicted sigma between 0.9 and 1.1 times the error. Pictures that cannot be measured must say so,
each time.

The circles and lines of OpenCV and, where it is installed, scikit-image are measured in the same
pictures.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tests.inspection.inside import (
    PIXELS,
    EdgeSettings,
    NotMeasuredError,
    Sectors,
    Strips,
    find_circle,
    find_line,
    find_pair,
    find_point,
    fit_circle_in_plane,
    fit_line_in_plane,
    strip_between,
    width,
)
from tests.inspection.proofs import calipers_of_others as others
from tests.inspection.rendering import Array, disc, half_plane, photographed, pixel_means

WORST_OVER_BOUND, SIGMA_RANGE = 1.15, (0.9, 1.1)

OFF = np.array([0.8, -0.5])
"""Error of the given centre of a circle, pixels."""

STEP = 1e-3
"""Step of numerical derivatives of a drawing, pixels and radians."""


class Light(NamedTuple):
    """Light and camera of a scene."""

    contrast: float = 150.0
    noise: float = 2.0
    blur: float = 0.8
    bits: int = 8

    @property
    def scale(self) -> float:
        """Levels of the picture per level of 255."""
        return float(2**self.bits - 1) / 255

    @property
    def settings(self) -> EdgeSettings:
        """Settings of the search for edges."""
        white = float(2**self.bits - 1)
        return EdgeSettings(contrast=10 * self.scale, white=white)

    @property
    def variance(self) -> float:
        """Noise of a pixel, rounding included."""
        return (self.noise * self.scale) ** 2 + 1 / 12

    def photograph(self, shares: Array, random: np.random.Generator) -> Any:
        """Return the picture of shares of light, 0 to 1."""
        levels = self.scale * (50.0 + self.contrast * shares)
        return photographed(levels, self.noise * self.scale, random, self.bits)


LIGHT = Light()


class Trial(NamedTuple):
    """One measurement of one value."""

    error: float
    sigma: float
    bound: float


def information(
    draw: Callable[[Array], Array],
    values: Array,
    wanted: int,
    masks: Sequence[Array],
    light: Light,
) -> Array:
    """Return the Fisher information (W, W) of the pixels about the first ``wanted`` values.

    ``draw`` gives shares (H, W) by values, of which the last one is the blur. All values but the
    wanted ones, and the levels at both sides, are unknown in each of the masks (H, W) by itself.
    """
    gain = light.scale * light.contrast
    steps = STEP * np.eye(len(values))
    slopes = [gain * (draw(values + one) - draw(values - one)) / (2 * STEP) for one in steps]
    slopes += [draw(values), np.ones_like(slopes[0])]
    found = np.zeros((wanted, wanted))
    for mask in masks:
        rows = np.array([one[mask] for one in slopes])
        both = rows @ rows.T / light.variance
        mixed = both[:wanted, wanted:]
        found += both[:wanted, :wanted] - mixed @ np.linalg.solve(both[wanted:, wanted:], mixed.T)
    return found


def masks_of(shape: tuple[int, int], strips: Strips | Sectors) -> list[Array]:
    """Return the pixels of each strip, by the definition of a strip."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    found = []
    if isinstance(strips, Sectors):
        off = np.hypot(u - strips.centre[0], v - strips.centre[1]) - strips.radius
        turn = np.arctan2(v - strips.centre[1], u - strips.centre[0])
        for middle in strips.angles:
            aside = np.abs((turn - middle + math.pi) % (2 * math.pi) - math.pi) * strips.radius
            found.append((np.abs(off) <= strips.length / 2) & (aside <= strips.width / 2))
        return found
    for (x, y), (dx, dy) in zip(strips.middles, strips.directions, strict=True):
        along, aside = dx * (u - x) + dy * (v - y), dx * (v - y) - dy * (u - x)
        within = (np.abs(along) <= strips.length / 2) & (np.abs(aside) <= strips.width / 2)
        found.append(within)
    return found


@dataclass(frozen=True, kw_only=True)
class Case:
    """A feature that is measured repeatedly.

    Attributes:
        name: what is varied.
        light: how it is photographed.
        others: whether other libraries measure the same pictures.
    """

    name: str
    light: Light = LIGHT
    others: bool = False

    def trials(self, random: np.random.Generator, count: int) -> Iterator[dict[str, Trial]]:
        """Yield the values of one random drawing in ``pictures`` pictures."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class EdgeCase(Case):
    """An edge in a strip."""

    angle: float = 17.0  # degrees
    tilt: float = 0.0  # degrees out of the strip
    strip: float = 10.0
    length: float = 30.0

    def trials(self, random: np.random.Generator, count: int) -> Iterator[dict[str, Trial]]:
        size, middle = (51, 51), np.array([25.0, 25.0])
        turn = math.radians(self.angle)
        ahead = np.array([math.cos(turn), math.sin(turn)])
        middle = middle + random.uniform(-0.5, 0.5, size=2)
        half = ahead * self.length / 2
        strip = strip_between(middle - half, middle + half, self.strip)
        values = np.array([random.uniform(-2, 2), math.radians(self.tilt), self.light.blur])

        def draw(at: Array) -> Array:
            x, y = middle + at[0] * ahead
            return pixel_means(size, half_plane((x, y), turn + at[1], at[2]))

        known = information(draw, values, 1, masks_of(size, strip), self.light)
        bound, shares = float(known[0, 0]) ** -0.5, draw(values)
        for _ in range(count):
            picture = self.light.photograph(shares, random)
            edge = find_point(picture, strip, self.light.settings, "single").edge
            found = {"place": Trial(edge.place - values[0], edge.sigma, bound)}
            if self.others:
                ends = middle - half, middle + half
                place = others.edge_by_profile(picture, *ends, int(self.strip))
                found["place: profile_line"] = Trial(place - values[0], math.nan, bound)
            yield found


@dataclass(frozen=True, kw_only=True)
class WidthCase(Case):
    """A bar across a strip."""

    wide: float = 20.0
    tilt: float = 0.0  # degrees
    strip: float = 10.0

    def trials(self, random: np.random.Generator, count: int) -> Iterator[dict[str, Trial]]:
        length = self.wide + 24
        size = (int(length) + 20,) * 2
        turn = random.uniform(0, 2 * math.pi)
        ahead = np.array([math.cos(turn), math.sin(turn)])
        middle = np.array(size[::-1]) / 2 - 0.5 + random.uniform(-0.5, 0.5, size=2)
        half = ahead * length / 2
        strip = strip_between(middle - half, middle + half, self.strip)
        tilt, shift = math.radians(self.tilt), random.uniform(-2, 2)
        near = self.wide < 8.0
        ends = shift + np.array([-0.5, 0.5]) * self.wide
        masks = masks_of(size, strip)
        variance = 0.0

        def edge(place: float, turned: float, blur: float) -> Array:
            x, y = middle + place * ahead
            return pixel_means(size, half_plane((x, y), turn + turned, blur))

        shares = edge(ends[0], tilt, self.light.blur) - edge(ends[1], tilt, self.light.blur)
        # the distance of the ends times the cosine of their mean tilt
        if near:

            def bar(at: Array) -> Array:
                second: Array = at[3] * edge(at[1], at[2], at[4])
                return edge(at[0], at[2], at[4]) - second

            values = np.array([*ends, tilt, 1.0, self.light.blur])
            known = np.linalg.inv(information(bar, values, 3, masks, self.light))
            by = np.array([-math.cos(tilt), math.cos(tilt), -self.wide * math.sin(tilt)])
            variance = float(by @ known @ by)
        else:
            v, u = np.mgrid[: size[0], : size[1]]
            before = (u - middle[0]) * ahead[0] + (v - middle[1]) * ahead[1] < shift
            for sign, place, side in ((-1, ends[0], before), (1, ends[1], ~before)):
                values = np.array([place, tilt, self.light.blur])
                known = np.linalg.inv(
                    information(
                        lambda at: edge(at[0], at[1], at[2]),
                        values,
                        2,
                        [masks[0] & side],
                        self.light,
                    )
                )
                by = np.array([sign * math.cos(tilt), -self.wide * math.sin(tilt) / 2])
                variance += float(by @ known @ by)
        truth = self.wide * math.cos(tilt)
        for _ in range(count):
            picture = self.light.photograph(shares, random)
            found = find_pair(picture, strip, self.light.settings, "single")
            value = width(*found, PIXELS)
            yield {"width": Trial(value.value - truth, value.sigma, math.sqrt(variance))}


@dataclass(frozen=True, kw_only=True)
class LineCase(Case):
    """A line with dirt in some strips."""

    angle: float = 17.0
    off: float = 1.5  # pixels between the line and where it is looked for
    turned: float = 1.0  # degrees between both
    strips: int = 10
    strip: float = 8.0
    dirty: int = 0

    def trials(self, random: np.random.Generator, count: int) -> Iterator[dict[str, Trial]]:
        long = self.strips * self.strip
        size = (int(long) + 44,) * 2
        turn = math.radians(self.angle)
        ahead = np.array([math.cos(turn), math.sin(turn)])
        normal = ahead[::-1] * [-1.0, 1.0]
        middle = np.array(size[::-1]) / 2 - 0.5 + random.uniform(-0.5, 0.5, size=2)
        search = turn + math.radians(self.turned)
        about = middle + self.off * normal
        way = np.array([math.cos(search), math.sin(search)]) * long / 2
        parts = ((np.arange(self.strips) + 0.5) / self.strips - 0.5) * long
        strips = Strips(
            middle + parts[:, None] * ahead, np.tile(normal, (self.strips, 1)), 20.0, self.strip
        )
        values = np.array([0.0, 0.0, self.light.blur])

        def draw(at: Array) -> Array:
            x, y = middle + at[0] * normal
            return pixel_means(size, half_plane((x, y), turn + math.pi / 2 + at[1], at[2]))

        shares = draw(values)
        dirty = random.choice(self.strips, self.dirty, replace=False)
        masks = [one for i, one in enumerate(masks_of(size, strips)) if i not in dirty]
        known = np.linalg.inv(information(draw, values, 2, masks, self.light))
        for place in dirty:
            shares = soiled(shares, middle + parts[place] * ahead, normal, random)
        for _ in range(count):
            picture = self.light.photograph(shares, random)
            found = find_line(
                picture,
                about - way,
                about + way,
                strip_length=24.0,
                width=self.strip,
                count=self.strips,
                settings=self.light.settings,
                which="strongest",
            )
            line = fit_line_in_plane(found, np.array([about - way, about + way]), PIXELS).curve
            across = line.middle + ((middle - line.middle) @ line.direction) * line.direction
            bent = math.asin(float(ahead[0] * line.direction[1] - ahead[1] * line.direction[0]))
            measured = {
                "offset": Trial(
                    float((across - middle) @ normal),
                    math.sqrt(line.offset_variance(middle)),
                    math.sqrt(known[0, 0]),
                ),
                "angle": Trial(bent, math.sqrt(line.covariance[1, 1]), math.sqrt(known[1, 1])),
            }
            if self.others:
                bound = math.sqrt(known[0, 0])

                def far(points: Array) -> Array:
                    beside: Array = (points - middle) @ normal
                    return beside

                for name, model in (
                    (
                        "Canny, fitLine",
                        others.line_by_opencv(others.near(others.canny_points(picture), far, 10)),
                    ),
                    (
                        "find_contours, ransac",
                        others.line_by_ransac(others.near(others.contour_points(picture), far, 10)),
                    ),
                ):
                    error = math.nan
                    if model is not None:
                        at, way_of = (np.asarray(one, float) for one in model)
                        across_of = way_of[::-1] * [-1.0, 1.0]
                        error = float((at - middle) @ across_of / (across_of @ normal))
                    measured[f"offset: {name}"] = Trial(error, math.nan, bound)
            yield measured


def soiled(shares: Array, place: Array, normal: Array, random: np.random.Generator) -> Array:
    """Return shares with a grain of dirt beside an edge, or a scratch across it."""
    v, u = np.mgrid[: shares.shape[0], : shares.shape[1]]
    at = place + random.choice([-1.0, 1.0]) * random.uniform(2.0, 3.0) * normal
    level = random.choice([0.0, 1.0])
    covered = np.hypot(u - at[0], v - at[1]) < 3.4
    return np.where(covered, level, shares)


@dataclass(frozen=True, kw_only=True)
class CircleCase(Case):
    """A circle or an arc with dirt in some strips."""

    radius: float = 25.0
    arc: tuple[float, float] = (0.0, 360.0)
    strips: int = 24
    dirty: int = 0

    def trials(self, random: np.random.Generator, count: int) -> Iterator[dict[str, Trial]]:
        radius = self.radius + random.uniform(-0.3, 0.3)
        size = (int(2 * radius) + 34,) * 2
        centre = np.array(size[::-1]) / 2 - 0.5 + random.uniform(-0.5, 0.5, size=2)
        begin, end = map(math.radians, self.arc)
        angles = begin + (np.arange(self.strips) + 0.5) / self.strips * (end - begin)
        search, wide = min(24.0, 1.7 * self.radius), (end - begin) * self.radius / self.strips
        values = np.array([*centre, radius, self.light.blur])

        def draw(at: Array) -> Array:
            return pixel_means(size, disc((at[0], at[1]), at[2], at[3]))

        shares = draw(values)
        dirty = random.choice(self.strips, self.dirty, replace=False)
        strips = Sectors(centre, radius, angles, 20.0, wide)
        masks = [one for i, one in enumerate(masks_of(size, strips)) if i not in dirty]
        known = np.linalg.inv(information(draw, values, 3, masks, self.light))
        for place in dirty:
            way = np.array([math.cos(angles[place]), math.sin(angles[place])])
            shares = soiled(shares, centre + radius * way, way, random)
        bounds = np.sqrt(np.diag(known))
        for _ in range(count):
            picture = self.light.photograph(shares, random)
            found = find_circle(
                picture,
                centre + OFF,
                self.radius,
                arc=(begin, end),
                strip_length=search,
                width=wide,
                count=self.strips,
                settings=self.light.settings,
                which="strongest",
            )
            circle = fit_circle_in_plane(found, PIXELS).curve
            sigmas = np.sqrt(np.diag(circle.covariance))
            errors = np.array([*(circle.centre - centre), circle.radius - radius])
            trials = [Trial(*one) for one in zip(errors, sigmas, bounds, strict=True)]
            measured = dict(zip(("centre x", "centre y", "radius"), trials, strict=True))
            if self.others:
                for name, model in (
                    ("HoughCircles", others.circle_by_hough(picture, radius)),
                    (
                        "find_contours, ransac",
                        others.circle_by_ransac(others.contour_points(picture)),
                    ),
                ):
                    measured[f"radius: {name}"] = Trial(
                        float(model[2] - radius), math.nan, bounds[2]
                    )
            yield measured


def cases() -> Iterator[Case]:
    """Yield the cases of the long proof."""
    yield EdgeCase(name="edge", others=True)
    for contrast in (20.0, 60.0, 190.0):
        yield EdgeCase(name=f"contrast {contrast:g}", light=Light(contrast=contrast))
    for noise in (0.5, 5.0, 10.0):
        yield EdgeCase(name=f"noise {noise:g}", light=Light(noise=noise))
    for blur in (0.3, 0.5, 1.5, 3.0, 4.5):
        yield EdgeCase(name=f"blur {blur:g} px", light=Light(blur=blur), length=40.0, others=True)
    for angle in (0.0, 2.0, 30.0, 45.0, 90.0, 133.0):
        yield EdgeCase(name=f"at {angle:g} deg", angle=angle, light=Light(blur=0.5))
    for tilt in (2.0, 10.0, -20.0):
        yield EdgeCase(name=f"tilted {tilt:g} deg", tilt=tilt)
    for strip in (3.0, 5.0, 20.0):
        yield EdgeCase(name=f"strip {strip:g} px", strip=strip)
    yield EdgeCase(name="16 bits", light=Light(bits=16))
    yield EdgeCase(name="12 bits, noise 0.5", light=Light(bits=12, noise=0.5))
    for wide in (3.0, 5.0, 10.0, 30.0):
        yield WidthCase(name=f"bar {wide:g} px", wide=wide)
    yield WidthCase(name="bar 5 px, blur 1.5", wide=5.0, light=Light(blur=1.5))
    yield WidthCase(name="bar 30 px, tilted 5 deg", wide=30.0, tilt=5.0)
    yield LineCase(name="line", others=True)
    yield LineCase(name="line at 0 deg", angle=0.0, turned=0.0, off=0.3)
    yield LineCase(name="line, noise 8, contrast 60", light=Light(60.0, 8.0, 1.2))
    yield LineCase(name="line, 2 of 10 dirty", dirty=2, others=True)
    yield LineCase(name="line, 4 of 12 dirty", dirty=4, strips=12)
    yield LineCase(name="line, 16 bits", light=Light(bits=16))
    yield CircleCase(name="circle", others=True)
    for radius in (6.0, 12.0, 60.0):
        strips = 12 if radius < 20 else 36
        yield CircleCase(name=f"radius {radius:g} px", radius=radius, strips=strips)
    for blur in (0.4, 2.0):
        yield CircleCase(name=f"circle, blur {blur:g} px", light=Light(blur=blur), others=True)
    yield CircleCase(name="circle, noise 8, contrast 60", light=Light(60.0, 8.0, 1.2))
    for arc in (180.0, 90.0, 40.0):
        yield CircleCase(name=f"arc of {arc:g} deg", arc=(10.0, 10.0 + arc), radius=40.0, strips=16)
    yield CircleCase(name="circle, 4 of 24 dirty", dirty=4, others=True)
    yield CircleCase(name="circle, 8 of 24 dirty", dirty=8)
    yield CircleCase(name="circle, 16 bits", light=Light(bits=16))


class Row(NamedTuple):
    """Figures of one value of a case."""

    case: str
    value: str
    trials: int
    error: float  # rms
    over_bound: float
    predicted_over_observed: float
    troubles: int

    @property
    def good(self) -> bool:
        """True if the figures reach their goal, within the chance of this number of trials."""
        if math.isnan(self.predicted_over_observed):
            return True  # of another library
        chance = 3 / math.sqrt(2 * self.trials)
        low, high = SIGMA_RANGE
        return (
            self.over_bound <= WORST_OVER_BOUND + chance
            and low - chance <= self.predicted_over_observed <= high + chance
            and self.troubles == 0
        )

    def __str__(self) -> str:
        return (
            f"| {self.case} | {self.value} | {self.trials} | {self.error:.5f} | "
            f"{self.over_bound:.3f} | {self.predicted_over_observed:.3f} | {self.troubles} |"
            f"{'' if self.good else ' MISSED'}"
        )


def judged(case: Case, seed: int, drawings: int, pictures: int) -> list[Row]:
    """Return the figures of a case over drawings with several pictures each."""
    found: dict[str, list[Trial]] = {}
    troubles: Counter[str] = Counter()
    for number in range(drawings):
        random = np.random.default_rng([seed, number])
        try:
            for one in case.trials(random, pictures):
                for name, trial in one.items():
                    merged = "centre" if name.startswith("centre ") else name
                    found.setdefault(merged, []).append(trial)
        except NotMeasuredError as exc:  # the rest of the drawing is lost
            troubles[str(exc)] += 1
    for text, count in troubles.items():
        sys.stderr.write(f"{case.name}: {count} times {text}\n")
    rows = []
    for name, trials in found.items():
        error, sigma, bound = np.sqrt(np.mean(np.square(trials), axis=0))
        rows.append(
            Row(
                case.name,
                name,
                len(trials),
                float(error),
                float(error / bound),
                float(sigma / error),
                sum(troubles.values()),
            )
        )
    return rows


def main() -> int:
    """Print the table; return 1 if a case misses its goal."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.inspection.proofs.calipers", description=__doc__
    )
    parser.add_argument("names", nargs="*", help="only cases whose names begin so")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--drawings", type=int, default=30)
    parser.add_argument("--pictures", type=int, default=30, help="of each drawing")
    options = parser.parse_args()
    sys.stdout.write(
        "| case | value | trials | rms error | over bound | predicted / observed | troubles |\n"
        "| --- | --- | --- | --- | --- | --- | --- |\n"
    )
    missed = 0
    for case in cases():
        if options.names and not any(case.name.startswith(one) for one in options.names):
            continue
        for row in judged(case, options.seed, options.drawings, options.pictures):
            sys.stdout.write(f"{row}\n")
            sys.stdout.flush()
            missed += not row.good
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
