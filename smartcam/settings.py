"""The settings of a connection: the camera's address and the client's options.

A wrong option is a :exc:`~smartcam.ConfigurationError` that names it.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, TypeVar, cast
from urllib.parse import parse_qsl, quote, quote_plus, unquote, urlencode, urlsplit

from smartcam._arguments import (
    MAX_APPLICATION_ID,
    MAX_CONNECT_ATTEMPTS,
    MAX_DATA_BYTES,
    MAX_NAME_CHARACTERS,
    MAX_OPTION_SECONDS,
    MIN_PAYLOAD_LIMIT_BYTES,
    check_text,
    excerpt,
)
from smartcam._suggestions import did_you_mean, hint
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError, PluginError, UnsupportedError
from smartcam.registry import PROTOCOLS

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from pydantic import BaseModel, ValidationError
    from pydantic_core import ErrorDetails

    from smartcam.interpreters._inside import Spec
    from smartcam.models import Calibration
    from smartcam.protocols import Protocol

__all__ = ["CameraOptions", "CameraSettings"]

FLEET_SCHEMES = ("fleet", "fleet+tls")
"""URL schemes of cameras in a fleet, which an agent shares."""

M = TypeVar("M", bound="BaseModel")


class Address(NamedTuple):
    """The address of a camera, and what is known about its protocol before connecting.

    Attributes:
        protocol: name of the protocol.
        scheme: scheme of the URL, which decides the transport.
        host: name or address of the camera.
        port: port of the camera.
        dialect: the dialect; None if the client has to find it.
        quirks: the camera's deviations from the dialect.
        parameters: other parameters in the URL by name, which the protocol uses. They include
            ``user`` and ``password`` if the protocol has a login.
        path: part of the URL after the host: a camera's name in a fleet.
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
        """The address as a URL, with dialect and quirks if known; never with a password."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        user = query = ""
        if self.parameters or self.quirks:
            users = [quote(value, safe="") for key, value in self.parameters if key == USER]
            user = "".join(f"{name}@" for name in users)
            pairs = [("dialect", self.dialect), ("quirks", ",".join(self.quirks)), *self.parameters]
            query = urlencode(
                [(key, value) for key, value in pairs if value and key not in {USER, PASSWORD}],
                safe=",:",
            )
        elif self.dialect:
            query = f"dialect={quote_plus(self.dialect, safe=',:')}"
        authority = f"{user}{host}:{self.port}" if host else ""
        path = f"/{self.path}" if self.path else ""
        return f"{self.scheme}://{authority}{path}{'?' if query else ''}{query}"

    def __repr__(self) -> str:
        """Return the address as a text for logs, without the password."""
        shown = tuple((key, "***" if key == PASSWORD else value) for key, value in self.parameters)
        fields = zip(self._fields, self._replace(parameters=shown), strict=True)
        return f"Address({', '.join(f'{name}={value!r}' for name, value in fields)})"


def is_fleet(url: str) -> bool:
    """Return True if a URL is the URL of a fleet, or of a camera in a fleet."""
    scheme = check_text(url, "url").strip().partition("://")[0]
    return scheme.lower() in FLEET_SCHEMES


SOFTWARE_SCHEME = "software:"
"""The beginning of an address of a software camera: this process inspects its pictures."""


def is_software(url: str) -> bool:
    """Return True if a URL is the address of a software camera."""
    return check_text(url, "url").strip().lower().startswith(SOFTWARE_SCHEME)


MAX_KNOWN_ADDRESSES = 256
"""Largest number of URLs whose parsed address is kept, for cameras that are opened again."""


def parse_address(url: str, *, model: str | None = None) -> Address:
    """Read a camera URL such as ``bvs://192.168.0.10?dialect=handbook``.

    Args:
        url: a URL, or a bare ``HOST[:PORT]``: BVS over TCP, unless ``model`` has another protocol.
        model: camera model; picks the protocol of a bare host.

    Raises:
        ConfigurationError: the text names the wrong part, and the accepted values.
    """
    url = check_text(url, "camera address")
    if model is not None:
        model = check_text(model, "camera model", least=1, most=200)
    if "@" in url:  # the URL has a password, which must not be kept
        return _read_address(url, model)
    return _known_address(url, model, PROTOCOLS.revision)


@functools.lru_cache(maxsize=MAX_KNOWN_ADDRESSES)
def _known_address(url: str, model: str | None, revision: int) -> Address:
    """Return the address of a URL; cached as long as the registry's ``revision`` is the same."""
    return _read_address(url, model)


