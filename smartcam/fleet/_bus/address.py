"""Parse the address of a fleet, and check names in it."""

from __future__ import annotations

import os
import re
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import parse_qsl, urlsplit

from smartcam._arguments import check_text
from smartcam._suggestions import did_you_mean
from smartcam._zenoh import BusLink
from smartcam.exceptions import ConfigurationError
from smartcam.settings import FLEET_SCHEMES, Address, masked

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Self

DEFAULT_PORT = 7447
CERTIFICATES = "SMARTCAM_FLEET_CERTIFICATES"
"""Environment variable with the folder of certificates, for URLs that name no folder."""

CERTIFICATE_FILES = ("ca.pem", "cert.pem", "key.pem")

CHUNK = r"[a-z0-9_-]+"
MAX_CHUNKS = 4
MAX_NAME_CHARACTERS = 100
_NAME = re.compile(rf"{CHUNK}(/{CHUNK}){{0,{MAX_CHUNKS - 1}}}")
_PATTERN_CHUNK = re.compile(rf"\*\*|\*|{CHUNK}")
_HOST = re.compile(r"[\w.:%-]+")
_WORD = re.compile(CHUNK)
_PARAMETERS = ("fleet", "certificates", "program")


def check_name(name: str, label: str = "camera") -> str:
    """Return a camera's name.

    Raises:
        ConfigurationError: the name is not valid.
    """
    name = check_text(name, label)
    if len(name) > MAX_NAME_CHARACTERS or not _NAME.fullmatch(name):
        raise ConfigurationError(
            f"{label} {name!r:.120}: expected a name such as line1/cam3: one to {MAX_CHUNKS} parts "
            f"of a-z, 0-9, _ and -, with / between them, {MAX_NAME_CHARACTERS} characters at most"
        )
    return name


def check_word(word: str, label: str) -> str:
    """Return the name of a fleet or an agent.

    Raises:
        ConfigurationError: the name is not valid.
    """
    word = check_text(word, label)
    if len(word) > MAX_NAME_CHARACTERS or not _WORD.fullmatch(word):
        raise ConfigurationError(
            f"{label} {word!r:.120}: expected a-z, 0-9, _ and -, such as plant"
        )
    return word


def check_pattern(pattern: str) -> str:
    """Return a pattern of cameras' names: ``*`` is one part, ``**`` any number of them.

    Raises:
        ConfigurationError: the pattern is not valid.
    """
    pattern = check_text(pattern, "pattern")
    chunks = pattern.split("/")
    if len(pattern) > MAX_NAME_CHARACTERS or not all(map(_PATTERN_CHUNK.fullmatch, chunks)):
        raise ConfigurationError(
            f"pattern {pattern!r:.120}: expected a camera's name, with * for one part of it and ** "
            "for any number of parts, such as line1/* or **"
        )
    return pattern


def missing_certificates(folder: Path) -> str:
    """Return a text that names the missing files of a folder of certificates; empty if complete."""
    missing = [name for name in CERTIFICATE_FILES if not (folder / name).is_file()]
    return f"{folder} has no {', no '.join(missing)}" if missing else ""


class FleetAddress(NamedTuple):
    """A fleet, or a camera of one.

    Attributes:
        scheme: ``fleet``, or ``fleet+tls``.
        host: name or address of an agent, or of a router.
        port: port of the agent, or of the router.
        fleet: name of the fleet; None: the only fleet there.
        camera: name of the camera; empty for the fleet.
        certificates: folder with the certificates of this program, for ``fleet+tls``.
        program: name of this program for people, such as ``robot1``; None: the script's name.
    """

    scheme: str
    host: str
    port: int = DEFAULT_PORT
    fleet: str | None = None
    camera: str = ""
    certificates: str | None = None
    program: str | None = None

    @classmethod
    def parse(cls, url: str) -> Self:
        """Read a URL such as ``fleet://plant-server/line1/cam3?fleet=plant``.

        Raises:
            ConfigurationError: a part is wrong; the text names it and what is accepted.
        """
        url = check_text(url, "fleet address", least=1)
        shown = masked(url)
        label = f"fleet address {shown!r:.200}"
        try:
            parts = urlsplit(url.strip())
            port = parts.port if parts.port is not None else DEFAULT_PORT
        except ValueError as exc:
            if shown != url:  # the error may quote the password
                raise ConfigurationError(f"{label} is no URL") from None
            raise ConfigurationError(f"{label}: {exc}") from exc
        if parts.scheme not in FLEET_SCHEMES:
            raise ConfigurationError(
                f"{label}: expected fleet://HOST[:PORT][/CAMERA], got scheme {parts.scheme!r}"
                f"{did_you_mean(parts.scheme, FLEET_SCHEMES)}"
            )
        if not parts.hostname:
            raise ConfigurationError(
                f"{label} has no host: expected fleet://HOST[:PORT][/CAMERA] with the host of the "
                "fleet's agent; on this computer it is localhost"
            )
        if not _HOST.fullmatch(parts.hostname):
            raise ConfigurationError(f"{label}: {parts.hostname!r:.80} is no host")
        refused = {"a user": "@" in parts.netloc, "a fragment": parts.fragment, "port 0": port == 0}
        for part, present in refused.items():
            if present:
                raise ConfigurationError(f"{label} has {part}, which means nothing")
        query: dict[str, str] = {}
        for key, value in parse_qsl(parts.query, keep_blank_values=True):
            if key not in _PARAMETERS:
                raise ConfigurationError(
                    f"{label}: unknown {key!r}; known are {', '.join(map(repr, _PARAMETERS))}"
                    f"{did_you_mean(key, _PARAMETERS)}"
                )
            if key in query:
                raise ConfigurationError(f"{label} names two {key}")
            query[key] = value
        camera = parts.path.strip("/")
        if camera:
            check_name(camera, f"{label}: camera")
        fleet = check_word(query["fleet"], f"{label}: fleet") if "fleet" in query else None
        program = check_word(query["program"], f"{label}: program") if "program" in query else None
        tls = parts.scheme == "fleet+tls"
        certificates = query.get("certificates") or (os.environ.get(CERTIFICATES) if tls else None)
        if tls and not certificates:
            raise ConfigurationError(
                f"{label}: expected certificates: ?certificates=DIR, or the variable {CERTIFICATES}"
            )
        if "certificates" in query and not tls:
            raise ConfigurationError(f"{label}: certificates are for fleet+tls://")
        return cls(parts.scheme, parts.hostname, port, fleet, camera, certificates, program)

    @property
    def link(self) -> BusLink:
        """Link by which a program reaches the fleet."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        kind = "tls" if self.scheme == "fleet+tls" else "tcp"
        return BusLink(connect=(f"{kind}/{host}:{self.port}",), certificates=self.certificates)

    def of(self, camera: str) -> Address:
        """Return the address of a camera of the fleet."""
        options = {} if self.fleet is None else {"fleet": self.fleet}
        if self.certificates is not None:
            options["certificates"] = self.certificates
        if self.program is not None:
            options["program"] = self.program
        parameters = tuple(options.items())
        return Address("fleet", self.scheme, self.host, self.port, None, (), parameters, camera)

    @property
    def url(self) -> str:
        """The fleet's URL."""
        return self.of("").url
