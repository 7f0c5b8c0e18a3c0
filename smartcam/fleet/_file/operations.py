"""Define the section of a fleet file on health, metrics and the log."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from smartcam.fleet._file.ros import Fields

DEFAULT_ENDPOINT = "127.0.0.1:9464"

_ENDPOINT = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)


def _check_endpoint(text: str) -> str:
    match = _ENDPOINT.fullmatch(text)
    if match is None or int(match[2]) > 0xFFFF:
        raise ValueError(f"expected HOST:PORT such as {DEFAULT_ENDPOINT}, got {text!r:.80}")
    return text


Endpoint = Annotated[
    str,
    AfterValidator(_check_endpoint),
    WithJsonSchema({"type": "string", "pattern": f"^{_ENDPOINT.pattern}$"}),
]


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?$")]


class OperationsSection(Fields):
    """The operation of an agent: health and metrics over HTTP, and its log."""

    listen: Endpoint | None = Field(
        DEFAULT_ENDPOINT,
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
        description="histograms of latency: 'agent': one for all cameras, and sum and count for "
        "each camera; 'camera': one for each camera, 20 more lines of /metrics per camera",
    )
    log: Literal["text", "json"] = Field(
        "text", description="form of smartcam serve's log: lines for people, or JSON"
    )
    level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="lowest level of written JSON lines"
    )

    @property
    def endpoint(self) -> tuple[str, int] | None:
        """Host and port to listen on."""
        if self.listen is None:
            return None
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)