def _read_address(url: str, model: str | None) -> Address:
    protocol, full = _pick_protocol(url.strip(), model)
    shown = masked(url)
    try:
        parts = urlsplit(full)
        host, port = parts.hostname, parts.port
    except ValueError as exc:
        if shown != url and "'" in str(exc):  # the error's text quotes the URL, and so the password
            raise ConfigurationError(
                f"camera address {shown!r} is no URL; in a password write / ? # [ ] as "
                "%2F %3F %23 %5B %5D"
            ) from None
        raise ConfigurationError(f"camera address {shown!r}: {exc}") from exc
    if port is None:
        port = protocol.default_port
    if not host:
        raise ConfigurationError(f"camera address {shown!r} has no host")
    # urlsplit accepts some brackets; which of them depends on the version of Python
    host_and_port = parts.netloc.rpartition("@")[2]
    if "[" in host or "]" in host or host_and_port.rfind("[") > 0:
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
        raise ConfigurationError(
            f"camera address {shown!r} has {surplus[0]}, which means nothing: expected "
            f"{parts.scheme}://HOST[:PORT]"
        )
    values = _query(shown, parts.query, protocol)
    if has_login and parts.username is not None:
        values[USER], values[PASSWORD] = unquote(parts.username), unquote(parts.password or "")
    dialect, quirks = values.pop("dialect", None), values.pop("quirks", "")
    if dialect is not None and dialect not in protocol.dialects:
        raise ConfigurationError(
            f"camera address {shown!r}: {protocol.name} has no dialect {dialect!r}; "
            f"it has {', '.join(protocol.dialects)}{did_you_mean(dialect, protocol.dialects)}"
        )
    address = Address(
        protocol.name,
        parts.scheme,
        host,
        port,
        dialect,
        tuple(sorted({name.strip() for name in quirks.split(",") if name.strip()})),
        tuple(values.items()),
    )
    try:
        if dialect is None and address.quirks:
            raise ConfigurationError("quirks belong to a dialect: name the dialect, too")
        protocol.dialect_groups(protocol.schemes[address.scheme], dialect, address.quirks, values)
    except ConfigurationError as exc:
        raise ConfigurationError(f"camera address {shown!r}: {exc}") from exc
    return address


USER, PASSWORD = "user", "password"
"""Names of the parameters that are before the host in a URL."""


def _query(shown: str, query: str, protocol: Protocol) -> dict[str, str]:
    """Return the parameters of a URL's query; ``shown`` is the URL for error texts."""
    known = ["dialect", "quirks", *(key for key in protocol.parameters if key not in _LOGIN)]
    values: dict[str, str] = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in known:
            raise ConfigurationError(
                f"camera address {shown!r}: unknown {key!r}; known are "
                f"{', '.join(map(repr, known))}{did_you_mean(key, known)}"
            )
        if key in values:
            raise ConfigurationError(f"camera address {shown!r} names two {key}")
        values[key] = value
    return values


_LOGIN = frozenset({USER, PASSWORD})


def masked(url: str) -> str:
    """Return a URL without its password, for error texts."""
    begin = url.find("://") + 3 if "://" in url else 0
    login, at, host = url[begin:].rpartition("@")
    user, colon, _ = login.partition(":")
    shown = f"{url[:begin]}{user}:***@{host}" if at and colon else url
    return _PASSWORD_IN_QUERY.sub(r"\1***", shown)


_PASSWORD_IN_QUERY = re.compile(rf"(\b{PASSWORD}=)[^&#]*", re.IGNORECASE)


