"""Test a finished calibration, and return the warnings that its user should know.

Each test warns of a healthy calibration in at most one of 100 cases.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._plane.fitting import fit
from smartcam.calibration._plane.model_selection import ROUNDING_RATIO, squares, touch_noise
from smartcam.calibration._statistics import Noise
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code, Remark

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._plane.fitting import Fit, ModelName, Normalization, Pairs
    from smartcam.calibration._plane.model_selection import Candidates
    from smartcam.geometry._inside import Array

SIGNIFICANCE_LEVEL = 0.01
"""Probability with which noise alone may cause a warning."""

SCALE_TOLERANCE = 0.005
"""A scale may be off the nominal one by this part: printers and heights of parts change it by as
much."""

MAX_SCALE_ERROR = 0.1
"""A scale that is off the nominal one by more than this part comes from mixed-up units or
sheets."""

MIN_TOOL_COSINE = 0.17
"""If the cosine between tool and normal is smaller, the tool's axis does not show the side."""

MAX_POINTS_FOR_PAIRS = 25
"""With at most this many points, each pair is left out in turn; with more, two points hardly move
the map."""

MIN_POINTS_LEFT = 3
"""More points than this must be left when some are left out: three fit a similarity nearly
always."""

MIN_DEGREES_OF_FREEDOM = 6
"""An estimated sigma with fewer degrees of freedom is off by 30 percent and more (derived)."""

TYPICAL_SIGMA_M = 0.0002
"""Sigma of a careful touch, metres, assumed for the degrees of freedom that an estimate lacks."""


class Limit(NamedTuple):
    """The largest plausible standard deviation of a touch's coordinate."""

    touch: float  # part from the robot's tip, metres
    part: float  # part from the camera, as a part of the field

    def of(self, field: float) -> float:
        """Return the limit for a field of the given size, metres."""
        return math.hypot(self.touch, self.part * field)


MAX_SIGMA = Limit(0.0005, 0.001)
"""Larger residuals may be mistakes: a hand-guided robot and a camera of 640 x 480 pixels stay below
this limit."""

_TINY = 1e-8


class Evidence(NamedTuple):
    """The data that the tests examine; lengths are in units of ``place``."""

    pairs: Pairs
    fitted: Fit  # the fit that was chosen
    candidates: Candidates  # the fits of the other models
    preferred: ModelName  # the model that the user asked for
    asked: bool  # whether the user named the model
    held_out: Array  # (N, 3), residuals of the chosen fit
    sigma: float | None  # standard deviation of a touch's coordinate; None if it was not given
    most: float  # the error that the user gave, else the largest plausible one
    place: Normalization  # centre and size of the points
    nominal_scale: float | None  # metres per unit of the camera's points; None if it was not given
    # cosine between tool and normal; None if the tool's axis was not given
    side: float | None
    numbers: NDArray[np.intp]  # (N,), names of the points in messages


def findings(evidence: Evidence) -> tuple[Remark, ...]:
    """Return the warnings, the most serious first."""
    tests = (_planarity, _fit, _wrong_instead, _model, _scale, _held_out, _touches, _side)
    return tuple(remark for test in tests for remark in test(evidence))


def sigma_of(squared: float, freedom: int, typical: float) -> float:
    """Estimate the sigma of residuals from the sum of their squares.

    ``typical``: sigma assumed for the degrees of freedom that are missing; few residuals may all be
    small by chance.
    """
    missing = max(0, MIN_DEGREES_OF_FREEDOM - freedom)
    return math.sqrt((squared + missing * typical**2) / (freedom + missing))


def check_side(normal: Array, tool_z: Array) -> float:
    """Return the cosine between tool and plane's normal; raise MIRRORED if they point alike."""
    cosine = float(normal @ tool_z) / float(np.linalg.norm(tool_z))
    if cosine > MIN_TOOL_COSINE:
        raise Code.MIRRORED.refusal(
            "expected the plane's normal to point against the tool, got one along it (cosine "
            f"{cosine:.2f}): the camera's y axis points the wrong way, or points are swapped",
            -1.0,
            cosine,
        )
    return cosine


