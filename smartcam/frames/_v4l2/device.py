"""An open device: its identity, formats and settings. Errors of the driver become smartcam's."""

from __future__ import annotations

import errno
import os
import struct
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames._pixels.colours import MATRICES
from smartcam.frames._pixels.formats import PIXEL_FORMATS, find_format, with_matrix
from smartcam.frames._pixels.layouts import Planes, YuvPairs
from smartcam.frames._v4l2 import abi, system

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Self

    from smartcam.frames._pixels.formats import PixelFormat
    from smartcam.frames._v4l2.abi import BufferLayout, Ioctl


FORMATS: Final = {
    abi.fourcc(pixel_format.fourcc): pixel_format
    for pixel_format in PIXEL_FORMATS
    if pixel_format.fourcc
}
"""The supported formats of V4L2."""

MAX_ENTRIES: Final = 512
"""Largest number of entries of one enumeration; a driver with more is broken."""

MAX_RATE_DEVIATION: Final = 0.01
"""Largest relative deviation from the requested rate: a camera may give 29.97/s for 30/s."""

REASONS: Final = {
    errno.ENOENT: "there is no such device",
    errno.ENXIO: "there is no such device",
    errno.ENODEV: "it is gone: unplugged, or its driver was unloaded",
    errno.EACCES: "access is denied: add the user to the device's group, mostly 'video'",
    errno.EPERM: "access is denied: add the user to the device's group, mostly 'video'",
    errno.EBUSY: "it is in use by another program",
    errno.ENOTTY: "it is not a V4L2 device, or its driver cannot do that",
    errno.ENOSPC: "the bus cannot carry so much data: choose a smaller size or a lower rate",
    errno.EIO: "the device or its connection failed",
}


def device_error(path: str, action: str, error: OSError) -> FrameSourceError:
    """Return the error for a failed system call; its text lists the existing devices."""
    number = error.errno or 0
    devices = tuple(f"{path} ({name})" for path, name in system.nodes().items())
    reason = REASONS.get(number, os.strerror(number))
    shown = f"; here are {', '.join(devices)}" if devices else "; no video device is here"
    return FrameSourceError(
        f"{path}: {action}: {errno.errorcode.get(number, number)}, {reason}{shown}",
        source=path,
        available=devices,
    )


class WantedSetting(NamedTuple):
    """The requested setting of a device; None leaves the device's value unchanged."""

    format: PixelFormat | None
    size: tuple[int, int] | None
    rate: float | None


class Setting(NamedTuple):
    """The setting of a device.

    Attributes:
        format: format of the pixels.
        layout: layout of the pixels in a buffer.
        rate: frames per second; None: unknown.
    """

    format: PixelFormat
    layout: BufferLayout
    rate: float | None


