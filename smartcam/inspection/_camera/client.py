"""Define the client of a software camera: it runs the camera, too, in the same process."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_flag, check_kind
from smartcam._finishing import finish
from smartcam._suggestions import did_you_mean
from smartcam.client import SmartCamera
from smartcam.exceptions import (
    CameraFaultError,
    ConfigurationError,
    ResponseTimeoutError,
    UnsupportedError,
)
from smartcam.inspection._camera.device import SoftwareDevice
from smartcam.inspection._camera.pairing import MAX_PICTURES_KEPT, PictureFinder
from smartcam.inspection._camera.pictures import png_of
from smartcam.inspection._cell import load_cell
from smartcam.models import Capabilities, Result, ValueT
from smartcam.settings import SOFTWARE_SCHEME, Address, CameraSettings

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Self

    from smartcam._client._inside import TriggerRequest
    from smartcam.inspection._camera.frame_inspector import InspectedPicture
    from smartcam.inspection._cell import CellCamera
    from smartcam.observers import Observer


class SoftwareCamera(SmartCamera[ValueT]):
    """A camera whose pictures are inspected in this process: ``software:cell.yaml#line1/cam1``.

    The client runs an emulated device in this process, so triggers, statuses, errors and streams
    work as with a camera on the network. Results are interpreted by the programs' layouts unless
    ``interpret_as`` gives others. An application is named by its number or its name.

    Args:
        url: address of the camera, ``software:FILE#CAMERA``.
        options: options of a client.
        observers: observers of the session.

    Raises:
        ConfigurationError: the file or an option is wrong.
        MissingExtraError: an extra is not installed.
    """

    def __init__(
        self, url: str, options: dict[str, Any], observers: Iterable[Observer] = ()
    ) -> None:
        camera = find_camera(url)
        self._device = SoftwareDevice(camera)
        defaults = {
            "name": camera.name,
            "interpret_as": self._device.interpret_as,
            "application_names": {
                program.name: number for number, program in camera.programs.items()
            },
        }
        given = {
            **defaults,
            **{name: value for name, value in options.items() if value or name not in defaults},
        }
        emulator = self._device.emulator
        address = Address("bvs", "bvs", emulator.host, 1, emulator.dialect)
        self._pairs = PictureFinder(
            self._device.last_sent, lambda: self.statistics().received, self._report_picture
        )
        self._device.inspector.viewers.add(self._pairs.record_picture)
        settings = CameraSettings.of(address, given)
        super().__init__(settings, observers=[self._pairs, *observers])

    @property
    def capabilities(self) -> Capabilities:
        return dataclasses.replace(super().capabilities, read_image=True)

    @property
    def last_picture(self) -> InspectedPicture | None:
        """The last inspected picture with its findings; None before the first."""
        return self._device.inspector.last_picture

    @property
    def frame_trouble(self) -> str:
        """Reason why no frames come; "" if they come."""
        return self._device.inspector.trouble

    async def open(self) -> Self:
        try:
            await self._device.start()
            self._use_address(self.settings.address._replace(port=self._device.emulator.port))
        except BaseException:
            await finish(self._device.stop)
            raise
        return await super().open()

    async def close(self) -> None:
        try:
            await super().close()
        finally:
            await finish(self._device.stop)

    async def _switch_application(self, application: int | str, timeout: float) -> None:
        if isinstance(application, str):
            application = self._device.camera.program(application).application
        await super()._switch_application(application, timeout)

    async def _trigger(
        self, application: int | None, request: TriggerRequest, timeout: float
    ) -> list[Result]:
        try:
            return await super()._trigger(application, request, timeout)
        except CameraFaultError as exc:
            trouble = self.frame_trouble or "the camera is closed"
            raise CameraFaultError(f"{exc}: {trouble}") from exc

    async def _read_image(self, timeout: float) -> bytes:
        return await self._read_last_picture(timeout, drawn=False)

    async def read_drawn_image(self, *, timeout: float | None = None) -> bytes:
        """Return the last inspected picture with the marks of its tools, as a PNG's bytes.

        Raises:
            UnsupportedError: no picture was judged yet.
            ResponseTimeoutError: the picture was not drawn in time.

        Cancellation: safe.
        """
        limit = self._limit(timeout, self.settings.request_timeout)
        return await self._read_last_picture(limit, drawn=True)

    async def read_judged_image(
        self, result: Result[Any], *, drawn: bool = False, timeout: float | None = None
    ) -> bytes:
        """Return the picture from which a result was made, as a PNG's bytes.

        The pictures of the last 8 results are kept. To keep all pictures, add a recorder to the
        camera's observers.

        Args:
            result: result of this camera.
            drawn: whether to draw the marks of the tools.
            timeout: time limit, seconds; default the camera's ``request_timeout``.

        Raises:
            ConfigurationError: an argument has another type.
            UnsupportedError: the result's picture is unknown, or no longer kept.
            ResponseTimeoutError: the picture was not made in time.

        Cancellation: safe.
        """
        check_kind(result, Result, "result", "a Result", "read_judged_image")
        drawn = check_flag(drawn, "drawn", "read_judged_image")
        limit = self._limit(timeout, self.settings.request_timeout)
        inspected = self._pairs.find_picture(result)
        if inspected is None:
            raise UnsupportedError(
                f"{self.name}: the picture of result {result.number} is not here: expected one of "
                f"the last {MAX_PICTURES_KEPT} results of this camera"
            )
        return await self._encode_png(inspected, limit, drawn=drawn)

    def _report_picture(self, result: Result[Any], inspected: InspectedPicture) -> None:
        if self._observers.handles_pictures:
            self._observers.picture(result, inspected.frame_with_drawings)

    async def _read_last_picture(self, timeout: float, *, drawn: bool) -> bytes:
        self._require_session()
        inspected = self.last_picture
        if inspected is None:
            raise UnsupportedError(f"{self.name}: no picture was judged yet: trigger first")
        return await self._encode_png(inspected, timeout, drawn=drawn)

    async def _encode_png(self, picture: InspectedPicture, timeout: float, *, drawn: bool) -> bytes:
        try:
            async with asyncio.timeout(timeout):
                return await asyncio.to_thread(png_of, picture, drawn=drawn)
        except TimeoutError:
            raise ResponseTimeoutError(
                f"{self.name}: the picture was not made within {timeout:g} s", waited=timeout
            ) from None


def find_camera(url: str) -> CellCamera:
    """Return the camera of an address, ``software:FILE`` or ``software:FILE#CAMERA``.

    Raises:
        ConfigurationError: the file is wrong, has no such camera, or has several and the address
            names none.
    """
    path, mark, name = url.strip()[len(SOFTWARE_SCHEME) :].partition("#")
    if not path:
        raise ConfigurationError(
            f"camera address {url!r}: expected software:FILE#CAMERA, such as "
            "software:cell.yaml#line1/cam1"
        )
    cameras = load_cell(path)
    if mark and name in cameras:
        return cameras[name]
    if not mark and len(cameras) == 1:
        return next(iter(cameras.values()))
    names = ", ".join(cameras)
    if mark:
        raise ConfigurationError(
            f"{path} has no software camera {name!r:.80}; it has {names}"
            f"{did_you_mean(name, cameras)}"
        )
    raise ConfigurationError(f"{path} has several software cameras: name one of {names} after #")