def check_scale(measured: float, nominal: float, uncertainty: float, *, exact: bool) -> str | None:
    """Return the remark on a scale that is not the nominal one; None for the nominal one.

    Scales are in metres per unit of the camera; ``uncertainty`` is the standard deviation of
    ``measured``, as a part of it. Raises SCALE_MISMATCH if the scale is off by more than a tenth,
    or at all if it must be ``exact``.
    """
    error = measured / nominal - 1.0
    if abs(error) <= max(SCALE_TOLERANCE, 3.0 * uncertainty):
        return None
    percent = f"{100 * error:+.2g}" if abs(error) < 0.1 else f"{100 * error:+.0f}"
    text = f"scale: expected {nominal:.6g} m for each unit of the camera, got {measured:.6g}"
    text += f" ({percent} %): the print, the units or the height are other than thought"
    if exact or abs(error) > MAX_SCALE_ERROR:
        raise Code.SCALE_MISMATCH.refusal(text, nominal, measured)
    return text


def _planarity(evidence: Evidence) -> Iterator[Remark]:
    """Compare the residuals out of the plane with the given noise, or with those inside it."""
    flat, weights, count = evidence.candidates.get("affine"), evidence.pairs.weights, -3
    count += len(weights)
    if flat is None or not count:
        return
    normal = np.cross(*flat.matrix[:3, :2].T)
    normal /= np.linalg.norm(normal)
    out = flat.residuals @ normal
    squared = float((weights * out**2).sum())
    fitted = evidence.fitted.residuals
    within = squares(fitted - np.outer(fitted @ normal, normal), weights)
    noise = touch_noise(evidence.sigma, within, evidence.fitted.freedom - count)
    if noise is not None and noise.chance(squared, count) < SIGNIFICANCE_LEVEL:
        worst, mm = int(np.argmax(weights * out**2)), 1e3 * evidence.place.robot_size
        yield Code.NOT_PLANAR.remark(
            f"the touched points lie {mm * math.sqrt(squared / count):.3g} mm rms out of a plane, "
            f"where touching explains {mm * math.sqrt(noise.variance):.3g} mm; "
            f"point {evidence.numbers[worst]} is the furthest, "
            f"{mm * abs(float(out[worst])):.3g} mm"
        )


def _fit(evidence: Evidence) -> Iterator[Remark]:
    """Test for one point that is far worse than the others, then test all of them together."""
    fitted, weights = evidence.fitted, evidence.pairs.weights
    total = squares(fitted.residuals, weights)
    chances = [_chance_among(evidence, squared, total) for squared in _studentized(fitted)]
    worst = int(np.argmin(chances))
    if chances[worst] * len(chances) < SIGNIFICANCE_LEVEL:
        residual = 1e3 * evidence.place.robot_size * float(np.linalg.norm(fitted.residuals[worst]))
        yield Code.OUTLIER.remark(
            f"point {evidence.numbers[worst]} fits far worse than the others: its residual of "
            f"{residual:.3g} mm comes by chance once in {1 / max(chances[worst], 1e-12):.3g} "
            "touches"
        )
        return
    most = max(evidence.most, ROUNDING_RATIO)
    if fitted.freedom and Noise(most**2).chance(total, fitted.freedom) < SIGNIFICANCE_LEVEL:
        mm = 1e3 * evidence.place.robot_size
        given = "was given" if evidence.sigma is not None else "is the most that is taken for noise"
        yield Code.POOR_FIT.remark(
            "the residuals speak of touches with a sigma of "
            f"{mm * math.sqrt(total / fitted.freedom):.3g} mm, where {mm * most:.3g} mm {given}"
        )


def _wrong_instead(evidence: Evidence) -> Iterator[Remark]:
    """Test whether one or two wrong touches explain as much as a tilted camera."""
    fitted, pairs = evidence.fitted, evidence.pairs
    count = len(pairs.camera)
    if (
        fitted.model not in {"affine", "homography"}
        or not fitted.freedom
        or count > MAX_POINTS_FOR_PAIRS
    ):
        return
    noise = touch_noise(evidence.sigma, squares(fitted.residuals, pairs.weights), fitted.freedom)
    better: list[tuple[float, tuple[int, ...]]] = []
    for few in (1, 2):
        for out in itertools.combinations(
            range(count), few if count - few > MIN_POINTS_LEFT else 0
        ):
            try:
                simple = fit("similarity", pairs.without(*out))
            except CalibrationError:  # the others lie in a line
                continue
            squared = squares(simple.residuals, np.delete(pairs.weights, out))
            better.append((0.0 if noise is None else noise.chance(squared, simple.freedom), out))
    chance, out = max(better, default=(0.0, ()))
    if out and chance > SIGNIFICANCE_LEVEL:
        points = " and ".join(str(evidence.numbers[i]) for i in out)
        yield Code.OUTLIER.remark(
            f"point{'s' * (len(out) > 1)} {points} may be wrong: without, one scale fits all "
            f"others as well as the model {fitted.model} does with them"
        )


