"""What a connection is told: the camera's address and the client's options.

A wrong option is a :exc:`~smartcam.ConfigurationError` that names it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, TypedDict, TypeVar, cast
from urllib.parse import parse_qsl, quote, unquote, urlencode, urlsplit

from pydantic import BaseModel, ConfigDict, Field, InstanceOf, ValidationError

from smartcam._suggestions import did_you_mean
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError, PluginError, UnsupportedError
from smartcam.registry import PROTOCOLS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from pydantic_core import ErrorDetails

    from smartcam.interpreters._base import Spec
    from smartcam.models import Calibration
    from smartcam.protocols._base import Protocol

__all__ = ["Address", "CameraOptions", "CameraSettings", "parse_address"]

FLEET_SCHEMES = ("fleet", "fleet+tls")
"""Of the addresses of cameras that an agent shares."""

M = TypeVar("M", bound=BaseModel)

Seconds = Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)]


class Address(NamedTuple):
    """Where a camera is and what is known of how it speaks.

    Attributes:
        protocol: name of the protocol.
        scheme: of the URL; it decides the transport.
        host: name or address.
        port: its port.
        dialect: pinned dialect, None to find it out.
        quirks: pinned deviations from the dialect.
        parameters: what else the URL says, as the protocol understands it: names and values. They
            include ``user`` and ``password`` where the protocol has a login.
        path: what stands behind the host: a camera's name in a fleet.
    """

    protocol: str
    scheme: str
    host: str
    port: int
    dialect: str | None = None
    quirks: tuple[str, ...] = ()
    parameters: tuple[tuple[str, str], ...] = ()
    path: str = ""

    @property
    def url(self) -> str:
        """The address as a URL, with everything pinned that is known; never with a password."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        user = "".join(quote(value, safe="") + "@" for key, value in self.parameters if key == USER)
        said = [("dialect", self.dialect), ("quirks", ",".join(self.quirks)), *self.parameters]
        query = urlencode(
            [(key, value) for key, value in said if value and key not in {USER, PASSWORD}],
            safe=",:",
        )
        place = f"{user}{host}:{self.port}" if host else ""
        path = f"/{self.path}" if self.path else ""
        return f"{self.scheme}://{place}{path}{'?' if query else ''}{query}"

    def __repr__(self) -> str:
        """Return all of it but the password, which is not for logs."""
        shown = tuple((key, "***" if key == PASSWORD else value) for key, value in self.parameters)
        fields = zip(self._fields, self._replace(parameters=shown), strict=True)
        return f"Address({', '.join(f'{name}={value!r}' for name, value in fields)})"


def parse_address(url: str, *, model: str | None = None) -> Address:
    """Read a camera URL such as ``bvs://192.168.0.10?dialect=handbook``.

    Args:
        url: a URL, or a bare ``HOST[:PORT]``: BVS over TCP, unless ``model`` says otherwise.
        model: camera model; picks the protocol of a bare host.

    Raises:
        ConfigurationError: says which part is wrong and what is accepted.
    """
    protocol, full = _pick_protocol(url.strip(), model)
    shown = masked(url)
    try:
        parts = urlsplit(full)
        port = parts.port if parts.port is not None else protocol.default_port
    except ValueError as exc:
        if shown != url and "'" in str(exc):  # it quotes the URL, and so the password
            raise ConfigurationError(
                f"camera address {shown!r} is no URL; in a password each of / ? # [ ] stands as "
                "%2F %3F %23 %5B %5D"
            ) from None
        raise ConfigurationError(f"camera address {shown!r}: {exc}") from exc
    if not parts.hostname:
        raise ConfigurationError(f"camera address {shown!r} has no host")
    # urlsplit lets some pass, and which ones differs from Python to Python
    place = parts.netloc.rpartition("@")[2]
    if "[" in parts.hostname or "]" in parts.hostname or place.rfind("[") > 0:
        raise ConfigurationError(f"camera address {shown!r} has a bracket inside its host")
    if port == 0:
        raise ConfigurationError(f"camera address {shown!r}: port 0 is no camera's port")
    has_login = USER in protocol.parameters
    surplus = [
        name
        for name, value in [
            ("a user", "@" in parts.netloc and not has_login),
            ("a path", parts.path.strip("/")),
            ("a fragment", parts.fragment),
        ]
        if value
    ]
    if surplus:
        raise ConfigurationError(f"camera address {shown!r} has {surplus[0]}, which means nothing")
    said = _query(shown, parts.query, protocol)
    if has_login and parts.username is not None:
        said[USER], said[PASSWORD] = unquote(parts.username), unquote(parts.password or "")
    dialect, quirks = said.pop("dialect", None), said.pop("quirks", "")
    if dialect is not None and dialect not in protocol.dialects:
        raise ConfigurationError(
            f"camera address {shown!r}: {protocol.name} has no dialect {dialect!r}; "
            f"it has {', '.join(protocol.dialects)}{did_you_mean(dialect, protocol.dialects)}"
        )
    address = Address(
        protocol.name,
        parts.scheme,
        parts.hostname,
        port,
        dialect,
        tuple(sorted({name.strip() for name in quirks.split(",") if name.strip()})),
        tuple(said.items()),
    )
    try:
        if dialect is None and address.quirks:
            raise ConfigurationError("quirks are a dialect's: name the dialect, too")
        protocol.tries(protocol.schemes[address.scheme], dialect, address.quirks, said)
    except ConfigurationError as exc:
        raise ConfigurationError(f"camera address {shown!r}: {exc}") from exc
    return address


