"""Fit the map from a camera's points to a robot's points, and compute the map's covariance.

A camera that looks at a plane maps it to its image by a homography. Together with the pose of the
plane in the robot's space that is one matrix: ``w (x, y, z, 1) = matrix (u, v, 1)``, with 11
degrees of freedom. The models are special cases: affine (9) has ``w = 1``, similarity (7) has axes
of equal length at right angles, rigid (6) has a scale that is known beforehand.

All four are fitted by least squares in the robot's space, which is the most likely map if the noise
of the touches (the robot's points, touched with its tip) is independent and equal on each axis;
noise of the camera counts as noise of the touch. Points are centred and scaled first. The
covariance is that of the matrix' 12 elements, for every model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

import numpy as np

from smartcam.calibration._files import storage
from smartcam.calibration._homography import apply_homography, element_derivatives
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array

ModelName: TypeAlias = Literal["rigid", "similarity", "affine", "homography"]

MIN_CONDITION = 1e-4
"""Smallest over largest singular value of a fit's column-scaled Jacobian.

Well-placed points have 0.03 and more; if the points leave a parameter open, the ratio is a rounding
error below 1e-10 (measured).
"""

MAX_STEPS = 50
"""The refinement of a homography takes at most this many steps; it usually takes 3 to 8."""

MAX_HALVINGS = 20
"""A step that increases the sum of squares is halved at most this many times; if the sum is still
not smaller, only rounding errors are left."""

MIN_STEP = 1e-13
"""The refinement ends when a step changes the matrix' elements, which are about 1, by less than
this; the next step would be a thousand times smaller."""

MAX_FULL_REFITS = 200
"""With at most this many points, a homography is fitted again without each point. With more, the
residuals are corrected by their leverages, which are below 0.1; the relative error of that is their
square."""


@dataclass(frozen=True, slots=True, eq=False)
class Normalization(storage.Stored):
    """Centres and sizes of the points; for a fit, points are centred and divided by their size."""

    _keys: ClassVar[storage.Keys] = {"camera_centre": "camera", "robot_centre": "robot"}

    camera_centre: storage.Vector2  # of the camera's points (2,)
    # RMS distance of the camera's points from their centre, in the camera's unit
    camera_size: storage.Positive
    robot_centre: storage.Vector3  # of the robot's points (3,), metres
    robot_size: storage.Positive  # RMS distance of the robot's points from their centre, metres

    def to_original(self, matrix: Array) -> Array:
        """Return the matrix (4, 3) between original points from that between normalized points."""
        result = (
            np.concatenate([self.robot_size * matrix[:3], matrix[3:]]) @ self._normalizing_matrix()
        )
        result[:3] += np.outer(self.robot_centre, result[3])
        return result

    def to_normalized(self, matrix: Array) -> Array:
        """Return the matrix (4, 3) between normalized points from that between original points."""
        result = matrix.copy()
        result[:3] = (result[:3] - np.outer(self.robot_centre, result[3])) / self.robot_size
        return result @ np.linalg.inv(self._normalizing_matrix())

    def _normalizing_matrix(self) -> Array:
        matrix = np.diag([1.0 / self.camera_size, 1.0 / self.camera_size, 1.0])
        matrix[:2, 2] = -self.camera_centre / self.camera_size
        return matrix


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Pairs of camera's and robot's points, as the fit uses them."""

    camera: Array  # (N, 2), camera's points, centred, of RMS length 1
    robot: Array  # (N, 3), robot's points, centred, of RMS length 1
    weights: Array  # (N,), one over the relative variance of each pair

    def leave_out(self, *index: int) -> Pairs:
        """Return the pairs without those at some indices."""
        keep = ~np.isin(np.arange(len(self.camera)), index)
        return Pairs(self.camera[keep], self.robot[keep], self.weights[keep])

    @property
    def homogeneous(self) -> Array:
        """The camera's points with a third component 1, (N, 3)."""
        return np.column_stack([self.camera, np.ones(len(self.camera))])


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted map."""

    model: ModelName
    matrix: Array  # (4, 3), between centred points
    residuals: Array  # (N, 3), robot minus mapped
    # (12, 12), of the matrix' elements row by row, for a touch variance of 1
    unit_covariance: Array
    residual_covariances: Array  # (N, 3, 3), for a touch variance of 1
    freedom: int  # number of coordinates minus number of parameters


@dataclass(frozen=True, slots=True)
class Model:
    """A kind of map, with the functions that fit it."""

    parameters: int  # degrees of freedom
    min_points: int  # least number of points
    # function of pairs and of a scale, used by ``rigid`` only, that returns the matrix
    solve: Callable[[Pairs, float], Array]
    # function that returns the directions (12, parameters) in which a matrix may change
    tangent: Callable[[Array], Array]


def fit(name: ModelName, pairs: Pairs, scale: float = 1.0) -> Fit:
    """Return the most likely map of one model; raise COLLINEAR if the points do not determine it.

    ``pairs``: at least as many as the model needs; neither the camera's nor the robot's points may
    all be the same, or all in a line. ``scale``: ratio of a length in the robot's unit to that in
    the camera's, for ``rigid`` only.
    """
    model = MODELS[name]
    matrix = model.solve(pairs, scale)
    tangent = model.tangent(matrix)
    scaled_jacobian, lengths = _scaled_jacobian(name, matrix, pairs)
    # The elements m of a matrix change by T d, so the Jacobian by d is J T. With W^(1/2) J T = U S
    # V^T (its columns divided by their lengths l) the covariance of m is T (T^T J^T W J T)^-1 T^T =
    # H H^T, H = T diag(1/l) V S^-1, and the hat matrix of the residuals is U U^T: a residual's
    # variance is I - U_i U_i^T, divided by its weight.
    # Source: Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 5.2; Cook and
    # Weisberg, Residuals and Influence in Regression (1982), chapter 2.
    left, singular, right = np.linalg.svd(scaled_jacobian, full_matrices=False)
    condition = float(singular[-1] / singular[0]) if singular[0] > 0.0 else 0.0
    if condition < MIN_CONDITION:
        raise Code.COLLINEAR.error(
            f"{name}: expected points that determine all {model.parameters} parameters "
            f"(condition at least {MIN_CONDITION:g}), got {condition:.2g}: too many in a line",
            MIN_CONDITION,
            condition,
        )
    root = tangent @ (right.T / singular / lengths[:, None])
    left_blocks = left.reshape(-1, 3, model.parameters)
    hat = left_blocks @ left_blocks.swapaxes(1, 2)
    return Fit(
        name,
        matrix,
        pairs.robot - apply_homography(matrix, pairs.camera),
        root @ root.T,
        (np.eye(3) - hat) / pairs.weights[:, None, None],
        3 * len(pairs.camera) - model.parameters,
    )


def _scaled_jacobian(name: ModelName, matrix: Array, pairs: Pairs) -> tuple[Array, Array]:
    """Return the Jacobian of the weighted residuals by the parameters, and its columns' lengths.

    The columns are divided by their lengths.
    """
    model = MODELS[name]
    jacobian = element_derivatives(matrix, pairs.camera) @ model.tangent(matrix)
    root = np.sqrt(pairs.weights)[:, None, None]
    weighted = (root * jacobian).reshape(-1, model.parameters)
    lengths = np.linalg.norm(weighted, axis=0)
    lengths[lengths == 0.0] = 1.0  # nothing depends on this parameter
    return weighted / lengths, lengths


def held_out(fitted: Fit, pairs: Pairs, scale: float = 1.0) -> Array:
    """Return each point minus the place that a fit of all other points predicts, (N, 3).

    The difference is NaN if the other points determine no map. ``affine`` uses leverages, ``rigid``
    and ``similarity`` subtract the point from the sums, and only a ``homography`` is fitted again.
    """
    if len(pairs.camera) <= MODELS[fitted.model].min_points:
        return np.full_like(pairs.robot, np.nan)
    if fitted.model in {"rigid", "similarity"}:
        return _held_out_by_sums(pairs, scale if fitted.model == "rigid" else None)
    if fitted.model == "homography" and len(pairs.camera) <= MAX_FULL_REFITS:
        return np.stack([_held_out_by_refit(fitted, pairs, i) for i in range(len(pairs.camera))])
    return _held_out_by_leverage(fitted, pairs)


def _held_out_by_leverage(fitted: Fit, pairs: Pairs) -> Array:
    # Without point i the residual there is (I - H_ii)^-1 e_i, exactly so in a linear fit.
    # Source: Cook and Weisberg, Residuals and Influence in Regression (1982), chapter 2.
    weighted_blocks = fitted.residual_covariances * pairs.weights[:, None, None]
    smallest = np.linalg.eigvalsh(weighted_blocks)[:, 0]
    result = np.full_like(pairs.robot, np.nan)
    is_determined = smallest > MIN_CONDITION**2
    result[is_determined] = np.linalg.solve(
        weighted_blocks[is_determined], fitted.residuals[is_determined][..., None]
    )[..., 0]
    return result


def _held_out_by_refit(fitted: Fit, pairs: Pairs, index: int) -> Array:
    others = pairs.leave_out(index)
    matrix = _refine_homography(others, fitted.matrix)
    singular = np.linalg.svd(_scaled_jacobian(fitted.model, matrix, others)[0], compute_uv=False)
    if singular[-1] < MIN_CONDITION * singular[0]:
        return np.full(3, np.nan)
    expected = apply_homography(matrix, pairs.camera[index : index + 1])
    residual: Array = pairs.robot[index] - expected[0]
    return residual


def _held_out_by_sums(pairs: Pairs, scale: float | None) -> Array:
    """Return the held-out residuals (N, 3), from sums over all points minus one point's part."""
    u, p, w = pairs.camera, pairs.robot, pairs.weights[:, None]
    # sum w (p - p') (u - u')^T = sum w p u^T - W p' u'^T, with the means p' and u' and W = sum w;
    # without a point these are the sums over all points minus the part of that point.
    total = w.sum() - w
    mean_u, mean_p = ((w * u).sum(0) - w * u) / total, ((w * p).sum(0) - w * p) / total
    cross = np.einsum("ni,nj->nij", w * p, u)
    cross = cross.sum(0) - cross - np.einsum("ni,nj->nij", total * mean_p, mean_u)
    square = np.einsum("ni,nj->nij", w * u, u)
    square = square.sum(0) - square - np.einsum("ni,nj->nij", total * mean_u, mean_u)
    axes = scaled_axes(cross, np.trace(square, axis1=1, axis2=2), scale)
    residuals: Array = p - mean_p - np.einsum("nij,nj->ni", axes, u - mean_u)
    spread = np.linalg.eigvalsh(square)
    residuals[spread[:, 0] < (MIN_CONDITION**2) * spread[:, 1]] = np.nan
    return residuals


