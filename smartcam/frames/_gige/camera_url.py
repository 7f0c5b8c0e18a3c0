"""Find the camera that a URL names, and read the URL's options."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qsl

from smartcam.exceptions import FrameSourceError
from smartcam.frames._driver import FoundSource
from smartcam.frames._gige.discovery import find_cameras, networks
from smartcam.frames._gige.gvcp import PORT
from smartcam.frames._gige.setup import FEATURE_PREFIX, PACKET_SIZES, WantedStream

if TYPE_CHECKING:
    from smartcam.frames._address import FrameAddress
    from smartcam.frames._gige.discovery import AnsweringCamera

_PARAMETERS: Final = (
    "serial",
    "format",
    "size",
    "fps",
    "packet_size",
    "resend",
    "trigger",
    "feature.NAME",
)


def read_wanted_stream(address: FrameAddress) -> WantedStream:
    """Read a URL's parameters.

    Raises:
        ConfigurationError: a parameter is wrong; the text names the known ones.
    """
    names = [name for name, _ in parse_qsl(address.query, keep_blank_values=True)]
    features = [
        name for name in names if name.startswith(FEATURE_PREFIX) and name != FEATURE_PREFIX
    ]
    parameters = address.parameters([*_PARAMETERS, *features])
    if address.path not in ("", "/"):
        raise address.wrong("path", "gige://HOST", address.path)
    if "serial" in parameters and address.host:
        raise address.wrong("serial", "none together with an address", parameters["serial"])
    resend = parameters.get("resend", "on")
    if resend not in ("on", "off"):
        raise address.wrong("resend", "on or off", resend)
    packet_size = parameters.get("packet_size", "auto")
    packet_bytes = 0.0
    if packet_size != "auto":
        packet_bytes = address.number("packet_size", packet_size, *PACKET_SIZES)
    return WantedStream(
        parameters,
        address.size(parameters["size"]) if "size" in parameters else None,
        address.number("fps", parameters["fps"], 0.001, 100_000) if "fps" in parameters else None,
        int(packet_bytes) & ~3,
        resend == "on",
        parameters.get("trigger"),
    )


async def find_camera(address: FrameAddress, stream: WantedStream) -> tuple[str, int]:
    """Return the address and the port of a camera.

    Raises:
        FrameSourceError: the address names no host, and none or several cameras were found.
    """
    if address.host:
        return address.host, address.port or PORT
    serial = stream.parameters.get("serial")
    cameras = await find_cameras(networks())
    matching = [camera for camera in cameras if serial in (None, camera.info.serial)]
    if len(matching) != 1:
        known = tuple(f"{as_source(camera).url} {camera.info.label}" for camera in cameras)
        which = "" if serial is None else f" with the serial number {serial}"
        raise FrameSourceError(
            f"{address.shown}: expected one camera{which}, found {len(matching)}; there "
            f"are {', '.join(known) or 'none'}",
            source=address.shown,
            available=known,
        )
    return matching[0].address, PORT


def as_source(camera: AnsweringCamera) -> FoundSource:
    """Return the entry of a camera in a list of sources."""
    remark = ""
    if not camera.reachable:
        remark = (
            f"its address {camera.info.address} is outside of the network it answered from: "
            f"smartcam frames force-address {camera.info.mac} ADDRESS/PREFIX gives it another"
        )
    return FoundSource(f"gige://{camera.address}", camera.info.label, (), remark)
