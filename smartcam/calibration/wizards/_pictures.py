"""Get pictures for the wizards: from a file's bytes, or from a folder that a camera writes to."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.image import MAX_SIDE_PX, HasGrey
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from smartcam.exceptions import CalibrationError

TakePicture = Callable[[], Awaitable[Any]]
"""Function that takes a picture and returns it: uint8 or uint16, (H, W) or (H, W, 3)."""


class Pictures(Protocol):
    """An open source of frames, as from :func:`smartcam.frames.open`."""

    def after(self, moment: float, /) -> Awaitable[HasGrey]:
        """Return the first frame whose exposure began after a moment of ``time.monotonic()``."""
        ...


def picture_taker(pictures: TakePicture | Pictures) -> TakePicture:
    """Return a function that takes a picture.

    For a source of frames, the function returns the brightness of the first frame that is exposed
    after the call. Errors of the source are passed on, such as a missing device or no frame in
    time.
    """
    if callable(pictures):
        return pictures
    source = pictures

    async def take() -> NDArray[Any]:
        frame = await source.after(time.monotonic())
        return await asyncio.to_thread(frame.grey)

    return take


MAX_PREVIEW_BYTES: Final = 700_000
"""Largest number of bytes of a picture's preview, which the journal keeps in one line: a line holds
1 MiB."""

PICTURE_TIMEOUT: Final = 60.0
"""Longest time, seconds, to take a picture and to find the target in it."""

MAX_PICTURE_BYTES: Final = 1 << 26
"""Largest number of bytes of a picture's file: 20 million pixels of colour in a bitmap."""

MAX_FILES: Final = 10_000
"""Largest number of entries of a folder of pictures, which is listed several times per second."""

FOLDER_TIMEOUT: Final = 25.0
"""Longest time, seconds, to wait for a picture in a folder."""

LISTING_PERIOD: Final = 0.2
"""Seconds between two listings of a folder; a file whose length stays the same is complete."""

