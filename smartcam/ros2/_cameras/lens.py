"""A camera's lens in ROS: ``camera_info``, its file, and ``set_camera_info``."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from smartcam.calibration._inside import MAX_CAMERA_FILE_BYTES, parse_camera_info
from smartcam.calibration.formats import write_camera_info
from smartcam.exceptions import ConfigurationError, RosError, RosMessageError, SmartCamError
from smartcam.ros2._cameras.image_messages import header_fields_at
from smartcam.ros2._cameras.lens_messages import lens_fields, lens_from

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.calibration._inside import CameraInfo
    from smartcam.frames import Frame

logger: logging.Logger = logging.getLogger("smartcam.ros2")


def path_from_url(url: str) -> Path | None:
    """Return the file of ``camera_info_url``: ``file:///path``, or a path; "" means no file.

    Raises:
        ConfigurationError: the URL is of another scheme.
    """
    if not url:
        return None
    parts = urlsplit(url)
    if parts.scheme == "file" and parts.netloc in {"", "localhost"}:
        return Path(unquote(parts.path))
    if "://" in url:
        raise ConfigurationError(
            f"camera_info_url: expected file:///PATH or a path, got {url!r:.120}"
        )
    return Path(url)


class CameraLens:
    """The lens of a camera's pictures: from a file, otherwise from the frame.

    Args:
        name: name of the camera, for the file.
        frame_id: the camera's optical frame.
        url: URL of a file with ``camera_info`` of ROS, which need not exist yet; "": no file.
        size: function that returns the pictures' width and height.

    Raises:
        ConfigurationError: the URL is not valid.
    """

    def __init__(
        self, name: str, frame_id: str, url: str, size: Callable[[], Awaitable[tuple[int, int]]]
    ) -> None:
        self._name, self._frame_id, self._size = name, frame_id, size
        self._path = path_from_url(url)
        self._info: CameraInfo | None = None
        self._is_loaded = self._path is None
        self._warned_size: tuple[int, int] | None = None
        self._file_lock = asyncio.Lock()

    async def load(self) -> None:
        """Read the file if it was not read yet; log and ignore a file that is not valid."""
        if self._is_loaded or self._path is None:
            return
        async with self._file_lock:
            if self._is_loaded:
                return
            try:
                self._info = await asyncio.to_thread(_read_file, self._path)
            except FileNotFoundError:
                logger.info("%s: %s is not there: not calibrated yet", self._name, self._path)
            except (SmartCamError, OSError) as exc:
                logger.warning("%s ! the lens is not known: %s", self._name, exc)
            self._is_loaded = True

    def camera_info_fields(self, frame: Frame) -> dict[str, Any]:
        """Return the ``sensor_msgs/CameraInfo`` of a frame."""
        header, size = header_fields_at(frame.utc, self._frame_id), (frame.width, frame.height)
        info = self._info
        lens = frame.camera_info if info is None else info.camera
        if lens is not None and tuple(lens.size) != size:
            if self._warned_size != size:
                self._warned_size = size
                logger.warning(
                    "%s ! the lens is that of pictures of %dx%d, these have %dx%d: camera_info is "
                    "that of a camera that is not calibrated",
                    self._name,
                    *lens.size,
                    *size,
                )
            lens = None
        if lens is None or info is None:
            return lens_fields(lens, header, size)
        return lens_fields(
            lens, header, size, rectification=info.rectification, projection=info.projection
        )

    async def serve_set_camera_info(self, request: Any) -> dict[str, Any]:
        """Serve ``sensor_msgs/srv/SetCameraInfo``.

        Cancellation: the file is either the old one or the new one, complete.
        """
        try:
            path = await self._write_lens(request.camera_info)
        except (SmartCamError, OSError) as exc:
            logger.warning("%s ! set_camera_info was refused: %s", self._name, exc)
            return {"success": False, "status_message": str(exc)}
        return {"success": True, "status_message": f"written to {path}"}

    async def _write_lens(self, message: Any) -> Path:
        info = lens_from(message)
        if info is None:
            raise RosMessageError("camera_info: expected a calibration, got one with K[0] = 0")
        if self._path is None:
            raise RosError(
                "this camera has no file for its lens: camera_info comes from the source of the "
                "frames; expected camera_info_url to name a file"
            )
        width, height = await self._size()
        if info.camera.size != (width, height):
            lens_size = info.camera.size
            raise RosMessageError(
                f"camera_info: expected the size of the pictures, {width}x{height}, got "
                f"{lens_size[0]}x{lens_size[1]}"
            )
        async with self._file_lock:
            await asyncio.to_thread(
                write_camera_info,
                self._path,
                info.camera,
                name=self._name,
                rectification=info.rectification,
                projection=info.projection,
            )
            self._info, self._is_loaded, self._warned_size = info, True, None
        logger.info("%s: set_camera_info: written to %s", self._name, self._path)
        return self._path


def _read_file(path: Path) -> CameraInfo:
    with path.open("rb") as file:
        data = file.read(MAX_CAMERA_FILE_BYTES + 1)
    if len(data) > MAX_CAMERA_FILE_BYTES:
        raise ConfigurationError(
            f"{path}: expected a camera_info of {MAX_CAMERA_FILE_BYTES} bytes at most"
        )
    try:
        return parse_camera_info(data.decode())
    except UnicodeDecodeError as exc:
        raise ConfigurationError(f"{path}: expected text: {exc}") from exc
    except SmartCamError as exc:
        raise ConfigurationError(f"{path}: {exc}") from exc
