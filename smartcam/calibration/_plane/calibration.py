"""Map localizations in a camera's plane to poses of a robot.

::

    calibration = fit_plane(camera_points, robot_points, touch_sigma=0.0002)
    poses = calibration.to_robot(result.value)
    calibration.predicted_error([[0.10, 0.05]])     # metres, rms

Each point is seen by the camera and touched by the robot. Three points are needed; nine show how
good the calibration is. With six or more, ``robust=True`` leaves out those that are wrong.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias, overload

import numpy as np
from pydantic import StrictBool

from smartcam._argument_checks import check_arguments, numbers, or_none
from smartcam._arguments import check_flag, check_text, excerpt
from smartcam._forks import cached_property
from smartcam.calibration._files import storage
from smartcam.calibration._homography import element_derivatives
from smartcam.calibration._one_blas_thread import one_blas_thread
from smartcam.calibration._plane.diagnostics import (
    MAX_SIGMA,
    TYPICAL_SIGMA_M,
    Evidence,
    check_side,
    estimate_sigma,
    find_warnings,
)
from smartcam.calibration._plane.fitting import MODELS, Fit, ModelName, Normalization
from smartcam.calibration._plane.mapping import PlaneMap
from smartcam.calibration._plane.model_selection import (
    ROUNDING_RATIO,
    Candidates,
    rms,
    sum_of_squares,
)
from smartcam.calibration._plane.order import find_better_order
from smartcam.calibration._plane.pose_sigmas import robot_sigmas
from smartcam.calibration._plane.robust import find_agreeing
from smartcam.calibration._plane.validation import (
    check_lever,
    check_positive,
    check_samples,
    extent,
    lever,
    merge_repeated,
    normalize,
    read_pairs,
)
from smartcam.calibration._statistics import Noise, common_move, normal_deviations
from smartcam.calibration._verdict import Allowed, judge
from smartcam.exceptions import ConfigurationError
from smartcam.geometry._inside import Array, Code, Remark, as_points, as_vector
from smartcam.models import Localization

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import ArrayLike, NDArray

    from smartcam.calibration._verdict import AdvisedVerdict, CalibrationVerdict

KIND = "plane"

PlaneModel: TypeAlias = Literal["auto", "rigid", "similarity", "affine", "homography"]

POINTS_PER_BLOCK = 16_384
"""Covariances are computed for this many points at a time, which takes 5 MB."""

MIN_POINTS_FOR_VERDICT: dict[str, int] = {"rigid": 5, "similarity": 5, "affine": 6, "homography": 8}
"""A verdict needs at least this many points: fewer points may fit the model although two of them
are wrong in the same way (simulated)."""

MAX_TOUCH_SIGMAS = 4.0
"""A remark names a touch that is farther than this many sigmas from the mean of all touches of its
point: noise alone causes that once in a thousand touches."""

MIN_DIRECTION_LENGTH = 1e-9
"""A vector shorter than this has no direction."""

STALE_LEVEL = 0.01
"""Default of the probability with which a calibration that still holds may be called stale."""


class Drift(NamedTuple):
    """Result of touching points again and comparing them with the calibration.

    Attributes:
        offsets: touched minus expected (K, 3), metres.
        expected: RMS length of the offsets that errors of touches and calibration explain, metres.
        chance: probability, 0 to 1, with which these errors alone give offsets as large.
        z: ``chance`` in standard deviations of a normal distribution.
        stale: True if ``chance`` is less than the given level.
    """

    offsets: Array
    expected: float
    chance: float
    z: float
    stale: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaneCalibration(storage.SavedCalibration):
    """The result of :func:`fit_plane`; immutable.

    ``==`` is True only for the same object; compare the contents by :meth:`to_data`.

    Attributes:
        model: ``rigid``, ``similarity``, ``affine``, ``homography``, or ``touches`` for
            :func:`~smartcam.calibration.fit_touches`.
        camera_points: (N, 2), as given.
        robot_points: (N, 3), as given, metres.
        weights: (N,), as given, or ones; 0 for a point that ``robust`` left out.
        matrix: (4, 3) with ``w (x, y, z, 1) = matrix (u, v, 1)``, metres.
        normalization: centre and size of the points, in both spaces.
        unit_covariance: (12, 12), of the elements of the matrix between the centred and scaled
            points, row by row, for touches with a variance of 1 m^2.
        residuals: (N, 3), robot minus mapped, metres. They are smaller than the true errors, except
            for points that were left out.
        leave_one_out: (N, 3), robot minus the place mapped by a calibration from the other points,
            metres; NaN if these give no fit. It includes the error of the point's own touch. For a
            point left out it is the residual.
        freedom: number of coordinates of the points that count, minus that of parameters.
        touch_sigma: standard deviation of one coordinate of a touch of weight 1, metres: as given
            or, if ``sigma_given`` is false, estimated from the residuals; None if it cannot be
            estimated.
        sigma_given: whether ``touch_sigma`` was given.
        candidate_errors: RMS held-out error of each compared model, metres; None for a model
            without one.
        nominal_scale: expected metres per unit of the camera's points.
        tool_z: (3,), direction of the tool's axis into the plane; None if it is not known.
        height: height of the plane over the touched one, metres; see :meth:`at_height`.
        robot_frame: name of the frame that poses are given in.
        camera_frame: name of the frame that localizations must come in; None for any.
        y_down: whether the camera's own y axis points down; the points here have the opposite y, as
            :func:`smartcam.connect` gives them with ``y_down``; None: not known.
        allowed_error: error that 95 of 100 points may have at most, as the user wants, metres;
            None: :attr:`verdict` takes a hundredth of the touched field.
        warnings: remarks to read before using the calibration; they number the points from 1, as
            pictures and wizards do.
    """

    kind: ClassVar[str] = KIND
    _label: ClassVar[str] = "plane calibration"
    _keys: ClassVar[storage.Keys] = {"normalization": "place", "candidate_errors": "candidates"}
    _optional_keys: ClassVar[frozenset[str]] = frozenset(
        {"tool_z", "height", "camera_frame", "y_down", "allowed_error"}
    )

    model: ModelName | Literal["touches"]
    camera_points: Annotated[Array, storage.rows(storage.Pair, 2, min_length=3)]
    robot_points: Annotated[Array, storage.rows(storage.Triple, 3, min_length=3)]
    weights: Annotated[Array, storage.rows(storage.NonNegative, min_length=3)]
    matrix: storage.Matrix43
    normalization: Normalization
    unit_covariance: Annotated[Array, storage.matrix(12)]
    residuals: Annotated[Array, storage.rows(storage.Triple, 3, min_length=3)]
    leave_one_out: Annotated[
        Array, storage.rows(storage.NullableTriple, 3, min_length=3, nulls=True)
    ]
    freedom: storage.Count
    touch_sigma: storage.NonNegative | None
    sigma_given: bool
    candidate_errors: dict[str, storage.Number | None]
    nominal_scale: storage.Positive | None = None
    tool_z: storage.Vector3 | None = None
    height: storage.Number = 0.0
    robot_frame: str = "robot"
    camera_frame: str | None = None
    y_down: StrictBool | None = None
    allowed_error: storage.Positive | None = None
    warnings: storage.Remarks = ()

    def __post_init__(self) -> None:
        fields = [getattr(self, field.name) for field in dataclasses.fields(self)]
        for array in (*fields, self.normalization.camera_centre, self.normalization.robot_centre):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False

    @cached_property
    def _map(self) -> PlaneMap:
        return PlaneMap(self.matrix, self.normalization.camera_centre)

    @cached_property
    def _local_matrix(self) -> Array:
        """The matrix between centred and scaled points (4, 3)."""
        return self.normalization.to_normalized(self.matrix)

    @property
    def rotation(self) -> Array:
        """R_robot_camera (3, 3): x is the camera's x at the centre, z the plane's normal."""
        return self._map.frame

    @property
    def normal(self) -> Array:
        """The plane's normal (3,), towards the side from which the camera's x turns left to y."""
        normal: Array = self._map.frame[:, 2]
        return normal

    @property
    def origin(self) -> Array:
        """Position (3,) of the camera's (0, 0), metres."""
        origin: Array = self.transform([[0.0, 0.0]])[0]
        return origin

    @property
    def scale(self) -> float:
        """Metres per unit of the camera's points, at their centre."""
        return self._map.scale

    @property
    def held_out_error(self) -> float | None:
        """Rms length of :attr:`leave_one_out`, metres; None if a point has none."""
        value = rms(self.leave_one_out, self.weights)
        return None if math.isnan(value) else value

    @property
    def outliers(self) -> tuple[int, ...]:
        """Indices of the points that ``robust`` left out; they count in no error."""
        return tuple(np.flatnonzero(self.weights == 0.0).tolist())

    @property
    def worst(self) -> int:
        """Index of the point with the largest held-out error, or residual if there is none.

        Points that were left out do not count.
        """
        held_out = not np.isnan(self.leave_one_out).any()
        errors = self.leave_one_out if held_out else self.residuals
        return int(np.argmax(self.weights * (errors**2).sum(axis=1)))

    @property
    def verdict(self) -> CalibrationVerdict:
        """Verdict on the calibration: its quality, the error to expect, and what to do about it."""
        return self.judged().verdict

    def judged(self, predicted: float | None = None, where: str = "") -> AdvisedVerdict:
        """Return the verdict and the advice.

        ``predicted``: RMS error to expect, metres; None: that at the touched points. ``where``: the
        place for which the verdict holds, as a part of its text.
        """
        is_used, left_out = self.weights > 0.0, [1 + index for index in self.outliers]
        if predicted is None and self.touch_sigma is not None:
            at_points = self.predicted_error(self.camera_points[is_used])
            predicted = math.sqrt(float((at_points**2).mean()))
        without_text = (
            f" without point{'s' * (len(left_out) > 1)} {', '.join(map(str, left_out))}"
            if left_out
            else ""
        )
        held_out, advice = self.held_out_error, "touch more points"
        point_count = len(np.unique(self.camera_points[is_used], axis=0))
        if point_count < (min_points := MIN_POINTS_FOR_VERDICT.get(self.model, 0)):
            held_out = None
            advice = (
                f"two wrong ones of {point_count} points can look right: touch {min_points} or more"
            )
        return judge(
            None if held_out is None else 1e3 * held_out,
            [
                warning
                for warning in self.warnings
                if not (left_out and warning.code == Code.OUTLIER)
            ],
            worst=1 + self.worst,
            predicted=None if predicted is None else 1e3 * predicted,
            allowed=Allowed.of(self.allowed_error, extent(self.robot_points[is_used])),
            advice=advice,
            where=f"{where}{without_text}",
        )

    def transform(self, points: ArrayLike, out: Array | None = None) -> Array:
        """Map points of the camera to the robot's space.

        Args:
            points: (N, 2), in the unit that the calibration was made in; or (N, 3) with a third
                component 1, which is faster for a contiguous array of many points.
            out: (N, 3), contiguous float64, written and returned; None for a new array.

        Returns:
            (N, 3), metres. NaN gives NaN.

        Raises:
            CalibrationError: SHAPE; OUT_OF_FIELD: a point behind the plane's horizon; NOT_FINITE: a
                result is no finite number.
        """
        return self._map.transform(points, out)

    def inverse(self, points: ArrayLike) -> Array:
        """Map points of the robot's space to the camera's.

        Args:
            points: (N, 3), metres; a point off the plane is projected onto it first.

        Returns:
            (N, 2), in the camera's unit.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE; OUT_OF_FIELD: not visible from the camera.
        """
        return self._map.inverse(points)

    @overload
    def to_robot(self, localizations: Localization, *, tool_flip: bool = False) -> Localization: ...
    @overload
    def to_robot(
        self, localizations: Iterable[Localization], *, tool_flip: bool = False
    ) -> list[Localization]: ...
    def to_robot(
        self, localizations: Localization | Iterable[Localization], *, tool_flip: bool = False
    ) -> Localization | list[Localization]:
        """Return localizations with their poses in the robot's space.

        Their z axis is the plane's normal, their x axis the part's. The header is in the robot's
        frame; number and time do not change. If a pose has a ``sigma``, and the touches' sigma is
        known, its robot pose has a ``sigma`` that includes the calibration's own error.

        Args:
            localizations: localizations of the camera, one or many.
            tool_flip: turn each pose by pi about its own x, so that z points into the plane, like
                the z of a tool that picks the part.

        Raises:
            CalibrationError: WRONG_FRAME: they come in another frame than ``camera_frame``;
                OUT_OF_PLANE: a pose is not in the camera's plane; OUT_OF_FIELD: a pose is behind
                the plane's horizon; NOT_FINITE: a value of a pose would be no finite number.
        """
        if isinstance(localizations, Localization):
            return self._poses((localizations,), tool_flip)[0]
        return self._poses(localizations, tool_flip)

    def _poses(self, localizations: Iterable[Localization], flip: bool) -> list[Localization]:
        if not isinstance(localizations, list):
            localizations = [*localizations]
        poses = self._map.poses(localizations, self.robot_frame, self.camera_frame, flip=flip)
        with_sigma = [
            n for n, localization in enumerate(localizations) if localization.pose.sigma is not None
        ]
        if with_sigma and self.touch_sigma is not None:
            sigmas = robot_sigmas(
                [localizations[n] for n in with_sigma],
                self.transform,
                self.normal,
                self._parameter_derivatives,
                self._touch_variance * self.unit_covariance,
                self.normalization.camera_size,
                flip=flip,
            )
            for n, sigma in zip(with_sigma, sigmas, strict=True):
                poses[n] = poses[n]._replace(pose=poses[n].pose.with_sigma(sigma))
        return poses

    def covariance_at(self, points: ArrayLike) -> Array:
        """Return the covariance of mapped points that the touches' noise causes.

        Args:
            points: (K, 2), of the camera.

        Returns:
            (K, 3, 3), m^2, along the robot's axes. The noise of the camera when it sees the point
            is not included.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE; UNVERIFIED: the touches' sigma is not known.
        """
        # J C J^T with the map's Jacobian by its parameters; C is derived in fitting.fit
        camera_array = as_points(points, 2, "camera points")
        return np.concatenate(
            [
                self._block_covariances(camera_array[i : i + POINTS_PER_BLOCK])
                for i in range(0, len(camera_array), POINTS_PER_BLOCK)
            ]
            or [np.zeros((0, 3, 3))]
        )

    def _block_covariances(self, camera_array: Array) -> Array:
        derivatives = self._parameter_derivatives(camera_array)
        covariances: Array = self._touch_variance * (
            derivatives @ self.unit_covariance @ derivatives.swapaxes(1, 2)
        )
        return covariances

    def _parameter_derivatives(self, camera_array: Array) -> Array:
        """Return the derivatives of mapped points by the fit's matrix, (K, 3, 12), metres."""
        normalized = (
            camera_array - self.normalization.camera_centre
        ) / self.normalization.camera_size
        derivatives: Array = self.normalization.robot_size * element_derivatives(
            self._local_matrix, normalized
        )
        return derivatives

    @property
    def _touch_variance(self) -> float:
        if self.touch_sigma is None:
            raise Code.UNVERIFIED.error(
                "predicted error: expected touch_sigma, or more points than the "
                f"{np.count_nonzero(self.weights)} that {self.model} needs",
                "touch_sigma",
            )
        return self.touch_sigma**2

    def predicted_error(self, points: ArrayLike) -> Array:
        """Return the RMS error to expect of mapped points if touches err by noise alone.

        Args:
            points: (K, 2), of the camera.

        Returns:
            (K,), metres: square root of the summed variances along the three axes.

        Raises:
            CalibrationError: as :meth:`covariance_at`.
        """
        error: Array = np.sqrt(np.trace(self.covariance_at(points), axis1=1, axis2=2))
        return error

    def check(
        self, camera_points: ArrayLike, robot_points: ArrayLike, *, level: float = STALE_LEVEL
    ) -> Drift:
        """Compare points that were touched again with the places that the calibration predicts.

        Offsets are compared with the covariance of the new touches plus that of the calibration,
        which all points share. With several points two tests are made, each at half the level: of
        all offsets, and of the one shift that fits them best, since a camera that was knocked
        shifts all points. The more points are touched, the more surely that is noticed.

        Args:
            camera_points: (K, 2), or one point (2,).
            robot_points: (K, 3) or (3,), where the robot touches them, metres.
            level: probability, between 0 and 1, with which a calibration that still holds may be
                called stale.

        Raises:
            CalibrationError: as :meth:`covariance_at`; NOT_FINITE: the level is not valid.
        """
        if not 0.0 < level < 1.0:
            raise Code.NOT_FINITE.error_with_value(
                "level: expected a number between 0 and 1", "a number between 0 and 1", level
            )
        camera_array = as_points(np.atleast_2d(camera_points), 2, "camera points")
        robot_array = as_points(np.atleast_2d(robot_points), 3, "robot points")
        if len(camera_array) != len(robot_array) or not len(camera_array):
            raise Code.SHAPE.error_with_value(
                f"expected as many robot points as camera points ({len(camera_array)}), "
                "one at least",
                len(camera_array),
                len(robot_array),
            )
        offsets = robot_array - self.transform(camera_array)
        derivatives = self._parameter_derivatives(camera_array).reshape(-1, 12)
        variance = self._touch_variance
        offset_covariance = derivatives @ self.unit_covariance @ derivatives.T + np.eye(
            len(derivatives)
        )
        all_squares = float(offsets.ravel() @ np.linalg.solve(offset_covariance, offsets.ravel()))
        shift_basis = np.tile(np.eye(3), (len(camera_array), 1))
        weighted = np.linalg.solve(offset_covariance, shift_basis)
        weighted_sum = weighted.T @ offsets.ravel()
        shift_squares = float(
            weighted_sum @ np.linalg.solve(shift_basis.T @ weighted, weighted_sum)
        )
        noise = Noise(
            max(variance, (ROUNDING_RATIO * self.normalization.robot_size) ** 2),
            None if self.sigma_given else self.freedom,
        )
        chance = noise.chance(all_squares, len(derivatives))
        if len(camera_array) > 1:
            chance = min(1.0, 2.0 * min(chance, noise.chance(shift_squares, 3)))
        expected = math.sqrt(variance * float(np.trace(offset_covariance)) / len(camera_array))
        return Drift(offsets, expected, chance, normal_deviations(chance), chance < level)

    def at_height(self, height: float, camera_position: ArrayLike) -> PlaneCalibration:
        """Return the calibration for features that lie over the touched plane.

        A feature seen at height h lies where the ray from the camera meets the plane raised by h.

        Args:
            height: height over the touched plane, towards the camera, metres.
            camera_position: (3,), the camera's centre of projection in the robot's space, metres.

        Raises:
            CalibrationError: OUT_OF_FIELD: the camera is not over that plane.
        """
        camera_centre = as_vector(camera_position, 3, "camera position")
        distance = abs(float((camera_centre - self._map.origin) @ self.normal))
        if not (math.isfinite(height) and distance > max(height, 0.0)):
            raise Code.OUT_OF_FIELD.error(
                f"expected a height below the camera's ({distance:.6g} m), got {height:.6g} m",
                distance,
                height,
            )
        share = height / distance
        matrix = self.matrix.copy()
        matrix[:3] = (1 - share) * matrix[:3] + share * np.outer(camera_centre, matrix[3])
        normalization = dataclasses.replace(
            self.normalization,
            robot_centre=(1 - share) * self.normalization.robot_centre + share * camera_centre,
            robot_size=(1 - share) * self.normalization.robot_size,
        )
        return dataclasses.replace(
            self, matrix=matrix, normalization=normalization, height=self.height + height
        )

    def _check(self, fields: Mapping[str, Any], label: str) -> None:
        names = ("robot_points", "weights", "residuals", "leave_one_out")
        storage.check_counts(fields, names, len(self.camera_points), label)
        if np.count_nonzero(self.weights) < 3:
            raise storage.invalid_data_error(
                label, "weights: expected 3 that are not 0", self.weights.tolist()
            )
        if self.unit_covariance.shape != (12, 12):
            raise storage.invalid_data_error(label, "unit_covariance: expected rows of 12", None)
        _ = self._map  # an invalid matrix raises here, not only when the first part is mapped