def _pick_protocol(url: str, model: str | None) -> tuple[Protocol, str]:
    if is_software(url):
        raise UnsupportedError(
            f"{url} is inspected in this process, by smartcam.connect: a network camera is needed "
            "here; smartcam-emulator --program FILE serves the program as one, and prints its "
            "address"
        )
    if "://" in url:
        scheme = url.partition("://")[0].lower()
        bvs = cast("Protocol", PROTOCOLS.load("bvs"))
        if scheme in bvs.schemes:  # first, since listing what is installed takes long
            return bvs, url
        for protocol in known_protocols():
            if scheme in protocol.schemes:
                return protocol, url
        schemes = [scheme for protocol in known_protocols() for scheme in protocol.schemes]
        if is_fleet(url):
            own_schemes = " or ".join(f"{scheme}://" for scheme in schemes)
            raise UnsupportedError(
                f"{masked(url)} is of a fleet, whose agent has the session with the camera: the "
                f"camera's own address is needed here, which begins with {own_schemes}"
            )
        schemes += FLEET_SCHEMES
        known = ", ".join(f"{scheme}://" for scheme in schemes)
        raise ConfigurationError(
            f"camera address {masked(url)!r}: unknown scheme {scheme!r}; known are {known}"
            f"{did_you_mean(scheme, schemes)}"
        )
    if model is None:
        return cast("Protocol", PROTOCOLS.load("bvs")), f"bvs://{url}"
    for protocol in known_protocols():
        if model.upper() in protocol.models:
            return protocol, f"{next(iter(protocol.schemes))}://{url}"
    models = [name for protocol in known_protocols() for name in protocol.models]
    raise ConfigurationError(
        f"unknown camera model {model!r}; known are {', '.join(models)}"
        f"{did_you_mean(model, models)}"
    )


def known_protocols() -> Iterator[Protocol]:
    """Yield the registered protocols that can be loaded."""
    for info in PROTOCOLS.available():
        try:
            protocol: Any = PROTOCOLS.load(info.name)
        except PluginError:
            if info.origin == "built-in":
                raise
            continue  # a broken plug-in is left out
        if hasattr(protocol, "schemes"):  # a plug-in that is no protocol is left out, too
            yield protocol


class OtherOptions(TypedDict, total=False):
    """The options of ``connect()``, except for the interpretation of results."""

    name: str
    application: int | str | None
    application_names: Mapping[str, int]
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
    """The options of ``connect()``; :class:`CameraSettings` has their defaults."""

    interpret_as: Spec | Mapping[int, Spec]


@dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """Options of one client. :meth:`make` and :meth:`of` check them, and make the object.

    Times are seconds; each limits one step.

    Attributes:
        given: names of the options that were given.
    """

    address: Address
    name: str = ""
    application: int | None = None
    application_names: Mapping[str, int] = field(default_factory=dict)
    interpret_as: Any = None
    calibration: Any = None
    y_down: bool = False
    lenient: bool = False
    connect_timeout: float = 10.0
    connect_attempts: int = 3
    switch_timeout: float = 10.0
    request_timeout: float = 5.0
    close_timeout: float = 1.0
    liveness_timeout: float | None = 5.0
    reconnect: Backoff | None = Backoff()  # noqa: RUF009 - it cannot be changed
    restore: bool = False
    max_length: int = 1 << 20
    given: frozenset[str] = frozenset()

    @classmethod
    def make(
        cls, url: str, model: str | None, options: CameraOptions | dict[str, Any]
    ) -> CameraSettings:
        """Validate the options of ``connect()``.

        Raises:
            ConfigurationError: the text has the option, the given value and the expected one.
        """
        return cls.of(parse_address(url, model=model), options)

    @classmethod
    def of(cls, address: Address, options: CameraOptions | dict[str, Any]) -> CameraSettings:
        """Validate options for an address.

        Raises:
            ConfigurationError: the text has the option, the given value and the expected one.
        """
        default_name = address.path or f"{address.host}:{address.port}"
        try:
            given = with_ids(cast("dict[str, Any]", options))
        except TypeError as exc:
            raise ConfigurationError(f"connect: {exc!s:.200}") from exc
        if "name" not in given and len(default_name) <= MAX_NAME_CHARACTERS:
            given = {**given, "name": default_name}
        checked = {option: _accept_usual(option, value) for option, value in given.items()}
        if any(value is _UNUSUAL for value in checked.values()):
            checked = _validated(given)
        checked["name"] = checked.get("name") or default_name
        settings = object.__new__(cls)  # five times faster than the class's constructor
        values = vars(settings)
        values.update(_DEFAULTS)
        values["application_names"] = {}
        values.update(checked)
        values["address"], values["given"] = address, frozenset(given)
        return settings


_DEFAULTS = {
    field.name: field.default
    for field in dataclasses.fields(CameraSettings)
    if field.default is not dataclasses.MISSING
}

