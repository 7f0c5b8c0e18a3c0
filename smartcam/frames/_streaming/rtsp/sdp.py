"""Write the description of a stream for clients (SDP, RFC 4566 and RFC 6184)."""

from __future__ import annotations

import base64

from smartcam.frames._streaming.rtsp.addresses import TRACK


def describe(
    name: str, host: str, session: int, sets: tuple[bytes, bytes], payload_type: int, rate: float
) -> bytes:
    """Return the description of one stream of H.264.

    Args:
        name: name of the stream.
        host: the server's own address.
        session: number of the description; changes with its content.
        sets: sequence and picture parameter sets.
        payload_type: payload type of the packets.
        rate: frames per second.
    """
    address_type = "IP6" if ":" in host else "IP4"
    any_address = "::" if address_type == "IP6" else "0.0.0.0"  # noqa: S104 - "any", to SDP
    encoded = ",".join(base64.b64encode(parameter_set).decode() for parameter_set in sets)
    lines = (
        "v=0",
        f"o=- {session} 1 IN {address_type} {host}",
        f"s={name}",
        f"c=IN {address_type} {any_address}",
        "t=0 0",
        "a=control:*",
        "a=range:npt=now-",
        f"m=video 0 RTP/AVP {payload_type}",
        f"a=rtpmap:{payload_type} H264/90000",
        f"a=fmtp:{payload_type} packetization-mode=1;profile-level-id={sets[0][1:4].hex().upper()};"
        f"sprop-parameter-sets={encoded}",
        f"a=framerate:{rate:g}",
        f"a=control:{TRACK}",
    )
    return "\r\n".join((*lines, "")).encode()
