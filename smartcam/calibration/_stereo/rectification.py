"""Rectify both images of a pair: show them as two parallel cameras would."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from smartcam._extras import load
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.exceptions import CalibrationError
    from smartcam.geometry import CameraModel, Transform
    from smartcam.geometry._inside import Array

Image: TypeAlias = "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]"

MIN_TURN_COSINE: Final = 0.1
"""Least cosine of the angle by which a camera's viewing direction may be turned. Below it, a camera
looks along the line to the other camera, and epipolar lines would meet inside of its image."""

MAX_PIXELS: Final = 100_000_000
"""A rectified image has at most this many pixels; its two maps have 8 bytes for each pixel."""

MAX_SAMPLES: Final = 50_000
"""The share of source pixels that are kept is computed from at most this many source pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rectification:
    """The result of :meth:`StereoCalibration.rectify`.

    In each pair of values, that of the left image comes first.

    Attributes:
        size: width and height of the rectified images, pixels.
        alpha: 0: all pixels of the output are valid; 1: all source pixels are kept.
        rotations: (3, 3) each, from each camera's frame into its rectified one.
        projections: (3, 4) each, from the left rectified frame, metres, into each rectified image.
        disparity_to_point: (4, 4), the matrix Q, which maps (u, v, disparity, 1) to the homogeneous
            point in the left rectified frame, metres.
        maps: (H, W, 2) each, float32: source of each output pixel, for ``cv2.remap``.
        masks: (H, W) each, True for output pixels that have a source.
        kept: share, 0 to 1, of the source pixels of each image that are in the output.
        invalid: share, 0 to 1, of the output pixels of each image that have no source.
    """

    size: tuple[int, int]
    alpha: float
    rotations: tuple[Array, Array]
    projections: tuple[Array, Array]
    disparity_to_point: Array
    maps: tuple[NDArray[np.float32], NDArray[np.float32]]
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]]
    kept: tuple[float, float]
    invalid: tuple[float, float]

    @property
    def lost(self) -> tuple[float, float]:
        """Share, 0 to 1, of the source pixels of each image that are not in the output."""
        return 1.0 - self.kept[0], 1.0 - self.kept[1]

    def apply(self, left: Image, right: Image) -> tuple[Image, Image]:
        """Rectify both images, (H, W) or (H, W, C); pixels without a source are 0."""
        cv2 = load("cv2")
        first, second = (
            np.asarray(cv2.remap(image, map_, None, cv2.INTER_LINEAR), dtype=np.uint8)
            for image, map_ in zip((left, right), self.maps, strict=True)
        )
        return first, second


def rectify(
    left: CameraModel,
    right: CameraModel,
    transform: Transform,
    *,
    alpha: float = 0.0,
    size: tuple[int, int] | None = None,
) -> Rectification:
    """Return the maps that make the rows of two images show the same points.

    Args:
        left: lens of the left camera.
        right: lens of the right camera, of the same model and image size.
        transform: ``T_right_left``.
        alpha: 0: all pixels of the output are valid; 1: all source pixels are kept; or between.
        size: size of the output, width and height in pixels; None: the source's.

    Raises:
        CalibrationError: ``SHAPE``: an alpha outside of 0 to 1, a size that is not valid or too
            large, lenses of different models; ``WRONG_SIZE``: images of different sizes;
            ``OUT_OF_FIELD``: the images would be empty, as for cameras one behind the other, or if
            one is upside down.
    """
    output_size = _check_arguments(left, right, alpha, size)
    turns, projections, disparity_to_point = _parallel_cameras(
        left, right, transform, alpha, output_size
    )
    cameras = (left, right)
    maps = tuple(
        _source_map(camera, turn, projection, output_size)
        for camera, turn, projection in zip(cameras, turns, projections, strict=True)
    )
    masks = tuple(_is_inside(map_, camera.size) for map_, camera in zip(maps, cameras, strict=True))
    cosine = min(float(turn[2, 2]) for turn in turns)
    is_upright = min(float(projection[0, 0]) for projection in projections) > 0
    if not (is_upright and cosine > MIN_TURN_COSINE and all(mask.any() for mask in masks)):
        raise Code.OUT_OF_FIELD.error(
            f"rectify with alpha {alpha:g}: expected two cameras beside each other that see the "
            "same place the same way up, got parallel images with nothing in them, or upside down "
            f"(cosine between old and new viewing direction: {cosine:.2f})",
            MIN_TURN_COSINE,
            cosine,
        )
    kept_shares = tuple(
        _kept_share(camera, turn, projection, output_size)
        for camera, turn, projection in zip(cameras, turns, projections, strict=True)
    )
    return Rectification(
        size=output_size,
        alpha=alpha,
        rotations=turns,
        projections=projections,
        disparity_to_point=disparity_to_point,
        maps=(maps[0], maps[1]),
        masks=(masks[0], masks[1]),
        kept=(kept_shares[0], kept_shares[1]),
        invalid=(1.0 - float(masks[0].mean()), 1.0 - float(masks[1].mean())),
    )


