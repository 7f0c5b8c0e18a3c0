"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.frames._clocks import MAX_DRIFT, MIN_DRIFT_DURATION, ClockStatistics
    from smartcam.frames._codecs.bitmap import read_bitmap
    from smartcam.frames._codecs.h264 import H264Encoder, random_access_point
    from smartcam.frames._codecs.jpeg import jpeg_header
    from smartcam.frames._codecs.pictures import convert_frame, decode_frame, to_jpeg, with_pixels
    from smartcam.frames._driver import TaskDriver
    from smartcam.frames._features import FEATURE_TIMEOUT, FeatureValue
    from smartcam.frames._frame import copy_with
    from smartcam.frames._gige import camera_url, discovery
    from smartcam.frames._gige.assembler import PacketCounts
    from smartcam.frames._gige.control import ControlChannel
    from smartcam.frames._gige.driver import GigEDriver
    from smartcam.frames._gige.features import GenicamFeatures
    from smartcam.frames._gige.force_address import checked_mac, force_address
    from smartcam.frames._gige.gvcp import Register
    from smartcam.frames._gige.session import GigESession
    from smartcam.frames._group import GroupStatistics
    from smartcam.frames._marks import COLOURS, Drawing, Kind, Role, stroke_width
    from smartcam.frames._pixels.formats import PixelFormat
    from smartcam.frames._pixels.layouts import Planes, YuvPairs
    from smartcam.frames._reader import FRAME_TIMEOUT, FrameTap, ReaderStatistics
    from smartcam.frames._source import SourceStatistics
    from smartcam.frames._streaming.rate import RateStatistics
    from smartcam.frames._synthetic import read_stamp
    from smartcam.frames._video.frames import colour_properties, format_of, to_lossless_av_frame

__all__ = [
    "COLOURS",
    "FEATURE_TIMEOUT",
    "FRAME_TIMEOUT",
    "MAX_DRIFT",
    "MIN_DRIFT_DURATION",
    "ClockStatistics",
    "ControlChannel",
    "Drawing",
    "FeatureValue",
    "FrameTap",
    "GenicamFeatures",
    "GigEDriver",
    "GigESession",
    "GroupStatistics",
    "H264Encoder",
    "Kind",
    "PacketCounts",
    "PixelFormat",
    "Planes",
    "RateStatistics",
    "ReaderStatistics",
    "Register",
    "Role",
    "SourceStatistics",
    "TaskDriver",
    "YuvPairs",
    "camera_url",
    "checked_mac",
    "colour_properties",
    "convert_frame",
    "copy_with",
    "decode_frame",
    "discovery",
    "force_address",
    "format_of",
    "jpeg_header",
    "random_access_point",
    "read_bitmap",
    "read_stamp",
    "stroke_width",
    "to_jpeg",
    "to_lossless_av_frame",
    "with_pixels",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_pixels.formats": "PixelFormat",
            "_source": "SourceStatistics",
            "_streaming.rate": "RateStatistics",
            "_group": "GroupStatistics",
            "_clocks": "ClockStatistics MIN_DRIFT_DURATION MAX_DRIFT",
            "_codecs.bitmap": "read_bitmap",
            "_codecs.h264": "H264Encoder random_access_point",
            "_codecs.jpeg": "jpeg_header",
            "_codecs.pictures": "convert_frame decode_frame to_jpeg with_pixels",
            "_driver": "TaskDriver",
            "_features": "FeatureValue FEATURE_TIMEOUT",
            "_frame": "copy_with",
            "_gige.force_address": "checked_mac force_address",
            "_gige.": "camera_url discovery",
            "_gige.assembler": "PacketCounts",
            "_gige.control": "ControlChannel",
            "_gige.driver": "GigEDriver",
            "_gige.features": "GenicamFeatures",
            "_gige.gvcp": "Register",
            "_gige.session": "GigESession",
            "_marks": "COLOURS Drawing Kind Role stroke_width",
            "_pixels.layouts": "Planes YuvPairs",
            "_reader": "ReaderStatistics FRAME_TIMEOUT FrameTap",
            "_synthetic": "read_stamp",
            "_video.frames": "colour_properties format_of to_lossless_av_frame",
        },
    )