USER, PASSWORD = "user", "password"
"""Parameters that stand before the host in a URL."""


def _query(shown: str, query: str, protocol: Protocol) -> dict[str, str]:
    """Return the parameters of a URL's query; ``shown`` is the URL for error texts."""
    known = ["dialect", "quirks", *(key for key in protocol.parameters if key not in _LOGIN)]
    said: dict[str, str] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            raise ConfigurationError(
                f"camera address {shown!r}: unknown {key!r}; known are "
                f"{', '.join(map(repr, known))}{did_you_mean(key, known)}"
            )
        if key in said:
            raise ConfigurationError(f"camera address {shown!r} names two {key}")
        said[key] = value
    return said


_LOGIN = frozenset({USER, PASSWORD})


def masked(url: str) -> str:
    """Return a URL without its password, for error texts."""
    begin = url.find("://") + 3 if "://" in url else 0
    login, at, host = url[begin:].rpartition("@")
    user, colon, _ = login.partition(":")
    shown = f"{url[:begin]}{user}:***@{host}" if at and colon else url
    return _PASSWORD_SAID.sub(r"\1***", shown)


_PASSWORD_SAID = re.compile(rf"(\b{PASSWORD}=)[^&#]*", re.IGNORECASE)


def _pick_protocol(url: str, model: str | None) -> tuple[Protocol, str]:
    if "://" in url:
        scheme = url.partition("://")[0].lower()
        for protocol in _protocols():
            if scheme in protocol.schemes:
                return protocol, url
        schemes = [one for protocol in _protocols() for one in protocol.schemes]
        if scheme in FLEET_SCHEMES:
            raise UnsupportedError(
                f"{masked(url)} is a camera that an agent of a fleet shares: this wants the "
                f"address of one at the wire, which begins with {' or '.join(schemes)}"
            )
        schemes += FLEET_SCHEMES
        known = ", ".join(f"{one}://" for one in schemes)
        raise ConfigurationError(
            f"camera address {masked(url)!r}: unknown scheme {scheme!r}; known are {known}"
            f"{did_you_mean(scheme, schemes)}"
        )
    if model is None:
        return cast("Protocol", PROTOCOLS.load("bvs")), f"bvs://{url}"
    for protocol in _protocols():
        if model.upper() in protocol.models:
            return protocol, f"{next(iter(protocol.schemes))}://{url}"
    models = [name for protocol in _protocols() for name in protocol.models]
    raise ConfigurationError(
        f"unknown camera model {model!r}; known are {', '.join(models)}"
        f"{did_you_mean(model, models)}"
    )


def _protocols() -> Iterator[Protocol]:
    for info in PROTOCOLS.available():
        try:
            protocol: Any = PROTOCOLS.load(info.name)
        except PluginError:
            if info.origin == "built-in":
                raise
            continue  # a broken plug-in costs only its own name
        if hasattr(protocol, "schemes"):  # so does one that gives something else
            yield protocol


class OtherOptions(TypedDict, total=False):
    """The options that ``connect()`` takes, but for what says how to read results."""

    name: str
    application: int | None
    calibration: Calibration | Mapping[int, Calibration | None] | None
    y_down: bool
    lenient: bool
    connect_timeout: float
    connect_attempts: int
    switch_timeout: float
    request_timeout: float
    close_timeout: float
    liveness_timeout: float | None
    reconnect: Backoff | None
    restore: bool
    max_length: int


