"""Define the planes in which lengths are measured: the picture, in pixels, or a calibrated plane.

Edges are mapped to the plane, and lengths are measured there, in millimetres for a calibrated
plane. So lines and lengths do not depend on the camera's tilt, nor on the lens' distortion if the
calibration has a lens.

A calibration's errors are common to all edges of a picture. They are described by independent
components. Each component is a variant of the map that differs by one standard deviation. Its
effect on a result is the difference between the result with this variant and the result with the
map.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam.calibration._inside import independent_parts
from smartcam.exceptions import CalibrationError, ConfigurationError
from smartcam.inspection._measure.fits import Edges
from smartcam.inspection._measure.troubles import NotMeasuredError, NoValueReason

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array

STEP_PX = 0.5
"""Step of a map's numerical derivative to each side, pixels."""

MM = 1000.0
"""Millimetres per metre."""


class Plane(NamedTuple):
    """A plane in which lengths are measured."""

    unit: str  # "px" or "mm"
    # function from pixels (N, 2) to points of the plane (N, 2)
    map: Callable[[Array], Array]
    # variants of the map; each of them differs by one component of the calibration's error
    variants: tuple[Callable[[Array], Array], ...] = ()
    # description of errors that are unknown
    remark: str = ""

    def map_points(self, pixels: Array) -> Array:
        """Map pixels (N, 2) to the plane; raise NotMeasuredError outside of the calibration."""
        try:
            return self.map(pixels)
        except CalibrationError as exc:
            raise NotMeasuredError(NoValueReason.OFF_CALIBRATION, str(exc)) from exc

    def jacobians(self, pixels: Array) -> Array:
        """Return the derivatives (N, 2, 2) of the plane's points by the pixels."""
        ends = [
            (self.map_points(pixels + step) - self.map_points(pixels - step)) / (2 * STEP_PX)
            for step in STEP_PX * np.eye(2)
        ]
        return np.stack(ends, axis=2)

    def map_edges(self, edges: Edges) -> Edges:
        """Map edges of the picture to the plane."""
        jacobians = self.jacobians(edges.points)
        # an edge has the direction t; a shift by s along its normal n moves the mapped edge by s
        # |det J| / |J t| along the mapped normal
        tangents = edges.normals[:, ::-1] * [-1.0, 1.0]
        mapped_tangents = np.einsum("nij,nj->ni", jacobians, tangents)
        lengths = np.linalg.norm(mapped_tangents, axis=1)
        normals = mapped_tangents[:, ::-1] * [1.0, -1.0] / lengths[:, None]
        mapped_normals = np.einsum("nij,nj->ni", jacobians, edges.normals)
        normals *= np.sign((normals * mapped_normals).sum(axis=1))[:, None]
        sigmas = edges.sigmas * np.abs(np.linalg.det(jacobians)) / lengths
        return Edges(self.map_points(edges.points), normals, sigmas)


PIXELS = Plane("px", lambda points: points)
"""The plane of the picture's pixels."""


def picture_plane(calibration: Any) -> Plane:
    """Return the picture as the plane, without distortion if the lens is known."""
    camera = getattr(calibration, "camera", None)
    return PIXELS if camera is None else Plane("px", camera.undistort)


def robot_plane(calibration: Any) -> Plane:
    """Return the plane of a calibration in the robot's x and y, in millimetres.

    The plane must be nearly level, so that the robot's z follows from x and y.
    """
    return measuring_plane(calibration, in_robot_axes=True)


def measuring_plane(calibration: Any, *, in_robot_axes: bool = False) -> Plane:
    """Return the plane of a calibration, in millimetres.

    ``in_robot_axes``: whether the axes are the robot's x and y; else they lie in the plane.

    ``calibration``: a :class:`~smartcam.calibration.PlaneCalibration` of pixels or a
    :class:`~smartcam.calibration.SheetCalibration`; a lens alone has no scale.

    Raises:
        ConfigurationError: another kind of calibration.
    """
    kind = getattr(calibration, "kind", None)
    if kind == "plane":
        return _with_variants(
            calibration, calibration, _plane_variants(calibration), in_robot_axes=in_robot_axes
        )
    if kind == "sheet":
        variants = [
            dataclasses.replace(calibration, plane=variant)
            for variant in _plane_variants(calibration.plane)
        ] + [
            dataclasses.replace(calibration, sheet=sheet)
            for sheet in (*_view_variants(calibration.sheet), *calibration.lens_planes)
        ]
        return _with_variants(calibration, calibration.plane, variants, in_robot_axes=in_robot_axes)
    raise ConfigurationError(
        "measure: calibration: expected the calibration of a plane, from fit_plane or "
        f"calibrate_sheet, got {kind or type(calibration).__name__}, which does not give the size "
        "of a pixel"
    )


def _with_variants(
    calibration: Any, plane: Any, variants: list[Any], *, in_robot_axes: bool
) -> Plane:
    axes = np.eye(3)[:, :2] if in_robot_axes else plane.rotation[:, :2]
    middle = np.asarray(plane.robot_points, dtype=np.float64).mean(axis=0)
    origin = np.zeros(3) if in_robot_axes else middle
    flips_v = calibration.kind == "plane" and calibration.y_down

    def mapping(variant: Any) -> Callable[[Array], Array]:
        def points(pixels: Array) -> Array:
            camera_points = pixels * [1.0, -1.0] if flips_v else pixels
            plane_points: Array = MM * (variant.transform(camera_points) - origin) @ axes
            return plane_points

        return points

    return Plane(
        "mm",
        mapping(calibration),
        tuple(mapping(variant) for variant in variants),
        _remark(calibration, plane),
    )


def _remark(calibration: Any, plane: Any) -> str:
    """Return a text about errors that sigma does not include; "" if it includes all."""
    unknown = ["the touches' error"] if plane.touch_sigma is None else []
    if calibration.kind == "sheet" and calibration.lens_covariance is None:
        unknown.append("the lens' error" if calibration.camera else "the lens' distortion")
    return f"sigma does not include {' and '.join(unknown)}: unknown" if unknown else ""


def _plane_variants(plane: Any) -> list[Any]:
    if plane.touch_sigma is None:
        return []
    matrix = plane.normalization.to_normalized(plane.matrix)
    return [
        dataclasses.replace(
            plane, matrix=plane.normalization.to_original(matrix + part.reshape(4, 3))
        )
        for part in independent_parts(plane.unit_covariance * plane.touch_sigma**2)
    ]


def _view_variants(sheet: Any) -> list[Any]:
    return [
        type(sheet)(sheet.size, sheet.matrix + part.reshape(3, 3), sheet.covariance, sheet.camera)
        for part in independent_parts(sheet.covariance)
    ]
