"""Fleet files: which cameras an agent shares, and where; read from YAML."""

from __future__ import annotations

import os
import re
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, cast

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    WithJsonSchema,
    model_validator,
)

from smartcam._client.interpretation import Interpretation
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.fleet._access_file import Access, access_mistakes
from smartcam.fleet._address import (
    CHUNK,
    MOST_CHUNKS,
    MOST_NAME,
    check_name,
    check_word,
    missing_certificates,
)
from smartcam.fleet._operations_file import OperationsSection  # noqa: TC001 - pydantic does
from smartcam.fleet._recording_file import RecordSection, mistakes_of
from smartcam.fleet._ros_file import Fields, RosCamera, RosSection, node_names
from smartcam.fleet._standby_file import Standby, standby_of
from smartcam.layout._yaml_files import read_model
from smartcam.settings import CameraSettings, Seconds, masked, parse_address

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from smartcam.calibration._lens.model import CameraModel
    from smartcam.frames import FrameSource

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"

MOST_CAMERAS = 10_000
"""Cameras of one agent; each emulated one has a port of its own."""

_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)
_PATTERN = "/**"


def _word(text: str) -> str:
    return check_word(text, "name")


Word = Annotated[
    str,
    AfterValidator(_word),
    WithJsonSchema({"type": "string", "pattern": f"^{CHUNK}$", "maxLength": MOST_NAME}),
]


def _endpoints(least_port: int) -> Any:
    """Return what makes a list of one endpoint, or of several; ``least_port``: of their ports."""

    def checked(given: object) -> list[str] | None:
        if given is None:
            return None
        found: list[str] = []
        for one in cast("list[object]", given) if isinstance(given, list) else [given]:
            parts = _ENDPOINT.fullmatch(one) if isinstance(one, str) else None
            if parts is None or not least_port <= int(parts[3]) <= 0xFFFF:
                raise ValueError(
                    f"expected tcp/HOST:PORT or tls/HOST:PORT, or a list of them; got {one!r:.80}"
                )
            found.append(parts[0])
        return found

    return PlainValidator(checked)


_ENDPOINT_SCHEMA = {"type": "string", "pattern": f"^{_ENDPOINT.pattern}$"}
_ENDPOINTS_SCHEMA = WithJsonSchema(
    {
        "anyOf": [
            _ENDPOINT_SCHEMA,
            {"type": "array", "items": _ENDPOINT_SCHEMA},
            {"type": "null"},
        ]
    }
)


class Retry(Fields):
    """When a camera that is not there, or was lost, is tried again."""

    initial: float = Field(0.1, ge=0, description="the first delay, seconds")
    factor: float = Field(2.0, ge=1, description="how much longer each delay is than the last")
    maximum: float = Field(10.0, ge=0, description="the longest delay, seconds")
    jitter: float = Field(0.3, ge=0, le=1, description="share of a delay that is left to chance")
    attempts: int | None = Field(None, ge=1, description="tries until it is given up; none: never")

    def backoff(self) -> Backoff:
        """Return the same for a client.

        Raises:
            ConfigurationError: the values do not go together.
        """
        return Backoff(**self.model_dump())


def _never(given: object) -> object:
    return None if given is False else given


def _or_false(schema: dict[str, Any]) -> None:
    schema["anyOf"].append({"const": False})


def _or_bool(schema: dict[str, Any]) -> None:
    schema["anyOf"].append({"type": "boolean"})


class Emulated(Fields):
    """Emulated cameras, to try a plant on a desk."""

    count: int = Field(1, ge=1, le=MOST_CAMERAS, description="how many")
    scenario: str | None = Field(
        None, description="a scenario file with one camera, beside this file; default as the demo's"
    )
    seed: int = Field(1, ge=0, description="of the first one's noise; each next one has one more")


