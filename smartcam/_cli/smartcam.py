"""The ``smartcam`` command: a table of its commands, with their modules.

The module of a command is imported when the command is used. The table also has the commands'
summaries, so that ``--help`` imports no module.
"""

from __future__ import annotations

import importlib
from collections.abc import MutableMapping
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import click

import smartcam
from smartcam._cli.usage import ListedGroup, exiting_on_interrupt

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from types import ModuleType

    from click.shell_completion import CompletionItem

EPILOG = (
    "Exit codes: 0 done; 1 an error of the system, or a fault of smartcam; 2 wrong usage, or a bad "
    "layout text; 3 no session: nothing listens, silence or garbage, connection lost, no such "
    "source of frames; 4 a wait in a session, or for a frame, ran out; 5 the camera refused, is "
    "not running or lacks the pixel format; 6 a result is not interpretable; 7 a calibration that "
    "was checked is stale, or two differ."
)


class ListedCommand(NamedTuple):
    """A command in the table.

    Attributes:
        module: module of this package that has a function with the command's name.
        summary: the first sentence of its help.
        extra: the extra that brings the module, "" if smartcam alone has it.
    """

    module: str
    summary: str
    extra: str = ""


TOPICS: Mapping[str, Mapping[str, ListedCommand]] = {
    "A camera": {
        "trigger": ListedCommand("camera", "Trigger and print the result."),
        "watch": ListedCommand(
            "camera",
            "Print results as they come, until Ctrl-C, --count or --seconds.",
        ),
        "live": ListedCommand(
            "live",
            "Serve a page of a camera until Ctrl-C: results as they come, status, counts.",
        ),
        "image": ListedCommand(
            "image",
            "Write a camera's last picture to a file, as the camera sends it (In-Sight: a "
            "bitmap), if its protocol has a request for it.",
        ),
        "status": ListedCommand("camera", "Show a camera's status; changes nothing on it."),
        "start": ListedCommand("camera", "Enter run mode; returns when the camera is ready."),
        "stop": ListedCommand("camera", "Leave run mode; returns when the camera has stopped."),
        "outlet": ListedCommand(
            "outlet",
            "Bring a camera's results to brokers and databases, as a YAML file says, until Ctrl-C.",
            extra="mqtt",
        ),
        "results": ListedCommand(
            "results",
            "Show the results in a store: those of a shift, those that failed.",
            extra="mqtt",
        ),
        "switch": ListedCommand(
            "camera",
            "Load another application by its id, or by its file's name if the camera can do "
            "that; returns when the camera is ready.",
        ),
    },
    "A fleet": {
        "serve": ListedCommand(
            "serve",
            "Connect to the cameras of a fleet file, and share them with any number of programs, "
            "until Ctrl-C or SIGTERM.",
            extra="fleet",
        ),
        "fleet": ListedCommand(
            "fleet", "Show and use the cameras of a fleet together.", extra="fleet"
        ),
        "ros2": ListedCommand(
            "ros2",
            "Show cameras in ROS 2, as nodes for programs that use rmw_zenoh, until Ctrl-C or "
            "SIGTERM; with --rmw native through the installed rclpy, over any middleware, and "
            "options after --ros-args are those of ROS then.",
            extra="ros2",
        ),
        "ros1": ListedCommand(
            "ros1",
            "Show cameras in ROS 1, over a rosbridge, until Ctrl-C or SIGTERM: the topics and "
            'services of "smartcam ros2", without those that ROS 1 cannot have.',
            extra="ros2",
        ),
    },
    "Pictures": {
        "frames": ListedCommand("frames", "Pictures of any camera.", extra="frames"),
        "teach": ListedCommand(
            "teach",
            "Teach an application of a software camera, on a page or by options: draw regions, "
            "choose tools, see what they find, set tolerances, save.",
            extra="inspection",
        ),
        "inspect": ListedCommand(
            "inspect",
            "Try an application of a software camera on pictures, and draw its findings.",
            extra="inspection",
        ),
        "depth": ListedCommand(
            "depth",
            "Clouds of points, as .ply and .pcd files: shown on a page, filtered, converted.",
            extra="depth",
        ),
    },
    "Finding out": {
        "find": ListedCommand(
            "find",
            "Find cameras in networks: opens the protocols' ports, sends nothing, and shows "
            "greetings.",
        ),
        "doctor": ListedCommand(
            "doctor",
            "Report each problem with its cure, in plain words: name, session, status, "
            "application, round trip, run state, results, clock.",
        ),
        "probe": ListedCommand("probe", "Find out how the camera at HOST or URL speaks."),
        "protocols": ListedCommand("listings", "List the protocols and their dialects."),
        "interpreters": ListedCommand(
            "listings", "List the interpreters that --interpret-as knows."
        ),
        "decode": ListedCommand(
            "decode",
            "Decode DATA: hex, the name of a file (binary, hex or a dump of it), or - for standard "
            "input.",
        ),
    },
    "A robot": {
        "calibrate": ListedCommand(
            "calibrate",
            "Calibrate a camera against a robot: where its localizations lie in the robot's space.",
            extra="calibration",
        ),
        "gateway": ListedCommand(
            "gateway",
            "Answer robots and PLCs that ask for parts, line by line over TCP, until Ctrl-C.",
            extra="calibration",
        ),
        "sheet": ListedCommand(
            "sheet",
            "Make a sheet to print: a target in true size, rays A and B from its origin, rulers.",
            extra="calibration",
        ),
    },
    "Recordings": {
        "record": ListedCommand(
            "record",
            "Record into an MCAP file all that a camera sends, until Ctrl-C, --count or "
            "--seconds: frames, results, events, errors; for a fleet's camera the results of all "
            "programs' triggers, but no frames.",
        ),
        "replay": ListedCommand(
            "record",
            "Emulate the recorded cameras: each trigger gets the recorded containers, byte for "
            "byte and after the same time, and unasked messages come again.",
        ),
        "pcap": ListedCommand(
            "record",
            "Write a recording's frames as packets for Wireshark: Ethernet, IP, TCP or UDP, with "
            "the recorded times.",
        ),
        "bag": ListedCommand(
            "record",
            "Make a rosbag2 of a recording: an MCAP file with ROS 2 messages in a folder, in the "
            "recorded order and with the recorded times.",
        ),
        "dissector": ListedCommand(
            "dissector",
            "Print the Wireshark dissector: one Lua file for every dialect of bvs.",
        ),
    },
    "Without a camera": {
        "emulator": ListedCommand(
            "smartcam_emulator",
            "Emulate smart cameras, over real TCP or UDP, until Ctrl-C or SIGTERM.",
        ),
        "demo": ListedCommand(
            "demos",
            "Show smartcam's main job with an emulated camera over real TCP.",
        ),
    },
}
"""Commands by topic, in the order of ``--help``."""

