"""Find the V4L2 cameras of this machine."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING

from smartcam.exceptions import FrameSourceError
from smartcam.frames._driver import FoundSource, StreamFormat
from smartcam.frames._v4l2 import abi, system
from smartcam.frames._v4l2.device import FORMATS, CaptureDevice

if TYPE_CHECKING:
    from collections.abc import Iterator


def find_cameras() -> list[FoundSource]:
    """Return a source for each video device; a remark says why a device cannot be opened.

    Devices of metadata or codecs are left out, since they capture no pictures.
    """
    devices = [_probe(path, name) for path, name in system.nodes().items()]
    return [device for device in devices if device is not None]


def _probe(path: str, name: str) -> FoundSource | None:
    url = f"v4l2://{path}"
    try:
        device = CaptureDevice.open(path)
    except FrameSourceError as exc:
        cause = exc.__cause__
        if cause is None:  # the device is no camera
            return None
        return FoundSource(url, name, remark=str(exc))
    with closing(device):
        try:
            formats = device.formats()
            supported = tuple(format_ for code in formats for format_ in _formats(device, code))
        except FrameSourceError as exc:
            return FoundSource(url, name, remark=str(exc))
    others = [abi.fourcc_text(code) for code in formats if code not in FORMATS]
    remark = f"also has {', '.join(others)}, not supported" if others else ""
    return FoundSource(url, device.identity[0], supported, remark)


def _formats(device: CaptureDevice, code: int) -> Iterator[StreamFormat]:
    pixel_format = FORMATS.get(code)
    if pixel_format is not None:
        for width, height in device.sizes(code):
            rates = tuple(device.rates(code, width, height))
            yield StreamFormat(pixel_format, width, height, rates)
