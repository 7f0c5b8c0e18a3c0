"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.frames._codecs import pictures
from smartcam.frames._codecs.bitmap import MAX_PIXEL_BYTES
from smartcam.frames._codecs.h264 import H264Decoder
from smartcam.frames._codecs.jpeg import decode_jpeg
from smartcam.frames._codecs.pictures import to_jpegxl, to_png
from smartcam.frames._gige import assembler, description, expressions, gvcp, setup
from smartcam.frames._gige.assembler import MAX_OPEN_BLOCKS, Assembler, Resend
from smartcam.frames._gige.description import locate, parse, unpack
from smartcam.frames._gige.discovery import (
    MAX_ANSWERS_OF_ONE_ADDRESS,
    AnsweringCamera,
    Network,
    _NetworkSearch,
    find_cameras,
    networks,
)
from smartcam.frames._gige.event_channel import decode_events
from smartcam.frames._gige.expressions import evaluate
from smartcam.frames._gige.gvcp import DeviceInfo
from smartcam.frames._gige.messages import MAX_CHUNKS, MessageFeatures, cut_chunks
from smartcam.frames._pixels.colours import MATRICES, yuv_to_rgb
from smartcam.frames._pixels.formats import PIXEL_FORMATS, with_matrix
from smartcam.frames._streaming.rtp import packets
from smartcam.frames._streaming.rtp.assembling import MAX_ACCESS_UNIT_BYTES, AccessUnit
from smartcam.frames._streaming.rtp.depacketizer import MAX_PACKETS_AHEAD, Depacketizer
from smartcam.frames._streaming.rtp.driver import RtpDriver
from smartcam.frames._streaming.rtp.h264 import H264Packetizer, parameter_sets, units
from smartcam.frames._streaming.rtp.h265 import H265PayloadFormat, size_in
from smartcam.frames._streaming.rtp.jpeg import JpegPayloadFormat
from smartcam.frames._streaming.rtp.packets import (
    Goodbye,
    PacketsMissing,
    PictureLost,
    ReceiverReport,
    RtpPacket,
    SenderReport,
    SourceDescription,
    compound,
    is_rtcp,
    parse_rtcp,
)
from smartcam.frames._streaming.rtp.parameters import description as parameters_description
from smartcam.frames._streaming.rtp.parameters import picture_size
from smartcam.frames._streaming.rtp.parameters import size_in as parameters_size_in
from smartcam.frames._streaming.rtp.receiver import NEW_HOST_DELAY, RtpStatistics
from smartcam.frames._streaming.rtp.reception import SECONDS_FROM_1900_TO_1970, ntp_time
from smartcam.frames._streaming.rtsp import delivery, messages
from smartcam.frames._streaming.rtsp.addresses import (
    RequestedTransport,
    RtspTarget,
    requested_transport,
    target_of,
)
from smartcam.frames._streaming.rtsp.authentication import (
    MAX_WRONG_PASSWORDS,
    Authentication,
    PasswordCheck,
    _digest_parameters,
)
from smartcam.frames._streaming.rtsp.delivery import STALL_TIMEOUT, _RtcpReceiver, open_port_pair
from smartcam.frames._streaming.rtsp.messages import (
    MAX_MESSAGE_BYTES,
    RequestParser,
    RtspError,
    RtspRequest,
)
from smartcam.frames._streaming.rtsp_client import answers
from smartcam.frames._streaming.rtsp_client.authorization import challenge_of
from smartcam.frames._streaming.rtsp_client.channels import transport_options
from smartcam.frames._streaming.rtsp_client.description import parse_description, url_of
from smartcam.frames._streaming.shared_stream import (
    KEY_FRAME_INTERVAL,
    LINGER,
    MAX_FAILURES,
    SharedH264,
)
from smartcam.frames._synthetic import stripes, write_stamp
from smartcam.frames._v4l2 import abi, discovery, system
from smartcam.frames._v4l2.abi import Ioctl
from smartcam.frames._v4l2.controls import DeviceControl
from smartcam.frames._v4l2.device import FORMATS, CaptureDevice
from smartcam.frames._v4l2.driver import V4L2Driver
from smartcam.frames._video import multipart, redirects
from smartcam.frames._video.multipart import MAX_BYTES_BETWEEN, MAX_PICTURE_BYTES, PictureCutter
