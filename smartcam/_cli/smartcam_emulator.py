"""The ``smartcam-emulator`` command."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import click
from click.core import ParameterSource

import smartcam
from smartcam._cli.options import DIALECTS, OUTPUT_OPTIONS, Options, async_command
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.texts import emulator_data
from smartcam._cli.usage import JsonErrorCommand
from smartcam._extras import from_part
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from contextlib import AsyncExitStack

    from smartcam.emulator import Scenario, WireCamera
    from smartcam.inspection import SoftwareDevice

PROTOCOL = "bvs"
"""The default protocol of the emulated cameras."""

PAGE_APPLICATION = 7
"""The application that runs at once if there is a page and no scenario."""

_OPTION_NAMES = {
    "scenario": "scenario",
    "dialect": "--dialect",
    "transport": "--transport",
    "seed": "--seed",
    "web": "--web",
}
"""Options that not every emulated camera accepts, with their names in error texts."""


@click.command(
    "emulator", cls=JsonErrorCommand, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.argument("scenario", required=False, metavar="[SCENARIO.yaml]")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    help="Port; 0 takes a free one, a camera's own is 36701 (BVS) or 23 (In-Sight). Further "
    "cameras take the next ones. Default: the scenario's, else 0.",
)
@click.option(
    "--protocol",
    metavar="NAME",
    help="Protocol: a name in `smartcam protocols` that brings an emulated camera; "
    f"default: the scenario's, else {PROTOCOL}.",
)
@click.option(
    "--dialect",
    type=click.Choice(DIALECTS),
    help=f"Dialect; default: the scenario's, else {DIALECTS[0]}.",
)
@click.option(
    "--transport",
    type=click.Choice(("tcp", "udp")),
    help="Transport; default: the scenario's, else tcp.",
)
@click.option(
    "--cameras", type=click.IntRange(1, 10_000), default=1, show_default=True, help="How many."
)
@click.option(
    "--quirk",
    "quirks",
    multiple=True,
    metavar="NAME[=VALUE]",
    help="Choose a behaviour that the manuals leave open; NAME alone means NAME=true. Repeatable; "
    "overrides the scenario's.",
)
@click.option(
    "--seed",
    type=int,
    help="Seed of all random numbers; default: the scenario's, else 0.",
)
@click.option(
    "--program",
    type=click.Path(dir_okay=False),
    metavar="CELL.yaml",
    help="Serve the software cameras of a cell file instead: programs that inspect real pictures.",
)
@click.option("--schema", is_flag=True, help="Print the JSON Schema of scenario files, and end.")
@click.option(
    "--generators", is_flag=True, help="List the generators of applications' values, and end."
)
@page_options("Serve a page that shows and controls the cameras; its address goes to stderr.")
@async_command(*OUTPUT_OPTIONS, program="smartcam-emulator", interrupt_code=0, terminate_code=0)
@click.version_option(smartcam.__version__)
@click.pass_context
async def command(
    context: click.Context,
    /,
    scenario: str | None,
    host: str,
    port: int | None,
    protocol: str | None,
    dialect: str | None,
    transport: Literal["tcp", "udp"] | None,
    cameras: int,
    quirks: tuple[str, ...],
    seed: int | None,
    program: str | None,
    schema: bool,
    generators: bool,
    web: PageOptions,
    options: Options,
) -> None:
    """Emulate smart cameras, over real TCP or UDP, until Ctrl-C or SIGTERM.

    Prints one line per camera, its URL. Without a scenario there are the built-in applications:
    1 three strings, 3 mixed fields, 7 the tangram table's localizations, 9 a free-running counter,
    21 "Hello World". An In-Sight camera has the jobs 1 (constants), 7 (a counter of triggers) and
    9 (free-running), and is offline at first. With --web and without a scenario 7 runs at once.
    """
    if schema:
        import json

        from smartcam.emulator._inside import scenario_schema

        click.echo(json.dumps(scenario_schema(), indent=2))
        return
    if generators:
        _list_generators(options)
        return
    import asyncio
    from contextlib import AsyncExitStack

    from smartcam.emulator import WireCamera
    from smartcam.emulator._inside import emulated_class

    quirk_values = dict(map(_parse_quirk, quirks)) or None
    camera_options: dict[str, Any] = {
        "host": host,
        "dialect": dialect,
        "transport": transport,
        "quirks": quirk_values,
    }
    servers: list[WireCamera | SoftwareDevice]
    if program is not None:
        if scenario is not None or cameras > 1:
            raise click.UsageError(
                "--program has the cameras of its file: expected no scenario and no --cameras"
            )
        servers = [*_software_cameras(program, protocol or PROTOCOL, port, seed, camera_options)]
    else:
        plans = _load_scenarios(scenario, protocol, dialect, cameras, has_page=web.is_wanted)
        for plan in plans:
            _refuse_unsupported_options(context, plan)
        servers = [
            emulated_class(plan.protocol).from_scenario(
                plan,
                port=port + index if port else port,
                seed=None if seed is None else seed + index,
                **camera_options,
            )
            for index, plan in enumerate(plans)
        ]
    async with AsyncExitStack() as stack:
        for server in servers:
            await stack.enter_async_context(server)
        emulators = [
            server if isinstance(server, WireCamera) else server.emulator for server in servers
        ]
        address = await _open_page(web, stack, emulators)
        show_name = scenario is not None or program is not None
        for emulator in emulators:
            _show_camera(emulator, options, show_name=show_name, page=address)
        await asyncio.Event().wait()


emulator = command
"""The command as ``smartcam emulator``."""


def _list_generators(options: Options) -> None:
    """Print a line for each generator; a broken plug-in affects only its own line."""
    from smartcam.emulator._inside import find_generator
    from smartcam.registry import GENERATORS

    for info in GENERATORS.available():
        try:
            about = (find_generator(info.name).__doc__ or "").partition("\n")[0]
        except ConfigurationError as exc:
            about = f"broken: {exc}"
        value = {"name": info.name, "origin": info.origin, "about": about}
        options.show(value, f"{info.name} ({info.origin}): {about}")


async def _open_page(
    web: PageOptions, stack: AsyncExitStack, cameras: Iterable[WireCamera]
) -> str | None:
    """Serve the page until the stack ends, print its address to stderr and return it."""
    if not web.is_wanted:
        return None
    from smartcam.web import EmulatorSite

    site = EmulatorSite({camera.name: camera for camera in cameras}, **web.site_arguments)
    await stack.enter_async_context(site)
    click.echo(f"page: {site.url}", err=True)
    return site.url


def _software_cameras(
    path: str, protocol: str, port: int | None, seed: int | None, camera_options: dict[str, Any]
) -> Iterator[SoftwareDevice]:
    """Yield the software cameras of a cell file.

    Raises ConfigurationError: the file is wrong, or an option does not fit a camera.
    """
    with from_part("inspection", "--program needs"):
        from smartcam.inspection import SoftwareDevice, load_cell
    for index, camera in enumerate(load_cell(path).values()):
        yield SoftwareDevice(
            camera,
            protocol=protocol,
            port=port + index if port else 0,
            seed=None if seed is None else seed + index,
            **camera_options,
        )


def _load_scenarios(
    path: str | None,
    protocol: str | None,
    dialect: str | None,
    camera_count: int,
    *,
    has_page: bool,
) -> tuple[Scenario, ...]:
    """Return a scenario for each camera.

    Raises ConfigurationError: the file is wrong, or ``camera_count`` multiplies several cameras;
    MissingExtraError: PyYAML is not installed.
    """
    from smartcam.emulator._inside import load_scenarios

    default_scenario = _default_scenario(protocol or PROTOCOL, has_page=has_page)
    loaded = (default_scenario,) if path is None else load_scenarios(path, dialect=dialect)
    for plan in loaded:
        if protocol not in {None, plan.protocol}:
            raise ConfigurationError(
                f"--protocol {protocol}: the scenario {path} has a camera of {plan.protocol}"
            )
    if camera_count == 1:
        return loaded
    first, *others = loaded
    if others:
        raise ConfigurationError(
            f"--cameras {camera_count}: the scenario {path} has {len(loaded)} cameras already"
        )
    return tuple(
        first.model_copy(update={"name": f"camera{index + 1}", "seed": first.seed + index})
        for index in range(camera_count)
    )


def _default_scenario(protocol: str, *, has_page: bool) -> Scenario:
    """Return the scenario for no file; with a page, an application runs if that is possible."""
    from smartcam.emulator import Scenario
    from smartcam.emulator._inside import emulated_class

    camera_class = emulated_class(protocol)
    running_scenario = Scenario(protocol=protocol, active=PAGE_APPLICATION, running=True)
    idle_scenario = Scenario(protocol=protocol)
    if not has_page or not camera_class.state_options(PAGE_APPLICATION, running=True):
        return idle_scenario
    return running_scenario if camera_class.mistake(running_scenario) is None else idle_scenario


def _parse_quirk(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        return name, True
    from smartcam.layout._inside import BadYamlError, load

    try:
        return name, load(value, label="--quirk NAME=VALUE")
    except BadYamlError as exc:
        raise ConfigurationError(f"--quirk {text:.200}: {exc}") from exc


def _refuse_unsupported_options(context: click.Context, plan: Scenario) -> None:
    """Raise a usage error for an option that a camera of this protocol does not take."""
    from smartcam.emulator._inside import emulated_class

    takes = emulated_class(plan.protocol).accepted_options
    for name, text in _OPTION_NAMES.items():
        is_given = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        if is_given and name not in takes:
            supported = ", ".join(text for name, text in _OPTION_NAMES.items() if name in takes)
            raise click.UsageError(
                f"--protocol {plan.protocol} takes no {text}; it takes {supported}"
            )


def _show_camera(
    emulator: WireCamera, options: Options, *, show_name: bool, page: str | None
) -> None:
    value = emulator_data(emulator)
    if show_name or page is not None:
        value["name"] = emulator.name
    if page is not None:
        value["web"] = page
    if emulator.is_random:
        value["seed"] = emulator.seed
        click.echo(f"{emulator.name}: random numbers have the seed {emulator.seed}", err=True)
    options.show(value, emulator.url)
