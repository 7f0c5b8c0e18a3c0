"""Read the pictures of any camera; readers get the newest.

::

    async with smartcam.frames.open("v4l2:///dev/video0?format=YUYV&size=640x480&fps=30") as source:
        async for frame in source:
            show(frame.grey())

A source streams only while it has readers. A slow reader gets the newest frame, with counts of
skipped and lost frames. The extra ``frames`` installs the codecs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._codecs.threads import Codecs
    from smartcam.frames._driver import FoundSource, FrameDriver, FrameSink, StreamFormat
    from smartcam.frames._features import DeviceFeatures, Feature
    from smartcam.frames._frame import Frame, FrameTrigger, Moment
    from smartcam.frames._group import FrameGroup, FrameSet
    from smartcam.frames._opening import discover, open
    from smartcam.frames._pixels.formats import find_format
    from smartcam.frames._reader import FrameReader
    from smartcam.frames._source import FrameSource
    from smartcam.frames._stages import Rectifier, Undistorter
    from smartcam.frames._streaming.rate import RateControl
    from smartcam.frames._streaming.rtp.sender import RtpSender
    from smartcam.frames._streaming.rtsp.server import RtspServer
    from smartcam.frames._trigger import AwaitedTrigger

__all__ = [
    "AwaitedTrigger",
    "Codecs",
    "DeviceFeatures",
    "Feature",
    "FoundSource",
    "Frame",
    "FrameAddress",
    "FrameDriver",
    "FrameGroup",
    "FrameReader",
    "FrameSet",
    "FrameSink",
    "FrameSource",
    "FrameTrigger",
    "Moment",
    "RateControl",
    "Rectifier",
    "RtpSender",
    "RtspServer",
    "StreamFormat",
    "Undistorter",
    "discover",
    "find_format",
    "open",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_address": "FrameAddress",
            "_codecs.threads": "Codecs",
            "_driver": "FoundSource FrameDriver FrameSink StreamFormat",
            "_features": "DeviceFeatures Feature",
            "_frame": "Frame FrameTrigger Moment",
            "_group": "FrameGroup FrameSet",
            "_opening": "discover open",
            "_pixels.formats": "find_format",
            "_reader": "FrameReader",
            "_source": "FrameSource",
            "_stages": "Rectifier Undistorter",
            "_trigger": "AwaitedTrigger",
            "_streaming.rate": "RateControl",
            "_streaming.rtp.sender": "RtpSender",
            "_streaming.rtsp.server": "RtspServer",
        },
    )