@check_arguments(
    model=check_text,
    weights=or_none(numbers),
    tool_z=or_none(numbers),
    robust=check_flag,
)
@one_blas_thread
def fit_plane(
    camera_points: ArrayLike,
    robot_points: ArrayLike,
    *,
    model: PlaneModel = "auto",
    touch_sigma: float | None = None,
    weights: ArrayLike | None = None,
    nominal_scale: float | None = None,
    tool_z: ArrayLike | None = None,
    robust: bool = False,
    robot_frame: str = "robot",
    camera_frame: str | None = None,
    y_down: bool | None = None,
    allowed_error: float | None = None,
) -> PlaneCalibration:
    """Fit the map from the camera's plane to the robot's space to points known to both.

    Args:
        camera_points: (N, 2), places of the points for the camera, in metres, pixels or any unit.
        robot_points: (N, 3), places of the same points in the same order for the robot, metres.
        model: ``rigid`` (3 points or more, scale as ``nominal_scale``, 1 without), ``similarity``
            (3), ``affine`` (3), ``homography`` (4: a tilted camera whose lens is corrected for), or
            ``auto``: the one with the smallest held-out error; a more general one must also fit
            better than noise alone explains in 99 of 100 cases. ``rigid`` is compared only if
            ``nominal_scale`` is given.
        touch_sigma: standard deviation of one coordinate of a touch, robot and camera together,
            metres; None: estimated from the residuals. If these have fewer than 6 degrees of
            freedom, 0.2 mm are assumed for the missing ones. An estimate above
            ``sqrt((0.5 mm)^2 + (field / 1000)^2)`` is reported as POOR_FIT, since mistakes may
            cause it.
        weights: (N,), one over the relative variance of each touch.
        nominal_scale: expected metres per unit of the camera's points.
        tool_z: (3,) or (N, 3), direction of the tool's axis, into the plane, when it touched. In
            space a mirrored plane fits as well as the right one, so only this axis shows whether y
            points the wrong way.
        robust: leave out points that do not agree with the others (6 points or more, of which more
            than half agree; MSAC). They keep their place among the points, with the weight 0, and
            each is named by a warning OUTLIER. Which points these are does not depend on ``model``.
            Give ``touch_sigma``: without it fewer wrong points are found, and only those further
            off.
        robot_frame: name of the frame that poses will be given in.
        camera_frame: name of the frame that localizations must come in; None for any.
        y_down: whether the camera's own y axis points down; the points have the opposite y;
            None: not known. The value is stored, and compared when the calibration is used; nothing
            is turned here.
        allowed_error: error that 95 of 100 points may have at most, metres; None: a hundredth of
            the touched field. See :attr:`PlaneCalibration.verdict`.

    Repeated touches of one camera point, or touches whose robot positions are nearly equal, count
    as a single point, their mean: an error of the point is in all of them.

    Raises:
        CalibrationError: ``code`` says why there is no calibration: SHAPE, NOT_FINITE, TOO_FEW,
            COINCIDENT, COLLINEAR, SHORT_LEVER, NOT_PLANAR, MIRRORED, UNIT_UNKNOWN: a field of more
            than 20 m, SCALE_MISMATCH where ``rigid`` was asked for, or with ``robust`` OUTLIER: no
            map agrees with more than half of the points; OUT_OF_FIELD: a point that was
            left out is behind the plane's horizon.
        MissingExtraError: SciPy is not installed.
        ValueError: ``model`` is unknown.
    """
    if model != "auto" and model not in MODELS:
        raise ConfigurationError(
            f"fit_plane: model: expected auto, {', '.join(MODELS)}, got {excerpt(model)}"
        )
    camera, robot, point_weights = read_pairs(camera_points, robot_points, weights)
    check_positive(touch_sigma, "touch_sigma", "metres")
    check_positive(nominal_scale, "nominal_scale", "metres for each unit of the camera")
    check_positive(allowed_error, "allowed_error", "metres")
    merged = merge_repeated(camera, robot, point_weights)
    merged_camera, merged_robot = merged.camera, merged.robot
    inliers = np.arange(len(merged_camera))
    min_points = MODELS["similarity" if model == "auto" else model].min_points
    # the message about equal points must name the points as given
    if len(merged_camera) < len(camera):
        check_samples(camera, robot, min_points, touch_sigma, allow_strays=robust)
    if robust:
        inliers = np.flatnonzero(
            find_agreeing(merged_camera, merged_robot, merged.weights, touch_sigma)
        )
    check_samples(merged_camera[inliers], merged_robot[inliers], min_points, touch_sigma)
    max_sigma = MAX_SIGMA.of(extent(merged_robot[inliers])) if touch_sigma is None else touch_sigma
    # all points are used, since points in a wrong order may also agree with one another
    reordered = find_better_order(merged_camera, merged_robot, max_sigma)
    if reordered is not None and set(reordered.moved).isdisjoint(inliers):
        reordered = None
    tool_axis = None if tool_z is None else mean_axis(tool_z, len(camera))
    normalization, pairs = normalize(
        merged_camera[inliers], merged_robot[inliers], merged.weights[inliers]
    )
    sigma = None if touch_sigma is None else touch_sigma / normalization.robot_size
    scale_ratio = normalization.camera_size / normalization.robot_size
    expected_scale = 1.0 if nominal_scale is None and model == "rigid" else nominal_scale
    candidates = Candidates(pairs, None if expected_scale is None else expected_scale * scale_ratio)
    start_model: ModelName = candidates.simplest_model() if model == "auto" else model
    preferred = candidates.choose(sigma, start_model)
    fitted = candidates.require(preferred if model == "auto" else model)
    held_out = candidates.held_out(fitted)
    matrix = normalization.to_original(fitted.matrix)
    plane = PlaneMap(matrix, normalization.camera_centre)
    evidence = Evidence(
        pairs=pairs,
        fitted=fitted,
        candidates=candidates,
        preferred=preferred,
        is_model_given=model != "auto",
        held_out=held_out,
        sigma=sigma,
        max_sigma=max_sigma / normalization.robot_size,
        normalization=normalization,
        nominal_scale=expected_scale,
        tool_cosine=None if tool_axis is None else check_side(plane.frame[:, 2], tool_axis),
        point_numbers=1 + merged.first_index[inliers],
    )
    estimate = _estimate_touch_sigma(
        fitted, pairs.weights, TYPICAL_SIGMA_M / normalization.robot_size
    )
    if robust and touch_sigma is None and estimate is not None:
        check_lever(lever(merged_robot[inliers]), normalization.robot_size * estimate)
    left_out = np.setdiff1d(np.arange(len(merged_camera)), inliers)
    stray_offsets = np.zeros_like(merged_robot)
    stray_offsets[left_out] = merged_robot[left_out] - plane.transform(merged_camera[left_out])
    touch_offsets = robot - merged_robot[merged.point_index]
    compared_models: list[ModelName] = [*candidates.names] if model == "auto" else [fitted.model]
    calibration = PlaneCalibration(
        model=fitted.model,
        camera_points=camera,
        robot_points=robot,
        weights=np.where(np.isin(merged.point_index, inliers), point_weights, 0.0),
        matrix=matrix,
        normalization=normalization,
        unit_covariance=fitted.unit_covariance / normalization.robot_size**2,
        residuals=_with_rows(stray_offsets, inliers, normalization.robot_size * fitted.residuals)[
            merged.point_index
        ]
        + touch_offsets,
        leave_one_out=_with_rows(stray_offsets, inliers, normalization.robot_size * held_out)[
            merged.point_index
        ]
        + touch_offsets,
        freedom=fitted.freedom,
        touch_sigma=touch_sigma
        if estimate is None or touch_sigma is not None
        else normalization.robot_size * estimate,
        sigma_given=touch_sigma is not None,
        candidate_errors={
            name: None if math.isnan(error) else normalization.robot_size * error
            for name, error in candidates.errors(compared_models).items()
        },
        nominal_scale=nominal_scale,
        tool_z=tool_axis,
        robot_frame=robot_frame,
        camera_frame=camera_frame,
        y_down=y_down,
        allowed_error=allowed_error,
        warnings=find_warnings(evidence),
    )
    remarks = [] if reordered is None else [reordered.remark(1 + merged.first_index)]
    remarks += [
        *_move_remarks(stray_offsets[left_out], 1 + merged.first_index[left_out]),
        *(
            _left_out_remark(calibration, index, point_weights[index])
            for index in calibration.outliers
        ),
    ]
    distances = np.linalg.norm(touch_offsets, axis=1)
    if distances.max() > MAX_TOUCH_SIGMAS * max_sigma:
        number, worst = 1 + int(distances.argmax()), 1e3 * float(distances.max())
        text = f"point {number} was touched {worst:.3g} mm from"
        remarks.append(Code.OUTLIER.remark(f"{text} the mean of its touches"))
    return dataclasses.replace(calibration, warnings=(*remarks, *calibration.warnings))