class CaptureDevice:
    """An open capture device. Its methods block while the device works."""

    def __init__(self, path: str, descriptor: int) -> None:
        self.path = path
        self.descriptor = descriptor  # of the open file
        self.capability = abi.Capability(*self.checked_ioctl(abi.QUERYCAP))

    @classmethod
    def open(cls, path: str) -> Self:
        """Open a device that captures pictures.

        Raises:
            FrameSourceError: there is no such file, it is no V4L2 device, or access is denied.
        """
        try:
            descriptor = system.open(path)
        except OSError as exc:
            raise device_error(path, "opening it", exc) from exc
        try:
            device = cls(path, descriptor)
            device._check_capabilities()
        except BaseException:
            system.close(descriptor)
            raise
        return device

    def close(self) -> None:
        """Close the device."""
        system.close(self.descriptor)

    @property
    def identity(self) -> tuple[str, str]:
        """Name and bus address of the device, which identify it."""
        return abi.decode_text(self.capability.card), abi.decode_text(self.capability.bus_info)

    def checked_ioctl(self, request: Ioctl, *fields: object, action: str = "") -> tuple[Any, ...]:
        """Return the driver's answer to an ioctl; omitted fields are 0.

        Raises:
            FrameSourceError: the driver refuses.
        """
        try:
            return self.ioctl(request, *fields)
        except OSError as exc:
            raise device_error(self.path, action or request.name, exc) from exc

    def ioctl(self, request: Ioctl, *fields: object) -> tuple[Any, ...]:
        """Return the driver's answer to an ioctl, or raise its OSError; omitted fields are 0."""
        layout = request.layout
        argument = bytearray(layout.size)
        # the input fields come first, each of 32 bits
        struct.pack_into(f"{len(fields)}I", argument, 0, *fields)
        system.ioctl(self.descriptor, request, argument)
        return layout.unpack(argument)

    def enumerate(self, request: Ioctl, *fields: object) -> Iterator[tuple[Any, ...]]:
        """Yield the entries of the driver's enumeration, if it has one."""
        for index in range(MAX_ENTRIES):
            try:
                yield self.ioctl(request, index, *fields)
            except OSError as exc:
                if exc.errno in (errno.EINVAL, errno.ENOTTY):
                    return
                raise device_error(self.path, request.name, exc) from exc

    # capabilities

    def formats(self) -> list[int]:
        """Return the fourcc of each supported format."""
        return [answer[4] for answer in self.enumerate(abi.ENUM_FMT, abi.CAPTURE)]

    def sizes(self, code: int) -> list[tuple[int, int]]:
        """Return the sizes of a format; for a range, the smallest and the largest."""
        sizes: list[tuple[int, int]] = []
        for _, _, size_type, *numbers in self.enumerate(abi.ENUM_FRAMESIZES, code):
            if size_type == abi.DISCRETE:
                sizes.append((numbers[0], numbers[1]))
            else:
                return [(numbers[0], numbers[3]), (numbers[1], numbers[4])]
        return sizes

    def size_texts(self, code: int) -> list[str]:
        """Return the sizes of a format as texts."""
        for _, _, size_type, *numbers in self.enumerate(abi.ENUM_FRAMESIZES, code):
            if size_type != abi.DISCRETE:
                smallest, largest = f"{numbers[0]}x{numbers[3]}", f"{numbers[1]}x{numbers[4]}"
                return [f"{smallest} to {largest} in steps of {numbers[2]}x{numbers[5]}"]
            break
        return [f"{width}x{height}" for width, height in self.sizes(code)]

    def rates(self, code: int, width: int, height: int) -> list[float]:
        """Return the frame rates, fastest first; for a range, the fastest and the slowest."""
        rates: list[float] = []
        answers = self.enumerate(abi.ENUM_FRAMEINTERVALS, code, width, height)
        for _, _, _, _, interval_type, *numbers in answers:
            count = 2 if interval_type == abi.DISCRETE else 4
            rates += [
                numbers[index + 1] / numbers[index]
                for index in range(0, count, 2)
                if numbers[index] and numbers[index + 1]
            ]
            if interval_type != abi.DISCRETE:
                break
        return sorted(rates, reverse=True)

    # settings

    def apply(self, wanted: WantedSetting) -> Setting:
        """Apply a setting, and check the result.

        Raises:
            FrameFormatError: the device chose another format, size or rate; the text lists the
                supported ones.
            FrameSourceError: the device is in use.
        """
        current = self._layout(
            self.checked_ioctl(abi.G_FMT, abi.CAPTURE, action="reading its format")
        )
        code = self._choose_format(wanted.format, current.fourcc)
        width, height = wanted.size or (current.width, current.height)
        layout = self._layout(
            self.checked_ioctl(
                abi.S_FMT, abi.CAPTURE, *self._padding(), width, height, code, abi.FIELD_NONE,
                action="setting its format",
            )
        )  # fmt: skip
        self._check_applied(code, wanted.size, layout)
        pixel_format = self._with_matrix_and_range(FORMATS[code], layout)
        return Setting(pixel_format, layout, self._apply_rate(wanted.rate, layout))

    def _with_matrix_and_range(
        self, pixel_format: PixelFormat, layout: BufferLayout
    ) -> PixelFormat:
        """Return the format with the device's matrix and range.

        Raises:
            FrameFormatError: the device's matrix is not supported.
        """
        is_extended = layout.private == abi.PRIVATE_MAGIC
        encoding, quantization = (layout.ycbcr_enc, layout.quantization) if is_extended else (0, 0)
        if pixel_format.name in ("RGB8", "BGR8"):
            limited = quantization == abi.LIMITED_RANGE
            return find_format(f"{pixel_format.name}_limited") if limited else pixel_format
        if not isinstance(pixel_format.layout, YuvPairs | Planes):
            return pixel_format
        default_matrix = abi.MATRIX_OF_COLORSPACE.get(layout.colorspace, "601")
        matrix = abi.MATRIX_OF_ENCODING.get(encoding, default_matrix)
        is_jpeg = quantization == 0 and layout.colorspace == abi.COLORSPACE_JPEG
        full = " full" if is_jpeg or quantization == abi.FULL_RANGE else ""
        if matrix not in MATRICES:
            raise FrameFormatError(
                f"{self.path}: expected Y, U and V by BT.601, BT.709 or BT.2020, the device has "
                f"those of {matrix} (color space {layout.colorspace}, encoding {encoding})",
                source=self.path,
            )
        return with_matrix(pixel_format, matrix + full)

    def _check_capabilities(self) -> None:
        """Check that the device captures pictures in a supported way."""
        reported = self.capability
        has_device_caps = reported.capabilities & abi.CAP_DEVICE_CAPS
        flags = reported.device_caps if has_device_caps else reported.capabilities
        if flags & abi.CAP_VIDEO_CAPTURE and flags & abi.CAP_STREAMING:
            return
        kind = next(
            (name for bit, name in _OTHER_DEVICES.items() if flags & bit),
            "no camera: it captures no pictures, or does not stream them",
        )
        devices = tuple(f"{path} ({name})" for path, name in system.nodes().items())
        raise FrameSourceError(
            f"{self.path}: expected a camera, got {self.identity[0]!r}, which is {kind}; "
            f"here are {', '.join(devices)}",
            source=self.path,
            available=devices,
        )

    @staticmethod
    def _padding() -> tuple[int, ...]:
        return (0,) * (abi.POINTER // 4 - 1)

    @staticmethod
    def _layout(answer: tuple[Any, ...]) -> BufferLayout:
        return abi.BufferLayout(*answer[1:12])

    def _choose_format(self, wanted: PixelFormat | None, current: int) -> int:
        """Return the fourcc of the format to stream."""
        if wanted is None:
            codes = [code for code in (current, *self.formats()) if code in FORMATS]
        else:
            codes = [abi.fourcc(wanted.fourcc)] if wanted.fourcc else []
        if not codes:
            raise self._no_format_error("a supported format" if wanted is None else wanted.name)
        return codes[0]

    def _no_format_error(self, expected: str) -> FrameFormatError:
        offered = tuple(_format_name(code) for code in self.formats())
        return FrameFormatError(
            f"{self.path}: expected {expected}, it has {', '.join(offered) or 'none'}",
            source=self.path,
            available=offered,
        )

    def _check_applied(self, code: int, size: tuple[int, int] | None, actual: BufferLayout) -> None:
        """Check that the device applied the format and the size."""
        if actual.fourcc != code:
            raise self._no_format_error(_format_name(code))
        if size is not None and size != (actual.width, actual.height):
            offered = tuple(self.size_texts(code))
            raise FrameFormatError(
                f"{self.path}: expected {_format_name(code)} {size[0]}x{size[1]}, the device took "
                f"{actual.width}x{actual.height}; it has "
                f"{', '.join(offered) or 'no list of sizes'}",
                source=self.path,
                available=offered,
            )
        if actual.field not in abi.WHOLE_FIELDS:
            raise FrameFormatError(
                f"{self.path}: expected whole pictures, it has fields (kind {actual.field}) of "
                "half the rows",
                source=self.path,
            )

    def _apply_rate(self, wanted: float | None, layout: BufferLayout) -> float | None:
        """Set the rate if one is requested; return the device's rate."""
        try:
            _, flags, _, numerator, denominator, *_ = self.ioctl(abi.G_PARM, abi.CAPTURE)
            if wanted is not None and flags & abi.CAP_TIMEPERFRAME:
                period = 1 / Fraction(wanted).limit_denominator(1001)
                _, flags, _, numerator, denominator, *_ = self.ioctl(
                    abi.S_PARM, abi.CAPTURE, 0, 0, period.numerator, period.denominator
                )
        except OSError as exc:
            if exc.errno not in (errno.ENOTTY, errno.EINVAL):
                raise device_error(self.path, "setting its rate", exc) from exc
            flags = numerator = denominator = 0
        actual = (
            denominator / numerator
            if flags & abi.CAP_TIMEPERFRAME and numerator and denominator
            else None
        )
        if wanted is not None and (
            actual is None or abs(actual - wanted) > wanted * MAX_RATE_DEVIATION
        ):
            offered = tuple(
                f"{rate:g}/s" for rate in self.rates(layout.fourcc, layout.width, layout.height)
            )
            raise FrameFormatError(
                f"{self.path}: expected {wanted:g} frames/s of {_format_name(layout.fourcc)} "
                f"{layout.width}x{layout.height}, the device took "
                f"{'an unknown rate' if actual is None else f'{actual:g}'}; it has "
                f"{', '.join(offered) or 'no list of rates'}",
                source=self.path,
                available=offered,
            )
        return actual


_OTHER_DEVICES: Final = {
    abi.CAP_VIDEO_M2M: "a codec",
    abi.CAP_VIDEO_M2M_MPLANE: "a codec",
    abi.CAP_VIDEO_CAPTURE_MPLANE: "a camera with pictures of several planes in as many buffers, "
    "which is not supported",
    abi.CAP_META_CAPTURE: "the metadata of a camera; its pictures are at another device",
}


def _format_name(code: int) -> str:
    pixel_format = FORMATS.get(code)
    name = abi.fourcc_text(code)
    if pixel_format is None or pixel_format.name == name:
        return name
    return f"{pixel_format.name} ({name})"
