"""Test a finished calibration, and return the warnings that its user should know.

Each test warns of a healthy calibration in at most one of 100 cases.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._plane.fitting import fit
from smartcam.calibration._plane.model_selection import ROUNDING_RATIO, sum_of_squares, touch_noise
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
"""A scale may differ from the nominal one by this fraction: printers, and the heights of
workpieces, change the scale by as much."""

MAX_SCALE_ERROR = 0.1
"""If a scale differs from the nominal one by more than this fraction, the units or the sheet are
wrong."""

MIN_TOOL_COSINE = 0.17
"""If the cosine between tool and normal is smaller than this, the tool's axis does not show from
which side the plane is touched."""

MAX_POINTS_FOR_PAIRS = 25
"""With at most this many points, each pair of points is left out in turn; with more points, leaving
out two hardly changes the map."""

MIN_POINTS_LEFT = 3
"""More points than this must remain when some are left out: three points nearly always fit a
similarity."""

MIN_DEGREES_OF_FREEDOM = 6
"""An estimated sigma with fewer degrees of freedom is off by 30 percent and more."""

TYPICAL_SIGMA_M = 0.0002
"""Sigma of a careful touch, metres, assumed for the degrees of freedom that an estimate lacks."""


class Limit(NamedTuple):
    """The largest plausible standard deviation of a touch's coordinate."""

    touch_sigma: float  # part that the robot's tip causes, metres
    field_share: float  # part that the camera causes, relative to the size of the field

    def of(self, field: float) -> float:
        """Return the limit for a field of the given size, metres."""
        return math.hypot(self.touch_sigma, self.field_share * field)


MAX_SIGMA = Limit(0.0005, 0.001)
"""Larger residuals may be mistakes: a hand-guided robot and a camera of 640 x 480 pixels stay below
this limit."""

MIN_VARIANCE_RATIO = 1e-8


class Evidence(NamedTuple):
    """The data that the tests examine; lengths are normalized by ``normalization``."""

    pairs: Pairs
    fitted: Fit  # the fit of the model that is used
    candidates: Candidates  # the fits of the other models
    preferred: ModelName  # the model that the points justify
    is_model_given: bool  # whether the user chose the model
    # (N, 3), residual of each point with the fit to the other points; NaN if there is none
    held_out: Array
    sigma: float | None  # standard deviation of a touch's coordinate; None if it was not given
    max_sigma: float  # the sigma that the user gave, else the largest plausible one
    normalization: Normalization  # centre and size of the points
    nominal_scale: float | None  # metres per unit of the camera's points; None if it was not given
    # cosine between tool and normal; None if the tool's axis was not given
    tool_cosine: float | None
    point_numbers: NDArray[np.intp]  # (N,), numbers of the points in messages, from 1


def find_warnings(evidence: Evidence) -> tuple[Remark, ...]:
    """Return the warnings, the most serious first."""
    tests = (
        _test_planarity,
        _test_residuals,
        _test_wrong_touches,
        _test_model,
        _test_scale,
        _test_held_out,
        _test_sigma,
        _test_side,
    )
    return tuple(remark for test in tests for remark in test(evidence))


def estimate_sigma(squared: float, freedom: int, typical: float) -> float:
    """Estimate the sigma of residuals from the sum of their squares.

    ``typical``: sigma assumed for the degrees of freedom that are missing; few residuals may all be
    small by chance.
    """
    missing = max(0, MIN_DEGREES_OF_FREEDOM - freedom)
    return math.sqrt((squared + missing * typical**2) / (freedom + missing))


def check_side(normal: Array, tool_z: Array) -> float:
    """Return the cosine between tool and normal; raise MIRRORED if they point to the same side."""
    cosine = float(normal @ tool_z) / float(np.linalg.norm(tool_z))
    if cosine > MIN_TOOL_COSINE:
        raise Code.MIRRORED.error(
            "expected the plane's normal to point against the tool, got one along it (cosine "
            f"{cosine:.2f}): the camera's y axis points the wrong way, or points are swapped",
            -1.0,
            cosine,
        )
    return cosine


def check_scale(measured: float, nominal: float, uncertainty: float, *, exact: bool) -> str | None:
    """Return the text of a remark if the scale is not the nominal one, else None.

    Scales are in metres per unit of the camera; ``uncertainty`` is the standard deviation of
    ``measured``, as a share of it. Raises SCALE_MISMATCH if the scale is off by more than a tenth,
    or at all if it must be ``exact``.
    """
    deviation = measured / nominal - 1.0
    if abs(deviation) <= max(SCALE_TOLERANCE, 3.0 * uncertainty):
        return None
    percent = f"{100 * deviation:+.2g}" if abs(deviation) < 0.1 else f"{100 * deviation:+.0f}"
    text = f"scale: expected {nominal:.6g} m for each unit of the camera, got {measured:.6g}"
    text += f" ({percent} %): the print, the units or the height are other than thought"
    if exact or abs(deviation) > MAX_SCALE_ERROR:
        raise Code.SCALE_MISMATCH.error(text, nominal, measured)
    return text


