"""Define the section of a fleet file on health, metrics and the log."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from smartcam.fleet._file.ros import Fields

DEFAULT_PLACE = "127.0.0.1:9464"

_PLACE = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)


def _check_place(text: str) -> str:
    match = _PLACE.fullmatch(text)
    if match is None or int(match[2]) > 0xFFFF:
        raise ValueError(f"expected HOST:PORT such as {DEFAULT_PLACE}, got {text!r:.80}")
    return text


Place = Annotated[
    str,
    AfterValidator(_check_place),
    WithJsonSchema({"type": "string", "pattern": f"^{_PLACE.pattern}$"}),
]


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?$")]


class OperationsSection(Fields):
    """The operation of an agent: health and metrics over HTTP, and its log."""

    listen: Place | None = Field(
        DEFAULT_PLACE,
        description="HOST:PORT of /healthz, /readyz and /metrics, which every client can read; "
        "null: nowhere; port 0 takes a free one",
    )
    names: tuple[Name, ...] = Field(
        (),
        description="further names of this computer that are allowed as the Host of a request, "
        "besides addresses and its own name; used if it listens on more than its local address",
    )
    latency: Literal["agent", "camera"] = Field(
        "agent",
        description="histograms of latency: agent, one for all cameras together, and sum and count "
        "for each camera; or camera, one for each camera, with 20 lines more",
    )
    log: Literal["text", "json"] = Field(
        "text", description="form of smartcam serve's log: lines for people, or JSON"
    )
    level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="lowest level of written JSON lines"
    )

    @property
    def place(self) -> tuple[str, int] | None:
        """Host and port to listen on."""
        if self.listen is None:
            return None
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)
