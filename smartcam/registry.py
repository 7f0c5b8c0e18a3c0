"""Find plug-ins by name: built-ins and entry points in one place.

Names are listed without importing anything, and a plug-in is loaded at its first use. A broken
plug-in makes only its own name unusable. If the metadata of a distribution cannot be read, only its
own plug-ins are missing; the log names it.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, NamedTuple

from smartcam._arguments import excerpt
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import PluginError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from importlib.metadata import Distribution, EntryPoint

__all__ = ["FRAMES", "INTERPRETERS", "OUTLETS", "PROTOCOLS"]

_log = logging.getLogger(__name__)


class PluginInfo(NamedTuple):
    """The origin of a plug-in.

    Attributes:
        name: name by which users ask for it.
        target: ``module:attribute`` that it is loaded from.
        origin: ``built-in``, ``registered``, or the distributions that provide it.
    """

    name: str
    target: str
    origin: str


class Registry:
    """Plug-ins of one entry-point group.

    Args:
        group: entry-point group, as in ``[project.entry-points."smartcam.interpreters"]``.
        builtins: name to ``module:attribute`` of the plug-ins in smartcam.
        aliases: other accepted names of built-ins.

    Attributes:
        revision: number that changes when a plug-in is registered, and at :meth:`refresh`.
    """

    def __init__(
        self, group: str, builtins: dict[str, str], aliases: dict[str, str] | None = None
    ) -> None:
        self.group = group
        self.revision: int = 0
        self._builtins = builtins
        self._aliases = aliases or {}
        self._points_found: dict[str, list[EntryPoint]] | None = None
        self._loaded: dict[str, object] = {}
        self._registered: dict[str, object] = {}

    def available(self) -> list[PluginInfo]:
        """Return every known name, sorted; imports nothing."""
        infos = [PluginInfo(name, target, "built-in") for name, target in self._builtins.items()]
        infos += [PluginInfo(name, "", "registered") for name in self._registered]
        for name, points in self._entry_points().items():
            if name not in self._registered:
                origin = ", ".join(_distribution(point) for point in points)
                infos.append(PluginInfo(name, points[0].value, origin))
        return sorted(infos)

    def __contains__(self, name: object) -> bool:
        """Return True if ``name`` is known, as a name or an alias."""
        known = (self._builtins, self._aliases, self._registered)
        return any(name in names for names in known) or name in self._entry_points()

    def register(self, name: str, plugin: object) -> None:
        """Register a plug-in for this process, without a package that provides it.

        Raises:
            PluginError: the name is taken by another object.
        """
        if self._registered.get(name) is plugin:
            return
        if name in self and self.load(name) is not plugin:
            raise PluginError(f"{self.group}: {excerpt(name)} is there already", name=name)
        self._registered[name] = plugin
        self.revision += 1

    def load(self, name: str) -> object:
        """Return the plug-in of a name, importing it at the first call.

        Raises:
            PluginError: the name is unknown, provided twice, or its import failed.
        """
        name = self._aliases.get(name, name)
        if name not in self._loaded:
            registered = self._registered.get(name)
            self._loaded[name] = self._load(name) if registered is None else registered
        return self._loaded[name]

    def refresh(self) -> None:
        """Forget found and loaded plug-ins, but not registered ones; later calls search again."""
        self._points_found = None
        self._loaded.clear()
        self.revision += 1

    def _entry_points(self) -> dict[str, list[EntryPoint]]:
        if self._points_found is None:
            self._points_found = {}
            for point in _points(self.group):
                self._points_found.setdefault(point.name, []).append(point)
            for name in self._builtins.keys() & self._points_found.keys():
                _log.warning(
                    "%s: the name %s is smartcam's own, that of %s is left out",
                    self.group,
                    excerpt(name),
                    " and ".join(_distribution(point) for point in self._points_found.pop(name)),
                )
        return self._points_found

    def _load(self, name: str) -> object:
        if name in self._builtins:  # without a slow search of the installed packages
            module, _, attribute = self._builtins[name].partition(":")
            return getattr(importlib.import_module(module), attribute)
        points = self._entry_points().get(name, [])
        providers = [_distribution(point) for point in points]
        if not points:
            known = [info.name for info in self.available()]
            raise PluginError(
                f"{self.group}: {excerpt(name)} is unknown; known are {', '.join(known)}"
                f"{did_you_mean(name, known)}",
                name=name,
            )
        if len(points) > 1:
            raise PluginError(
                f"{self.group}: the name {excerpt(name)} is provided by {' and '.join(providers)}",
                name=name,
            )
        try:
            loaded: object = points[0].load()
        except (Exception, SystemExit) as exc:  # an import must not end the program
            raise PluginError(
                f"{self.group}: {excerpt(name)} of {providers[0]} failed to load: {exc!r}",
                name=name,
            ) from exc
        return loaded


def _distribution(point: EntryPoint) -> str:
    return point.value if point.dist is None else _name_of(point.dist) or point.value


def _points(group: str) -> Iterator[EntryPoint]:
    """Yield the entry points of a group; a distribution that is found twice counts once."""
    distributions = [(each, _entry_points_text(each)) for each in _distributions()]
    if not any(text is None or group in text for _, text in distributions):
        return  # the usual case; to read names is slow
    seen: set[str] = set()
    for distribution, text in distributions:
        try:
            name = _key(distribution)
            is_wanted = name not in seen and (text is None or group in text)
            points = list(distribution.entry_points.select(group=group)) if is_wanted else []
            seen.add(name or str(id(distribution)))
        except Exception as exc:  # noqa: BLE001 - anything may stand in other people's files
            _log.warning(
                "%s: the entry points of %s cannot be read, they are left out: %r",
                group,
                getattr(distribution, "_path", None) or "a distribution",
                exc,
            )
        else:
            yield from points


def _entry_points_text(distribution: Distribution) -> str | None:
    """Return the text of a distribution's entry points, None if it cannot be read in this way."""
    try:
        return distribution.read_text("entry_points.txt") or ""
    except Exception:  # noqa: BLE001 - anything may stand in other people's files
        return None


