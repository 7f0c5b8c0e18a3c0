"""Read fleet files in YAML: the cameras that an agent shares, and the agent's settings."""

from __future__ import annotations

import os
import re
import socket
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, cast

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from smartcam._arguments import check_path
from smartcam._client._inside import Interpretation
from smartcam._extras import from_part
from smartcam._settings_model import Seconds  # noqa: TC001 - pydantic does
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.fleet._bus.address import (
    CHUNK,
    MAX_CHUNKS,
    MAX_NAME_CHARACTERS,
    check_name,
    check_word,
    missing_certificates,
)
from smartcam.fleet._file.bus_access import Access, access_mistakes
from smartcam.fleet._file.operations import OperationsSection  # noqa: TC001 - pydantic does
from smartcam.fleet._file.recording import RecordSection, record_mistakes
from smartcam.fleet._file.ros import Fields, RosCamera, RosSection, node_names
from smartcam.fleet._file.standby import Standby, expand_standby
from smartcam.layout._inside import file_schema, read_model
from smartcam.settings import (
    CameraSettings,
    is_fleet,
    masked,
    parse_address,
    validated,
    with_ids,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from smartcam.frames import FrameSource
    from smartcam.geometry import CameraModel
    from smartcam.inspection._inside import CellCamera

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"

MAX_CAMERAS_PER_AGENT = 10_000
"""Largest number of cameras of one agent; each emulated camera has an own port."""

_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9A-Fa-f:.]+\]|[\w.-]+):(\d{1,5})", re.ASCII)
_PATTERN = "/**"


def _check_word_text(text: str) -> str:
    return check_word(text, "name")


Word = Annotated[
    str,
    AfterValidator(_check_word_text),
    WithJsonSchema({"type": "string", "pattern": f"^{CHUNK}$", "maxLength": MAX_NAME_CHARACTERS}),
]


def _endpoint_validator(least_port: int) -> Any:
    """Return the validator of one endpoint or a list of them, with ports from ``least_port`` on."""

    def check_endpoints(value: object) -> list[str] | None:
        if value is None:
            return None
        endpoints: list[str] = []
        for endpoint in cast("list[object]", value) if isinstance(value, list) else [value]:
            parts = _ENDPOINT.fullmatch(endpoint) if isinstance(endpoint, str) else None
            if parts is None or not least_port <= int(parts[3]) <= 0xFFFF:
                raise ValueError(
                    "expected tcp/HOST:PORT or tls/HOST:PORT, or a list of them; "
                    f"got {endpoint!r:.80}"
                )
            endpoints.append(parts[0])
        return endpoints

    return PlainValidator(check_endpoints)


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
    """The delays before each further attempt to connect to a camera."""

    initial: float = Field(0.1, ge=0, description="the first delay, seconds")
    factor: float = Field(2.0, ge=1, description="each delay is this times the last")
    maximum: float = Field(10.0, ge=0, description="the longest delay, seconds")
    jitter: float = Field(0.3, ge=0, le=1, description="random share of a delay")
    attempts: int | None = Field(None, ge=1, description="largest number of attempts; null: no end")

    def backoff(self) -> Backoff:
        """Return the delays for a client.

        Raises:
            ConfigurationError: the values do not fit together.
        """
        return Backoff(**self.model_dump())


def _none_for_false(value: object) -> object:
    return None if value is False else value


def _allow_false(schema: dict[str, Any]) -> None:
    schema["anyOf"].append({"const": False})


def _allow_bool(schema: dict[str, Any]) -> None:
    schema["anyOf"].append({"type": "boolean"})


class Emulated(Fields):
    """Emulated cameras, to try a plant without hardware."""

    count: int = Field(1, ge=1, le=MAX_CAMERAS_PER_AGENT, description="number of cameras")
    scenario: str | None = Field(
        None, description="a scenario file with one camera, beside this file; default: the demo's"
    )
    seed: int = Field(
        1, ge=0, description="seed of the first camera's noise; each next camera has one more"
    )