PICTURE_SUFFIXES: Final = frozenset(
    {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff"}
)
"""Suffixes of picture files, in lower case."""


def decode_picture(data: bytes, name: str = "picture") -> NDArray[Any]:
    """Return the picture that a file's bytes hold, (H, W), grey, uint8 or uint16.

    The file may be a bitmap, JPEG, PNG, TIFF or another format that OpenCV reads. Pixels are those
    of the camera's sensor; an orientation in the file is ignored. ``name`` is for messages. Raises
    BAD_PICTURE if the file has too many bytes or pixels, or is no picture; MissingExtraError:
    OpenCV is not installed.
    """
    if len(data) > MAX_PICTURE_BYTES:
        raise _picture_error(name, f"{MAX_PICTURE_BYTES} bytes at most", f"{len(data)}")
    cv2 = load("cv2")
    try:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:  # error for no bytes, and for more pixels than OpenCV allows
        image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise _picture_error(
            name, "a bitmap, JPEG, PNG or TIFF", f"{len(data)} bytes: {data[:16].hex(' ')}"
        )
    if max(image.shape) > MAX_SIDE_PX:
        raise _picture_error(
            name, f"{MAX_SIDE_PX} pixels along each side", f"{image.shape[1]}x{image.shape[0]}"
        )
    picture: NDArray[Any] = image
    return picture


def picture_instruction(awaited: str) -> str:
    """Return the last sentence of a step's description, which explains how to take the picture."""
    if not awaited:
        return ""
    return f" Press the button here before the camera takes its picture: {awaited}."


class PictureFolder:
    """A folder that a camera, or a person, puts pictures into.

    Args:
        path: the folder.
        timeout: time for which :meth:`take` waits, seconds.

    Attributes:
        path: the folder.
        timeout: time for which :meth:`take` waits, seconds.

    Raises:
        CalibrationError: NO_PICTURE: the path is no folder.
    """

    def __init__(self, path: str | os.PathLike[str], *, timeout: float = FOLDER_TIMEOUT) -> None:
        self.path: Path = Path(path)
        self.timeout: float = timeout
        self._scan_folder()

    @property
    def awaited(self) -> str:
        """Text, for people, that describes the picture that :meth:`take` waits for."""
        return (
            f"the first file written to {self.path} from now on counts, if its name ends in "
            f"{', '.join(sorted(PICTURE_SUFFIXES))}. The step waits {self.timeout:g} s for it"
        )

    async def take(self) -> NDArray[Any]:
        """Wait for the next picture and return it, (H, W).

        Pictures that are in the folder already do not count unless they are written again, since
        they show an earlier scene. If several pictures come, the newest is used.

        Raises:
            CalibrationError: NO_PICTURE: no picture came in time, or the folder is missing or has
                too many files; BAD_PICTURE: the picture cannot be read, or is too large.

        Cancellation: safe; no file is changed.
        """
        before, other_names = self._scan_folder(), self._other_names()
        last: dict[str, tuple[int, int]] = before
        try:
            async with asyncio.timeout(self.timeout):
                while True:
                    await asyncio.sleep(LISTING_PERIOD)
                    now = self._scan_folder()
                    complete = [
                        name
                        for name, file in now.items()
                        if file != before.get(name) and file == last.get(name) and file[1]
                    ]
                    if complete:
                        newest = max(complete, key=lambda name: now[name])
                        return await asyncio.to_thread(self._read, newest)
                    last = now
        except TimeoutError as exc:
            raise Code.NO_PICTURE.error(
                f"no picture came into {self.path} within {self.timeout:g} s"
                f"{self._describe_other_files(before, other_names)}; expected a file that ends in "
                f"one of {', '.join(sorted(PICTURE_SUFFIXES))}, written after the button was "
                "pressed",
                sorted(PICTURE_SUFFIXES),
            ) from exc

    def _other_names(self) -> set[str]:
        """Return the names of the entries of the folder that are no pictures."""
        with contextlib.suppress(OSError):
            names = [path.name for path in itertools.islice(self.path.iterdir(), MAX_FILES)]
            return {name for name in names if Path(name).suffix.lower() not in PICTURE_SUFFIXES}
        return set()

    def _describe_other_files(
        self, before: dict[str, tuple[int, int]], other_names: set[str]
    ) -> str:
        """Return a note on new files that are no pictures, and on pictures from before."""
        notes = [f"pictures from before: {len(before)}"] if before else []
        new_names = sorted(self._other_names() - other_names)
        if new_names:
            more = f" and {len(new_names) - 3} more" if len(new_names) > 3 else ""
            notes.insert(0, f"new files that are not pictures: {', '.join(new_names[:3])}{more}")
        return f" ({'; '.join(notes)})" if notes else ""

    def _scan_folder(self) -> dict[str, tuple[int, int]]:
        """Return the time of writing, ns, and the number of bytes of each picture."""
        files: dict[str, tuple[int, int]] = {}
        try:
            for count, file in enumerate(self.path.iterdir()):
                if count >= MAX_FILES:
                    raise Code.NO_PICTURE.error(
                        f"{self.path}: expected {MAX_FILES} files at most, got more", MAX_FILES
                    )
                if file.suffix.lower() not in PICTURE_SUFFIXES:
                    continue
                try:
                    status = file.stat()
                except FileNotFoundError:  # removed or renamed meanwhile
                    continue
                files[file.name] = (status.st_mtime_ns, status.st_size)
        except OSError as exc:
            raise Code.NO_PICTURE.error_with_value(
                f"{self.path}: expected a folder that pictures come into", got=exc.strerror
            ) from exc
        return files

    def _read(self, name: str) -> NDArray[Any]:
        try:
            with (self.path / name).open("rb") as stream:
                data = stream.read(MAX_PICTURE_BYTES + 1)
        except OSError as exc:
            raise _picture_error(name, "a file that can be read", str(exc.strerror)) from exc
        return decode_picture(data, name)


def _picture_error(name: str, expected: str, actual: str) -> CalibrationError:
    return Code.BAD_PICTURE.error_with_value(f"{name}: expected {expected}", expected, actual)
