"""``smartcam dissector``: the Wireshark dissector."""

from __future__ import annotations

from pathlib import Path

import click

from smartcam.cli.running import run
from smartcam.dissector import lua_source
from smartcam.exceptions import ConfigurationError

__all__ = ["dissector"]


@click.command()
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False), help="Write it to this file instead."
)
@click.option("--debug", is_flag=True, help="Show tracebacks, on stderr.")
def dissector(output: str | None, *, debug: bool) -> None:
    """Print the Wireshark dissector: one Lua file for every dialect of bvs.

    Put it into Wireshark's folder for personal Lua plugins, or use it once with
    -X lua_script:FILE.
    """
    run(_give(output), program="smartcam", debug=debug)


async def _give(output: str | None) -> None:
    if output is None:
        click.echo(lua_source(), nl=False)
    else:
        _write(Path(output))


def _write(path: Path) -> None:
    try:
        path.write_text(lua_source(), encoding="ascii")
    except OSError as exc:
        raise ConfigurationError(f"--output {path}: {exc.strerror}") from exc
