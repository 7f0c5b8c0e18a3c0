"""Fleet files: which cameras an agent shares, and where; read from YAML."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._address import check_name, check_word
from smartcam.layout._yaml_files import read_model
from smartcam.settings import CameraSettings, Seconds

if TYPE_CHECKING:
    from pathlib import Path

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"
MOST_EMULATED = 10_000


def _word(text: str) -> str:
    return check_word(text, "name")


Word = Annotated[str, AfterValidator(_word)]


class _Fields(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid", frozen=True)


class Retry(_Fields):
    """When a camera that is not there, or was lost, is tried again."""

    initial: float = Field(0.1, ge=0, description="the first delay, seconds")
    factor: float = Field(2.0, ge=1, description="how much longer each delay is than the last")
    maximum: float = Field(10.0, ge=0, description="the longest delay, seconds")
    jitter: float = Field(0.3, ge=0, le=1, description="share of a delay that is left to chance")
    attempts: int | None = Field(None, ge=1, description="tries until it is given up; none: never")


class Emulated(_Fields):
    """Emulated cameras, to try a plant on a desk."""

    count: int = Field(1, ge=1, le=MOST_EMULATED, description="how many")
    scenario: str | None = Field(
        None, description="a scenario file with one camera, beside this file; default as the demo's"
    )
    seed: int = Field(1, ge=0, description="of the first one's noise; each next one has one more")


class CameraEntry(_Fields):
    """A camera, or several emulated ones."""

    url: str | None = Field(None, description="where the camera is: bvs://HOST, insight://HOST")
    emulated: Emulated | None = Field(None, description="an emulated one instead")
    model: str | None = Field(None, description="picks the protocol where url is a bare host")
    application: int | None = Field(
        None, ge=0, le=0xFFFFFFFF, description="application to have running and ready"
    )
    interpret_as: str | dict[int, str] | None = Field(
        None,
        description="what result containers hold, for programs that do not say: an interpreter, a "
        "layout, or one for each application",
    )
    y_down: bool = Field(False, description="the camera's y axis points down")
    lenient: bool = Field(False, description="any non-zero byte is a true bool")
    restore: bool = Field(
        False, description="after a reconnect have application and run state back"
    )
    connect_timeout: Seconds = Field(10.0, description="for a session, all attempts together")
    switch_timeout: Seconds = Field(10.0, description="for a switch until the camera is ready")
    request_timeout: Seconds = Field(5.0, description="for the answer to a request")
    liveness_timeout: Seconds | None = Field(
        5.0, description="until a camera that gives no sign of life counts as gone"
    )
    reconnect: Retry | Literal[False] = Field(
        Retry.model_validate({}), description="when a lost camera is tried again; false: never"
    )

    @model_validator(mode="after")
    def _one_of(self) -> CameraEntry:
        if (self.url is None) == (self.emulated is None):
            raise ValueError("expected either url or emulated")
        return self

    def settings(self, name: str, url: str) -> CameraSettings:
        """Return what the session with a camera is told.

        Raises:
            ConfigurationError: an option cannot work.
        """
        own = {"url", "emulated", "model", "reconnect"}
        options: dict[str, Any] = self.model_dump(exclude=own)
        reconnect = Backoff(**self.reconnect.model_dump()) if self.reconnect else None
        return CameraSettings.make(
            url, self.model, {**options, "name": name, "reconnect": reconnect}
        )


class History(_Fields):
    """What is kept of each camera's last results, for programs that were cut off for a while."""

    results: int = Field(20_000, ge=1, le=10_000_000, description="results")
    bytes: int = Field(1 << 24, ge=1, le=1 << 34, description="their bytes, about")


class Planned(NamedTuple):
    """A camera of a fleet file.

    Attributes:
        name: in the fleet.
        entry: what the file says.
        nth: of an emulated one, from 0.
    """

    name: str
    entry: CameraEntry
    nth: int


