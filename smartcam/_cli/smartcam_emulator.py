"""The ``smartcam-emulator`` command."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any, Literal

import click
from click.core import ParameterSource

import smartcam
from smartcam._cli.options import OUTPUT, Options, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import JsonErrors
from smartcam._cli.texts import camera_value
from smartcam.emulator import EmulatedCamera, Scenario, load_scenarios, scenario_schema
from smartcam.emulator._insight.camera import EmulatedInSight
from smartcam.emulator._insight.job import BUILTIN_JOBS
from smartcam.exceptions import ConfigurationError
from smartcam.layout._yamls import BadYamlError, load
from smartcam.protocols._bvs import BVS
from smartcam.protocols._insight.dialect import INSIGHT

if TYPE_CHECKING:
    from collections.abc import Iterable

DIALECTS = tuple(BVS.dialects)
PROTOCOLS = (BVS.name, INSIGHT.name)


@click.command(cls=JsonErrors, context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("scenario", required=False, metavar="[SCENARIO.yaml]")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    help="Port; 0 takes a free one, a camera's own is 36701 (BVS) or 23 (In-Sight). Further "
    "cameras take the next ones. Default what the scenario says, else 0.",
)
@click.option(
    "--protocol",
    type=click.Choice(PROTOCOLS),
    default=PROTOCOLS[0],
    show_default=True,
    help="Whose cameras; insight takes no scenario, --dialect or --transport.",
)
@click.option(
    "--dialect",
    type=click.Choice(DIALECTS),
    help=f"Speak; default what the scenario says, else {DIALECTS[0]}.",
)
@click.option(
    "--transport",
    type=click.Choice(("tcp", "udp")),
    help="Over; default what the scenario says, else tcp.",
)
@click.option(
    "--cameras", type=click.IntRange(1, 10_000), default=1, show_default=True, help="How many."
)
@click.option(
    "--quirk",
    "quirks",
    multiple=True,
    metavar="NAME[=VALUE]",
    help="Choose what is not known of real cameras; without a value it is on. Repeatable; goes "
    "before the scenario's.",
)
@click.option(
    "--seed",
    type=int,
    help="Of all that is left to chance; default what the scenario says, else 0.",
)
@click.option("--schema", is_flag=True, help="Print the JSON Schema of scenario files, and end.")
@page_options("Serve a page that shows and controls the cameras; its address goes to stderr.")
@runs(*OUTPUT, program="smartcam-emulator", interrupted=0, terminated=0)
@click.version_option(smartcam.__version__)
@click.pass_context
async def command(
    context: click.Context,
    /,
    scenario: str | None,
    host: str,
    port: int | None,
    protocol: str,
    dialect: str | None,
    transport: Literal["tcp", "udp"] | None,
    cameras: int,
    quirks: tuple[str, ...],
    seed: int | None,
    schema: bool,
    web: PageOptions,
    options: Options,
) -> None:
    """Emulate smart cameras, over real TCP or UDP, until Ctrl-C or SIGTERM.

    Prints one line per camera, its URL. Without a scenario there are the built-in applications:
    1 three strings, 3 mixed fields, 7 the tangram table's localizations, 9 a free-running counter,
    21 "Hello World". An In-Sight camera has the jobs 1 (constants), 7 (a counter of triggers) and
    9 (free-running), and is offline at first.
    """
    if schema:
        click.echo(json.dumps(scenario_schema(), indent=2))
        return
    in_sight = protocol == INSIGHT.name
    if in_sight:
        _refuse_what_does_not_fit(context)

    emulators: list[EmulatedCamera] | list[EmulatedInSight]
    if in_sight:
        chosen = _quirks(None, quirks)
        emulators = [
            EmulatedInSight(
                BUILTIN_JOBS,
                host=host,
                port=port + index if port else 0,
                quirks=chosen,
                name=f"camera{index + 1}",
            )
            for index in range(cameras)
        ]
    else:
        emulators = [
            EmulatedCamera(
                scenario=plan,
                host=host,
                port=port + index if port else port,
                dialect=dialect,
                transport=transport,
                quirks=_quirks(plan, quirks),
                seed=None if seed is None else seed + index,
            )
            for index, plan in enumerate(_scenarios(scenario, dialect, cameras))
        ]
    async with contextlib.AsyncExitStack() as stack:
        for emulator in emulators:
            await stack.enter_async_context(emulator)
        shown = [one for one in emulators if isinstance(one, EmulatedCamera)]
        address = await _open_page(web, stack, shown)
        for emulator in emulators:
            _announce(emulator, options, named=scenario is not None, page=address)
        await asyncio.Event().wait()


async def _open_page(
    web: PageOptions, stack: contextlib.AsyncExitStack, cameras: Iterable[EmulatedCamera]
) -> str | None:
    """Serve the page until the stack ends, print its address to stderr and return it."""
    if not web.wanted:
        return None
    from smartcam.web import EmulatorSite

    site = EmulatorSite({camera.name: camera for camera in cameras}, **web.place)
    await stack.enter_async_context(site)
    click.echo(f"page: {site.url}", err=True)
    return site.url


def _scenarios(path: str | None, dialect: str | None, copies: int) -> tuple[Scenario, ...]:
    """Return a scenario for each camera.

    Raises ConfigurationError: the file is wrong, or copies are wanted of several cameras;
    MissingExtraError: PyYAML is not installed.
    """
    loaded = (Scenario(),) if path is None else load_scenarios(path, dialect=dialect)
    if copies == 1:
        return loaded
    one, *others = loaded
    if others:
        raise ConfigurationError(
            f"--cameras {copies}: the scenario {path} has {len(loaded)} cameras already"
        )
    return tuple(
        one.model_copy(update={"name": f"camera{index + 1}", "seed": one.seed + index})
        for index in range(copies)
    )


def _quirks(scenario: Scenario | None, given: Iterable[str]) -> dict[str, Any] | None:
    """Return the quirks that were given, with those of the scenario behind them; None for none.

    Raises ConfigurationError: a value is no YAML; MissingExtraError: PyYAML is not installed.
    """
    options = dict(_quirk(text) for text in given)
    if not options:
        return None
    before = {} if scenario is None else scenario.quirks.model_dump(exclude_unset=True)
    return {**before, **options}


def _quirk(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals:
        return name, True
    try:
        return name, load(value, what="--quirk NAME=VALUE")
    except BadYamlError as exc:
        raise ConfigurationError(f"--quirk {text:.200}: {exc}") from exc


def _refuse_what_does_not_fit(context: click.Context) -> None:
    """Refuse what was said for the cameras of another protocol; click.UsageError names it."""
    said = {
        "scenario": "scenario",
        "dialect": "--dialect",
        "transport": "--transport",
        "seed": "--seed",
        "web": "--web",
    }
    for name, text in said.items():
        if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--protocol {INSIGHT.name} takes no {text}")


def _announce(
    emulator: EmulatedCamera | EmulatedInSight,
    options: Options,
    *,
    named: bool,
    page: str | None,
) -> None:
    if isinstance(emulator, EmulatedInSight):
        transport, dialect = INSIGHT.schemes["insight"].value, next(iter(INSIGHT.dialects))
        ids = [job.id for job in emulator.device.jobs.values() if job.id is not None]
    else:
        transport, dialect = emulator.transport, emulator.dialect
        ids = list(emulator.device.applications)
    value = camera_value(emulator, transport, dialect, ids)
    if named or page is not None:
        value["name"] = emulator.name
    if page is not None:
        value["web"] = page
    if isinstance(emulator, EmulatedCamera) and emulator.scenario.is_random:
        value["seed"] = emulator.seed
        click.echo(
            f"{emulator.name}: what is left to chance has the seed {emulator.seed}", err=True
        )
    options.show(value, emulator.url)