LISTED = {name: listed for commands in TOPICS.values() for name, listed in commands.items()}
"""All commands by name."""

ALIASES = {"emulate": "emulator"}
"""Other names of commands, which ``--help`` does not show."""


class CommandTable(MutableMapping[str, click.Command]):
    """The commands by name; a command is imported when it is first looked up.

    Args:
        listed: modules and summaries of the commands.
    """

    def __init__(self, listed: Mapping[str, ListedCommand]) -> None:
        self._commands: dict[str, ListedCommand | click.Command] = {**listed}

    def __getitem__(self, name: str) -> click.Command:
        command = self._commands[name]
        if isinstance(command, ListedCommand):
            with exiting_on_interrupt():
                module = _load_module(name, command)
            command = self._commands[name] = cast("click.Command", getattr(module, name))
        return command

    def __setitem__(self, name: str, command: click.Command) -> None:
        self._commands[name] = command

    def __delitem__(self, name: str) -> None:
        del self._commands[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._commands)

    def __len__(self) -> int:
        return len(self._commands)


def _load_module(name: str, listed: ListedCommand) -> ModuleType:
    """Import the module of a command; raise a usage error if its extra is missing."""
    from smartcam._extras import from_part
    from smartcam.exceptions import MissingExtraError

    try:
        with from_part(listed.extra, f"smartcam {name} needs"):
            return importlib.import_module(f"smartcam._cli.{listed.module}")
    except MissingExtraError as exc:
        raise click.UsageError(str(exc)) from exc


class CommandsByTopic(ListedGroup):
    """The commands, listed by topic with whole summaries."""

    def __init__(self, name: str | None = None, **settings: Any) -> None:
        super().__init__(name, commands=CommandTable(LISTED), **settings)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command with this name or alias."""
        return super().get_command(ctx, ALIASES.get(cmd_name, cmd_name))

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands by topic."""
        for topic, commands in TOPICS.items():
            with formatter.section(topic):
                formatter.write_dl([(name, listed.summary) for name, listed in commands.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Return the commands and options that begin with this text."""
        from click.shell_completion import CompletionItem

        items = [
            # click's help text of the command, without importing the command
            CompletionItem(
                name, help=click.Command(name, help=LISTED[name].summary).get_short_help_str()
            )
            for name in self.list_commands(ctx)
            if name.startswith(incomplete)
        ]
        return [*items, *click.Command.shell_complete(self, ctx, incomplete)]


def _install_completion(ctx: click.Context, _option: click.Parameter, shell: str | None) -> None:
    if shell is None or ctx.resilient_parsing:
        return
    from smartcam._cli.completion import install

    click.echo(install(shell))
    ctx.exit()


@click.group(
    cls=CommandsByTopic, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(smartcam.__version__)
@click.option(
    "--install-completion",
    metavar="[bash|zsh|fish]",
    is_flag=False,
    flag_value="",
    expose_value=False,
    is_eager=True,
    callback=_install_completion,
    help="Install the shell's completion of smartcam and smartcam-emulator, and end; default: the "
    "shell that SHELL names.",
)
def command() -> None:
    """Talk to industrial smart cameras.

    A camera is named by its URL: bvs://HOST[:PORT] over TCP, bvs+udp://HOST[:PORT] over UDP,
    insight://[USER[:PASSWORD]@]HOST[:PORT]; ?dialect=NAME pins the dialect (see
    "smartcam protocols"). fleet://HOST[:PORT]/NAME is a camera that "smartcam serve" shares with
    any number of programs. "smartcam emulator" (or smartcam-emulator) is a camera to try all of
    it with.
    """
