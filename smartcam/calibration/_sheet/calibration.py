"""Map a camera's pixels to the robot's space, by one picture of a printed sheet.

::

    view = find_target(image, target)
    plane = fit_corners(target, [0, 8, 45, 53], touches, touch_sigma=0.0002, tool_z=(0, 0, -1))
    calibration = calibrate_sheet(
        view, plane, camera=lens.camera, lens_covariance=lens.covariance
    )
    calibration.transform([[412.5, 300.0]])         # pixels, v down: metres of the robot

The robot touches points of the printed target, or the lines ("rays") that are printed along its x
and y axes; the camera need not see the touched points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, overload

import numpy as np

from smartcam._argument_checks import (
    a_target,
    an_integer,
    check_arguments,
    each,
    numbers,
    of_class,
    or_none,
)
from smartcam._arguments import check_flag
from smartcam._forks import cached_property
from smartcam.calibration._files import storage
from smartcam.calibration._homography import derivatives
from smartcam.calibration._least_squares import independent_parts
from smartcam.calibration._lens.bundle import lens_values, with_lens
from smartcam.calibration._one_blas_thread import one_blas_thread
from smartcam.calibration._plane.calibration import PlaneCalibration, fit_plane
from smartcam.calibration._plane.pose_sigmas import robot_sigmas
from smartcam.calibration._sheet.plane import SheetPlane, fit_sheet_view
from smartcam.calibration._solvers import Chain, Poses, chain_of, check_frames
from smartcam.calibration._verdict import AdvisedVerdict, CalibrationVerdict
from smartcam.calibration._views import TargetView
from smartcam.geometry import CameraModel
from smartcam.geometry._inside import Array, Code, Remark, check_finite
from smartcam.models import Localization

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import ArrayLike

    from smartcam.calibration._targets import Target
    from smartcam.models import PoseSigma

KIND = "sheet"
"""Kind of these calibrations, as their files name it."""

MAX_UNEXPLAINED_PX = {True: 0.3, False: 0.1}
"""A remark says if residuals exceed the points' noise by more than this, pixels. With a lens (True)
the limit allows for errors of print, edges and lens; without a lens the limit is a tenth of usual
distortion."""

ONE_SCALE_MODELS = frozenset({"rigid", "similarity", "touches"})
"""Models of a plane that keep the shape of a sheet; ``touches`` is that of :func:`fit_touches`."""


PLANE_FORM = storage.Form(
    dict[str, Any],
    read=lambda data, _: PlaneCalibration.from_data(data),
    write=lambda plane: plane.to_data(),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class SheetCalibration(storage.SavedCalibration):
    """The result of :func:`calibrate_sheet`; immutable.

    Localizations must be in pixels with the y axis up (y is -v), as :func:`smartcam.connect` gives
    them with ``y_down=True``, for a camera whose own y axis points down; others are refused. Plain
    pixels, as in :meth:`transform`, have v down.

    Attributes:
        view: view of the target by the camera.
        sheet: map from pixels to the sheet.
        plane: map from the sheet's metres to the robot.
        lens_covariance: (4 + K, 4 + K), covariance of the lens' values, as in
            :attr:`IntrinsicCalibration.covariance`; None: not known, or there is no lens.
        rms: standard deviation of a coordinate of the view's points from the fit, pixels.
        camera_frame: name of the frame that localizations must come in; None for any.
        remarks: warnings about the view.
    """

    y_down: ClassVar[bool] = True
    kind: ClassVar[str] = KIND
    _label: ClassVar[str] = "sheet's calibration"
    _keys: ClassVar[storage.Keys] = {"sheet": "", "remarks": "warnings"}
    _optional_keys: ClassVar[frozenset[str]] = frozenset({"lens_covariance"})
    _extra_keys: ClassVar[storage.ExtraKeys] = {
        "target": (storage.StoredTarget, lambda calibration: calibration.view.target),
        "camera": (CameraModel | None, lambda calibration: calibration.sheet.camera),
        "matrix": (storage.Matrix3, lambda calibration: calibration.sheet.matrix),
        "covariance": (
            Annotated[Array, storage.matrix(9)],
            lambda calibration: calibration.sheet.covariance,
        ),
    }

    view: TargetView
    sheet: SheetPlane
    plane: Annotated[PlaneCalibration, PLANE_FORM]
    rms: storage.NonNegative
    lens_covariance: Annotated[Array, storage.matrix()] | None = None
    camera_frame: str | None = None
    remarks: storage.Remarks = ()

    @classmethod
    def _read(cls, fields: dict[str, Any], context: storage.Context) -> SheetCalibration:
        matrix, covariance = fields["matrix"], fields["covariance"]
        if covariance.shape != (9, 9):
            raise storage.invalid_data_error(
                context["label"], "covariance: expected 9 rows of 9", len(covariance)
            )
        if abs(np.linalg.det(matrix)) == 0.0:
            text = "matrix: expected one that can be inverted"
            raise storage.invalid_data_error(context["label"], text, matrix.tolist())
        fields["sheet"] = SheetPlane(fields["view"].size, matrix, covariance, fields["camera"])
        return super()._read(fields, context)

    def _check(self, fields: Mapping[str, Any], label: str) -> None:
        if self.lens_covariance is not None:
            _check_lens(self.lens_covariance, self.camera, label)

    @property
    def camera(self) -> CameraModel | None:
        """The lens; None: pixels are taken as they are."""
        return self.sheet.camera

    @property
    def robot_frame(self) -> str:
        """Name of the frame that poses are given in."""
        return self.plane.robot_frame

    @property
    def model(self) -> str:
        """Model of the map from the sheet to the robot."""
        return self.plane.model

    @property
    def warnings(self) -> tuple[Remark, ...]:
        """Warnings to read before using the calibration: of the view, then of the touches."""
        return (*self.remarks, *self.plane.warnings)

    @property
    def verdict(self) -> CalibrationVerdict:
        """Verdict on the calibration's quality, the millimetres it is good for, and the cure."""
        return self.judged().verdict

    def judged(self) -> AdvisedVerdict:
        """Return the verdict for the area that the target covers in the image, and the advice."""
        if any(remark.code == Code.POOR_FIT for remark in self.remarks):
            lens = "this camera's own lens calibration" if self.camera else "a lens: --lens"
            text = f"Not good enough: the picture needs {lens}, or a flat sheet"
            return AdvisedVerdict(CalibrationVerdict("poor", text), option="more")
        predicted = None
        if self.plane.touch_sigma is not None:
            errors = self.predicted_error(self.view.points)
            predicted = float(np.sqrt((errors**2).mean()))
        return self.plane.judged(predicted, " where the sheet lay")

    @cached_property
    def chain(self) -> Chain:
        """The calibration as a chain of solvers, for localizations with y up (-v)."""
        chain = Chain(
            [self.sheet],
            frame=self.robot_frame,
            camera_frame=self.camera_frame,
            y_down=self.y_down,
        )
        return chain.then(chain_of(self.plane))

    @cached_property
    def lens_planes(self) -> tuple[SheetPlane, ...]:
        """Maps from pixels to the sheet, for lenses with an error of one standard deviation each.

        The errors of these lenses are independent; their outer products add up to
        ``lens_covariance``. For each lens the sheet is located again, from the same view.
        """
        if self.camera is None or self.lens_covariance is None:
            return ()
        values, moves = lens_values(self.camera), independent_parts(self.lens_covariance)
        return tuple(
            fit_sheet_view(self.view, with_lens(self.camera, values + move)).plane for move in moves
        )

    def transform(self, pixels: ArrayLike) -> Array:
        """Map pixels to points of the plane in the robot's space.

        Args:
            pixels: (N, 2), u to the right and v down from the middle of the upper left pixel.

        Returns:
            (N, 3), metres.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE; OUT_OF_FIELD: outside of the image, or behind the
                plane's horizon.
        """
        return self.plane.transform(self.sheet.on_sheet(pixels))

    def inverse(self, points: ArrayLike) -> Array:
        """Map points of the robot's space to the camera's.

        Args:
            points: (N, 3), metres; a point beside the plane is projected onto it.

        Returns:
            (N, 2), pixels, v down; NaN for points behind the camera.

        Raises:
            CalibrationError: SHAPE or NOT_FINITE.
        """
        return self.sheet.in_image(self.plane.inverse(points))

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

        Args:
            localizations: localizations of the camera, one or many: pixels, with y up (-v).
            tool_flip: as in :meth:`PlaneCalibration.to_robot`.

        If a pose has a ``sigma``, and the touches' sigma is known, its robot pose has a ``sigma``
        that includes the errors of view, touches and lens.

        Raises:
            CalibrationError: WRONG_FRAME, OUT_OF_PLANE, OUT_OF_FIELD.
        """
        if isinstance(localizations, Localization):
            return self._map_localizations([localizations], tool_flip)[0]
        return self._map_localizations(list(localizations), tool_flip)

    def _map_localizations(self, parts: list[Localization], flip: bool) -> list[Localization]:
        check_frames(parts, self.camera_frame)
        on_sheet = self.sheet.solve(Poses.of(parts)).replace_poses_of(parts)
        rows = [index for index, part in enumerate(parts) if part.pose.sigma is not None]
        if rows and self.plane.touch_sigma is not None:
            for index, sigma in zip(
                rows, self._sigmas([parts[index] for index in rows]), strict=True
            ):
                on_sheet[index] = on_sheet[index]._replace(
                    pose=on_sheet[index].pose.with_sigma(sigma)
                )
        return self.plane.to_robot(on_sheet, tool_flip=flip)

    def _sigmas(self, parts: list[Localization]) -> list[PoseSigma]:
        """Return the sigmas of poses on the sheet: errors of localizations, view and lens."""
        lenses = self.lens_planes
        y_up = np.array([1.0, -1.0])

        def points_on_sheet(points: Array) -> Array:
            flat = self.sheet.on_sheet_unchecked(points * y_up)
            return np.column_stack([flat, np.zeros(len(flat))])

        def parameter_slopes(points: Array) -> Array:
            flat = self.sheet.on_sheet_unchecked(points * y_up)
            slopes = np.zeros((len(flat), 3, 9 + len(lenses)))
            slopes[:, :2, :9] = self.sheet.element_slopes(flat)
            for column, lens in enumerate(lenses, start=9):
                slopes[:, :2, column] = lens.on_sheet_unchecked(points * y_up) - flat
            return slopes

        covariance = np.eye(9 + len(lenses))
        covariance[:9, :9] = self.sheet.covariance
        normal, size = np.array([0.0, 0.0, 1.0]), float(max(self.sheet.size))
        return robot_sigmas(
            parts, points_on_sheet, normal, parameter_slopes, covariance, size, flip=False
        )

    def covariance_at(self, pixels: ArrayLike) -> Array:
        """Return the covariance of mapped pixels that the noise of view, touches and lens causes.

        Args:
            pixels: (K, 2), v down.

        Returns:
            (K, 3, 3), m^2, along the robot's axes. It includes errors of the lens if
            ``lens_covariance`` is given; the noise of the camera when it sees the point is not
            included.

        Raises:
            CalibrationError: as :meth:`transform`; UNVERIFIED: the touches' sigma is not known.
        """
        sheet_points = self.sheet.on_sheet(pixels)
        # to first order: D C D^T with the map's derivative D
        slopes = derivatives(self.plane.matrix, sheet_points)
        sheet_covariance = self.sheet.covariance_at(pixels)
        for plane in self.lens_planes:
            deviation = plane.on_sheet(pixels) - sheet_points
            sheet_covariance = sheet_covariance + deviation[:, :, None] * deviation[:, None, :]
        camera_part = slopes @ sheet_covariance @ slopes.swapaxes(1, 2)
        covariance: Array = self.plane.covariance_at(sheet_points) + camera_part
        return covariance

    def predicted_error(self, pixels: ArrayLike) -> Array:
        """Return the rms error (K,) to expect of mapped pixels (K, 2), metres.

        Raises:
            CalibrationError: as :meth:`covariance_at`.
        """
        error: Array = np.sqrt(np.trace(self.covariance_at(pixels), axis1=1, axis2=2))
        return error


def _check_lens(covariance: Array, camera: CameraModel | None, label: str) -> None:
    """Raise SHAPE or NOT_FINITE if a covariance cannot be that of the lens' values."""
    count = 0 if camera is None else 4 + len(camera.distortion)
    storage.check_shape(covariance, (count, count), label, "lens_covariance")
    check_finite(covariance, f"{label}: lens_covariance")


