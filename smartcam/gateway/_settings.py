"""Define the settings of a gateway, and the styles of answers for makes of robots."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from smartcam.calibration._inside import ROBOTS
from smartcam.layout._inside import read_model

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Self

DEFAULT_LISTEN = "tcp/127.0.0.1:7001"

DEFAULT_TIMEOUT = 5.0
"""Largest number of seconds until a request is answered."""

MAX_SECONDS = 86_400.0
"""Largest value of each setting in seconds."""

MAX_CLIENTS = 100
"""Largest number of robots that may be connected at a time."""

_LISTEN = re.compile(r"tcp/(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)

LINE_ENDS: Mapping[str, str] = {"lf": "\n", "crlf": "\r\n", "cr": "\r", "none": ""}
"""Bytes at the end of an answer, by name."""

Also = Literal["quality", "photo_index", "feature_id"]


class Style(NamedTuple):
    """The style of answers: each option has a value here, from the make or from the settings.

    Attributes:
        form: form of an answer: ``text``, ``brackets`` or ``xml``.
        pose: convention of poses, as for ``pose_to``, such as ``kuka``.
        length: unit of lengths, ``m`` or ``mm``.
        angle: unit of angles, ``rad`` or ``deg``.
        decimals: digits after the decimal point.
        separator: text between two values.
        line_end: text after an answer.
        width: number of bytes of each answer, filled with blanks; 0: as many as the answer needs.
        max_bytes: largest number of bytes of an answer. A longer text for people is cut; too many
            numbers are an error.
    """

    form: str = "text"
    pose: str = "kuka"
    length: str = "mm"
    angle: str = "deg"
    decimals: int = 3
    separator: str = ","
    line_end: str = "\r\n"
    width: int = 0
    max_bytes: int = 250


STYLES: Mapping[str, Style] = {
    "plain": Style(),
    "ur": Style("brackets", "ur", "m", "rad", 6, line_end="\n", max_bytes=1000),
    "kuka": Style("xml", "kuka", decimals=4, line_end="", max_bytes=1000),
    "fanuc": Style(pose="fanuc", line_end="\r", max_bytes=120),
    "siemens": Style(width=96, max_bytes=96),
}
"""The style of answers that each make of controller can read; docs/robots.md names the sources."""


def _check_listen(text: str) -> str:
    match = _LISTEN.fullmatch(text)
    if match is None or int(match[2]) > 0xFFFF:
        raise ValueError(f"expected tcp/HOST:PORT such as {DEFAULT_LISTEN}, got {text!r:.80}")
    return text


def _check_separator(text: str) -> str:
    if len(text) != 1 or text.isalnum() or text in "+-.\r\n" or not " " <= text < "\x7f":
        raise ValueError(
            f"expected one character that stands in no number, such as ',' or ';', got {text!r}"
        )
    return text


Seconds = Annotated[float, Field(gt=0, le=MAX_SECONDS, allow_inf_nan=False)]


class GatewaySettings(BaseModel):
    """The settings of a gateway; an option that is None gets the default of the robot's make."""

    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True)

    listen: Annotated[str, AfterValidator(_check_listen)] = Field(
        default=DEFAULT_LISTEN,
        description="address that robots connect to, tcp/HOST:PORT; port 0 takes a free one",
    )
    robot: Literal["plain", "ur", "kuka", "fanuc", "siemens"] = Field(
        default="plain", description="make of the controller, with defaults of other options"
    )
    form: Literal["text", "brackets", "xml"] | None = Field(
        default=None,
        description="text: 0,2,400.000,...; brackets: (0,2,0.400000,...) for "
        "socket_read_ascii_float; xml: for EthernetKRL",
    )
    pose: Literal["ur", "abb", "kuka", "fanuc", "meca500"] | None = Field(
        default=None, description="convention of poses: the numbers for a part's orientation"
    )
    length: Literal["m", "mm"] | None = Field(default=None, description="unit of lengths")
    angle: Literal["rad", "deg"] | None = Field(default=None, description="unit of angles")
    decimals: Annotated[int, Field(ge=0, le=9)] | None = Field(
        default=None, description="digits after the decimal point"
    )
    separator: Annotated[str, AfterValidator(_check_separator)] | None = Field(
        default=None, description="text between two values"
    )
    line_end: Literal["lf", "crlf", "cr", "none"] | None = Field(
        default=None, description="end of each answer; a request may end with any of them"
    )
    width: Annotated[int, Field(ge=0, le=1000)] | None = Field(
        default=None, description="bytes of each answer, filled with blanks; 0: as many as it needs"
    )
    also: tuple[Also, ...] = Field(default=(), description="values that follow the pose of a part")
    tool_flip: bool = Field(
        default=False,
        description="turn each pose by half a turn about its x, so that z points into the "
        "table, as a tool's does",
    )
    timeout: Seconds = Field(
        default=DEFAULT_TIMEOUT, description="seconds until an answer, at most"
    )
    max_age: Seconds = Field(
        default=60.0, description="seconds after a result in which NEXT still returns its parts"
    )
    idle: Seconds = Field(
        default=3600.0, description="seconds after which a silent robot is hung up on"
    )
    clients: int = Field(default=8, ge=1, le=MAX_CLIENTS, description="robots at a time")

    @property
    def host_and_port(self) -> tuple[str, int]:
        """Host and port to listen on."""
        host, _, port = self.listen.removeprefix("tcp/").rpartition(":")
        return host.strip("[]"), int(port)

    @property
    def style(self) -> Style:
        """Style of the answers: that of the make, changed by the options that are set."""
        names = ("form", "pose", "length", "angle", "decimals", "separator", "width")
        options = {name: value for name in names if (value := getattr(self, name)) is not None}
        if self.pose is not None:
            units_per_metre = ROBOTS[self.pose].units_per_metre
            defaults = {"length": "m" if units_per_metre == 1.0 else "mm", "angle": "rad"}
            defaults["angle"] = "rad" if self.pose == "ur" else "deg"
            options = {**defaults, **options}
        if self.line_end is not None:
            options["line_end"] = LINE_ENDS[self.line_end]
        if self.width:
            options["max_bytes"] = self.width
        return STYLES[self.robot]._replace(**options)

    @model_validator(mode="after")
    def _check_readable(self) -> Self:
        style = self.style
        if style.form == "brackets" and "feature_id" in self.also:
            raise ValueError("also: feature_id is a text, which brackets have no room for")
        if style.form == "text" and not (style.line_end or style.width):
            raise ValueError("line_end: answers without a line end need a width")
        return self