class FramesEntry(Fields):
    """The source of a camera's frames."""

    url: str = Field(description="v4l2:///dev/video0, rtsp://HOST/..., or a file beside this one")
    linger: float = Field(
        2.0, ge=0, le=3600, description="seconds of streaming after the last viewer"
    )
    stall: Seconds | None = Field(
        5.0,
        description="seconds without a frame after which the device is lost; null: it waits for "
        "triggers",
    )
    camera_info: str | None = Field(
        None,
        description="file with the lens, beside this one: a calibration of smartcam, or ROS' "
        "camera_info",
    )

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        """Yield all fields; in URLs the password is masked, since logs may show the fields."""
        for name, value in super().__repr_args__():
            yield name, masked(value) if name == "url" else value

    def make_source(self, folder: Path) -> FrameSource:
        """Return a source of the frames, which is not open.

        Args:
            folder: folder of the fleet file.

        Raises:
            SmartCamError: the URL, or the lens, is not valid.
            OSError: the lens cannot be read.
        """
        from smartcam import frames

        url = self.url if "://" in self.url else str(folder / self.url)
        return frames.open(
            url, camera_info=self.load_lens(folder), stall=self.stall, linger=self.linger
        )

    def load_lens(self, folder: Path) -> CameraModel | None:
        """Read the lens of ``camera_info``, and return it; None without ``camera_info``.

        Raises:
            CalibrationError: the file has no lens.
            OSError: the file cannot be read.
        """
        if self.camera_info is None:
            return None
        from smartcam.calibration import IntrinsicCalibration
        from smartcam.calibration.formats import read_cameras

        path = folder / self.camera_info
        if _is_calibration_file(path):
            return IntrinsicCalibration.load(path).camera
        return read_cameras(path, "camera_info").cameras[0]

    def camera_info_url(self, folder: Path) -> str:
        """Return the URL of ``camera_info`` if it is a file of ROS; otherwise an empty text."""
        if self.camera_info is None:
            return ""
        path = (folder / self.camera_info).absolute()
        return "" if path.exists() and _is_calibration_file(path) else path.as_uri()