@check_arguments(
    view=of_class("TargetView"),
    plane=of_class("PlaneCalibration"),
    camera=or_none(of_class("CameraModel")),
    lens_covariance=or_none(numbers),
)
@one_blas_thread
def calibrate_sheet(
    view: TargetView,
    plane: PlaneCalibration,
    *,
    camera: CameraModel | None = None,
    lens_covariance: ArrayLike | None = None,
    camera_frame: str | None = None,
) -> SheetCalibration:
    """Calibrate the map from pixels to the robot.

    Args:
        view: view of the target with the sheet at the place of the touches.
        plane: map from the sheet's metres to the robot: of :func:`fit_corners`, or of
            :func:`~smartcam.calibration.fit_touches` with the origin at (0, 0).
        camera: the lens, for images of the same size; None: a homography of the view's points.
        lens_covariance: (4 + K, 4 + K), covariance of the lens' values, as in
            :attr:`IntrinsicCalibration.covariance`; None: not known. Predicted errors include it.
        camera_frame: name of the frame that localizations must come in; None for any.

    Raises:
        CalibrationError: TOO_FEW, COLLINEAR, WRONG_SIZE, NOT_FINITE, POOR_FIT, MIRRORED: see
            :func:`~smartcam.calibration._sheet.plane.fit_sheet_view`. SHAPE or NOT_FINITE: the
            covariance is not valid.
    """
    if lens_covariance is not None:
        lens_covariance = storage.as_array(lens_covariance)
        _check_lens(lens_covariance, camera, "calibrate_sheet")
    fit = fit_sheet_view(view, camera)
    remarks: list[Remark] = []
    if camera is None:
        remarks.append(
            Code.LENS_UNKNOWN.remark(
                "no lens was given: the tilt of the camera is corrected, the distortion of its "
                "lens is not, and grows outside of the target's points"
            )
        )
    if fit.unexplained > MAX_UNEXPLAINED_PX[camera is not None]:
        cause = "the lens distorts" if camera is None else "the given lens is not this camera's"
        remarks.append(
            Code.POOR_FIT.remark(
                f"the target's points differ by {fit.rms:.2g} px rms from the fit of a flat sheet, "
                f"of which noise does not explain {fit.unexplained:.2g} px: {cause}, or the sheet "
                "is not flat"
            )
        )
    return SheetCalibration(
        view=view,
        sheet=fit.plane,
        plane=plane,
        lens_covariance=lens_covariance,
        rms=fit.rms,
        camera_frame=camera_frame,
        remarks=tuple(remarks),
    )


