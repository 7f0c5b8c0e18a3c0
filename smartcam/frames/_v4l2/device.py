"""An open device: its identity, formats and settings, with the driver's errors as smartcam's."""

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

MAX_ANSWERS: Final = 512
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
    errno.ENOSPC: "the bus has no room for so many pictures: take a smaller size or a lower rate",
    errno.EIO: "the device or its connection failed",
}


def device_error(path: str, tried: str, error: OSError) -> FrameSourceError:
    """Return the error for a failed system call; its text lists the existing devices."""
    number = error.errno or 0
    devices = tuple(f"{path} ({name})" for path, name in system.nodes().items())
    reason = REASONS.get(number, os.strerror(number))
    shown = f"; here are {', '.join(devices)}" if devices else "; no video device is here"
    return FrameSourceError(
        f"{path}: {tried}: {errno.errorcode.get(number, number)}, {reason}{shown}",
        source=path,
        available=devices,
    )


class WantedSetting(NamedTuple):
    """The requested setting of a device; None leaves a value unchanged."""

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

    def __init__(self, path: str, number: int) -> None:
        self.path = path
        self.number = number  # the file descriptor
        self.capability = abi.Capability(*self.ask(abi.QUERYCAP))

    @classmethod
    def open(cls, path: str) -> Self:
        """Open a device that captures pictures.

        Raises:
            FrameSourceError: there is no such file, it is no V4L2 device, or access is denied.
        """
        try:
            number = system.open(path)
        except OSError as exc:
            raise device_error(path, "opening it", exc) from exc
        try:
            device = cls(path, number)
            device._check()
        except BaseException:
            system.close(number)
            raise
        return device

    def close(self) -> None:
        """Close the device."""
        system.close(self.number)

    @property
    def identity(self) -> tuple[str, str]:
        """Name and bus address of the device, which identify it."""
        return abi.text(self.capability.card), abi.text(self.capability.bus_info)

    def ask(self, request: Ioctl, *fields: object, tried: str = "") -> tuple[Any, ...]:
        """Return the driver's answer; omitted fields are 0.

        Raises:
            FrameSourceError: the driver refuses.
        """
        try:
            return self.try_to(request, *fields)
        except OSError as exc:
            raise device_error(self.path, tried or request.name, exc) from exc

    def try_to(self, request: Ioctl, *fields: object) -> tuple[Any, ...]:
        """Return the driver's answer, or raise its OSError."""
        layout = request.layout
        argument = bytearray(layout.size)
        # the input fields come first, each of 32 bits
        struct.pack_into(f"{len(fields)}I", argument, 0, *fields)
        system.ioctl(self.number, request, argument)
        return layout.unpack(argument)

    def enumerate(self, request: Ioctl, *fields: object) -> Iterator[tuple[Any, ...]]:
        """Yield the entries of the driver's enumeration, if it has one."""
        for index in range(MAX_ANSWERS):
            try:
                yield self.try_to(request, index, *fields)
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
        for _, _, kind, *numbers in self.enumerate(abi.ENUM_FRAMESIZES, code):
            if kind == abi.DISCRETE:
                sizes.append((numbers[0], numbers[1]))
            else:
                return [(numbers[0], numbers[3]), (numbers[1], numbers[4])]
        return sizes

    def size_texts(self, code: int) -> list[str]:
        """Return the sizes of a format as texts."""
        for _, _, kind, *numbers in self.enumerate(abi.ENUM_FRAMESIZES, code):
            if kind != abi.DISCRETE:
                least, most = f"{numbers[0]}x{numbers[3]}", f"{numbers[1]}x{numbers[4]}"
                return [f"{least} to {most} in steps of {numbers[2]}x{numbers[5]}"]
            break
        return [f"{width}x{height}" for width, height in self.sizes(code)]

    def rates(self, code: int, width: int, height: int) -> list[float]:
        """Return the frame rates, fastest first; for a range, the fastest and the slowest."""
        rates: list[float] = []
        answers = self.enumerate(abi.ENUM_FRAMEINTERVALS, code, width, height)
        for _, _, _, _, kind, *numbers in answers:
            last = 2 if kind == abi.DISCRETE else 4
            rates += [
                numbers[place + 1] / numbers[place]
                for place in range(0, last, 2)
                if numbers[place] and numbers[place + 1]
            ]
            if kind != abi.DISCRETE:
                break
        return sorted(rates, reverse=True)

    # settings

    def set(self, wanted: WantedSetting) -> Setting:
        """Apply a setting, and check the result.

        Raises:
            FrameFormatError: the device chose another format, size or rate; the text lists the
                supported ones.
            FrameSourceError: the device is in use.
        """
        current = self._layout(self.ask(abi.G_FMT, abi.CAPTURE, tried="reading its format"))
        code = self._code(wanted.format, current.fourcc)
        width, height = wanted.size or (current.width, current.height)
        layout = self._layout(
            self.ask(
                abi.S_FMT, abi.CAPTURE, *self._padding(), width, height, code, abi.FIELD_NONE,
                tried="setting its format",
            )
        )  # fmt: skip
        self._compare(code, wanted.size, layout)
        pixel_format = self._coloured(FORMATS[code], layout)
        return Setting(pixel_format, layout, self._rate(wanted.rate, layout))

    def _coloured(self, pixel_format: PixelFormat, layout: BufferLayout) -> PixelFormat:
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
        by_default = abi.MATRIX_OF_COLORSPACE.get(layout.colorspace, "601")
        matrix = abi.MATRIX_OF_ENCODING.get(encoding, by_default)
        jpeg = quantization == 0 and layout.colorspace == abi.COLORSPACE_JPEG
        full = " full" if jpeg or quantization == abi.FULL_RANGE else ""
        if matrix not in MATRICES:
            raise FrameFormatError(
                f"{self.path}: expected Y, U and V by BT.601, BT.709 or BT.2020, the device has "
                f"those of {matrix} (color space {layout.colorspace}, encoding {encoding})",
                source=self.path,
            )
        return with_matrix(pixel_format, matrix + full)

    def _check(self) -> None:
        """Check that the device captures pictures in a supported way."""
        has = self.capability
        by_device = has.capabilities & abi.CAP_DEVICE_CAPS
        does = has.device_caps if by_device else has.capabilities
        if does & abi.CAP_VIDEO_CAPTURE and does & abi.CAP_STREAMING:
            return
        kind = next(
            (name for bit, name in _OTHER_KINDS.items() if does & bit),
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

    def _code(self, wanted: PixelFormat | None, current: int) -> int:
        """Return the fourcc to stream."""
        if wanted is None:
            known = [code for code in (current, *self.formats()) if code in FORMATS]
        else:
            known = [abi.fourcc(wanted.fourcc)] if wanted.fourcc else []
        if not known:
            raise self._no_format_error("a supported format" if wanted is None else wanted.name)
        return known[0]

    def _no_format_error(self, expected: str) -> FrameFormatError:
        offered = tuple(_named(code) for code in self.formats())
        return FrameFormatError(
            f"{self.path}: expected {expected}, it has {', '.join(offered) or 'none'}",
            source=self.path,
            available=offered,
        )

    def _compare(self, code: int, size: tuple[int, int] | None, actual: BufferLayout) -> None:
        """Check that the device applied the setting."""
        if actual.fourcc != code:
            raise self._no_format_error(_named(code))
        if size is not None and size != (actual.width, actual.height):
            offered = tuple(self.size_texts(code))
            raise FrameFormatError(
                f"{self.path}: expected {_named(code)} {size[0]}x{size[1]}, the device took "
                f"{actual.width}x{actual.height}; it has "
                f"{', '.join(offered) or 'no list of sizes'}",
                source=self.path,
                available=offered,
            )
        if actual.field not in abi.WHOLE_FIELDS:
            raise FrameFormatError(
                f"{self.path}: expected whole pictures, it has fields (kind {actual.field}), half "
                "the rows each",
                source=self.path,
            )

    def _rate(self, wanted: float | None, layout: BufferLayout) -> float | None:
        """Set the rate if one is wanted; return the device's rate."""
        try:
            _, can, _, over, under, *_ = self.try_to(abi.G_PARM, abi.CAPTURE)
            if wanted is not None and can & abi.CAP_TIMEPERFRAME:
                period = 1 / Fraction(wanted).limit_denominator(1001)
                _, can, _, over, under, *_ = self.try_to(
                    abi.S_PARM, abi.CAPTURE, 0, 0, period.numerator, period.denominator
                )
        except OSError as exc:
            if exc.errno not in (errno.ENOTTY, errno.EINVAL):
                raise device_error(self.path, "setting its rate", exc) from exc
            can = over = under = 0
        actual = under / over if can & abi.CAP_TIMEPERFRAME and over and under else None
        if wanted is not None and (
            actual is None or abs(actual - wanted) > wanted * MAX_RATE_DEVIATION
        ):
            offered = tuple(
                f"{rate:g}/s" for rate in self.rates(layout.fourcc, layout.width, layout.height)
            )
            raise FrameFormatError(
                f"{self.path}: expected {wanted:g} frames/s of {_named(layout.fourcc)} "
                f"{layout.width}x{layout.height}, the device took "
                f"{'an unknown rate' if actual is None else f'{actual:g}'}; it has "
                f"{', '.join(offered) or 'no list of rates'}",
                source=self.path,
                available=offered,
            )
        return actual


_OTHER_KINDS: Final = {
    abi.CAP_VIDEO_M2M: "a codec",
    abi.CAP_VIDEO_M2M_MPLANE: "a codec",
    abi.CAP_VIDEO_CAPTURE_MPLANE: "a camera with pictures of several planes in as many buffers, "
    "which is not supported",
    abi.CAP_META_CAPTURE: "the metadata of a camera; its pictures are at another device",
}


def _named(code: int) -> str:
    known = FORMATS.get(code)
    name = abi.fourcc_text(code)
    return name if known is None or known.name == name else f"{known.name} ({name})"