class GatewayFile(GatewaySettings):
    """A gateway and its camera in one file."""

    url: str | None = Field(default=None, description="URL of the camera, also of one in a fleet")
    emulated: bool = Field(default=False, description="an emulated camera instead")
    application: int | None = Field(
        default=None,
        ge=0,
        le=0xFFFFFFFF,
        description="the application that is to run",
    )
    interpret_as: str | None = Field(
        default=None, description="how results are interpreted; default: localizations"
    )
    y_down: bool = Field(default=False, description="the camera's y axis points down")
    calibration: str | None = Field(
        default=None, description="calibration file, beside this one; poses are then the robot's"
    )
    name: str | None = Field(default=None, description="the camera's name, in results and poses")

    @classmethod
    def load(cls, path: str | Path) -> GatewayFile:
        """Read a file.

        Raises:
            ConfigurationError: the file cannot be read, or a field is wrong; the error gives line
                and field.
            MissingExtraError: the extra ``yaml`` is not installed.
        """
        file = read_model(path, "gateway", cls, "listen", _find_mistake)
        if file.calibration is None:
            return file
        return file.model_copy(update={"calibration": str(Path(path).parent / file.calibration)})

    def settings(self, **changes: Any) -> GatewaySettings:
        """Return the settings of the gateway alone, with changes."""
        names = GatewaySettings.model_fields
        fields = {name: getattr(self, name) for name in names if name in self.model_fields_set}
        return GatewaySettings.model_validate({**fields, **changes})


def _find_mistake(file: GatewayFile) -> tuple[Sequence[int | str], str] | None:
    if (file.url is None) == (not file.emulated):
        return ("url",), "expected a camera's URL, or emulated: true"
    return None
