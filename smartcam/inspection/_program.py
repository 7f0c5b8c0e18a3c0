"""Programs: the ordered tools of an application, run on one picture."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, cast, get_args

from pydantic import ValidationError

from smartcam._arguments import check_bytes, check_text, wrong_argument
from smartcam._suggestions import did_you_mean, hint
from smartcam.exceptions import ConfigurationError, InspectionError, PluginError, SmartCamError
from smartcam.inspection._finding import Finding, Inspection
from smartcam.inspection._picture import Picture
from smartcam.inspection._places import IDENTITY, place_region
from smartcam.inspection._tool import Tool, ToolSettings, View
from smartcam.layout import Layout
from smartcam.layout._inside import Field
from smartcam.registry import TOOLS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.frames import Frame
    from smartcam.inspection._tool import AnyTool, ToolSetup

MAX_TOOLS: Final = 50
"""Largest number of tools of one program."""

MAX_REASON_BYTES: Final = 80
"""Largest number of bytes of the reason in a result container; longer reasons are cut."""

PROGRAM_FIELDS: Final = ("ok", "reason")
"""Fields that the program itself adds; no tool may have them."""

_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,29}")

KeyPath = tuple[int | str, ...]


class ProgramError(ConfigurationError):
    """A mistake in a program's settings.

    Attributes:
        keys: keys that lead to the mistake, from the application's mapping.
    """

    def __init__(self, message: str, keys: KeyPath = ()) -> None:
        super().__init__(message)
        self.keys = keys


@dataclass(frozen=True, slots=True)
class ProgramStep:
    """A tool in a program.

    Attributes:
        name: name of the tool in its program, unique there.
        tool: the tool.
        in_result: whether the tool's values are in the result; False for the tools of another
            application, whose frame of reference this one follows.
        fields: fields of the values, with their names in the result.
        records: fields of each record.
    """

    name: str
    tool: AnyTool
    in_result: bool
    fields: tuple[Field, ...] = ()
    records: tuple[Field, ...] = ()


class Program:
    """The tools of an application in running order.

    Args:
        application: number of the application.
        name: name of the application.
        steps: tools of the application.
        sequence: whether the result begins with the sequence number.

    Raises:
        ConfigurationError: two tools have records, or fields do not fit together.

    Attributes:
        application: number of the application.
        name: name of the application.
        steps: tools of the application.
        layout: layout of a result: ``ok: bool, reason: string[80]``, and the tools' fields. With
            several tools, each tool's fields have its name as a prefix, and each has its own
            ``ok``.
    """

    def __init__(
        self, application: int, name: str, steps: Sequence[ProgramStep], *, sequence: bool = False
    ) -> None:
        self.application = application
        self.name = name
        several = sum(step.in_result for step in steps) > 1
        self.steps: tuple[ProgramStep, ...] = tuple(
            _add_fields(step, several=several) for step in steps
        )
        fields = [Field("sequence", "int32", sequence=True)] if sequence else []
        fields += [Field("ok", "bool"), Field("reason", "string", MAX_REASON_BYTES)]
        fields += (field for step in self.steps for field in step.fields)
        text = ", ".join(map(str, fields))
        list_steps = [step for step in self.steps if step.records]
        if len(list_steps) > 1:
            raise ConfigurationError(
                f"{list_steps[0].name} and {list_steps[1].name} each find several "
                "things, and a result has room for one list: expected one of them, and the other "
                "one in another application"
            )
        if list_steps:
            text += f", {list_steps[0].name}: ({', '.join(map(str, list_steps[0].records))})*"
        self.layout: Layout = Layout(text)
        self._several = several

    @property
    def interpret_as(self) -> str:
        """Text of the layout, for a client's ``interpret_as``."""
        return self.layout.text

    def inspect(self, source: Frame | Picture | NDArray[Any], *, input: bytes = b"") -> Inspection:
        """Return the tools' findings on a picture. Blocks; runs in any thread.

        Args:
            source: a frame, or pixels as for :class:`Picture`.
            input: input data of the trigger.

        Raises:
            FrameFormatError: the source is no picture.
            InspectionError: a tool failed.
            MissingExtraError: an extra that a tool needs is not installed.
        """
        input = check_bytes(input, "input", "Program.inspect")
        picture = Picture.of(source)
        findings, seconds = self._run(picture, input)
        values: dict[str, Any] = {
            "ok": all(finding.ok for finding in findings.values()),
            "reason": "",
        }
        if self.layout.sequence_field is not None:
            values["sequence"] = 0
        for step in self.steps:
            values |= _result_values(step, findings[step.name], several=self._several)
        reason = _first_reason(findings)
        values["reason"] = _shorten(reason)
        return Inspection(
            application=self.application,
            name=self.name,
            ok=values["ok"],
            reason=reason,
            values=values,
            findings=findings,
            seconds=seconds,
            layout=self.layout,
            picture=picture,
        )

    def _run(self, picture: Picture, input: bytes) -> tuple[dict[str, Finding], dict[str, float]]:
        findings: dict[str, Finding] = {}
        seconds: dict[str, float] = {}
        for step in self.steps:
            started = time.perf_counter()
            try:
                findings[step.name] = _run_tool(step.tool, picture, input, findings)
            except SmartCamError:
                raise
            except Exception as exc:
                raise InspectionError(
                    f"application {self.application} ({self.name}): the tool {step.name} failed: "
                    f"{exc!r}",
                    application=self.application,
                    tool=step.name,
                ) from exc
            seconds[step.name] = time.perf_counter() - started
        return findings, seconds


