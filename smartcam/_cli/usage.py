"""A wrong use of a command, and what may go wrong before it runs."""

from __future__ import annotations

import contextlib
import sys
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Iterator

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """End the program as Ctrl-C ends it later, where it comes while something is imported."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def error_json(error: Exception, text: str, code: int, **more: str) -> str:
    """Return an error as JSON: its class, its text, the exit code, and its public attributes.

    ``more``: what stands in front.
    """
    said = {name: value for name, value in vars(error).items() if not name.startswith("_")}
    if isinstance(error, click.ClickException):
        said = {}  # click's own, with its context
    import json

    from smartcam.models import jsonable

    value = {**more, "error": type(error).__name__, "text": text, "exit_code": code, **said}
    return json.dumps(jsonable(value))


class JsonErrors(click.Command):
    """A command that tells a wrong use as JSON where ``--json`` is given."""

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """Parse."""
        with _told_as_json("--json" in args):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run."""
        with _told_as_json("--json" in ctx.args or bool(ctx.params.get("as_json"))):
            return super().invoke(ctx)


@contextlib.contextmanager
def _told_as_json(wanted: bool) -> Iterator[None]:
    try:
        yield
    except click.ClickException as exc:
        if not wanted:
            raise
        sys.stderr.write(error_json(exc, exc.format_message(), exc.exit_code) + "\n")
        raise click.exceptions.Exit(exc.exit_code) from exc
