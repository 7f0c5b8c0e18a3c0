"""Pictures of any camera, the newest first.

::

    async with smartcam.frames.open("v4l2:///dev/video0?format=YUYV&size=640x480&fps=30") as source:
        async for frame in source:
            show(frame.grey())

A source streams only while somebody reads. A slow reader gets the newest frame, with the number of
frames that it skipped and of those that were lost on the way. The extra ``frames`` brings the
codecs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._codecs.h264 import H264Decoder, H264Encoder
    from smartcam.frames._codecs.threads import Codecs
    from smartcam.frames._driver import FoundSource, FrameDriver, FrameSink, StreamFormat
    from smartcam.frames._events import FrameEvents
    from smartcam.frames._features import (
        DeviceFeatures,
        Feature,
        FeatureValue,
        FrameFeature,
        FrameFeatures,
    )
    from smartcam.frames._frame import Frame, FrameTrigger, Moment
    from smartcam.frames._group import FrameGroup, FrameSet
    from smartcam.frames._opening import discover, open
    from smartcam.frames._pixels.formats import PixelFormat, find_format
    from smartcam.frames._reader import FrameReader, ReaderStatistics
    from smartcam.frames._source import FrameSource, SourceStatistics
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
    "FeatureValue",
    "FoundSource",
    "Frame",
    "FrameAddress",
    "FrameDriver",
    "FrameEvents",
    "FrameFeature",
    "FrameFeatures",
    "FrameGroup",
    "FrameReader",
    "FrameSet",
    "FrameSink",
    "FrameSource",
    "FrameTrigger",
    "H264Decoder",
    "H264Encoder",
    "Moment",
    "PixelFormat",
    "RateControl",
    "ReaderStatistics",
    "Rectifier",
    "RtpSender",
    "RtspServer",
    "SourceStatistics",
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
            "_codecs.h264": "H264Decoder H264Encoder",
            "_codecs.threads": "Codecs",
            "_driver": "FoundSource FrameDriver FrameSink StreamFormat",
            "_events": "FrameEvents",
            "_features": "DeviceFeatures Feature FeatureValue FrameFeature FrameFeatures",
            "_frame": "Frame FrameTrigger Moment",
            "_group": "FrameGroup FrameSet",
            "_opening": "discover open",
            "_pixels.formats": "PixelFormat find_format",
            "_reader": "FrameReader ReaderStatistics",
            "_source": "FrameSource SourceStatistics",
            "_stages": "Rectifier Undistorter",
            "_trigger": "AwaitedTrigger",
            "_streaming.rate": "RateControl",
            "_streaming.rtp.sender": "RtpSender",
            "_streaming.rtsp.server": "RtspServer",
        },
    )
