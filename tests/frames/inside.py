"""Private names of the room that several of its tests use."""

from __future__ import annotations

from smartcam.frames._gige.description import parse
from smartcam.frames._streaming.rtp.depacketizer import Depacketizer
from smartcam.frames._streaming.rtp.driver import RtpDriver
from smartcam.frames._streaming.rtp.packets import RtpPacket, is_rtcp
from smartcam.frames._v4l2 import discovery, system

__all__ = ["Depacketizer", "RtpDriver", "RtpPacket", "discovery", "is_rtcp", "parse", "system"]