def _check_arguments(
    left: CameraModel, right: CameraModel, alpha: float, size: tuple[int, int] | None
) -> tuple[int, int]:
    """Return the size of the output; raise the errors of :func:`rectify` about its arguments."""
    if not (math.isfinite(alpha) and 0.0 <= alpha <= 1.0):
        raise _argument_error("alpha", "0 to 1", alpha)
    if left.distortion_model != right.distortion_model:
        raise _argument_error("lenses", f"two of {left.distortion_model}", right.distortion_model)
    if tuple(left.size) != tuple(right.size):
        raise Code.WRONG_SIZE.error(
            f"rectify: expected images of one size, {left.size[0]} x {left.size[1]}, got "
            f"{right.size[0]} x {right.size[1]} on the right",
            left.size,
            right.size,
        )
    width, height = size or left.size
    if not (width > 0 and height > 0 and width * height <= MAX_PIXELS):
        raise _argument_error("size", f"1 to {MAX_PIXELS} pixels", (width, height))
    return int(width), int(height)


def _argument_error(label: str, expected: str, actual: object) -> CalibrationError:
    return Code.SHAPE.error_with_value(f"rectify: {label}: expected {expected}", expected, actual)


def _parallel_cameras(
    left: CameraModel,
    right: CameraModel,
    transform: Transform,
    alpha: float,
    output_size: tuple[int, int],
) -> tuple[tuple[Array, Array], tuple[Array, Array], Array]:
    """Return the rotations and projections of two parallel cameras, and the matrix Q."""
    # Each camera is turned by half of the rotation between them, in opposite senses, so that both
    # look in the same direction and neither image changes more than necessary; then both are turned
    # until the baseline is along x. A point at depth Z has the disparity d = f B / Z then, and Q
    # takes (u, v, d, 1) to (u - cx, v - cy, f, -d / Tx), which is (X, Y, Z, 1) times d / B. Source:
    # Bouguet's algorithm, as in Bradski and Kaehler, Learning OpenCV (2008), chapter 12.
    cv2 = load("cv2")
    arguments = (
        left.matrix,
        left.distortion,
        right.matrix,
        right.distortion,
        left.size,
        transform.rotation,
        transform.translation,
    )
    if left.distortion_model == "equidistant":
        rectified: Any = cv2.fisheye.stereoRectify(
            *arguments, cv2.CALIB_ZERO_DISPARITY, newImageSize=output_size, balance=alpha
        )
    else:
        rectified = cv2.stereoRectify(
            *arguments, flags=cv2.CALIB_ZERO_DISPARITY, alpha=alpha, newImageSize=output_size
        )
    first, second, first_projection, second_projection, disparity_to_point = (
        np.array(values, dtype=np.float64) for values in rectified[:5]
    )
    return (first, second), (first_projection, second_projection), disparity_to_point


def _source_map(
    camera: CameraModel, turn: Array, projection: Array, output_size: tuple[int, int]
) -> NDArray[np.float32]:
    cv2 = load("cv2")
    module = cv2.fisheye if camera.distortion_model == "equidistant" else cv2
    maps = module.initUndistortRectifyMap(
        camera.matrix, camera.distortion, turn, projection[:, :3], output_size, cv2.CV_32FC1
    )
    return np.stack(maps, axis=-1).astype(np.float32)


def _is_inside(pixels: NDArray[Any], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask of the pixels (..., 2) that lie in an image."""
    with np.errstate(invalid="ignore"):
        u, v = pixels[..., 0], pixels[..., 1]
        return np.asarray((u >= 0) & (v >= 0) & (u <= size[0] - 1) & (v <= size[1] - 1))


def _kept_share(
    camera: CameraModel, turn: Array, projection: Array, output_size: tuple[int, int]
) -> float:
    """Return the part of a camera's source pixels that is in the output."""
    width, height = camera.size
    step = max(1, math.ceil(math.sqrt(width * height / MAX_SAMPLES)))
    u, v = np.meshgrid(np.arange(step // 2, width, step), np.arange(step // 2, height, step))
    rays = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
    # a pixel's ray, turned into the rectified camera's frame, and its pixel there: P (R K^-1 u)
    turned = np.column_stack([rays, np.ones(len(rays))]) @ turn.T
    homogeneous = turned @ projection[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = homogeneous[:, :2] / homogeneous[:, 2:]
    return float((_is_inside(pixels, output_size) & (turned[:, 2] > 0)).mean())
