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
def importing() -> Iterator[None]:
    """End the program after Ctrl-C during an import as it would end later."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def error_json(error: Exception, text: str, code: int, **more: str) -> str:
    """Return an error as JSON: its class, its text, the exit code, and its public attributes.

    ``more``: fields to put first.
    """
    attributes = {name: value for name, value in vars(error).items() if not name.startswith("_")}
    if isinstance(error, click.ClickException):
        attributes = {}  # click's own, with its context
    import json

    from smartcam.models import jsonable

    value = {**more, "error": type(error).__name__, "text": text, "exit_code": code, **attributes}
    return json.dumps(jsonable(value))


class JsonErrors(click.Command):
    """A command that reports wrong usage as JSON if ``--json`` is given."""

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **extra: Any,
    ) -> click.Context:
        """Parse."""
        with _reported_as_json("--json" in args):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run."""
        with _reported_as_json("--json" in ctx.args or bool(ctx.params.get("as_json"))):
            return super().invoke(ctx)


class ListedGroup(JsonErrors, click.Group):
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

            end = did_you_mean(args[0], self.list_commands(ctx)) or "."
            ctx.fail(f"No such command {args[0]!r}{end}")
        return super().resolve_command(ctx, args)


MAX_SUMMARY_CHARACTERS = 400
"""Largest number of characters of a command's first sentence that a list shows."""


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
def _reported_as_json(wanted: bool) -> Iterator[None]:
    try:
        with _options_suggested(), _numbers_explained():
            yield
    except click.ClickException as exc:
        if not wanted:
            raise
        sys.stderr.write(error_json(exc, exc.format_message(), exc.exit_code) + "\n")
        raise click.exceptions.Exit(exc.exit_code) from exc


_KINDS = {
    "integer": "a whole number",
    "integer range": "a whole number",
    "float": "a number",
    "float range": "a number",
}
"""Words for the kind of an option's value, by click's names."""


@contextlib.contextmanager
def _numbers_explained() -> Iterator[None]:
    """Explain in words, in the error for a wrong value, that a number is expected."""
    try:
        yield
    except click.BadParameter as exc:
        given, matched, kind = exc.message.partition(" is not a valid ")
        words = _KINDS.get(kind.rstrip(".")) if matched else None
        if words is not None:
            point = given.strip("'").replace(",", ".")
            end = f"; did you mean {point}?" if _is_number(point) else "."
            text = f"{given} is not {words}{end}"
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
def _options_suggested() -> Iterator[None]:
    """Suggest the option that was probably meant, in the error for an unknown one."""
    try:
        yield
    except click.NoSuchOption as exc:
        if exc.ctx is None:
            raise
        from smartcam._suggestions import did_you_mean

        params = exc.ctx.command.params
        known = [name for each in params for name in (*each.opts, *each.secondary_opts)]
        names = [name for name in known if name.startswith("--")]
        end = did_you_mean(exc.option_name, names) or "."
        text = f"No such option {exc.option_name!r}{end}"
        raise click.NoSuchOption(exc.option_name, text, ctx=exc.ctx) from exc