def _is_calibration_file(path: Path) -> bool:
    """Return True if a file is a calibration of smartcam.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return file.read(64).lstrip()[:1] == b"{"


def _expand_url(value: object) -> object:
    """Convert a URL alone to a mapping."""
    return {"url": value} if isinstance(value, str) else value


def _allow_url(schema: dict[str, Any]) -> None:
    schema["anyOf"].append({"type": "string"})


_SOURCES = ("url", "emulated", "software")
"""Keys for the source of a camera; an entry has exactly one of them."""


class CameraEntry(Fields):
    """A camera, or several emulated ones."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        json_schema_extra={"oneOf": [{"required": [name]} for name in _SOURCES]}
    )

    url: str | None = Field(None, description="address of the camera: bvs://HOST, insight://HOST")
    emulated: Emulated | None = Field(None, description="an emulated camera instead")
    software: dict[str, Any] | None = Field(
        None,
        description="a plain camera whose pictures are inspected here instead: frames, calibration "
        "and applications, as in a cell file",
    )
    model: str | None = Field(None, description="model, for the protocol if url is a bare host")
    application: Annotated[int, Field(ge=0, le=0xFFFFFFFF)] | str | None = Field(
        None, description="application to load and run: its id, or its name"
    )
    application_names: dict[str, Annotated[int, Field(ge=0, le=0xFFFFFFFF)]] = Field(
        {}, description="names of applications and their ids; a name may replace any id"
    )
    interpret_as: str | dict[int | str, str] | None = Field(
        None,
        description="contents of results, for programs that give none: an interpreter, a "
        "layout, or one for each application",
    )
    y_down: bool = Field(False, description="the camera's y axis points down")
    lenient: bool = Field(False, description="any byte but 0 counts as true in a bool")
    restore: bool | None = Field(
        None,
        description="restore application and run state after a reconnect; default: true if "
        "the camera's ROS node becomes active by itself",
    )
    connect_timeout: Seconds = Field(10.0, description="longest wait for a session, all attempts")
    switch_timeout: Seconds = Field(10.0, description="longest wait for a switch")
    request_timeout: Seconds = Field(5.0, description="longest wait for the answer to a request")
    liveness_timeout: Seconds | None = Field(
        5.0,
        description="longest wait for the answer to a check of the connection; null: no end",
    )
    frames: Annotated[FramesEntry | None, BeforeValidator(_expand_url)] = Field(
        None,
        description="source of the camera's pictures: a URL, or a mapping with more",
        json_schema_extra=_allow_url,
    )
    ros2: RosCamera = Field(
        RosCamera.model_validate({}), description="its node in ROS 2, if the fleet has nodes"
    )
    reconnect: Annotated[Retry | None, BeforeValidator(_none_for_false)] = Field(
        Retry.model_validate({}),
        description="delays before a lost camera is connected again; false: never",
        json_schema_extra=_allow_false,
    )

    @model_validator(mode="after")
    def _check_source(self) -> CameraEntry:
        given = [name for name in _SOURCES if getattr(self, name) is not None]
        if len(given) != 1:
            given_names = " and ".join(given) or "none of them"
            raise ValueError(f"expected one of {', '.join(_SOURCES)}; got {given_names}")
        return self

    def __repr_args__(self) -> Iterable[tuple[str | None, Any]]:
        """Yield all fields; in URLs the password is masked, since logs may show the fields."""
        for name, value in super().__repr_args__():
            yield name, masked(value) if name == "url" and isinstance(value, str) else value

    def settings(self, name: str, url: str, *, restore: bool = False) -> CameraSettings:
        """Return the settings of the session with a camera.

        Args:
            name: name of the camera in the fleet.
            url: address of the camera.
            restore: value of ``restore`` if the entry has none.

        Raises:
            ConfigurationError: an option is wrong.
        """
        not_options = {*_SOURCES, "model", "reconnect", "frames", "ros2"}
        options: dict[str, Any] = self.model_dump(exclude=not_options)
        reconnect = None if self.reconnect is None else self.reconnect.backoff()
        options["restore"] = restore if self.restore is None else self.restore
        return CameraSettings.make(
            url, self.model, {**options, "name": name, "reconnect": reconnect}
        )


class History(Fields):
    """The results of each camera that are kept for programs that were cut off for a while."""

    results: int = Field(20_000, ge=1, le=10_000_000, description="largest number of results")
    bytes: int = Field(1 << 24, ge=1, le=1 << 34, description="approximate bytes of results")


class PlannedCamera(NamedTuple):
    """A camera of a fleet file, which may be one of several cameras of an entry.

    Attributes:
        name: name of the camera in the fleet.
        entry: entry of the camera in the file.
        index_in_entry: index of the camera among the emulated cameras of its entry, from 0.
    """

    name: str
    entry: CameraEntry
    index_in_entry: int


def _refuse_nontext_keys(value: object) -> object:
    """Refuse names that YAML does not read as texts, such as 12 and yes."""
    if isinstance(value, dict):
        for name in cast("dict[object, object]", value):
            if not isinstance(name, str):
                raise ValueError(f"the name {name!r:.40} is no text: put it in quotes")  # noqa: TRY004 - as pydantic wants
    return value


def _limit_names(schema: dict[str, Any]) -> None:
    tail = rf"(/{CHUNK}){{0,{MAX_CHUNKS - 1}}}(/\*\*)?"
    schema["propertyNames"] = {"pattern": f"^{CHUNK}{tail}$", "maxLength": MAX_NAME_CHARACTERS}