def scaled_axes(cross: Array, square: Array, scale: float | None) -> Array:
    """Return the scaled axes (..., 3, 2) that fit sums of products (..., 3, 2) best."""
    # Of sum (p - p') (u - u')^T = U S V^T the best axes are R = U V^T, and the best scale is
    # trace(S) / sum |u - u'|^2.
    # Source: Umeyama, Least-Squares Estimation of Transformation Parameters Between Two Point
    # Patterns (1991).
    left, singular, right = np.linalg.svd(cross, full_matrices=False)
    scales = singular.sum(-1) / square if scale is None else np.full(square.shape, scale)
    axes: Array = scales[..., None, None] * (left @ right)
    return axes


def _solve_similarity(pairs: Pairs, scale: float | None) -> Array:
    """Return Umeyama's solution, which from two dimensions to three is never a reflection."""
    u, p, w = pairs.camera, pairs.robot, pairs.weights[:, None]
    mean_u, mean_p = (w * u).sum(0) / w.sum(), (w * p).sum(0) / w.sum()
    centred = w * (u - mean_u)
    cross = (p - mean_p).T @ centred
    axes = scaled_axes(cross, (centred * (u - mean_u)).sum(), scale)
    return _affine_matrix(axes, mean_p - axes @ mean_u)


def _affine_matrix(axes: Array, offset: Array) -> Array:
    matrix = np.zeros((4, 3))
    matrix[:3, :2], matrix[:3, 2], matrix[3, 2] = axes, offset, 1.0
    return matrix


