"""Pictures of any camera, the newest first.

::

    async with smartcam.frames.open("v4l2:///dev/video0?format=YUYV&size=640x480&fps=30") as source:
        async for frame in source:
            show(frame.grey())

Nothing streams until somebody reads. A slow reader gets the newest frame, and a count of what it
skipped and of what was lost before it came. The extra ``frames`` brings the codecs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._clocks import ClockStatistics
    from smartcam.frames._codecs import Codecs
    from smartcam.frames._driver import FoundSource, FrameDriver, FrameSink, StreamFormat
    from smartcam.frames._frame import Frame, Moment
    from smartcam.frames._group import FrameGroup, FrameSet, GroupStatistics
    from smartcam.frames._h264 import H264Decoder, H264Encoder
    from smartcam.frames._opening import discover, open
    from smartcam.frames._pixels import PixelFormat, find_format
    from smartcam.frames._rate import RateControl, RateStatistics
    from smartcam.frames._reader import FrameReader, ReaderStatistics
    from smartcam.frames._rtp.feedback import RtpReceiver
    from smartcam.frames._rtp.receiver import RtpStatistics
    from smartcam.frames._rtp.sender import RtpSender, RtpSenderStatistics
    from smartcam.frames._rtsp.server import RtspServer
    from smartcam.frames._rtsp.streams import RtspStatistics
    from smartcam.frames._source import FrameSource, SourceStatistics
    from smartcam.frames._stages import Rectifier, Undistorter

__all__ = [
    "ClockStatistics",
    "Codecs",
    "FoundSource",
    "Frame",
    "FrameAddress",
    "FrameDriver",
    "FrameGroup",
    "FrameReader",
    "FrameSet",
    "FrameSink",
    "FrameSource",
    "GroupStatistics",
    "H264Decoder",
    "H264Encoder",
    "Moment",
    "PixelFormat",
    "RateControl",
    "RateStatistics",
    "ReaderStatistics",
    "Rectifier",
    "RtpReceiver",
    "RtpSender",
    "RtpSenderStatistics",
    "RtpStatistics",
    "RtspServer",
    "RtspStatistics",
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
            "_clocks": "ClockStatistics",
            "_codecs": "Codecs",
            "_driver": "FoundSource FrameDriver FrameSink StreamFormat",
            "_frame": "Frame Moment",
            "_group": "FrameGroup FrameSet GroupStatistics",
            "_h264": "H264Decoder H264Encoder",
            "_opening": "discover open",
            "_pixels": "PixelFormat find_format",
            "_rate": "RateControl RateStatistics",
            "_reader": "FrameReader ReaderStatistics",
            "_rtp.feedback": "RtpReceiver",
            "_rtp.receiver": "RtpStatistics",
            "_rtp.sender": "RtpSender RtpSenderStatistics",
            "_rtsp.server": "RtspServer",
            "_rtsp.streams": "RtspStatistics",
            "_source": "FrameSource SourceStatistics",
            "_stages": "Rectifier Undistorter",
        },
    )
