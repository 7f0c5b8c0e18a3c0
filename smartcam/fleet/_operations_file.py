"""What a fleet file says of how an agent is watched."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, WithJsonSchema

from smartcam.fleet._ros_file import Fields

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


class OperationsSection(Fields):
    """How an agent is watched: health and numbers over HTTP, and what it logs."""

    listen: Place | None = Field(
        DEFAULT_PLACE,
        description="where /healthz, /readyz and /metrics are served, HOST:PORT, to whoever asks; "
        "null: nowhere; port 0 takes a free one",
    )
    latency: Literal["agent", "camera"] = Field(
        "agent",
        description="what has histograms of latency: all cameras of the agent together, each "
        "camera then has sum and count only; or each camera, which is 20 lines more for each",
    )
    log: Literal["text", "json"] = Field(
        "text", description="how smartcam serve says what happens: lines for people, or JSON"
    )
    level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="of JSON lines, what is left out below"
    )

    @property
    def place(self) -> tuple[str, int] | None:
        """Host and port to listen on."""
        if self.listen is None:
            return None
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)
