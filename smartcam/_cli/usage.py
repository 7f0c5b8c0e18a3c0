"""Handle wrong usage of a command, and errors before it runs."""

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
def exiting_on_interrupt() -> Iterator[None]:
    """Exit with the code for Ctrl-C if Ctrl-C is pressed during an import in the block."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def error_json(error: Exception, text: str, code: int, **more: str) -> str:
    """Return an error as JSON: its class, its text, the exit code, and its public attributes.

    ``more``: fields that come before these in the object.
    """
    attributes = {name: value for name, value in vars(error).items() if not name.startswith("_")}
    if isinstance(error, click.ClickException):
        attributes = {}  # they are click's own, such as its context
    import json

    from smartcam.models import jsonable

    value = {**more, "error": type(error).__name__, "text": text, "exit_code": code, **attributes}
    return json.dumps(jsonable(value))


class JsonErrorCommand(click.Command):
    """A command that reports wrong usage as JSON if ``--json`` is given."""

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """Parse the arguments."""
        with _reporting_as_json("--json" in args):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        with _reporting_as_json("--json" in ctx.args or bool(ctx.params.get("as_json"))):
            return super().invoke(ctx)


class ListedGroup(JsonErrorCommand, click.Group):
    """A group of commands, which are listed with their whole summaries."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list."""
        write_commands(self, ctx, formatter)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command of that name; a usage error suggests one."""
        if args and not args[0].startswith("-") and self.get_command(ctx, args[0]) is None:
            from smartcam._suggestions import did_you_mean

            hint = did_you_mean(args[0], self.list_commands(ctx)) or "."
            ctx.fail(f"No such command {args[0]!r}{hint}")
        return super().resolve_command(ctx, args)


MAX_SUMMARY_CHARACTERS = 400
"""Largest number of characters of a command's first sentence in a list of commands."""


def write_commands(group: click.Group, ctx: click.Context, formatter: click.HelpFormatter) -> None:
    """Write the commands of a group with their whole summaries, without hidden ones."""
    commands = [(name, group.commands[name]) for name in group.list_commands(ctx)]
    rows = [
        (name, command.get_short_help_str(MAX_SUMMARY_CHARACTERS))
        for name, command in commands
        if not command.hidden
    ]
    with formatter.section("Commands"):
        formatter.write_dl(rows)


@contextlib.contextmanager
def _reporting_as_json(as_json: bool) -> Iterator[None]:
    """Improve the texts of wrong usage, and print them as JSON if ``as_json``."""
    try:
        with _suggesting_options(), _explaining_numbers():
            yield
    except click.ClickException as exc:
        if not as_json:
            raise
        sys.stderr.write(error_json(exc, exc.format_message(), exc.exit_code) + "\n")
        raise click.exceptions.Exit(exc.exit_code) from exc


_TYPE_TEXTS = {
    "integer": "a whole number",
    "integer range": "a whole number",
    "float": "a number",
    "float range": "a number",
}
"""Words for the type of an option's value, by click's name of the type."""


@contextlib.contextmanager
def _explaining_numbers() -> Iterator[None]:
    """Say in the error for a wrong value that a number is expected."""
    try:
        yield
    except click.BadParameter as exc:
        value, separator, type_name = exc.message.partition(" is not a valid ")
        words = _TYPE_TEXTS.get(type_name.rstrip(".")) if separator else None
        if words is not None:
            with_point = value.strip("'").replace(",", ".")
            hint = f"; did you mean {with_point}?" if _is_number(with_point) else "."
            text = f"{value} is not {words}{hint}"
            raise click.BadParameter(
                text, ctx=exc.ctx, param=exc.param, param_hint=exc.param_hint
            ) from exc
        raise


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def _suggesting_options() -> Iterator[None]:
    """Name a similar option in the error for an unknown option."""
    try:
        yield
    except click.NoSuchOption as exc:
        if exc.ctx is None:
            raise
        from smartcam._suggestions import did_you_mean

        params = exc.ctx.command.params
        all_names = [name for each in params for name in (*each.opts, *each.secondary_opts)]
        names = [name for name in all_names if name.startswith("--")]
        hint = did_you_mean(exc.option_name, names) or "."
        text = f"No such option {exc.option_name!r}{hint}"
        raise click.NoSuchOption(exc.option_name, text, ctx=exc.ctx) from exc
