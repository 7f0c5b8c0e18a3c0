"""``smartcam fleet certificates``: make certificates with the roles of a fleet."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam._cli.texts import table_text
from smartcam._cli.usage import JsonErrorCommand

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.fleet._inside import MadeCertificate
F = TypeVar("F", bound="Callable[..., Any]")


def _names_option(option: str, variable: str, text: str) -> Callable[[F], F]:
    """Declare an option that can be given any number of times, each time with a name."""
    return click.option(option, variable, multiple=True, metavar="NAME", help=text)


@click.command(
    cls=JsonErrorCommand,
    help="Make certificates for a fleet over TLS, each with a role: agents share cameras, viewers "
    "read, operators also command, and Zenoh routers forward. DIR gets an authority "
    "the first time, with its key, and a folder for each name, with instructions for its "
    "use. Run it again to add names, and to renew certificates that end within 30 days; the "
    'rest stays. Needs the extra "fleet".',
)
@click.argument("folder", metavar="DIR", type=click.Path(file_okay=False, path_type=Path))
@_names_option("--agent", "agents", "An agent, by its name in fleet.yaml.")
@_names_option("--viewer", "viewers", "A program that may read.")
@_names_option("--operator", "operators", "A program that may command, too.")
@_names_option("--router", "routers", "A Zenoh router, zenohd.")
@click.option(
    "--host",
    "hosts",
    multiple=True,
    metavar="HOST",
    help="Name or address by which programs reach these agents and routers; default: this "
    "computer's name. localhost is always one.",
)
@click.option(
    "--days",
    type=click.FloatRange(min=0, min_open=True, max=36_500),
    default=365.0,
    show_default=True,
    help="Days that new certificates are valid.",
)
@async_command(*OUTPUT_OPTIONS)
async def certificates(
    folder: Path,
    agents: tuple[str, ...],
    viewers: tuple[str, ...],
    operators: tuple[str, ...],
    routers: tuple[str, ...],
    hosts: tuple[str, ...],
    days: float,
    options: Options,
) -> None:
    """Make certificates."""
    from smartcam.fleet._inside import make_certificates

    names_by_role = {"agent": agents, "viewer": viewers, "operator": operators, "router": routers}
    made_certificates = await asyncio.to_thread(
        make_certificates, folder, names_by_role, hosts=hosts, lifetime=timedelta(days=days)
    )
    if options.as_json:
        for certificate in made_certificates:
            options.show(certificate._asdict(), "")
        return
    if not made_certificates:
        click.echo(f"{folder} has an authority, and no certificates yet: --agent, --viewer, ...")
        return
    head = ("name", "role", "", "until", "how to use it")
    click.echo(
        table_text(head, [_certificate_row(certificate) for certificate in made_certificates])
    )


def _certificate_row(certificate: MadeCertificate) -> tuple[str, ...]:
    end_text = (
        f"{certificate.expires_at:%Y-%m-%d}"
        if certificate.expires_at - datetime.now(UTC) > timedelta(days=2)
        else (f"{certificate.expires_at:%Y-%m-%d %H:%M} UTC")
    )
    return (
        certificate.name,
        certificate.role,
        certificate.done,
        end_text,
        f"{certificate.folder}/how-to-use.txt",
    )