def _solve_affine(pairs: Pairs, _scale: float) -> Array:
    root = np.sqrt(pairs.weights)[:, None]
    left, right = root * pairs.homogeneous, root * pairs.robot
    solution = np.asarray(np.linalg.lstsq(left, right, rcond=None)[0], dtype=np.float64)
    return _affine_matrix(solution[:2].T, solution[2])


def _solve_homography(pairs: Pairs, scale: float) -> Array:
    return _refine_homography(pairs, _linear_homography(pairs, scale))


def _refine_homography(pairs: Pairs, matrix: Array) -> Array:
    """Refine a solution until the sum of squares no longer decreases."""
    root = np.sqrt(pairs.weights)[:, None]
    residuals = root * (pairs.robot - apply_homography(matrix, pairs.camera))
    tangent = _homography_tangent(matrix)
    for _ in range(MAX_STEPS):
        derivatives = element_derivatives(matrix, pairs.camera) @ tangent
        jacobian = (root[..., None] * derivatives).reshape(-1, 11)
        step = tangent @ np.linalg.lstsq(jacobian, residuals.ravel(), rcond=None)[0]
        for halving in range(MAX_HALVINGS):
            candidate = matrix + 0.5**halving * step.reshape(4, 3)
            if (pairs.homogeneous @ candidate[3]).min() <= 0.0:  # a point beyond the horizon
                continue
            candidate_residuals = root * (pairs.robot - apply_homography(candidate, pairs.camera))
            if (candidate_residuals**2).sum() < (residuals**2).sum():
                break
        else:
            return matrix
        matrix, residuals = candidate, candidate_residuals
        if np.abs(step).max() < MIN_STEP:
            return matrix
    return matrix