class FramesEntry(Fields):
    """Where a camera's frames come from."""

    url: str = Field(description="v4l2:///dev/video0, rtsp://HOST/..., or a file beside this one")
    linger: float = Field(
        2.0, ge=0, le=3600, description="seconds that it goes on streaming after the last who looks"
    )
    stall: Seconds | None = Field(
        5.0,
        description="seconds without a frame after which it counts as stuck; null: it waits for "
        "triggers",
    )
    camera_info: str | None = Field(
        None,
        description="file with the lens, beside this one: a calibration of smartcam's, or ROS' "
        "camera_info",
    )

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        """Show all of it but a password, which is not for logs."""
        for name, value in super().__repr_args__():
            yield name, masked(value) if name == "url" else value

    def source(self, folder: Path) -> FrameSource:
        """Return the source; it is not open.

        Args:
            folder: that the file is in.

        Raises:
            SmartCamError: the URL, or the lens, cannot work.
            OSError: the lens cannot be read.
        """
        from smartcam import frames

        url = self.url if "://" in self.url else str(folder / self.url)
        return frames.open(url, camera_info=self.lens(folder), stall=self.stall, linger=self.linger)

    def lens(self, folder: Path) -> CameraModel | None:
        """Return the lens, None where none is said.

        Raises:
            CalibrationError: the file is no lens.
            OSError: it cannot be read.
        """
        if self.camera_info is None:
            return None
        from smartcam.calibration import IntrinsicCalibration
        from smartcam.calibration.formats import read_cameras

        path = folder / self.camera_info
        with path.open("rb") as file:
            ours = file.read(64).lstrip()[:1] == b"{"
        if ours:
            return IntrinsicCalibration.load(path).camera
        return read_cameras(path, "camera_info").cameras[0]


def _frames(given: object) -> object:
    """Take a URL alone for a mapping with nothing else in it."""
    return {"url": given} if isinstance(given, str) else given


def _or_url(schema: dict[str, Any]) -> None:
    schema["anyOf"].append({"type": "string"})