def _test_planarity(evidence: Evidence) -> Iterator[Remark]:
    """Compare the residuals along the normal with the given noise, or with those in the plane."""
    affine, weights = evidence.candidates.get("affine"), evidence.pairs.weights
    freedom = len(weights) - 3
    if affine is None or not freedom:
        return
    normal = np.cross(*affine.matrix[:3, :2].T)
    normal /= np.linalg.norm(normal)
    heights = affine.residuals @ normal
    squares_of_heights = float((weights * heights**2).sum())
    fitted = evidence.fitted.residuals
    squares_in_plane = sum_of_squares(fitted - np.outer(fitted @ normal, normal), weights)
    noise = touch_noise(evidence.sigma, squares_in_plane, evidence.fitted.freedom - freedom)
    if noise is not None and noise.chance(squares_of_heights, freedom) < SIGNIFICANCE_LEVEL:
        worst, mm = int(np.argmax(weights * heights**2)), 1e3 * evidence.normalization.robot_size
        yield Code.NOT_PLANAR.remark(
            f"the touched points lie {mm * math.sqrt(squares_of_heights / freedom):.3g} mm rms "
            f"out of a plane, touching errors alone would give {mm * math.sqrt(noise.variance):.3g}"
            " mm; "
            f"point {evidence.point_numbers[worst]} is the furthest, "
            f"{mm * abs(float(heights[worst])):.3g} mm"
        )


def _test_residuals(evidence: Evidence) -> Iterator[Remark]:
    """Test for one point that is far worse than the others, then test all of them together."""
    fitted, weights = evidence.fitted, evidence.pairs.weights
    total = sum_of_squares(fitted.residuals, weights)
    chances = [
        _residual_chance(evidence, squared, total) for squared in _studentized_squares(fitted)
    ]
    worst = int(np.argmin(chances))
    if chances[worst] * len(chances) < SIGNIFICANCE_LEVEL:
        length = float(np.linalg.norm(fitted.residuals[worst]))
        residual = 1e3 * evidence.normalization.robot_size * length
        yield Code.OUTLIER.remark(
            f"point {evidence.point_numbers[worst]} fits far worse than the others: its residual "
            f"of {residual:.3g} mm comes by chance once in {1 / max(chances[worst], 1e-12):.3g} "
            "touches"
        )
        return
    max_sigma = max(evidence.max_sigma, ROUNDING_RATIO)
    if fitted.freedom and Noise(max_sigma**2).chance(total, fitted.freedom) < SIGNIFICANCE_LEVEL:
        mm = 1e3 * evidence.normalization.robot_size
        how = "was given" if evidence.sigma is not None else "is the most that is taken for noise"
        yield Code.POOR_FIT.remark(
            "the residuals speak of touches with a sigma of "
            f"{mm * math.sqrt(total / fitted.freedom):.3g} mm, where {mm * max_sigma:.3g} mm {how}"
        )


def _test_wrong_touches(evidence: Evidence) -> Iterator[Remark]:
    """Test whether one or two wrong touches explain the residuals as well as a tilted camera."""
    fitted, pairs = evidence.fitted, evidence.pairs
    count = len(pairs.camera)
    if (
        fitted.model not in {"affine", "homography"}
        or not fitted.freedom
        or count > MAX_POINTS_FOR_PAIRS
    ):
        return
    noise = touch_noise(
        evidence.sigma, sum_of_squares(fitted.residuals, pairs.weights), fitted.freedom
    )
    explanations: list[tuple[float, tuple[int, ...]]] = []
    for removed_count in (1, 2):
        for removed in itertools.combinations(
            range(count), removed_count if count - removed_count > MIN_POINTS_LEFT else 0
        ):
            try:
                similarity = fit("similarity", pairs.leave_out(*removed))
            except CalibrationError:  # the others lie in a line
                continue
            squared = sum_of_squares(similarity.residuals, np.delete(pairs.weights, removed))
            explanations.append(
                (0.0 if noise is None else noise.chance(squared, similarity.freedom), removed)
            )
    chance, removed = max(explanations, default=(0.0, ()))
    if removed and chance > SIGNIFICANCE_LEVEL:
        points = " and ".join(str(evidence.point_numbers[i]) for i in removed)
        yield Code.OUTLIER.remark(
            f"point{'s' * (len(removed) > 1)} {points} may be wrong: without them, one scale fits "
            f"the rest as well as the model {fitted.model} fits all points"
        )