class FollowedApplication(Tool[ToolSettings]):
    """The tools of an application whose frame of reference another one follows, as one tool.

    The frame of reference is the last one that one of these tools found.
    """

    settings_model = ToolSettings

    def __init__(self, steps: Sequence[ProgramStep], setup: ToolSetup) -> None:
        super().__init__(ToolSettings.model_validate({}), setup)
        self._steps = tuple(steps)

    def inspect(self, view: View) -> Finding:
        """Return the common verdict, and the last frame of reference."""
        findings: dict[str, Finding] = {}
        for step in self._steps:
            findings[step.name] = _run_tool(step.tool, view.picture, view.input, findings)
        references = [
            finding.reference for finding in findings.values() if finding.reference is not None
        ]
        return Finding(
            ok=all(finding.ok for finding in findings.values()),
            reason=_first_reason(findings),
            drawings=[mark for finding in findings.values() for mark in finding.drawings],
            reference=references[-1] if references else None,
        )


def _first_reason(findings: Mapping[str, Finding]) -> str:
    """Return the first reason among findings; "" if all are ok."""
    for name, finding in findings.items():
        if not finding.ok:
            reason = finding.reason or "not ok"
            return f"{name}: {reason}" if len(findings) > 1 else reason
    return ""


def _run_tool(
    tool: AnyTool, picture: Picture, input: bytes, earlier: Mapping[str, Finding]
) -> Finding:
    """Run a tool; if it cannot run, return a finding with the reason."""
    settings: ToolSettings = tool.settings
    reference = None
    if settings.follow is not None:
        reference = earlier[settings.follow].reference
        if reference is None:
            return Finding(
                ok=False, reason=f"the tool follows {settings.follow}, which was not found"
            )
    region = place_region(settings.region, reference, picture.size)
    is_outside = region.outside > 0.5 and tool.needs_whole_region
    if region.is_empty or is_outside:
        width, height = picture.size
        return Finding(
            ok=False,
            reason=f"the region reaches {region.outside:.0f} px out of the picture of {width} x "
            f"{height}",
        )
    view = View(
        picture=picture,
        region=region,
        reference=IDENTITY if reference is None else reference,
        follows=reference is not None,
        input=input,
        earlier=earlier,
    )
    return tool.inspect(view)


def _add_fields(step: ProgramStep, *, several: bool) -> ProgramStep:
    if not step.in_result:
        return step
    fields = Layout(step.tool.fields).fields if step.tool.fields else ()
    records = Layout(step.tool.records).fields if step.tool.records else ()
    for field in (*fields, *records):
        if field.name in PROGRAM_FIELDS or field.sequence:
            raise ConfigurationError(f"{step.name}: a tool may not have the field {field.name!r}")
    if several:
        verdict = Field("ok", "bool")
        fields = tuple(
            replace(field, name=f"{step.name}_{field.name}") for field in (verdict, *fields)
        )
    return replace(step, fields=fields, records=records)


