"""A point cloud: points in metres, with colours and standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike, NDArray

    from smartcam.geometry import Transform

_NUMBERS = "fiu"
"""NumPy's codes for kinds of real numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points in metres.

    The arrays are read-only. Given arrays of float32 (or uint8) are not copied, so the caller must
    not change them afterwards.

    Attributes:
        points: (N, 3) float32, metres, all finite.
        colours: (N, 3) uint8, red, green, blue; None: no colours.
        sigma: (N,) float32, metres, standard deviations along the ray on which each point was seen;
            None: unknown.

    Raises:
        ConfigurationError: other shapes, no numbers, a point that is not finite, a sigma below 0.
    """

    points: NDArray[Any]
    colours: NDArray[Any] | None = None
    sigma: NDArray[Any] | None = None

    def __post_init__(self) -> None:
        """Check the arrays, and make read-only views."""
        points = _as_floats(self.points, "points", (None, 3))
        object.__setattr__(self, "points", points)
        count = len(points)
        if self.colours is not None:
            colours = _as_bytes(self.colours, "colours", (count, 3))
            object.__setattr__(self, "colours", colours)
        if self.sigma is not None:
            sigma = _as_floats(self.sigma, "sigma", (count,))
            if count and sigma.min() < 0:
                raise ConfigurationError(f"sigma: expected 0 or more, got {sigma.min():g}")
            object.__setattr__(self, "sigma", sigma)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the parts for pickle; the copy is read-only, too."""
        return type(self), (self.points, self.colours, self.sigma)

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)

    def __repr__(self) -> str:
        """Return a text with the number of points and the names of their other values."""
        more = [name for name in ("colours", "sigma") if getattr(self, name) is not None]
        return f"<Cloud of {len(self):,} points{''.join(f', {name}' for name in more)}>"

    @classmethod
    def from_depth(
        cls,
        depth: ArrayLike,
        matrix: ArrayLike,
        colours: ArrayLike | None = None,
        sigma: ArrayLike | None = None,
    ) -> Self:
        """Return the points of a depth picture, row by row, in the camera's frame.

        Args:
            depth: (H, W) metres along the optical axis; 0 means no depth, and gives no point.
            matrix: (3, 3), of a camera without distortion, in pixels; the centre of the first
                pixel is (0, 0).
            colours: (H, W, 3) uint8, red, green, blue; or (H, W) uint8, grey.
            sigma: (H, W) metres, standard deviation of the depth along the optical axis. The points
                get the sigma along their rays, which is larger away from the axis.

        Raises:
            ConfigurationError: other shapes, a depth that is below 0 or not finite, a matrix that
                is no camera matrix, or sizes of depth, colours and sigma that differ.
        """
        metres = _as_floats(depth, "depth", (None, None))
        if metres.size and metres.min() < 0:
            raise ConfigurationError(
                f"depth: expected metres, 0 for none; got {metres.min():g} at its lowest"
            )
        inverse = _invert_camera_matrix(matrix)
        rows, columns = np.nonzero(metres)
        depths = metres[rows, columns].astype(np.float64)
        pixels = np.stack([columns, rows, np.ones(len(rows))], axis=1)
        rays = pixels @ inverse.T  # with z = 1
        point_colours = point_sigmas = None
        if colours is not None:
            picture = _as_colour_picture(colours, metres.shape)
            point_colours = picture[rows, columns]
        if sigma is not None:
            lengths = np.linalg.norm(rays, axis=1)
            if np.shape(sigma) == metres.shape:
                sigma = np.where(metres > 0, sigma, 0)  # without depth, sigma is not used
            point_sigmas = _as_floats(sigma, "sigma", metres.shape)[rows, columns] * lengths
        return cls(
            _as_float32(rays * depths[:, None]),
            point_colours,
            None if point_sigmas is None else _as_float32(point_sigmas),
        )

    @classmethod
    def joined(cls, clouds: Iterable[Cloud]) -> Self:
        """Return one cloud with the points of all, which are in one frame.

        Raises:
            ConfigurationError: only some of the clouds have colours, or sigma.
        """
        clouds = list(clouds)
        columns: dict[str, NDArray[Any] | None] = {}
        for name in ("colours", "sigma"):
            arrays = [array for cloud in clouds if (array := getattr(cloud, name)) is not None]
            if arrays and len(arrays) < len(clouds):
                raise ConfigurationError(
                    f"joined: expected all clouds with {name} or none, "
                    f"got {len(arrays)} of {len(clouds)}"
                )
            columns[name] = np.concatenate(arrays) if arrays else None
        points = [np.empty((0, 3), np.float32), *(cloud.points for cloud in clouds)]
        return cls(np.concatenate(points), **columns)

    def transformed(self, pose: Transform) -> Self:
        """Return the cloud in the frame that a rigid motion leads to.

        ``pose`` is a :class:`~smartcam.calibration.Transform`: ``T_robot_camera`` moves a cloud
        from the camera's frame to the robot's. Sigma does not change.

        Raises:
            ConfigurationError: ``pose`` is no Transform, or the moved points exceed float32's
                range.
        """
        motion = getattr(pose, "rigid", None)
        if motion is None:
            raise ConfigurationError(
                f"transformed: expected a Transform, got {type(pose).__name__}"
            )
        moved = motion.apply(self.points.astype(np.float64))
        return type(self)(_as_float32(moved), self.colours, self.sigma)

    def select(self, index: NDArray[Any]) -> Self:
        """Return the points of a mask (N,), or of indices in their order."""
        return type(self)(
            self.points[index],
            None if self.colours is None else self.colours[index],
            None if self.sigma is None else self.sigma[index],
        )