class FleetFile(_Fields):
    """The cameras that one agent shares."""

    fleet: Word = Field("plant", description="name of the fleet; several agents may be of one")
    agent: Word | None = Field(
        None, description="name of this agent, unique in the fleet; default: host and process"
    )
    listen: list[str] | str | None = Field(
        None,
        description="endpoints to listen on; this agent is the router, too, then. "
        "tcp/127.0.0.1:7447 where nothing is said to connect to",
    )
    connect: list[str] | str | None = Field(
        None, description="endpoints of routers or other agents, such as tls/plant-server:7447"
    )
    certificates: str | None = Field(
        None, description="folder with ca.pem, cert.pem and key.pem, for tls endpoints"
    )
    history: History = Field(
        History.model_validate({}), description="what is kept of each camera's last results"
    )
    cameras: dict[str, CameraEntry] = Field(
        description="by name, such as line1/cam3; emulated ones at a name that ends in /**",
        min_length=1,
    )

    @model_validator(mode="before")
    @classmethod
    def _as_lists(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        return {
            key: [value] if key in {"listen", "connect"} and isinstance(value, str) else value
            for key, value in data.items()
        }

    @property
    def endpoints(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Where to listen, and where to connect to."""
        listen, connect = tuple(self.listen or ()), tuple(self.connect or ())
        return (listen, connect) if listen or connect else ((DEFAULT_LISTEN,), ())

    @property
    def agent_name(self) -> str:
        """The agent's name."""
        if self.agent is not None:
            return self.agent
        host = socket.gethostname().partition(".")[0].lower()
        kept = "".join(
            one if one.isascii() and (one.isalnum() or one in "_-") else "_" for one in host
        )
        return f"{kept or 'agent'}-{os.getpid()}"

    def plan(self) -> list[Planned]:
        """Return its cameras.

        Raises:
            ValueError: a name cannot be one, or comes twice.
        """
        found: dict[str, Planned] = {}
        for name, entry in self.cameras.items():
            for planned in _planned(name, entry):
                if planned.name in found:
                    raise ValueError(f"{name}: there is a camera {planned.name} already")
                found[planned.name] = planned
        return [*found.values()]


def _planned(name: str, entry: CameraEntry) -> list[Planned]:
    if not name.endswith("/**"):
        if entry.emulated is not None and entry.emulated.count > 1:
            raise ValueError(
                f"{name}: {entry.emulated.count} cameras want a name such as {name}/**"
            )
        return [Planned(check_name(name), entry, 0)]
    if entry.emulated is None:
        raise ValueError(f"{name}: only emulated cameras have a pattern for a name")
    stem, count = name.removesuffix("/**"), entry.emulated.count
    check_name(f"{stem}/cam")
    width = len(str(count))
    return [Planned(f"{stem}/cam{n + 1:0{width}}", entry, n) for n in range(count)]


def load_fleet(path: str | Path) -> FleetFile:
    """Read a fleet file.

    Raises:
        ConfigurationError: the file cannot be read or a field of it is wrong; the text names file,
            line and field.
        MissingExtraError: PyYAML is not installed.
    """
    return read_model(path, "fleet", FleetFile, "cameras", _mistake)


def fleet_schema() -> dict[str, Any]:
    """Return the JSON Schema of fleet files."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **FleetFile.model_json_schema(),
        "title": "smartcam fleet",
    }


def _mistake(file: FleetFile) -> tuple[tuple[str, ...], str] | None:
    """Return what cannot work of a file, and where."""
    for name, entry in file.cameras.items():
        try:
            for planned in _planned(name, entry):
                entry.settings(planned.name, entry.url or "bvs://127.0.0.1")
        except (ConfigurationError, ValueError) as exc:
            return ("cameras", name), str(exc)
    try:
        file.plan()
    except ValueError as exc:
        return ("cameras",), str(exc)
    return None