class FleetFile(Fields):
    """The cameras that one agent shares."""

    fleet: Word = Field("plant", description="name of the fleet, which may have several agents")
    agent: Word | None = Field(
        None, description="name of this agent, unique in the fleet; default: host and process"
    )
    listen: Annotated[list[str] | str | None, _endpoint_validator(0), _ENDPOINTS_SCHEMA] = Field(
        None,
        description="endpoints to listen on, which makes this agent a router; default without "
        "connect: tcp/127.0.0.1:7447; port 0 takes a free one",
    )
    connect: Annotated[list[str] | str | None, _endpoint_validator(1), _ENDPOINTS_SCHEMA] = Field(
        None, description="endpoints of routers or other agents, such as tls/plant-server:7447"
    )
    certificates: str | None = Field(
        None,
        description="folder with ca.pem, cert.pem and key.pem, beside this file; for tls endpoints",
    )
    access: Access | None = Field(
        None,
        description="access to the endpoints: roles (of certificates), any-certificate, or "
        "anyone-may-command for every program that reaches the port; default: roles with tls, "
        "otherwise programs on this computer",
    )
    history: History = Field(
        History.model_validate({}), description="how many results are kept of each camera"
    )
    ros2: RosSection | None = Field(
        None, description="a node in ROS 2 for each camera; {} is enough"
    )
    operations: OperationsSection | None = Field(
        None, description="health, metrics and log of smartcam serve; {} is enough"
    )
    record: RecordSection | None = Field(
        None, description="record the cameras at the agent; {} is enough"
    )
    outlets: dict[str, dict[str, Any]] | None = Field(
        None,
        description="outlets for results, by their names: mqtt, opcua, sqlite or a plug-in",
    )
    calibrations: str | None = Field(
        None,
        min_length=1,
        description="folder, beside this file, of the calibration services, made if missing; "
        "without this key they refuse requests",
    )
    standby: Annotated[Standby | None, BeforeValidator(expand_standby)] = Field(
        None,
        description="stand by for cameras of another agent, and take over when it is lost: "
        "true, or a mapping with more",
        json_schema_extra=_allow_bool,
    )
    cameras: Annotated[dict[str, CameraEntry], BeforeValidator(_refuse_nontext_keys)] = Field(
        description="cameras by name, such as line1/cam3; emulated ones by a name that ends in "
        "/**; {}: none, the agent is a router for others",
        json_schema_extra=_limit_names,
    )

    @property
    def endpoints(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Endpoints to listen on, and those to connect to."""
        listen, connect = tuple(self.listen or ()), tuple(self.connect or ())
        return (listen, connect) if listen or connect else ((DEFAULT_LISTEN,), ())

    @property
    def agent_name(self) -> str:
        """The agent's name."""
        if self.agent is not None:
            return self.agent
        host = socket.gethostname().partition(".")[0].lower()
        name = "".join(
            character if character.isascii() and (character.isalnum() or character in "_-") else "_"
            for character in host
        )
        return f"{name or 'agent'}-{os.getpid()}"

    def plan(self) -> list[PlannedCamera]:
        """Return the cameras of the file, with one item for each emulated camera.

        Raises:
            ValueError: a name is not valid, or comes twice; or there are too many.
        """
        planned: dict[str, PlannedCamera] = {}
        for name, entry in self.cameras.items():
            _add_planned(planned, name, entry)
        return [*planned.values()]


def _add_planned(planned_cameras: dict[str, PlannedCamera], name: str, entry: CameraEntry) -> None:
    """Add the cameras of an entry to ``planned_cameras``."""
    for planned in _plan_entry(name, entry):
        if planned.name in planned_cameras:
            raise ValueError(f"there is a camera {planned.name} already")
        planned_cameras[planned.name] = planned
    if len(planned_cameras) > MAX_CAMERAS_PER_AGENT:
        raise ValueError(
            f"{len(planned_cameras)} cameras up to here, expected {MAX_CAMERAS_PER_AGENT} at most"
        )


def _plan_entry(name: str, entry: CameraEntry) -> Iterator[PlannedCamera]:
    is_pattern = name.endswith(_PATTERN)
    if not is_pattern and "*" in name:
        raise ValueError(f"{name!r:.120} means several: expected a name that ends in {_PATTERN}")
    count = 1 if entry.emulated is None else entry.emulated.count
    if not is_pattern:
        check_name(name)
        if count > 1:
            raise ValueError(f"an entry for {count} cameras needs a name such as {name}{_PATTERN}")
        yield PlannedCamera(name, entry, 0)
        return
    if entry.emulated is None:
        raise ValueError("only emulated cameras have a pattern for a name")
    stem, width = name.removesuffix(_PATTERN), len(str(count))
    for index in range(count):
        yield PlannedCamera(check_name(f"{stem}/cam{index + 1:0{width}}"), entry, index)


# ---------------------------------------------------------------------- reading a file


def load_fleet(path: str | Path) -> FleetFile:
    """Read a fleet file.

    Raises:
        ConfigurationError: the file cannot be read or a field of it is wrong; the text names file,
            line and field.
        MissingExtraError: PyYAML is not installed.
    """
    if isinstance(path, str) and "://" in path:
        raise _no_file_error(path)
    path = check_path(path, "path", "fleet")
    folder = path.parent
    file = read_model(
        path, "fleet", FleetFile, "cameras", lambda file: next(_mistakes(file, folder), None)
    )
    if file.certificates is None:
        return file
    return file.model_copy(update={"certificates": str(folder / file.certificates)})


def _no_file_error(url: str) -> ConfigurationError:
    """Return the error for an address instead of a fleet file."""
    shown = masked(url)
    if is_fleet(url):
        return ConfigurationError(
            f"fleet: expected a fleet file, got {shown!r}: an agent serves that fleet already"
        )
    return ConfigurationError(
        f"fleet: expected a fleet file, got the address {shown!r}: write a file with the line "
        f'cameras: {{line1/cam1: {{url: "{shown}"}}}} and name that file'
    )


def fleet_schema() -> dict[str, Any]:
    """Return the JSON Schema of fleet files."""
    return file_schema(FleetFile, "fleet")


Mistake = tuple["Sequence[int | str]", str]


def _mistakes(file: FleetFile, folder: Path) -> Iterator[Mistake]:
    """Yield the mistakes in a file: the keys that lead to the field, and a text."""
    yield from access_mistakes(file.access, file.endpoints[0])
    yield from _certificate_mistakes(file, folder)
    if not file.cameras and not file.endpoints[0]:
        text = "an agent without cameras is only a router, which needs the key listen"
        yield ("cameras",), text
    if file.record is not None:
        with_frames = [
            name for name, entry in file.cameras.items() if entry.frames or entry.software
        ]
        yield from record_mistakes(file.record, folder, with_frames)
    if file.outlets is not None:
        with from_part("mqtt", '"outlets:" in a fleet file needs'):
            from smartcam.outlets._inside import mistakes_of as outlet_mistakes
        yield from outlet_mistakes(file.outlets)
    planned: dict[str, PlannedCamera] = {}
    addresses: dict[tuple[str, int], str] = {}
    for name, entry in file.cameras.items():
        keys = ("cameras", name)
        try:
            _add_planned(planned, name, entry)
        except ValueError as exc:
            yield keys, str(exc)
        for more_keys, text in _entry_mistakes(name, entry, addresses, folder):
            yield (*keys, *more_keys), text
    if file.ros2 is not None:
        yield from _ros_mistakes(planned)


def _ros_mistakes(planned: dict[str, PlannedCamera]) -> Iterator[Mistake]:
    try:
        node_names([*planned])
    except ValueError as exc:
        yield ("cameras",), str(exc)


def _certificate_mistakes(file: FleetFile, folder: Path) -> Iterator[Mistake]:
    listen, connect = file.endpoints
    tls = [endpoint for endpoint in (*listen, *connect) if endpoint.startswith("tls/")]
    if file.certificates is None:
        if tls:
            yield (
                ("listen" if tls[0] in listen else "connect",),
                f"{tls[0]} needs the key certificates",
            )
        return
    if missing := missing_certificates(folder / file.certificates):
        yield ("certificates",), missing


def _entry_mistakes(
    name: str, entry: CameraEntry, addresses: dict[tuple[str, int], str], folder: Path
) -> Iterator[Mistake]:
    """Yield the mistakes of an entry, and add its address and name to ``addresses``."""
    if entry.url is not None:
        try:
            address = parse_address(entry.url, model=entry.model)
        except SmartCamError as exc:
            yield ("url",), str(exc)
            return
        other = addresses.setdefault((address.host, address.port), name)
        if other != name:
            yield ("url",), f"{other} has this address already, and a camera takes one client"
    elif entry.model is not None:
        yield ("model",), "is for a url"
    elif entry.emulated is not None and entry.emulated.scenario is not None:
        yield from _scenario_mistakes(folder / entry.emulated.scenario)
    elif entry.software is not None:
        yield from _software_mistakes(name, entry.software, folder)
    if entry.frames is not None:
        yield from _frames_mistakes(entry.frames, folder)
    ros = entry.ros2
    for key, load in (
        ("calibration", lambda: ros.load_calibration(folder)),
        ("hand_eye", lambda: ros.load_hand_eye(folder)),
        ("calibration_pose", ros.robot_pose),
    ):
        try:
            load()
        except (SmartCamError, OSError) as exc:
            yield ("ros2", key), str(exc)
    if entry.reconnect is not None:
        try:
            entry.reconnect.backoff()
        except ConfigurationError as exc:
            yield ("reconnect",), str(exc)
            return
    if isinstance(entry.application, str) and not entry.application_names:
        yield ("application",), "a name is given, and application_names has none"
    try:
        with_ids(entry.model_dump(include={"application", "application_names", "interpret_as"}))
    except ConfigurationError as exc:
        yield ("application_names",), str(exc)
    specs = entry.interpret_as
    spec_items = specs.items() if isinstance(specs, dict) else [(None, specs)]
    for application, spec in spec_items:
        if spec is not None:
            try:
                Interpretation(spec, lenient=entry.lenient, y_down=entry.y_down)
            except SmartCamError as exc:
                application_key = () if application is None else (application,)
                yield ("interpret_as", *application_key), str(exc)


def _frames_mistakes(entry: FramesEntry, folder: Path) -> Iterator[Mistake]:
    try:
        entry.load_lens(folder)
    except (SmartCamError, OSError) as exc:
        yield ("frames", "camera_info"), str(exc)
        return
    try:
        entry.make_source(folder)
    except SmartCamError as exc:
        yield ("frames", "url"), str(exc)


def software_camera(name: str, fields: dict[str, Any], folder: Path) -> CellCamera:
    """Return the software camera that the fields of an entry describe.

    Raises:
        ConfigurationError: the entry is wrong.
        MissingExtraError: a package that it needs is not installed.
    """
    with from_part("inspection", '"software:" in a fleet file needs'):
        from smartcam.inspection._inside import SoftwareEntry, make_camera
    return make_camera(name, validated(SoftwareEntry, fields, f"{name}: software"), folder)


def _software_mistakes(name: str, fields: dict[str, Any], folder: Path) -> Iterator[Mistake]:
    with from_part("inspection", '"software:" in a fleet file needs'):
        from smartcam.inspection._inside import SoftwareEntry, software_mistakes
    try:
        software = SoftwareEntry.model_validate(fields)
    except ValidationError as exc:
        first = exc.errors(include_url=False)[0]
        yield ("software", *first["loc"]), first["msg"].removeprefix("Value error, ")
        return
    for keys, text in software_mistakes(name, software, folder):
        yield ("software", *keys), text


def _scenario_mistakes(path: Path) -> Iterator[Mistake]:
    from smartcam.emulator import load_scenario

    try:
        load_scenario(path)
    except ConfigurationError as exc:
        yield ("emulated", "scenario"), str(exc)