def _residual_chance(evidence: Evidence, squared: float, total: float) -> float:
    """Return a residual's p-value; the noise is estimated from the other residuals if possible."""
    freedom = evidence.fitted.freedom - 3
    sigma = evidence.sigma if freedom < MIN_DEGREES_OF_FREEDOM else None
    noise = touch_noise(sigma, max(total - squared, 0.0), freedom)
    return 1.0 if noise is None else noise.chance(squared, 3)


def _studentized_squares(fitted: Fit) -> Array:
    """Return each residual's square over its variance (N,); 0 where the variance is 0."""
    values, vectors = np.linalg.eigh(fitted.residual_covariances)
    components = np.einsum("nij,ni->nj", vectors, fitted.residuals)
    is_determined = values > MIN_VARIANCE_RATIO * values.max()
    squares: Array = np.where(
        is_determined, components**2 / np.where(is_determined, values, 1.0), 0.0
    ).sum(axis=1)
    return squares


def _test_model(evidence: Evidence) -> Iterator[Remark]:
    """Warn if the field has no single scale, or if the points justify another model."""
    used, preferred = evidence.fitted.model, evidence.preferred
    if preferred not in {"affine", "homography"} or (evidence.is_model_given and used == preferred):
        return
    simple_model: ModelName = used if evidence.is_model_given else "similarity"
    errors = [
        1e3 * evidence.normalization.robot_size * evidence.candidates.error(name)
        for name in (simple_model, preferred)
    ]
    text = (
        f"held-out error with the model {simple_model} {errors[0]:.3g} mm, with {preferred} "
        f"{errors[1]:.3g} mm: the camera is tilted or its lens distorts"
    )
    yield Code.NOT_SIMILAR.remark(
        f"{text}; {used} was asked for" if evidence.is_model_given else text
    )


def _test_scale(evidence: Evidence) -> Iterator[Remark]:
    similarity = evidence.candidates.get("similarity")
    if evidence.nominal_scale is None or similarity is None:
        return
    unit = evidence.normalization.robot_size / evidence.normalization.camera_size
    measured = unit * float(np.linalg.norm(similarity.matrix[:3, 0]))
    total = sum_of_squares(similarity.residuals, evidence.pairs.weights)
    noise = touch_noise(evidence.sigma, total, similarity.freedom)
    weight = float(evidence.pairs.weights.sum())
    uncertainty = 0.0 if noise is None else math.sqrt(noise.variance / weight)
    exact = evidence.fitted.model == "rigid"
    text = check_scale(measured, evidence.nominal_scale, uncertainty, exact=exact)
    if text is not None:
        yield Code.SCALE_MISMATCH.remark(text)


def _test_held_out(evidence: Evidence) -> Iterator[Remark]:
    missing = np.flatnonzero(np.isnan(evidence.held_out).any(axis=1))
    if len(missing) == len(evidence.held_out):
        yield Code.NOT_HELD_OUT.remark(
            f"{len(missing)} points are just enough for the model {evidence.fitted.model}: none "
            "can be left out to see how good the calibration is, and the residuals do not tell"
        )
    elif len(missing):
        yield Code.NOT_HELD_OUT.remark(
            f"without point {evidence.point_numbers[missing[0]]} the others give no calibration: "
            "nothing checks it"
        )


def _test_sigma(evidence: Evidence) -> Iterator[Remark]:
    freedom = evidence.fitted.freedom
    if evidence.sigma is None and freedom < MIN_DEGREES_OF_FREEDOM:
        how = f"is estimated from {freedom} degrees of freedom only" if freedom else "is not known"
        yield Code.UNVERIFIED.remark(
            f"the touches' sigma {how}: give touch_sigma or touch more points"
        )


def _test_side(evidence: Evidence) -> Iterator[Remark]:
    return side_remarks(evidence.tool_cosine)


def side_remarks(tool_cosine: float | None) -> Iterator[Remark]:
    """Yield a remark if the tool's axis does not show the side of the plane.

    ``tool_cosine``: the cosine between tool and normal, None if the tool's axis was not given.
    """
    if tool_cosine is None or abs(tool_cosine) <= MIN_TOOL_COSINE:
        yield Code.SIDE_UNKNOWN.remark(
            "the tool's axis does not tell from which side the plane is touched: that the camera's "
            "y axis points the right way is not checked"
        )
