"""Compare two calibrations of one lens, and test whether noise explains the difference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, an_integer, check_arguments, each, or_none
from smartcam.calibration._lens.field import (
    DEFAULT_MAP_SHAPE,
    MIN_MOTION_PLACES,
    check_distance,
    finite_points,
    map_pixels,
    points_of_pixels,
    sensitivity,
)
from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
from smartcam.calibration._lens.uncertainty import MapFigures, figures
from smartcam.calibration._statistics import Noise
from smartcam.geometry import CameraModel, Transform
from smartcam.geometry._inside import IDENTITY, Code

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array, Rigid

CELLS: Final = (6, 8)
"""An image is divided into this many rows and columns of cells, to find where both calibrations
have seen the target."""

SIGNIFICANCE_LEVEL: Final = 0.01
"""Two calibrations count as different if noise alone makes them differ as much with a lower
probability than this."""

MIN_CHANCE: Final = 1e-9
"""Smallest probability that is reported: the noise is not exactly normal, so smaller values mean
nothing."""

MAX_STEPS: Final = 50
"""The fit of the motion takes at most this many steps; it usually takes five."""

MAX_FINAL_STEP_PX: Final = 1e-9
"""The fit of the motion ends when a step moves no point by more than this many pixels."""

MIN_DIFFERENCE_PX: Final = 1e-3
"""Differences below this many pixels are taken as 0."""


class Lens(NamedTuple):
    """A lens and its uncertainty, for the comparison of one calibration with another.

    Attributes:
        camera: the lens.
        covariance: (4 + K, 4 + K), covariance of the lens' values; None: not known.
        points: (N, 3), places of the target's points in the camera's frame, metres; None: not
            known.
        views: number of views from which ``covariance`` was estimated.
    """

    camera: CameraModel
    covariance: Array | None = None
    points: Array | None = None
    views: int = 1

    @classmethod
    def of(cls, source: IntrinsicCalibration | CameraModel) -> Lens:
        """Return the lens of a calibration, or a bare lens; raise ``SHAPE`` for anything else."""
        if isinstance(source, IntrinsicCalibration):
            views = sum(fit.used for fit in source.views)
            return cls(source.camera, source.covariance, source.target_points, views)
        if isinstance(source, CameraModel):
            return cls(source)
        raise Code.SHAPE.error_with_value(
            "compare_lenses: expected calibrations of lenses, or camera models",
            "IntrinsicCalibration or CameraModel",
            type(source).__name__,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class LensComparison:
    """The result of :func:`compare_lenses`.

    Attributes:
        distance: distance of the points from the camera, metres; None: infinity.
        pixels: (h, w, 2), pixels of the points in the first lens.
        difference: (h, w, 2), the pixel of the same point in the second lens minus that in the
            first, after ``motion``; NaN where a lens does not show the point.
        expected: (h, w, 2, 2), covariance of ``difference`` that the noise of both calibrations
            causes; None if one of the two is not known.
        motion: ``T_b_a``, the small motion of the camera that was removed from the difference.
        ratio: RMS of the differences over that expected from noise: about 1 if there is only noise;
            None without ``expected``.
        chance: probability, 0 to 1, with which noise alone makes the calibrations differ as much;
            None without ``expected``.
    """

    distance: float | None
    pixels: Array
    difference: Array
    expected: Array | None
    motion: Transform
    ratio: float | None
    chance: float | None

    @property
    def lengths(self) -> Array:
        """Lengths of the differences over sqrt(2), as the RMS of a coordinate, (h, w), pixels."""
        lengths: Array = np.linalg.norm(self.difference, axis=2) / math.sqrt(2)
        return lengths

    @property
    def observed(self) -> MapFigures:
        """Four numbers that sum up the differences, RMS of a coordinate, pixels."""
        return figures(self.lengths)

    @property
    def predicted(self) -> MapFigures | None:
        """Four numbers that sum up the differences by noise alone; None if the noise is unknown."""
        if self.expected is None:
            return None
        return figures(np.sqrt(np.trace(self.expected, axis1=2, axis2=3) / 2))

    @property
    def same(self) -> bool | None:
        """True if noise explains the difference; None if the noise is not known."""
        return None if self.chance is None else self.chance >= SIGNIFICANCE_LEVEL

    @property
    def verdict(self) -> str:
        """Result of the comparison in words."""
        if self.chance is None or self.ratio is None:
            return "no verdict: it needs the uncertainty of both, known to calibrations from views"
        chance = f"{self.chance:.2g}" if self.chance > MIN_CHANCE else f"below {MIN_CHANCE:g}"
        noise = f"{self.ratio:.2f} times what noise leads to, chance {chance}"
        if self.same:
            return f"the same within their noise: {noise}"
        return f"they differ by more than their noise explains: {noise}"


@check_arguments(distance=or_none(a_number), shape=each(an_integer, 2))
def compare_lenses(
    a: IntrinsicCalibration | CameraModel,
    b: IntrinsicCalibration | CameraModel,
    *,
    distance: float | None = None,
    shape: tuple[int, int] = DEFAULT_MAP_SHAPE,
) -> LensComparison:
    """Compare the pixels to which two calibrations of one lens project the same points.

    A small motion of the camera is removed from the difference first: the motion that fits best to
    the target's points in the area that both calibrations have seen. For lenses without views it is
    fitted to points at the distance, in the largest circle around the image's centre. The noise of
    the two is assumed to be independent; calibrations from the same images differ less.

    Args:
        a: calibration that is subtracted, or a bare lens, which is compared without a prediction.
        b: the other calibration or lens, for images of the same size.
        distance: distance of the points, metres; None: infinity.
        shape: rows and columns of the map, 2 to 500 each, from corner to corner.

    Raises:
        CalibrationError: ``SHAPE``: neither calibrations nor lenses, or no such rows and columns;
            ``WRONG_SIZE``: images of two sizes; ``NOT_FINITE``: no such distance; ``OUT_OF_FIELD``:
            the lenses share too few places of the image; ``POOR_FIT``: no motion maps one
            lens to the other.
    """
    return compare_estimates(Lens.of(a), Lens.of(b), distance=distance, shape=shape)


def compare_estimates(
    a: Lens, b: Lens, *, distance: float | None = None, shape: tuple[int, int] = DEFAULT_MAP_SHAPE
) -> LensComparison:
    """Compare two lenses, as :func:`compare_lenses` does."""
    check_distance(distance)
    camera_a, camera_b, at_infinity = a.camera, b.camera, distance is None
    if tuple(camera_a.size) != tuple(camera_b.size):
        raise Code.WRONG_SIZE.error(
            f"compare_lenses: expected lenses of images of one size, got {camera_a.size[0]} x "
            f"{camera_a.size[1]} and {camera_b.size[0]} x {camera_b.size[1]} pixels",
            camera_a.size,
            camera_b.size,
        )
    pixels = map_pixels(camera_a.size, shape)
    alignment_points, has_no_views = _alignment_points(a, b, distance)
    motion = _align(camera_a, camera_b, alignment_points, at_infinity=at_infinity and has_no_views)
    points = points_of_pixels(camera_a, pixels.reshape(-1, 2), distance)
    moved = points @ motion.rotation.T + (0.0 if at_infinity else motion.translation)
    difference = _project(camera_b, moved) - pixels.reshape(-1, 2)
    expected, ratio, chance = None, None, None
    if a.covariance is not None and b.covariance is not None:
        aligned = alignment_points @ motion.rotation.T + motion.translation
        by_lens_a = sensitivity(camera_a, points, at_infinity=at_infinity).without_motion(
            sensitivity(camera_a, alignment_points)
        )
        by_lens_b = sensitivity(camera_b, moved, at_infinity=at_infinity).without_motion(
            sensitivity(camera_b, aligned)
        )
        deviations = np.concatenate(
            [by_lens_a @ _square_root(a.covariance), by_lens_b @ _square_root(b.covariance)], axis=2
        )
        difference[~np.isfinite(deviations).all(axis=(1, 2))] = np.nan
        ratio, chance = _test_differences(difference, deviations, a.views + b.views - 2)
        expected = (deviations @ deviations.swapaxes(1, 2)).reshape(*shape, 2, 2)
    return LensComparison(
        distance=distance,
        pixels=pixels,
        difference=difference.reshape(*shape, 2),
        expected=expected,
        motion=Transform("b", "a", *motion),
        ratio=ratio,
        chance=chance,
    )


def rig_difference(
    a: Transform, b: Transform, first: LensComparison, second: LensComparison
) -> tuple[float, float]:
    """Return the difference between two calibrations of a pair in the pose of its cameras.

    Comparing the lenses removed a small motion from each difference; these motions are added again.

    Args:
        a: ``T_second_first`` of the one calibration.
        b: ``T_second_first`` of the other calibration.
        first: comparison of the lenses of the first camera.
        second: comparison of the lenses of the second camera.

    Returns:
        The turn between both, radians, and the shift, metres.
    """
    moved = second.motion.rigid @ a.rigid @ first.motion.rigid.inverse()
    shift = float(np.linalg.norm(moved.translation - b.translation))
    return float(moved.angle_to(b.rigid)), shift


def _alignment_points(a: Lens, b: Lens, distance: float | None) -> tuple[Array, bool]:
    """Return the points to which the motion is fitted, and whether neither lens has views.

    The points are those of the target in the cells of the image in which both lenses saw it, or in
    all cells if these are too few. For lenses without views, they are points in the largest circle
    around the image's centre: in corners without any view, lenses may project so differently that
    the camera would seem turned.
    """
    known = [(lens.camera, lens.points) for lens in (a, b) if lens.points is not None]
    if not known:
        size = np.array(a.camera.size, dtype=np.float64)
        pixels = map_pixels(a.camera.size, DEFAULT_MAP_SHAPE).reshape(-1, 2)
        is_inside = np.linalg.norm(pixels - (size - 1) / 2, axis=1) <= size.min() / 2
        return finite_points(points_of_pixels(a.camera, pixels[is_inside], distance)), True
    cells = [_cells(camera, points) for camera, points in known]
    common = set(cells[0]).intersection(*cells)
    all_points = np.concatenate([points for _, points in known])
    common_points = all_points[np.isin(np.concatenate(cells), list(common))]
    return finite_points(common_points if len(common) >= MIN_MOTION_PLACES else all_points), False


def _cells(camera: CameraModel, points: Array) -> list[int]:
    """Return the index of the cell in which each point is seen."""
    cell = (camera.project(points) + 0.5) / camera.size * CELLS[::-1]
    columns, rows = np.clip(np.floor(cell), 0, np.array(CELLS[::-1]) - 1).astype(int).T
    cells: list[int] = (rows * CELLS[1] + columns).tolist()
    return cells


def _align(
    first: CameraModel, second: CameraModel, alignment_points: Array, *, at_infinity: bool
) -> Rigid:
    """Return the motion after which both lenses project the same points to the same pixels.

    ``at_infinity``: the points are directions, so the motion is a turn. The method is Gauss-Newton.
    """
    pixels, motion = first.project(alignment_points), IDENTITY
    for _ in range(MAX_STEPS):
        moved = alignment_points @ motion.rotation.T + motion.translation
        by_motion = sensitivity(second, moved, at_infinity=at_infinity).by_motion.reshape(-1, 6)
        residuals = (pixels - _project(second, moved)).reshape(-1)
        finite = np.isfinite(residuals)
        if np.count_nonzero(finite) < len(finite) / 2:
            break
        step = np.asarray(
            np.linalg.lstsq(by_motion[finite], residuals[finite], rcond=None)[0], dtype=np.float64
        )
        motion = motion.turned_in_target(step)
        if np.abs(by_motion[finite] @ step).max() < MAX_FINAL_STEP_PX:
            return motion
    raise Code.POOR_FIT.error(
        "compare_lenses: expected two calibrations of one lens, got two that no motion of the "
        "camera makes agree",
        "two calibrations of one lens",
    )


def _project(camera: CameraModel, points: Array) -> Array:
    """Project points to pixels (N, 2); NaN stays NaN."""
    finite = np.isfinite(points).all(axis=1, keepdims=True)
    return np.where(finite, camera.project(np.where(finite, points, [0.0, 0.0, 1.0])), np.nan)


def _square_root(covariance: Array) -> Array:
    """Return S with S S^T the covariance."""
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _test_differences(difference: Array, deviations: Array, views: int) -> tuple[float, float]:
    """Return the ratio of differences (N, 2) to the expected ones, and its probability.

    ``deviations`` (N, 2, K): S with S S^T their covariance. ``views``: number of views from which
    both covariances were estimated, minus one for each.
    """
    # With D the covariances of the places by themselves, Q = sum of e^T D^-1 e has the mean 2 N and
    # is distributed as the sum of l times chi^2 of 1, l the eigenvalues of D^-1/2 S S^T D^-1/2,
    # which are those of S^T D^-1 S: places move together, since a lens has some ten values. So
    # Q / (2 N) is as chi^2 over its freedom, (sum l)^2 / sum l^2 (Satterthwaite, An Approximate
    # Distribution of Estimates of Variance Components, 1946); and as D is an estimate itself, it is
    # F. Only half of the views are counted, since some tell far more than others.
    finite = np.isfinite(difference).all(axis=1)
    if not finite.any():
        raise Code.OUT_OF_FIELD.error(
            "compare_lenses: expected lenses that reach the same places of the image, got none",
            got=0,
        )
    residuals, finite_deviations = difference[finite], deviations[finite]
    inverse = np.linalg.inv(
        finite_deviations @ finite_deviations.swapaxes(1, 2) + MIN_DIFFERENCE_PX**2 * np.eye(2)
    )
    squares = float(np.einsum("ni,nij,nj->", residuals, inverse, residuals)) / (2 * len(residuals))
    gram = np.einsum("nip,nij,njq->pq", finite_deviations, inverse, finite_deviations)
    total, trace_of_square = float(np.trace(gram)), float((gram**2).sum())
    if trace_of_square <= 0.0:  # no value of either lens was fitted
        return math.sqrt(squares), float(squares <= 1.0)
    noise = Noise(1.0, max(views // 2, 1))
    freedom = total**2 / trace_of_square
    return math.sqrt(squares), noise.chance(freedom * squares, freedom)