def _distributions() -> Iterator[Distribution]:
    from importlib.metadata import distributions  # slow, and built-in plug-ins do not need it

    try:
        yield from distributions()
    except Exception as exc:  # noqa: BLE001 - finders on sys.meta_path may raise anything
        _log.warning("installed distributions cannot be listed to their end: %r", exc)


def _key(distribution: Distribution) -> str:
    """Return a distribution's normalized name; its folder's name is fastest, if known."""
    known: str | None = getattr(distribution, "_normalized_name", None)
    return known or _name_of(distribution).lower()


def _name_of(distribution: Distribution) -> str:
    """Return a distribution's name; "" if its metadata cannot be read."""
    try:
        name: str | None = distribution.metadata["Name"]
    except Exception:  # noqa: BLE001 - anything may stand in other people's files
        return ""
    return name or ""


INTERPRETERS = Registry(
    "smartcam.interpreters",
    {
        "localizations": "smartcam.interpreters._localizations:LocalizationsInterpreter",
        "raw": "smartcam.interpreters._basic:RawInterpreter",
        "record": "smartcam.interpreters._basic:RecordInterpreter",
        "strings50": "smartcam.interpreters._basic:Strings50Interpreter",
        "table": "smartcam.interpreters._basic:TableInterpreter",
    },
    # the thesis' keywords for localizations and strings50
    aliases={"Localizations": "localizations", "50ByteStrings": "strings50"},
)

PROTOCOLS = Registry(
    "smartcam.protocols",
    {
        "bvs": "smartcam.protocols._bvs:BVS",
        "insight": "smartcam.protocols._insight.dialect:INSIGHT",
        "iv3": "smartcam.makes._keyence.iv3:IV3",
        "pcic": "smartcam.makes._ifm.dialect:PCIC",
        "sr": "smartcam.makes._keyence.sr:SR",
    },
)

GENERATORS = Registry(
    "smartcam.generators",
    {
        "input": "smartcam.emulator._generators:_input",
        "sequence": "smartcam.emulator._generators:_sequence",
        "tangram": "smartcam.emulator._generators:_tangram",
        "tangram_pixels": "smartcam.emulator._generators:_tangram_pixels",
    },
)

FRAMES = Registry(
    "smartcam.frames",
    {
        "file": "smartcam.frames._video.driver:VideoDriver",
        "fleet": "smartcam.fleet._frames.driver:FleetFrameDriver",
        "gige": "smartcam.frames._gige.driver:GigEDriver",
        "http": "smartcam.frames._video.web_camera:WebDriver",
        "insight": "smartcam.frames._insight:InSightDriver",
        "mcap": "smartcam.recording._pictures.driver:RecordedDriver",
        "rtp": "smartcam.frames._streaming.rtp.driver:RtpDriver",
        "rtsp": "smartcam.frames._streaming.rtsp_client.driver:RtspDriver",
        "synthetic": "smartcam.frames._synthetic:SyntheticDriver",
        "v4l2": "smartcam.frames._v4l2.driver:V4L2Driver",
    },
    aliases={"fleet+tls": "fleet", "https": "http", "rtsps": "rtsp"},
)

TOOLS = Registry(
    "smartcam.tools",
    {
        "compare": "smartcam.inspection._compare:Compare",
        "locate": "smartcam.inspection._locate.tool:Locate",
        "measure": "smartcam.inspection._measure.tool:Measure",
        "present": "smartcam.inspection._present:Present",
        "read": "smartcam.inspection._read.tool:ReadTool",
    },
)

OUTLETS = Registry(
    "smartcam.outlets",
    {
        "mqtt": "smartcam.outlets._mqtt:MqttOutlet",
        "opcua": "smartcam.outlets._opcua.outlet:OpcUaOutlet",
        "sqlite": "smartcam.outlets._store:ResultStore",
    },
)