def _result_values(step: ProgramStep, finding: Finding, *, several: bool) -> dict[str, Any]:
    """Return a finding's values by their names in the result; missing values are left empty."""
    if not step.in_result:
        return {}
    prefix = f"{step.name}_" if several else ""
    values_by_field = {**finding.values, "ok": finding.ok} if several else finding.values
    values = {
        field.name: values_by_field.get(field.name.removeprefix(prefix), _empty_value(field))
        for field in step.fields
    }
    if step.records:
        values[step.name] = [
            {field.name: record.get(field.name, _empty_value(field)) for field in step.records}
            for record in finding.records
        ]
    return values


def _empty_value(field: Field) -> Any:
    """Return the value of an empty field."""
    if field.type == "bool":
        return False
    if field.type == "string":
        return ""
    if field.type.startswith("real"):
        return float("nan")
    return 0


def _shorten(reason: str) -> str:
    data = reason.encode()
    if len(data) <= MAX_REASON_BYTES:
        return reason
    return data[: MAX_REASON_BYTES - 3].decode(errors="ignore") + "..."


# ---------------------------------------------------------------------- making programs


def split_tool_key(key: str) -> tuple[str, str]:
    """Split a key of an application, ``read`` or ``read left``, into kind and name of the tool."""
    kind, _, name = key.partition(" ")
    return kind, name.strip() or kind


def make_step(
    key: str, given: object, setup: ToolSetup, other_keys: Iterable[str] = ()
) -> ProgramStep:
    """Return the step of an application's entry.

    Args:
        key: ``TOOL``, or ``TOOL NAME`` if a program has several of one kind.
        given: settings of the tool, as in YAML.
        setup: folder and calibration for the tool.
        other_keys: other keys of the entry, for hints at misspelled names.

    Raises:
        ProgramError: the tool is unknown, or a setting is wrong.
    """
    kind, name = split_tool_key(key)
    if _NAME.fullmatch(name) is None:
        raise ProgramError(
            f"expected a name of small letters, digits and _, such as 'read left'; got "
            f"{name!r:.60}",
            (key,),
        )
    if kind not in TOOLS:
        tools = [info.name for info in TOOLS.available()]
        raise ProgramError(
            f"no tool is called {kind!r:.60}; tools are {', '.join(tools)}"
            f"{did_you_mean(kind, [*tools, *other_keys])}",
            (key,),
        )
    try:
        tool_class = cast("type[AnyTool]", TOOLS.load(kind))
    except PluginError as exc:
        raise ProgramError(str(exc), (key,)) from exc
    if not (isinstance(tool_class, type) and issubclass(tool_class, Tool)):
        raise ProgramError(f"{kind} is no subclass of smartcam.inspection.Tool", (key,))
    model = tool_class.settings_model
    try:
        settings = model.model_validate({} if given is None else given)
    except ValidationError as exc:
        errors = exc.errors(include_url=False)  # a misspelled key explains a missing key
        first = next((error for error in errors if error["type"] == "extra_forbidden"), errors[0])
        text = first["msg"].removeprefix("Value error, ") + hint(
            first, _known_settings(model, first["loc"])
        )
        raise ProgramError(text, (key, *first["loc"])) from exc
    try:
        return ProgramStep(name, tool_class(settings, setup), in_result=True)
    except ProgramError as exc:
        raise ProgramError(str(exc), (key, *exc.keys)) from exc
    except (SmartCamError, OSError) as exc:
        raise ProgramError(str(exc), (key,)) from exc


def _known_settings(model: Any, keys: KeyPath) -> Iterable[str]:
    """Return the names of the settings beside an error's last key."""
    for key in keys[:-1]:
        field = getattr(model, "model_fields", {}).get(key)
        types = () if field is None else (field.annotation, *get_args(field.annotation))
        model = next((model for model in types if hasattr(model, "model_fields")), None)
    return getattr(model, "model_fields", ())


def register_tool(name: str, tool: type[AnyTool]) -> None:
    """Register a tool in this process, without an entry point.

    Raises:
        ConfigurationError: the class is no tool, or the name is not valid.
        PluginError: another tool has the name.
    """
    if not (isinstance(tool, type) and issubclass(tool, Tool)):
        raise wrong_argument("tool", "a subclass of smartcam.inspection.Tool", tool)
    name = check_text(name, "name", "register_tool")
    if _NAME.fullmatch(name) is None:
        raise wrong_argument("name", "a name of small letters, digits and _", name)
    TOOLS.register(name, tool)
