"""Find the class of a protocol's emulated cameras; a plug-in's protocol has its own."""

from __future__ import annotations

import importlib
import inspect
from typing import TYPE_CHECKING

from smartcam._suggestions import did_you_mean
from smartcam.emulator._wire_camera import WireCamera
from smartcam.exceptions import ConfigurationError, PluginError, UnsupportedError
from smartcam.protocols._inside import load_protocol
from smartcam.registry import PROTOCOLS

if TYPE_CHECKING:
    from collections.abc import Iterable


def emulated_class(protocol: str) -> type[WireCamera]:
    """Return the class of a protocol's emulated cameras.

    Raises:
        PluginError: the protocol is unknown or broken, or its class is.
        UnsupportedError: the protocol has no emulated camera.
    """
    target = load_protocol(protocol).emulator
    if not target:
        raise UnsupportedError(
            f"protocol {protocol!r} brings no emulated camera; those that do: "
            f"{', '.join(_with_emulator())}"
        )
    module, _, attribute = target.partition(":")
    try:
        camera_class: object = getattr(importlib.import_module(module), attribute)
    except Exception as exc:
        raise PluginError(
            f"protocol {protocol!r}: its emulated camera {target!r} failed to load: {exc!r}",
            name=protocol,
        ) from exc
    if not (isinstance(camera_class, type) and issubclass(camera_class, WireCamera)):
        raise PluginError(
            f"protocol {protocol!r}: {target!r} is {camera_class!r}, no class of emulated cameras",
            name=protocol,
        )
    return camera_class


def _with_emulator() -> list[str]:
    """Return the protocols that have an emulated camera; broken plug-ins are left out."""
    names: list[str] = []
    for info in PROTOCOLS.available():
        try:
            names += [info.name] if load_protocol(info.name).emulator else []
        except ConfigurationError:
            continue
    return names


def check_options(kind: type[WireCamera], given: Iterable[str]) -> None:
    """Refuse options that a class of emulated cameras does not take.

    Raises:
        ConfigurationError: an option is unknown; the text names the known ones.
    """
    known = options_of(kind)
    for name in given:
        if name not in known:
            raise ConfigurationError(
                f"{kind.__name__} has no option {name!r}; it has {', '.join(sorted(known))}"
                f"{did_you_mean(name, known)}"
            )


def options_of(kind: type[WireCamera]) -> frozenset[str]:
    """Return the names of the options of a class of emulated cameras."""
    names: set[str] = set()
    for class_ in kind.__mro__:
        if class_ is WireCamera:
            break
        if "__init__" in vars(class_):
            parameters = inspect.signature(vars(class_)["__init__"]).parameters.values()
            names.update(p.name for p in parameters if p.kind is not p.VAR_KEYWORD)
    return frozenset(names - {"self"})
