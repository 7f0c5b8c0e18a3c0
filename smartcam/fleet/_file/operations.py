"""Read the section of a fleet file on health, metrics and the log."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from smartcam.fleet._file.ros import Fields

DEFAULT_PLACE = "127.0.0.1:9464"

_PLACE = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)


def _place(text: str) -> str:
    found = _PLACE.fullmatch(text)
    if found is None or int(found[2]) > 0xFFFF:
        raise ValueError(f"expected HOST:PORT such as {DEFAULT_PLACE}, got {text!r:.80}")
    return text


Place = Annotated[
    str,
    AfterValidator(_place),
    WithJsonSchema({"type": "string", "pattern": f"^{_PLACE.pattern}$"}),
]


Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?$")]


class OperationsSection(Fields):
    """The operation of an agent: health and metrics over HTTP, and its log."""

    listen: Place | None = Field(
        DEFAULT_PLACE,
        description="HOST:PORT at which /healthz, /readyz and /metrics are served, to all who ask; "
        "null: nowhere; port 0 takes a free one",
    )
    names: tuple[Name, ...] = Field(
        (),
        description="names by which others ask, where it listens on more than this computer's own "
        "address: they are what a request may say in its Host, beside addresses and the computer's "
        "own name; a web page that has its name point here says another one",
    )
    latency: Literal["agent", "camera"] = Field(
        "agent",
        description="owner of the histograms of latency: all cameras of the agent together, each "
        "camera then has sum and count only; or each camera, which is 20 lines more for each",
    )
    log: Literal["text", "json"] = Field(
        "text", description="form of smartcam serve's log: lines for people, or JSON"
    )
    level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="lowest level of JSON lines that are written"
    )

    @property
    def place(self) -> tuple[str, int] | None:
        """Host and port to listen on."""
        if self.listen is None:
            return None
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)