def _chance_among(evidence: Evidence, squared: float, total: float) -> float:
    """Return the probability of one residual's square, from the others if they are enough."""
    freedom = evidence.fitted.freedom - 3
    sigma = evidence.sigma if freedom < MIN_DEGREES_OF_FREEDOM else None
    noise = touch_noise(sigma, max(total - squared, 0.0), freedom)
    return 1.0 if noise is None else noise.chance(squared, 3)


def _studentized(fitted: Fit) -> Array:
    """Return each residual's square over its own variance (N,), 0 if that is 0."""
    values, vectors = np.linalg.eigh(fitted.blocks)
    along = np.einsum("nij,ni->nj", vectors, fitted.residuals)
    good = values > _TINY * values.max()
    squared: Array = np.where(good, along**2 / np.where(good, values, 1.0), 0.0).sum(axis=1)
    return squared


def _model(evidence: Evidence) -> Iterator[Remark]:
    """Warn if the field has no single scale, or if another model than the chosen one fits."""
    used, preferred = evidence.fitted.model, evidence.preferred
    if preferred not in {"affine", "homography"} or (evidence.asked and used == preferred):
        return
    simple: ModelName = used if evidence.asked else "similarity"
    errors = [
        1e3 * evidence.place.robot_size * evidence.candidates.error(name)
        for name in (simple, preferred)
    ]
    text = (
        f"held-out error with the model {simple} {errors[0]:.3g} mm, with {preferred} "
        f"{errors[1]:.3g} mm: the camera is tilted or its lens distorts"
    )
    yield Code.NOT_SIMILAR.remark(f"{text}; {used} was asked for" if evidence.asked else text)


def _scale(evidence: Evidence) -> Iterator[Remark]:
    similar = evidence.candidates.get("similarity")
    if evidence.nominal_scale is None or similar is None:
        return
    unit = evidence.place.robot_size / evidence.place.camera_size
    measured = unit * float(np.linalg.norm(similar.matrix[:3, 0]))
    total = squares(similar.residuals, evidence.pairs.weights)
    noise = touch_noise(evidence.sigma, total, similar.freedom)
    weight = float(evidence.pairs.weights.sum())
    uncertainty = 0.0 if noise is None else math.sqrt(noise.variance / weight)
    exact = evidence.fitted.model == "rigid"
    text = check_scale(measured, evidence.nominal_scale, uncertainty, exact=exact)
    if text is not None:
        yield Code.SCALE_MISMATCH.remark(text)


def _held_out(evidence: Evidence) -> Iterator[Remark]:
    missing = np.flatnonzero(np.isnan(evidence.held_out).any(axis=1))
    if len(missing) == len(evidence.held_out):
        yield Code.NOT_HELD_OUT.remark(
            f"{len(missing)} points are no more than {evidence.fitted.model} has need of: none can "
            "be left out to see how good the calibration is, and the residuals do not tell"
        )
    elif len(missing):
        yield Code.NOT_HELD_OUT.remark(
            f"without point {evidence.numbers[missing[0]]} the others give no calibration: "
            "nothing checks it"
        )


def _touches(evidence: Evidence) -> Iterator[Remark]:
    freedom = evidence.fitted.freedom
    if evidence.sigma is None and freedom < MIN_DEGREES_OF_FREEDOM:
        how = f"is estimated from {freedom} degrees of freedom only" if freedom else "is not known"
        yield Code.UNVERIFIED.remark(
            f"the touches' sigma {how}: give touch_sigma or touch more points"
        )


def _side(evidence: Evidence) -> Iterator[Remark]:
    return remark_side(evidence.side)


def remark_side(side: float | None) -> Iterator[Remark]:
    """Warn that the tool's axis does not show the side of the plane.

    ``side``: the cosine between tool and normal, None if the tool's axis was not given.
    """
    if side is None or abs(side) <= MIN_TOOL_COSINE:
        yield Code.SIDE_UNKNOWN.remark(
            "the tool's axis does not tell from which side the plane is touched: that the camera's "
            "y axis points the right way is not checked"
        )