_UNUSUAL = object()
"""Returned for a value that pydantic has to check."""

_SECONDS = (float, sys.float_info.min, MAX_OPTION_SECONDS)
_BOUNDS: dict[str, tuple[type[float], float, float]] = {
    **dict.fromkeys(("y_down", "lenient", "restore"), (bool, 0, 1)),
    **{
        f"{step}_timeout": _SECONDS
        for step in ("connect", "switch", "request", "close", "liveness")
    },
    "application": (int, 0, MAX_APPLICATION_ID),
    "connect_attempts": (int, 1, MAX_CONNECT_ATTEMPTS),
    "max_length": (int, MIN_PAYLOAD_LIMIT_BYTES, MAX_DATA_BYTES),
}
"""Type, least and largest value of options that are numbers or truth values."""


def _accept_usual(option: str, value: Any) -> Any:
    """Return an option's plain value if it is certainly valid, else ``_UNUSUAL``."""
    if option in _BOUNDS:
        kind, minimum, maximum = _BOUNDS[option]
        if type(value) is kind or (kind is float and type(value) is int):
            return kind(value) if minimum <= value <= maximum else _UNUSUAL
        is_allowed_none = value is None and option in {"application", "liveness_timeout"}
        return None if is_allowed_none else _UNUSUAL
    if option == "name":
        is_valid = type(value) is str and value.isascii() and len(value) <= MAX_NAME_CHARACTERS
        return value if is_valid else _UNUSUAL
    if option == "reconnect":
        return value if value is None or isinstance(value, Backoff) else _UNUSUAL
    return value if option in {"interpret_as", "calibration"} else _UNUSUAL


def _validated(given: dict[str, Any]) -> dict[str, Any]:
    """Return options as pydantic's model reads them.

    Raises:
        ConfigurationError: the text has the option, the given value and the expected one.
    """
    from pydantic import ValidationError

    from smartcam._settings_model import OPTIONS, SettingsModel

    try:
        settings = SettingsModel(**given)
    except ValidationError as exc:
        raise ConfigurationError(f"connect: {validation_text(exc, OPTIONS)}") from exc
    return {option: getattr(settings, option) for option in given}


def with_ids(options: dict[str, Any]) -> dict[str, Any]:
    """Return options with the ids of applications in place of their names.

    Raises:
        ConfigurationError: a name is not known.
    """
    names = options.get("application_names")
    if not isinstance(names, Mapping) or not names:
        return options
    changed = dict(options)
    if isinstance(changed.get("application"), str):
        changed["application"] = id_of(changed["application"], names)
    for option in ("interpret_as", "calibration"):
        given: Any = changed.get(option)
        if isinstance(given, Mapping):
            by_application: Mapping[Any, Any] = given
            changed[option] = {
                id_of(key, names) if isinstance(key, str) else key: value
                for key, value in by_application.items()
            }
    return changed


def id_of(application: str, names: Mapping[str, int]) -> int:
    """Return the id of an application's name.

    Raises:
        ConfigurationError: there is no such name.
    """
    if application in names:
        return names[application]
    raise ConfigurationError(
        f"application {excerpt(application)} is none of {', '.join(names)}"
        f"{did_you_mean(application, names)}"
    )


def validated(kind: type[M], given: M | Mapping[str, Any], label: str) -> M:
    """Return ``given`` as a model; if it is a mapping, it has the model's fields.

    Raises:
        ConfigurationError: a field is wrong; the text begins with ``label`` and names the field.
    """
    from pydantic import ValidationError

    try:
        return kind.model_validate(dict(given) if isinstance(given, Mapping) else given)
    except ValidationError as exc:
        text = validation_text(exc, kind.model_fields)
        raise ConfigurationError(f"{label}: {text}") from exc


def validation_text(error: ValidationError, known: Iterable[str] = ()) -> str:
    """Return pydantic's findings as one line: field, expected value, given value.

    ``known``: names of the fields at the top level, for suggestions.
    """
    return "; ".join(
        f"{'.'.join(f'{part!s:.80}' for part in item['loc']) or 'value'}: {item['msg']}"
        f"{_suggestion(item, known)} (got {excerpt(item['input'])})"
        for item in error.errors()
    )


def _suggestion(item: ErrorDetails, known: Iterable[str]) -> str:
    return hint(item, known if len(item["loc"]) == 1 else ())
