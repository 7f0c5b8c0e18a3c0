"""Read a server's description of its streams (SDP, RFC 8866)."""

from __future__ import annotations

import base64
import binascii
import re
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import urlsplit

from smartcam.frames._streaming.rtp.assembling import START_CODE
from smartcam.frames._streaming.rtp.stream_codecs import H264, H265, JPEG, StreamCodec

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_LINES: Final = 1000
"""Largest number of lines of a description that are read."""

CODECS: Final = {"H264": H264, "H265": H265, "HEVC": H265, "JPEG": JPEG}
"""Supported codecs by their names."""

STATIC_CODECS: Final = {26: "JPEG", 28: "NV", 31: "H261", 32: "MPV", 33: "MP2T", 34: "H263"}
"""Codecs by static payload types (RFC 3551)."""


class VideoTrack(NamedTuple):
    """A stream of video.

    Attributes:
        payload_type: payload type of the packets.
        codec_name: name of the codec, in capital letters; "": unknown.
        control: URL of the stream in the description, perhaps relative; "": the description's URL.
        parameters: parameters of the codec (fmtp), by names in lower case.
        size: size of the pictures; None: not in the description.
        is_encrypted: whether the packets are encrypted (SRTP).
    """

    payload_type: int
    codec_name: str
    control: str = ""
    parameters: Mapping[str, str] = MappingProxyType({})
    size: tuple[int, int] | None = None
    is_encrypted: bool = False

    @property
    def codec(self) -> StreamCodec | None:
        """Codec of the stream; None: not supported."""
        return CODECS.get(self.codec_name)

    @property
    def parameter_sets(self) -> bytes:
        """Parameter sets with start codes, for the decoder; b"" if the description has none."""
        names = ("sprop-vps", "sprop-sps", "sprop-pps", "sprop-parameter-sets")
        units = [value for name in names for value in self.parameters.get(name, "").split(",")]
        return b"".join(START_CODE + unit for text in units if (unit := _decode_base64(text)))


class StreamDescription(NamedTuple):
    """A server's description of its streams.

    Attributes:
        control: URL of all streams together, perhaps relative; "": not given.
        tracks: tracks of video.
        others: media types of the other streams, such as audio.
    """

    control: str
    tracks: tuple[VideoTrack, ...]
    others: tuple[str, ...]

    def first_supported_track(self) -> VideoTrack | None:
        """Return the first supported stream of video; None: there is none."""
        tracks = self.tracks
        return next((track for track in tracks if track.codec and not track.is_encrypted), None)


def parse_description(body: bytes) -> StreamDescription:
    """Parse a description; unreadable lines are skipped."""
    lines = body.decode("utf-8", "replace").replace("\r", "\n").split("\n")[:MAX_LINES]
    sections: list[list[str]] = [[]]
    for line in map(str.strip, lines):
        if line[:2].lower() == "m=":
            sections.append([])
        sections[-1].append(line)
    session, *media = sections
    media_lines = [section[0][2:].split() for section in media]
    tracks = [
        _track(media_line, section)
        for media_line, section in zip(media_lines, media, strict=True)
        if media_line[:1] == ["video"]
    ]
    others = tuple(line[0] for line in media_lines if line and line[0] != "video")
    return StreamDescription(_attribute(session, "control"), tuple(tracks), others)


def _track(media_line: list[str], lines: list[str]) -> VideoTrack:
    types = [int(text) for text in media_line[3:] if re.fullmatch(r"[0-9]{1,3}", text)] or [-1]
    codec_names = {payload_type: _codec_name(payload_type, lines) for payload_type in types}
    supported = (payload_type for payload_type in types if codec_names[payload_type] in CODECS)
    payload_type = next(supported, types[0])
    is_encrypted = len(media_line) > 2 and media_line[2].upper().startswith("RTP/SAVP")
    parameters = _parameters(_typed_attribute(lines, "fmtp", payload_type))
    codec_name = codec_names[payload_type]
    if not codec_name and "sprop-parameter-sets" in parameters:
        codec_name = "H264"
    control, size = _attribute(lines, "control"), _size(lines)
    return VideoTrack(payload_type, codec_name, control, parameters, size, is_encrypted)


def _codec_name(payload_type: int, lines: list[str]) -> str:
    text = _typed_attribute(lines, "rtpmap", payload_type)
    name = text.partition(";")[0].partition("/")[0].strip().upper()
    return name or STATIC_CODECS.get(payload_type, "")


def _attribute(lines: list[str], name: str) -> str:
    prefix = f"a={name}:"
    line = next((line for line in lines if line.lower().startswith(prefix)), prefix)
    return line[len(prefix) :].strip()


def _typed_attribute(lines: list[str], name: str, payload_type: int) -> str:
    """Return all values of an attribute for a payload type, joined by semicolons."""
    matches = (re.fullmatch(rf"(?i)a={name}:\s*([0-9]{{1,3}})\s+(.*)", line) for line in lines)
    found = (match for match in matches if match is not None and int(match[1]) == payload_type)
    return ";".join(match[2] for match in found)


def _parameters(text: str) -> dict[str, str]:
    parts = (parameter.partition("=") for parameter in text.split(";"))
    return {key.strip().lower(): value.strip(' \t"') for key, equals, value in parts if equals}


def _size(lines: list[str]) -> tuple[int, int] | None:
    """Return the size of the pictures, which some senders of large JPEGs describe."""
    for name, separator in (("x-dimensions", ","), ("framesize", "-")):
        match = re.search(
            rf"([0-9]{{1,5}})\s*{separator}\s*([0-9]{{1,5}})", _attribute(lines, name)
        )
        if match is not None and int(match[1]) and int(match[2]):
            return int(match[1]), int(match[2])
    return None


def _decode_base64(text: str) -> bytes:
    text = "".join(text.split())
    try:
        return base64.b64decode(text + "=" * (-len(text) % 4), validate=True)
    except (binascii.Error, ValueError):
        return b""


def url_of(control: str, base: str) -> str:
    """Return the absolute URL of a stream.

    Args:
        control: URL of the stream in the description, perhaps relative.
        base: URL of all streams together.

    The URL is only used in requests to the same server.
    """
    if not control or control == "*":
        return base
    try:
        is_absolute = urlsplit(control).scheme.lower() in ("rtsp", "rtsps")
    except ValueError:
        is_absolute = False
    if is_absolute:
        return control
    return f"{base}{control}" if base.endswith("/") else f"{base}/{control.removeprefix('/')}"