@check_arguments(
    target=a_target,
    ids=each(an_integer),
    tool_z=or_none(numbers),
    robust=check_flag,
)
def fit_corners(
    target: Target,
    ids: Sequence[int],
    touches: ArrayLike,
    *,
    touch_sigma: float | None = None,
    tool_z: ArrayLike | None = None,
    robust: bool = False,
    robot_frame: str = "robot",
) -> PlaneCalibration:
    """Fit the map from a sheet's metres to the robot to touches of points of its target.

    A sheet that lies flat keeps its shape. If touches do not fit that shape, a warning says so
    (NOT_SIMILAR), and the shape is kept. If the scale is not the target's, a warning says so, too
    (SCALE_MISMATCH), and the touches' scale is used: the print was not measured correctly.

    Args:
        target: target with its lengths as they are on paper.
        ids: (N,), numbers of the target's points that were touched, three at least.
        touches: (N, 3), places of the robot's tip, metres.
        touch_sigma: standard deviation of one coordinate of a touch, metres, as in
            :func:`~smartcam.calibration.fit_plane`.
        tool_z: direction of the tool's axis, as in :func:`~smartcam.calibration.fit_plane`.
        robust: leave out touches that do not agree with the others, as in
            :func:`~smartcam.calibration.fit_plane`.
        robot_frame: name of the robot's frame, in which poses will be given.

    Raises:
        CalibrationError: SHAPE: the target has no point of that number; SCALE_MISMATCH: the scale
            is off by more than a tenth; and those of :func:`~smartcam.calibration.fit_plane`.
    """
    target_points = target.points[:, :2]
    unknown_ids = [point_id for point_id in ids if not 0 <= point_id < len(target_points)]
    if unknown_ids:
        raise Code.SHAPE.error_with_value(
            f"touched points: expected numbers from 0 to {len(target_points) - 1}",
            len(target_points) - 1,
            unknown_ids[0],
        )
    sheet_points = target_points[np.asarray(ids, dtype=np.intp)]

    def fit_model(model: Any) -> PlaneCalibration:
        return fit_plane(
            sheet_points,
            touches,
            model=model,
            touch_sigma=touch_sigma,
            nominal_scale=1.0,
            tool_z=tool_z,
            robust=robust,
            robot_frame=robot_frame,
        )

    plane = fit_model("auto")
    return plane if plane.model in ONE_SCALE_MODELS else fit_model("similarity")