def _linear_homography(pairs: Pairs, scale: float) -> Array:
    """Return the direct linear solution in the plane that fits the robot's points best."""
    # In the plane through the robot's points x (h3 u) = h1 u and y (h3 u) = h2 u are linear in the
    # nine elements; of vectors of length 1 the last singular vector has the least sum of squares.
    # Back in space, p = mean + axes (x, y), so the upper rows are axes h12 + mean h3. Source:
    # Hartley and Zisserman, Multiple View Geometry, 2nd edition, section 4.1.
    root = np.sqrt(pairs.weights)[:, None]
    mean = (pairs.weights[:, None] * pairs.robot).sum(0) / pairs.weights.sum()
    axes = np.linalg.svd(root * (pairs.robot - mean), full_matrices=False)[2][:2].T
    in_plane = (pairs.robot - mean) @ axes
    u, zero = pairs.homogeneous, np.zeros((len(in_plane), 3))
    equations = np.concatenate(
        [
            root * np.column_stack([u, zero, -in_plane[:, :1] * u]),
            root * np.column_stack([zero, u, -in_plane[:, 1:] * u]),
        ]
    )
    solution = np.linalg.svd(equations, full_matrices=False)[2][-1].reshape(3, 3)
    w = pairs.homogeneous @ solution[2]
    if abs(solution[2, 2]) < MIN_CONDITION or w.min() * w.max() <= 0:
        return _solve_affine(pairs, scale)  # noise has put a point beyond the horizon
    solution = solution / solution[2, 2]
    upper_rows = axes @ solution[:2] + np.outer(mean, solution[2])
    return np.concatenate([upper_rows, solution[2:]])


def rigid_tangent(matrix: Array) -> Array:
    """Return derivatives (12, 6) of a matrix' elements by a shift and a turn about the centre."""
    # exp([w]x) a = a + w x a to first order: for the columns a, while the centre only shifts
    tangent = np.zeros((4, 3, 6))
    for axis in range(3):
        tangent[axis, 2, axis] = 1.0
        by_turn = np.cross(np.eye(3)[axis], matrix[:3, :2].T)
        tangent[:3, :2, 3 + axis] = by_turn.T
    return tangent.reshape(12, 6)


def _similarity_tangent(matrix: Array) -> Array:
    by_scale = np.zeros((4, 3))
    by_scale[:3, :2] = matrix[:3, :2]
    return np.column_stack([rigid_tangent(matrix), by_scale.ravel()])


def _homography_tangent(_matrix: Array) -> Array:
    return np.eye(12)[:, :11]


MODELS: dict[ModelName, Model] = {
    "rigid": Model(6, 3, _solve_similarity, rigid_tangent),
    "similarity": Model(
        7, 3, lambda pairs, _scale: _solve_similarity(pairs, None), _similarity_tangent
    ),
    "affine": Model(9, 3, _solve_affine, lambda _: np.eye(12)[:, :9]),
    "homography": Model(11, 4, _solve_homography, _homography_tangent),
}
"""Models from the simplest to the most general; each is a special case of the next."""
