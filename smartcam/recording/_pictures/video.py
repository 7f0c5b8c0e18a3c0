"""Write pictures as a Matroska video, with their times rounded to milliseconds."""

from __future__ import annotations

import contextlib
import os
from fractions import Fraction
from typing import IO, TYPE_CHECKING, Any, Final

from smartcam._extras import load
from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames._inside import colour_properties, to_lossless_av_frame
from smartcam.recording._exclusive_files import open_exclusively
from smartcam.recording._mcap.form import RecordedPicture

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.frames import Frame

TICK_DURATION: Final = Fraction(1, 1000)
"""Resolution, seconds, of the times that FFmpeg writes into a Matroska file."""

OPTIONS: Final = {"cluster_time_limit": "500", "flush_packets": "1"}
"""Options for FFmpeg with which a crash loses only the last cluster, half a second."""


def check_writable(frame: Frame) -> None:
    """Raise FrameFormatError if a video cannot hold a frame without loss."""
    if frame.format.name != "MJPEG":
        try:
            to_lossless_av_frame(frame)
        except FrameFormatError as exc:
            raise FrameFormatError(
                f"{exc}; a recording in MCAP (.mcap) takes any format",
                source=frame.source,
                available=exc.available,
            ) from exc


class VideoFile:
    """Videos of one camera's pictures that are being written by a recorder's thread.

    Args:
        stream: the open file, closed at the end.
        path: path of the file.
        overwrite: whether to replace existing further files.

    Attributes:
        paths: the files that were begun so far.
    """

    def __init__(self, stream: IO[bytes], path: Path, *, overwrite: bool) -> None:
        self.paths: list[Path] = [path]
        self._camera = ""
        self._stream = stream
        self._overwrite = overwrite
        self._container: Any = None
        self._video: Any = None
        self._format_and_size: tuple[str, int, int] | None = None
        self._start_time = 0.0
        self._last_ticks = -1

    def check_picture(self, frame: Frame, camera: str) -> None:
        """Check that the video can hold a picture.

        Raises:
            ConfigurationError: the video is another camera's.
            FrameFormatError: a part of the picture would be lost.
        """
        if not self._camera:
            check_writable(frame)
            self._camera = camera
        elif self._camera != camera:
            raise ConfigurationError(
                f"recording {self.paths[0]}: a video has the pictures of one camera, "
                f"{self._camera!r}, got one of {camera!r}; one in MCAP (.mcap) takes several"
            )

    def start(self) -> None:
        """Do nothing: the first picture decides the format."""

    def add(self, item: object, /) -> None:
        """Write a picture.

        Raises:
            OSError: the disk does not take it.
            ValueError: a video cannot hold the picture.
        """
        if not isinstance(item, RecordedPicture):
            return
        frame = item.frame
        format_and_size = frame.format.name, frame.width, frame.height
        try:
            if format_and_size != self._format_and_size:
                self._begin_video(item, format_and_size)
            self._write(frame)
        except FrameFormatError as exc:
            raise ValueError(str(exc)) from exc

    def flush(self) -> None:
        """Write FFmpeg's output to the disk."""
        self._stream.flush()
        os.fsync(self._stream.fileno())

    def finish(self) -> None:
        """End the video."""
        if self._container is None:
            return
        container, self._container = self._container, None
        if self._format_and_size is not None and self._format_and_size[0] != "MJPEG":
            for packet in self._video.encode(None):
                container.mux(packet)
        container.close()
        self._stream.flush()

    def close(self) -> None:
        """Close the file; bytes that it no longer takes are dropped."""
        container, self._container = self._container, None
        if container is not None:
            with contextlib.suppress(OSError, ValueError):
                container.close()
        with contextlib.suppress(OSError):
            self._stream.close()

    def _begin_video(self, picture: RecordedPicture, format_and_size: tuple[str, int, int]) -> None:
        """Begin a video for pictures of a format and size, in a further file after the first."""
        frame = picture.frame
        if self._format_and_size is not None:
            self.finish()
            self._stream.close()
            first = self.paths[0]
            path = first.with_stem(f"{first.stem}-{len(self.paths) + 1}")
            self._stream = open_exclusively(path, overwrite=self._overwrite)
            self.paths.append(path)
        self._format_and_size, self._start_time, self._last_ticks = (
            format_and_size,
            frame.captured,
            -1,
        )
        self._container = load("av").open(
            self._stream, "w", format="matroska", options=dict(OPTIONS)
        )
        self._container.metadata["creation_time"] = picture.at.isoformat().replace("+00:00", "Z")
        self._container.metadata["title"] = picture.camera
        is_jpeg = format_and_size[0] == "MJPEG"
        video = self._video = self._container.add_stream("mjpeg" if is_jpeg else "ffv1", rate=1000)
        video.width, video.height = frame.width, frame.height
        video.time_base = TICK_DURATION
        video.codec_context.time_base = TICK_DURATION
        if is_jpeg:
            video.pix_fmt = "yuvj420p"  # the JPEGs are not encoded again, and have this format
        else:
            video.pix_fmt = to_lossless_av_frame(frame).format.name
            video.codec_context.color_range, video.codec_context.colorspace = colour_properties(
                frame.format
            )
            video.options = {"level": "3", "slicecrc": "1"}

    def _write(self, frame: Frame) -> None:
        ticks = round((frame.captured - self._start_time) / float(TICK_DURATION))
        ticks = self._last_ticks = max(ticks, self._last_ticks + 1)
        if self._format_and_size is not None and self._format_and_size[0] == "MJPEG":
            packet = load("av").Packet(bytes(frame.data))
            packet.stream, packet.time_base = self._video, TICK_DURATION
            packet.pts = packet.dts = ticks
            packet.is_keyframe = True
            self._container.mux(packet)
            return
        av_frame = to_lossless_av_frame(frame)
        av_frame.pts, av_frame.time_base = ticks, TICK_DURATION
        for packet in self._video.encode(av_frame):
            self._container.mux(packet)