def _with_rows(array: Array, rows: NDArray[np.intp], values: Array) -> Array:
    """Return a copy of ``array`` with ``values`` in some rows."""
    result = array.copy()
    result[rows] = values
    return result


def _move_remarks(offsets: Array, numbers: NDArray[np.intp]) -> Iterator[Remark]:
    """Yield a remark if the touches that were left out are all shifted by about the same vector.

    ``offsets`` (N, 3): of these touches from the places that the others predict, metres.
    ``numbers``: numbers of the points, from 1.
    """
    if (shift := common_move(offsets)) is not None:
        yield Code.POOR_FIT.remark(
            f"points {', '.join(map(str, numbers.tolist()))} are left out, and all lie "
            f"{1e3 * float(np.linalg.norm(shift)):.3g} mm off to one side: the sheet or the tip "
            "moved between the touches; touch all points again"
        )


def _left_out_remark(calibration: PlaneCalibration, index: int, weight: float) -> Remark:
    """Return the remark that a point was left out, with its distance and the expected noise."""
    distance = float(np.linalg.norm(calibration.residuals[index]))
    variance = 3.0 / weight * (calibration.touch_sigma or 0.0) ** 2
    variance += (
        float(calibration.predicted_error(calibration.camera_points[index : index + 1])[0]) ** 2
    )
    return Code.OUTLIER.remark(
        f"point {1 + index} is left out: it lies {1e3 * distance:.3g} mm from where the others "
        f"predict it; touching errors alone would give {1e3 * math.sqrt(variance):.3g} mm rms"
    )


def _estimate_touch_sigma(fitted: Fit, weights: Array, typical: float) -> float | None:
    """Return the touches' sigma by the residuals; None without a degree of freedom."""
    if not fitted.freedom:
        return None
    return estimate_sigma(sum_of_squares(fitted.residuals, weights), fitted.freedom, typical)


def mean_axis(tool_z: ArrayLike, count: int) -> Array:
    """Return the mean direction (3,) of a tool's axis, of length 1.

    ``tool_z``: (3,), or (``count``, 3), of each touch. Raises SHAPE or NOT_FINITE; or COINCIDENT:
    the mean has no length.
    """
    values = np.asarray(tool_z, dtype=np.float64)
    if values.shape == (count, 3):
        axes = as_points(values, 3, "tool axis")
        values = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).mean(axis=0)
    axis = as_vector(values, 3, "tool axis")
    length = float(np.linalg.norm(axis))
    if not length > MIN_DIRECTION_LENGTH:
        raise Code.COINCIDENT.error_with_value(
            "tool axis: expected a direction", "a direction", axis.tolist()
        )
    return axis / length
