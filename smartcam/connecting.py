"""Make a camera from an address."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar, overload

from smartcam._extras import from_part
from smartcam.client import SmartCamera
from smartcam.settings import CameraSettings, is_fleet, is_software

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Literal, Unpack

    from smartcam.camera import Camera
    from smartcam.interpreters._inside import AnySpec, TypedSpec
    from smartcam.models import Localization
    from smartcam.observers import Observer
    from smartcam.settings import CameraOptions, OtherOptions

__all__ = ["connect"]

T = TypeVar("T")


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: Literal["localizations"],
    **options: Unpack[OtherOptions],
) -> Camera[list[Localization]]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: Literal["raw"],
    **options: Unpack[OtherOptions],
) -> Camera[bytes]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: AnySpec,
    **options: Unpack[OtherOptions],
) -> Camera[Any]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: TypedSpec[T],
    **options: Unpack[OtherOptions],
) -> Camera[T]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    **options: Unpack[CameraOptions],
) -> Camera[Any]: ...


def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    **options: Unpack[CameraOptions],
) -> Camera[Any]:
    """Return a camera to be opened with ``async with`` (or ``await``).

    Args:
        url: ``bvs://HOST[:PORT]`` over TCP, ``bvs+udp://HOST[:PORT]`` over UDP, ``?dialect=NAME``
            sets the dialect; or a bare ``HOST[:PORT]``, which is BVS over TCP.
            ``fleet://HOST[:PORT]/CAMERA`` is a camera that an agent shares
            (:mod:`smartcam.fleet`). ``software:FILE#CAMERA`` is an ordinary camera whose pictures
            are inspected in this process, by a cell file (:mod:`smartcam.inspection`).
        model: camera model, such as ``"BVS002C"``; picks the protocol of a bare host.
        observers: objects that are called with messages, events, results and errors:
            :class:`~smartcam.Observer`.
        **options: ``name``, ``application``, ``application_names``,
            ``interpret_as``, ``calibration``, ``y_down``,
            ``lenient``, ``connect_timeout``, ``connect_attempts``, ``switch_timeout``,
            ``request_timeout``, ``close_timeout``, ``liveness_timeout``, ``reconnect``,
            ``restore``, ``max_length``: see :class:`~smartcam.settings.CameraSettings`.

    ``interpret_as`` gives the type of the camera's values: ``"localizations"``, ``"raw"``, a class,
    a function. Without it the type is ``Any``, since a URL does not show it: results of a
    directly connected camera are bytes, those of a fleet's camera are as its fleet file says.

    With ``calibration`` the value of every result is a list of localizations in the robot's frame,
    as :meth:`~smartcam.models.Calibration.to_robot` returns them: of a trigger, in a stream and for
    an observer. The calibration gets the values that ``interpret_as`` gives; with ``y_down``, their
    y axis is reversed before. The frame in their headers is the camera's ``name``; if the
    calibration has a ``camera_frame``, it has to be the same. No value is returned uncalibrated: a
    value that is no list of localizations, or that the calibration refuses, gives an
    :exc:`~smartcam.InterpretationError` with the cause chained. An interpreter that never gives
    localizations (raw, record, table, strings50) is a ConfigurationError at once; if a single
    trigger names one, its value stays as it is. A mapping gives each application id its own
    calibration, or None to leave its values as they are; a result of any other application is an
    error, too.

    Raises:
        ConfigurationError: an address or option cannot work; no connection was tried.
    """
    if is_fleet(url):
        with from_part("fleet", "a camera of a fleet needs"):
            from smartcam.fleet._inside import fleet_camera

        return fleet_camera(url, dict(options), observers)
    if is_software(url):
        with from_part("inspection", "a software camera needs"):
            from smartcam.inspection import SoftwareCamera

        return SoftwareCamera(url, dict(options), observers)
    return SmartCamera(CameraSettings.make(url, model, options), observers=observers)
