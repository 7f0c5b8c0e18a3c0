"""Scenario files: read from YAML; a mistake is told with file, line and field."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pydantic import ValidationError

from smartcam.emulator._scenario.scenario import Scenario, ScenarioFile
from smartcam.exceptions import ConfigurationError
from smartcam.layout._yamls import MAX_YAML_TEXT, BadYamlError, compose, construct

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_SHOWN = 20  # mistakes that are told at once


def load_scenario(path: str | Path, *, dialect: str | None = None) -> Scenario:
    """Read a scenario file (YAML) with one camera.

    Args:
        path: of the file.
        dialect: goes before what the file says.

    Raises:
        ConfigurationError: as :func:`load_scenarios`, or there are several cameras in it.
        MissingExtraError: PyYAML is not installed.
    """
    first, *others = load_scenarios(path, dialect=dialect)
    if others:
        raise ConfigurationError(
            f"scenario {path}: one camera was expected, it has {1 + len(others)}: "
            f"{', '.join(one.name for one in (first, *others))}; EmulatedFleet takes them all"
        )
    return first


def load_scenarios(path: str | Path, *, dialect: str | None = None) -> tuple[Scenario, ...]:
    """Read a scenario file (YAML): one camera, or several under ``cameras``.

    Args:
        path: of the file.
        dialect: goes before what the file says.

    Raises:
        ConfigurationError: the file cannot be read or a field of it is wrong; the text names file,
            line and field.
        MissingExtraError: PyYAML is not installed.
    """
    try:
        with Path(path).open(encoding="utf-8") as stream:
            text = stream.read(MAX_YAML_TEXT + 1)
    except (OSError, UnicodeDecodeError) as exc:
        raise ConfigurationError(f"scenario {path}: {exc}") from exc
    try:
        root = compose(text, what="a scenario file")
        if root is not None:
            _refuse_twice(root, path)
        data = None if root is None else construct(root)
    except BadYamlError as exc:
        line = "" if exc.line is None else f", line {exc.line}"
        raise ConfigurationError(f"scenario {path}{line}: {exc}") from exc
    if not isinstance(data, dict):
        raise ConfigurationError(f"scenario {path}: expected fields such as 'applications:'")
    try:
        file = ScenarioFile.model_validate(data)
    except ValidationError as exc:
        findings = [
            (item["loc"], item["msg"].removeprefix("Value error, ")) for item in exc.errors()
        ]
        raise ConfigurationError(_texts(path, root, findings)) from exc
    scenarios = file.each()
    if dialect is not None:
        scenarios = tuple(one.model_copy(update={"dialect": dialect}) for one in scenarios)
    for index, scenario in enumerate(scenarios):
        mistake = scenario.mistake()
        if mistake is not None:
            place, text = mistake
            raise ConfigurationError(_texts(path, root, [(file.place(index, place), text)]))
    return scenarios


def scenario_schema() -> dict[str, Any]:
    """Return the JSON Schema of scenario files."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **ScenarioFile.model_json_schema(),
        "title": "smartcam scenario",
    }


def _texts(path: str | Path, root: Any, findings: Iterable[tuple[Sequence[int | str], str]]) -> str:
    texts = [
        ": ".join([f"line {_line(root, place)}", *_field(place), text])
        for place, text in itertools.islice(findings, _SHOWN)
    ]
    return f"scenario {path}, {'; '.join(texts)}"


def _field(place: Sequence[int | str]) -> list[str]:
    return [".".join(str(part) for part in place)] if place else []


def _line(node: Any, loc: Sequence[int | str]) -> int:
    """Return the line of the deepest node on the way to ``loc`` that is in the file."""
    for part in loc:
        found = _child(node, part)  # pydantic's way has the kinds of faults in it, too
        node = node if found is None else found
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