class CameraEntry(Fields):
    """A camera, or several emulated ones."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        json_schema_extra={"oneOf": [{"required": ["url"]}, {"required": ["emulated"]}]}
    )

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
    frames: Annotated[FramesEntry | None, BeforeValidator(_frames)] = Field(
        None,
        description="where its pictures come from: a URL, or a mapping with more",
        json_schema_extra=_or_url,
    )
    ros2: RosCamera = Field(
        RosCamera.model_validate({}), description="how it is seen in ROS 2, if the fleet is"
    )
    reconnect: Annotated[Retry | None, BeforeValidator(_never)] = Field(
        Retry.model_validate({}),
        description="when a lost camera is tried again; false: never",
        json_schema_extra=_or_false,
    )

    @model_validator(mode="after")
    def _one_of(self) -> CameraEntry:
        if (self.url is None) == (self.emulated is None):
            got = "neither" if self.url is None else "both"
            raise ValueError(f"expected either url or emulated, got {got}")
        return self

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        """Show all of it but a password, which is not for logs."""
        for name, value in super().__repr_args__():
            yield name, masked(value) if name == "url" and isinstance(value, str) else value

    def settings(self, name: str, url: str) -> CameraSettings:
        """Return what the session with a camera is told.

        Raises:
            ConfigurationError: an option cannot work.
        """
        own = {"url", "emulated", "model", "reconnect", "frames", "ros2"}
        options: dict[str, Any] = self.model_dump(exclude=own)
        reconnect = None if self.reconnect is None else self.reconnect.backoff()
        return CameraSettings.make(
            url, self.model, {**options, "name": name, "reconnect": reconnect}
        )


class History(Fields):
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


def _named(given: object) -> object:
    """Refuse what YAML has not read as a text: it takes 12 and yes for something else."""
    if isinstance(given, dict):
        for name in cast("dict[object, object]", given):
            if not isinstance(name, str):
                raise ValueError(f"the name {name!r:.40} is no text: put it in quotes")  # noqa: TRY004 - as pydantic wants
    return given


def _names(schema: dict[str, Any]) -> None:
    tail = rf"(/{CHUNK}){{0,{MOST_CHUNKS - 1}}}(/\*\*)?"
    schema["propertyNames"] = {"pattern": f"^{CHUNK}{tail}$", "maxLength": MOST_NAME}


class FleetFile(Fields):
    """The cameras that one agent shares."""

    fleet: Word = Field("plant", description="name of the fleet; several agents may be of one")
    agent: Word | None = Field(
        None, description="name of this agent, unique in the fleet; default: host and process"
    )
    listen: Annotated[list[str] | str | None, _endpoints(0), _ENDPOINTS_SCHEMA] = Field(
        None,
        description="endpoints to listen on; this agent is the router, too, then. "
        "tcp/127.0.0.1:7447 where nothing is said to connect to; port 0 takes a free one",
    )
    connect: Annotated[list[str] | str | None, _endpoints(1), _ENDPOINTS_SCHEMA] = Field(
        None, description="endpoints of routers or other agents, such as tls/plant-server:7447"
    )
    certificates: str | None = Field(
        None,
        description="folder with ca.pem, cert.pem and key.pem, beside this file; for tls endpoints",
    )
    access: Access | None = Field(
        None,
        description="who may use what listens: roles (of certificates), any-certificate, or "
        "anyone-may-command, which takes everybody who reaches it; default: roles with tls, else "
        "whoever is on this computer",
    )
    history: History = Field(
        History.model_validate({}), description="what is kept of each camera's last results"
    )
    ros2: RosSection | None = Field(
        None, description="have the cameras seen in ROS 2; {} is enough"
    )
    operations: OperationsSection | None = Field(
        None, description="how smartcam serve is watched: health, numbers, log; {} is enough"
    )
    record: RecordSection | None = Field(
        None, description="record the cameras beside the agent; {} is enough"
    )
    standby: Annotated[Standby | None, BeforeValidator(standby_of)] = Field(
        None,
        description="stand by for cameras that another agent has, and take over when it is gone: "
        "true, or a mapping with more",
        json_schema_extra=_or_bool,
    )
    cameras: Annotated[dict[str, CameraEntry], BeforeValidator(_named)] = Field(
        description="by name, such as line1/cam3; emulated ones at a name that ends in /**",
        min_length=1,
        json_schema_extra=_names,
    )

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
            ValueError: a name cannot be one, or comes twice; or there are too many.
        """
        found: dict[str, Planned] = {}
        for name, entry in self.cameras.items():
            _add(found, name, entry)
        return [*found.values()]


def _add(found: dict[str, Planned], name: str, entry: CameraEntry) -> None:
    """Add the cameras of an entry to those that are there."""
    for planned in _planned(name, entry):
        if planned.name in found:
            raise ValueError(f"there is a camera {planned.name} already")
        found[planned.name] = planned
    if len(found) > MOST_CAMERAS:
        raise ValueError(f"{len(found)} cameras up to here, expected {MOST_CAMERAS} at most")


def _planned(name: str, entry: CameraEntry) -> Iterator[Planned]:
    many = name.endswith(_PATTERN)
    if not many and "*" in name:
        raise ValueError(f"{name!r:.120} means several: expected a name that ends in {_PATTERN}")
    count = 1 if entry.emulated is None else entry.emulated.count
    if not many:
        check_name(name)
        if count > 1:
            raise ValueError(f"{count} cameras want a name such as {name}{_PATTERN}")
        yield Planned(name, entry, 0)
        return
    if entry.emulated is None:
        raise ValueError("only emulated cameras have a pattern for a name")
    stem, width = name.removesuffix(_PATTERN), len(str(count))
    for n in range(count):
        yield Planned(check_name(f"{stem}/cam{n + 1:0{width}}"), entry, n)


# ---------------------------------------------------------------------- reading one