def _as_float32(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return values as float32; too large values become infinite, which a cloud refuses."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _check_shape(values: NDArray[Any], label: str, shape: tuple[int | None, ...]) -> None:
    fits = len(values.shape) == len(shape) and all(
        want is None or count == want for count, want in zip(values.shape, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if count is None else str(count) for count in shape)
        raise ConfigurationError(f"{label}: expected the shape ({wanted}), got {values.shape}")


def _as_floats(given: ArrayLike, label: str, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
    """Return a read-only view as finite float32; raise ConfigurationError otherwise."""
    values = _as_array(given, label)
    if values.dtype.kind not in _NUMBERS:
        raise ConfigurationError(f"{label}: expected numbers, got {values.dtype}")
    _check_shape(values, label, shape)
    with np.errstate(over="ignore"):
        floats = np.ascontiguousarray(values, np.float32).view()
    if not np.isfinite(floats).all():
        wrong = int(np.count_nonzero(~np.isfinite(floats)))
        raise ConfigurationError(
            f"{label}: expected finite float32 values, got {wrong} that are not"
        )
    floats.flags.writeable = False
    return floats


def _as_bytes(given: ArrayLike, label: str, shape: tuple[int | None, ...]) -> NDArray[np.uint8]:
    values = _as_array(given, label)
    if values.dtype != np.uint8:
        raise ConfigurationError(f"{label}: expected uint8, got {values.dtype}")
    _check_shape(values, label, shape)
    view = np.ascontiguousarray(values).view()
    view.flags.writeable = False
    return view


def _as_array(given: ArrayLike, label: str) -> NDArray[Any]:
    try:
        return np.asarray(given)
    except (TypeError, ValueError, ArithmeticError) as exc:
        raise ConfigurationError(f"{label}: expected an array, got {type(given).__name__}") from exc


def _as_colour_picture(given: ArrayLike, size: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return a colour picture (H, W, 3) made of a colour or grey picture."""
    values = _as_array(given, "colours")
    if values.ndim == 2:
        grey = _as_bytes(values, "colours", size)
        return np.broadcast_to(grey[..., None], (*size, 3))
    return _as_bytes(values, "colours", (*size, 3))


def _invert_camera_matrix(given: ArrayLike) -> NDArray[np.float64]:
    """Return the inverse of a camera matrix, which turns pixels into rays with z = 1."""
    matrix = _as_array(given, "matrix")
    _check_shape(matrix, "matrix", (3, 3))
    if matrix.dtype.kind not in _NUMBERS or not np.isfinite(matrix).all():
        raise ConfigurationError(f"matrix: expected finite numbers, got {matrix.tolist()}")
    below_diagonal = np.array([[False] * 3, [True, False, False], [True, True, False]])
    is_triangular = not matrix[below_diagonal].any() and matrix[2, 2] == 1
    if not is_triangular or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise ConfigurationError(
            "matrix: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0, "
            f"got {matrix.tolist()}"
        )
    return np.asarray(np.linalg.inv(matrix.astype(np.float64)), np.float64)
