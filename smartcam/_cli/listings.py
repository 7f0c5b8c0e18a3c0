"""``smartcam protocols`` and ``interpreters``: list them, including plug-ins."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam._cli.texts import table_text
from smartcam.exceptions import PluginError, SmartCamError

if TYPE_CHECKING:
    from smartcam.registry import PluginInfo


@click.command()
@async_command(*OUTPUT_OPTIONS)
async def protocols(options: Options) -> None:
    """List the protocols and their dialects."""
    from smartcam.registry import PROTOCOLS

    for info in PROTOCOLS.available():
        try:
            value, text = _describe_protocol(info)
        except Exception as exc:  # noqa: BLE001 - a broken plug-in affects only its own line
            value, text = _describe_broken(info, exc)
        options.show(value, text)


def _describe_protocol(info: PluginInfo) -> tuple[object, str]:
    """Describe a protocol, as JSON and as text."""
    from smartcam.protocols._inside import load_protocol

    protocol = load_protocol(info.name)
    value = {
        "name": protocol.name,
        "origin": info.origin,
        "schemes": list(protocol.schemes),
        "default_port": protocol.default_port,
        "models": list(protocol.models),
        "dialects": [
            {"name": d.name, "about": d.about, "source": d.source}
            for d in protocol.dialects.values()
        ],
        "parameters": protocol.parameters,
    }
    rows = [(d.name, d.about) for d in protocol.dialects.values()]
    head = (
        f"{info.name} ({info.origin}): {', '.join(f'{s}://' for s in protocol.schemes)}, "
        f"port {protocol.default_port}, models {', '.join(protocol.models)}\n"
    )
    return value, head + table_text(("dialect", ""), rows)


def _describe_broken(info: PluginInfo, exc: Exception) -> tuple[object, str]:
    """Describe a plug-in that cannot be used."""
    reason = str(exc) if isinstance(exc, SmartCamError) else repr(exc)
    value = {**info._asdict(), "error": reason}
    return value, f"{info.name}  ({info.origin}: {info.target}) cannot be used: {reason}"


@click.command()
@async_command(*OUTPUT_OPTIONS)
async def interpreters(options: Options) -> None:
    """List the interpreters that --interpret-as knows."""
    from smartcam.registry import INTERPRETERS

    for info in INTERPRETERS.available():
        options.show(*_describe_interpreter(info))


def _describe_interpreter(info: PluginInfo) -> tuple[object, str]:
    """Describe an interpreter, as JSON and as text."""
    from smartcam.interpreters import resolve
    from smartcam.registry import INTERPRETERS

    about = ""
    try:
        about = _first_line(INTERPRETERS.load(info.name))
        resolve(info.name)
    except PluginError as exc:
        return _describe_broken(info, exc)
    except SmartCamError:
        pass  # it can be used, with a layout as its argument
    origin_text = "" if info.origin == "built-in" else f" ({info.origin}: {info.target})"
    return {**info._asdict(), "about": about}, f"{info.name:14} {about}{origin_text}"


def _first_line(loaded: object) -> str:
    """Return the first line of a plug-in's docstring, without its markup."""
    import inspect
    import re

    lines = (inspect.getdoc(loaded) or "").splitlines()
    return re.sub(r":[a-z]+:`~?(?:[\w.]*\.)?(\w+)`|`+", r"\1", lines[0]) if lines else ""