def load_fleet(path: str | Path) -> FleetFile:
    """Read a fleet file.

    Raises:
        ConfigurationError: the file cannot be read or a field of it is wrong; the text names file,
            line and field.
        MissingExtraError: PyYAML is not installed.
    """
    folder = Path(path).parent
    file = read_model(
        path, "fleet", FleetFile, "cameras", lambda found: next(_mistakes(found, folder), None)
    )
    if file.certificates is None:
        return file
    return file.model_copy(update={"certificates": str(folder / file.certificates)})


def fleet_schema() -> dict[str, Any]:
    """Return the JSON Schema of fleet files."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **FleetFile.model_json_schema(),
        "title": "smartcam fleet",
    }


Mistake = tuple["Sequence[int | str]", str]


def _mistakes(file: FleetFile, folder: Path) -> Iterator[Mistake]:
    """Give what cannot work of a file, and where."""
    yield from access_mistakes(file.access, file.endpoints[0])
    yield from _of_certificates(file, folder)
    if file.record is not None:
        yield from mistakes_of(file.record, folder)
    found: dict[str, Planned] = {}
    taken: dict[tuple[str, int], str] = {}
    for name, entry in file.cameras.items():
        place = ("cameras", name)
        try:
            _add(found, name, entry)
        except ValueError as exc:
            yield place, str(exc)
        for where, text in _of_entry(name, entry, taken, folder):
            yield (*place, *where), text
    if file.ros2 is not None:
        yield from _of_ros(found)


def _of_ros(found: dict[str, Planned]) -> Iterator[Mistake]:
    try:
        node_names([*found])
    except ValueError as exc:
        yield ("cameras",), str(exc)


def _of_certificates(file: FleetFile, folder: Path) -> Iterator[Mistake]:
    listen, connect = file.endpoints
    tls = [one for one in (*listen, *connect) if one.startswith("tls/")]
    if file.certificates is None:
        if tls:
            yield ("listen" if tls[0] in listen else "connect",), f"{tls[0]} wants certificates"
        return
    if missing := missing_certificates(folder / file.certificates):
        yield ("certificates",), missing


def _of_entry(
    name: str, entry: CameraEntry, taken: dict[tuple[str, int], str], folder: Path
) -> Iterator[Mistake]:
    """Give what cannot work of a camera; ``taken``: whose each address is."""
    if entry.url is not None:
        try:
            address = parse_address(entry.url, model=entry.model)
        except SmartCamError as exc:
            yield ("url",), str(exc)
            return
        other = taken.setdefault((address.host, address.port), name)
        if other != name:
            yield ("url",), f"this is the camera {other}, and a camera takes one client"
    elif entry.model is not None:
        yield ("model",), "is for a url"
    elif entry.emulated is not None and entry.emulated.scenario is not None:
        yield from _of_scenario(folder / entry.emulated.scenario)
    if entry.frames is not None:
        yield from _of_frames(entry.frames, folder)
    try:
        entry.ros2.load_calibration(folder)
    except (SmartCamError, OSError) as exc:
        yield ("ros2", "calibration"), str(exc)
    if entry.reconnect is not None:
        try:
            entry.reconnect.backoff()
        except ConfigurationError as exc:
            yield ("reconnect",), str(exc)
            return
    specs = entry.interpret_as
    each = specs.items() if isinstance(specs, dict) else [(None, specs)]
    for application, spec in each:
        if spec is not None:
            try:
                Interpretation(spec, lenient=entry.lenient, y_down=entry.y_down)
            except SmartCamError as exc:
                numbered = () if application is None else (application,)
                yield ("interpret_as", *numbered), str(exc)


def _of_frames(entry: FramesEntry, folder: Path) -> Iterator[Mistake]:
    try:
        entry.lens(folder)
    except (SmartCamError, OSError) as exc:
        yield ("frames", "camera_info"), str(exc)
        return
    try:
        entry.source(folder)
    except SmartCamError as exc:
        yield ("frames", "url"), str(exc)


def _of_scenario(path: Path) -> Iterator[Mistake]:
    from smartcam.emulator import load_scenario

    try:
        load_scenario(path)
    except ConfigurationError as exc:
        yield ("emulated", "scenario"), str(exc)
