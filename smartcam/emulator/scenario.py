"""Scenarios: an emulated camera, described in a file."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from smartcam.emulator.application import BUILTIN_APPLICATIONS, Application
from smartcam.emulator.quirks import Quirks
from smartcam.exceptions import ConfigurationError, MissingExtraError
from smartcam.layout.files import YAML_ALSO_RAISES

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Scenario", "load_scenario"]


class Scenario(BaseModel):
    """One camera: its applications, how it stands at first, and its quirks."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(default="camera", min_length=1, max_length=200, description="for logs")
    applications: tuple[Application, ...] = Field(
        default=(), description="the programs stored on it"
    )
    active: int | None = Field(
        default=None,
        description="id of the one loaded at first; default the first of applications, else 1",
    )
    running: bool = Field(default=False, description="in run mode from the beginning")
    builtins: bool = Field(
        default=True, description="have the built-in applications, as far as their ids are free"
    )
    quirks: Quirks = Field(default=Quirks(), description="what is unknown of real cameras")
    seed: int = Field(default=0, description="of the table scene's noise")

    @model_validator(mode="after")
    def _check(self) -> Scenario:
        ids = [application.id for application in self.applications]
        twice = next((number for number in ids if ids.count(number) > 1), None)
        if twice is not None:
            raise ValueError(f"application id {twice} is there twice")
        return self

    @property
    def all_applications(self) -> tuple[Application, ...]:
        """The scenario's applications, then the built-in ones whose ids are free."""
        ids = {application.id for application in self.applications}
        builtins = BUILTIN_APPLICATIONS if self.builtins else ()
        return (*self.applications, *(app for app in builtins if app.id not in ids))


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario file (YAML).

    Raises:
        ConfigurationError: the file cannot be read or a field of it is wrong; the text names file,
            line and field.
        MissingExtraError: PyYAML is not installed.
    """
    try:
        yaml: Any = importlib.import_module("yaml")
    except ImportError as exc:
        raise MissingExtraError(
            'scenario files need PyYAML: pip install "smartcam[yaml]"', extra="yaml"
        ) from exc
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as exc:
        raise ConfigurationError(f"scenario {path}: {exc}") from exc
    try:
        root = yaml.compose(text, yaml.SafeLoader)
        data = yaml.safe_load(text)
    except yaml.MarkedYAMLError as exc:
        line = f", line {exc.problem_mark.line + 1}" if exc.problem_mark is not None else ""
        raise ConfigurationError(f"scenario {path}{line}: {exc.problem or exc}") from exc
    except (yaml.YAMLError, *YAML_ALSO_RAISES) as exc:
        raise ConfigurationError(f"scenario {path}: {exc}") from exc
    if root is not None:
        _refuse_twice(root, path)
    if not isinstance(data, dict):
        raise ConfigurationError(f"scenario {path}: expected fields such as 'applications:'")
    try:
        return Scenario.model_validate(data)
    except ValidationError as exc:
        findings = [
            f"line {_line(root, item['loc'])}: "
            f"{'.'.join(str(part) for part in item['loc'])}: {item['msg']}"
            for item in exc.errors()
        ]
        raise ConfigurationError(f"scenario {path}, {'; '.join(findings)}") from exc


def _line(node: Any, loc: Sequence[int | str]) -> int:
    """Return the line of the deepest node on the way to ``loc`` that is in the file."""
    for part in loc:
        found = _child(node, part)
        if found is None:
            break
        node = found
    return int(node.start_mark.line) + 1


def _child(node: Any, part: int | str) -> Any:
    if node.id == "mapping":
        return next((value for key, value in node.value if key.value == str(part)), None)
    if node.id == "sequence" and isinstance(part, int) and part < len(node.value):
        return node.value[part]
    return None


def _refuse_twice(root: Any, path: str | Path) -> None:
    """Refuse a key that stands twice in one mapping; YAML would take the last in silence."""
    seen: set[int] = set()  # aliases may make a circle
    waiting = [root]
    while waiting:
        node = waiting.pop()
        if id(node) in seen or node.id == "scalar":
            continue
        seen.add(id(node))
        if node.id == "sequence":
            waiting.extend(node.value)
            continue
        keys: set[str] = set()
        for key, value in cast("list[tuple[Any, Any]]", node.value):
            if str(key.value) in keys:
                raise ConfigurationError(
                    f"scenario {path}, line {key.start_mark.line + 1}: "
                    f"{key.value!r} stands there twice"
                )
            keys.add(str(key.value))
            waiting.append(value)