class CameraOptions(OtherOptions, total=False):
    """The options that ``connect()`` takes; :class:`CameraSettings` has defaults and meanings."""

    interpret_as: Spec | Mapping[int, Spec]


class CameraSettings(BaseModel):
    """Options of one client. Times are seconds, each bounds one step."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        frozen=True, extra="forbid", arbitrary_types_allowed=True
    )

    address: Address = Field(description="where the camera is")
    name: str = Field("", max_length=200, description="name in logs and results; default HOST:PORT")
    application: int | None = Field(
        None, ge=0, le=0xFFFFFFFF, description="application to have running and ready"
    )
    interpret_as: Any = Field(None, description="what result containers hold")
    calibration: Any = Field(
        None,
        description="what brings localizations into the robot's frame: one for all applications, "
        "or a mapping from application id to one, or to None to leave its values as they are",
    )
    y_down: bool = Field(
        False, description="the camera's y axis points down; turned to y up on the way in"
    )
    lenient: bool = Field(False, description="any non-zero byte is a true bool")
    connect_timeout: Seconds = Field(10.0, description="for a session, all attempts together")
    connect_attempts: int = Field(3, ge=1, le=100, description="fresh links tried per dialect")
    switch_timeout: Seconds = Field(10.0, description="for a switch until the camera is ready")
    request_timeout: Seconds = Field(5.0, description="for the answer to a request")
    close_timeout: Seconds = Field(1.0, description="for an orderly end of the link")
    liveness_timeout: Seconds | None = Field(
        5.0, description="until a camera that gives no sign of life counts as gone; None: never"
    )
    reconnect: InstanceOf[Backoff] | None = Field(
        Backoff(), description="when a lost camera is tried again; None: never"
    )
    restore: bool = Field(
        False,
        description="after a reconnect have the named application and the run state back that "
        "were wanted; else they are left as the camera has them",
    )
    max_length: int = Field(
        1 << 20, ge=16, le=1 << 30, description="largest payload accepted, bytes"
    )

    @classmethod
    def make(
        cls, url: str, model: str | None, options: CameraOptions | dict[str, Any]
    ) -> CameraSettings:
        """Validate what ``connect()`` was given.

        Raises:
            ConfigurationError: names the option, what came and what was expected.
        """
        return cls.of(parse_address(url, model=model), options)

    @classmethod
    def of(cls, address: Address, options: CameraOptions | dict[str, Any]) -> CameraSettings:
        """Validate options for an address.

        Raises:
            ConfigurationError: names the option, what came and what was expected.
        """
        try:
            settings = cls(address=address, **cast("dict[str, Any]", options))
        except ValidationError as exc:
            known = [*CameraOptions.__annotations__, *OtherOptions.__annotations__]
            raise ConfigurationError(f"connect: {validation_text(exc, known)}") from exc
        except TypeError as exc:
            raise ConfigurationError(f"connect: {exc}") from exc
        if settings.name:
            return settings
        name = address.path or f"{address.host}:{address.port}"
        return settings.model_copy(update={"name": name})


def validated(kind: type[M], given: M | Mapping[str, Any], what: str) -> M:
    """Return ``given`` as a model; a mapping has its fields.

    Raises:
        ConfigurationError: a field is wrong; the text begins with ``what`` and names the field.
    """
    try:
        return kind.model_validate(dict(given) if isinstance(given, Mapping) else given)
    except ValidationError as exc:
        text = validation_text(exc, kind.model_fields)
        raise ConfigurationError(f"{what}: {text}") from exc


def validation_text(error: ValidationError, known: Iterable[str] = ()) -> str:
    """Return pydantic's findings as one line: where, what was expected, what came.

    ``known``: names that may stand at the top, one of which may have been meant.
    """
    return "; ".join(
        f"{'.'.join(str(part) for part in item['loc']) or 'value'}: {item['msg']}"
        f"{_meant(item, known)} (got {_shown(item['input'])})"
        for item in error.errors()
    )


def _meant(item: ErrorDetails, known: Iterable[str]) -> str:
    if item["type"] != "extra_forbidden" or len(item["loc"]) != 1:
        return ""
    return did_you_mean(str(item["loc"][0]), known)


def _shown(value: object) -> str:
    """Return a value as an error shows it; an integer may have more digits than can be written."""
    try:
        return f"{value!r:.80}"
    except ValueError:
        return f"{type(value).__name__} that is too long to be shown"
