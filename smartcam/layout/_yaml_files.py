"""Read smartcam's YAML files; report mistakes with file, line and field."""

from __future__ import annotations

import functools
import itertools
import os
from typing import TYPE_CHECKING, Any, TypeVar, cast

from pydantic import BaseModel, ValidationError

from smartcam._arguments import check_path, excerpt
from smartcam._suggestions import did_you_mean, hint
from smartcam.exceptions import ConfigurationError
from smartcam.layout._yaml_parsing import MAX_YAML_TEXT_CHARACTERS, BadYamlError, compose, construct

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from pydantic_core import ErrorDetails

M = TypeVar("M", bound=BaseModel)

_MAX_MISTAKES = 20  # mistakes that are reported at once

MAX_NEIGHBOUR_FILES = 1000
"""Largest number of files of a folder that are compared with a wrong file name."""


def file_schema(kind: type[BaseModel], label: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of files, such as ``scenario``."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **kind.model_json_schema(),
        "title": f"smartcam {label}",
    }


def read_model(
    path: str | Path,
    label: str,
    kind: type[M],
    such_as: str,
    find_mistake: Callable[[M], tuple[Sequence[int | str], str] | None],
) -> M:
    """Read a file.

    Args:
        path: path of the file.
        label: kind of the file for errors, such as ``scenario``.
        kind: pydantic model of the file's fields.
        such_as: name of a field, as an example for errors.
        find_mistake: function that returns the path of keys to a value that cannot work, and the
            reason; or None.

    Raises:
        ConfigurationError: the file cannot be read or a field of it is wrong; the text names file,
            line and field.
        MissingExtraError: PyYAML is not installed.
    """
    path = check_path(path, "path", label)
    file_label = f"{label} {path}"
    try:
        with path.open(encoding="utf-8") as stream:
            text = stream.read(MAX_YAML_TEXT_CHARACTERS + 1)
    except UnicodeDecodeError as exc:
        raise ConfigurationError(f"{file_label}: {exc}") from exc
    except OSError as exc:
        suggestion = (
            did_you_mean(path.name, _neighbour_names(path))
            if isinstance(exc, FileNotFoundError)
            else ""
        )
        raise ConfigurationError(f"{file_label}: {exc.strerror or exc}{suggestion}") from exc
    try:
        root = compose(text, label=f"a {label} file")
        if root is not None:
            _refuse_repeated_keys(root, file_label)
        data = None if root is None else construct(root)
    except BadYamlError as exc:
        line = "" if exc.line is None else f", line {exc.line}"
        raise ConfigurationError(f"{file_label}{line}: {exc}") from exc
    if not isinstance(data, dict):
        raise ConfigurationError(f"{file_label}: expected fields such as '{such_as}:'")
    try:
        model = kind.model_validate(data)
    except ValidationError as exc:
        findings = (
            (
                item["loc"],
                item["msg"].removeprefix("Value error, ")
                + _actual_text(item)
                + _field_hint(kind, item),
            )
            for item in exc.errors(include_url=False)
        )
        raise ConfigurationError(_mistakes_text(file_label, root, findings)) from exc
    found_mistake = find_mistake(model)
    if found_mistake is not None:
        raise ConfigurationError(_mistakes_text(file_label, root, [found_mistake]))
    return model


def _neighbour_names(path: Path) -> list[str]:
    """Return the names of files in the folder of a missing file."""
    try:
        with os.scandir(path.parent) as entries:
            return [entry.name for entry in itertools.islice(entries, MAX_NEIGHBOUR_FILES)]
    except OSError:
        return []


def _actual_text(item: ErrorDetails) -> str:
    """Return the given value as an addition to pydantic's error; "" if the error names it."""
    if item["type"] in {"missing", "extra_forbidden", "value_error", "union_tag_invalid"}:
        return ""
    given: object = item["input"]
    if isinstance(given, dict):
        return " (got fields)"
    return " (got a list)" if isinstance(given, list) else f" (got {excerpt(given)})"


def _field_hint(kind: type[BaseModel], item: ErrorDetails) -> str:
    """Return a hint with the field or word that was probably meant."""
    if item["type"] != "extra_forbidden":
        return hint(item, ())
    *key_path, _ = item["loc"]
    schema = _schema(kind)
    branches = [*_branches(schema, schema)]
    for part in key_path:
        children = [child for branch in branches for child in _child_schemas(schema, branch, part)]
        branches = children or branches  # pydantic's path also contains the types of a union
    return hint(
        item, dict.fromkeys(name for branch in branches for name in branch.get("properties", {}))
    )


@functools.cache
def _schema(kind: type[BaseModel]) -> dict[str, Any]:
    return kind.model_json_schema()


def _child_schemas(schema: Any, branch: Any, part: int | str) -> list[Any]:
    subschemas = [branch["items"]] if isinstance(part, int) and "items" in branch else []
    if part in branch.get("properties", {}):
        subschemas = [branch["properties"][part]]
    elif isinstance(branch.get("additionalProperties"), dict):
        subschemas = [branch["additionalProperties"]]
    return [below for kind in subschemas for below in _branches(schema, kind)]


def _branches(schema: Any, node: Any) -> Iterator[Any]:
    """Yield the schemas that a part of a schema refers to: a reference, each type of a union."""
    if "$ref" in node:
        yield from _branches(schema, schema["$defs"][node["$ref"].rpartition("/")[2]])
    subschemas = [*node.get("anyOf", ()), *node.get("oneOf", ()), *node.get("allOf", ())]
    for kind in subschemas:
        yield from _branches(schema, kind)
    if "properties" in node or "items" in node or "additionalProperties" in node:
        yield node


def _mistakes_text(
    file_label: str, root: Any, findings: Iterable[tuple[Sequence[int | str], str]]
) -> str:
    texts = [
        # of a layout's error only the first line, with the position; the others mark it by a caret
        ": ".join(
            [f"line {_find_line(root, key_path)}", *_path_text(key_path), text.partition("\n")[0]]
        )
        for key_path, text in itertools.islice(findings, _MAX_MISTAKES)
    ]
    return f"{file_label}, {'; '.join(texts)}"


def _path_text(key_path: Sequence[int | str]) -> list[str]:
    return [".".join(str(part) for part in key_path)] if key_path else []


def _find_line(node: Any, loc: Sequence[int | str]) -> int:
    """Return the line of the deepest node on the path to ``loc`` that is in the file."""
    for part in loc:
        child = _child_node(node, part)  # pydantic's path also contains the types of a union
        node = node if child is None else child
    return int(node.start_mark.line) + 1


def _child_node(node: Any, part: int | str) -> Any:
    if node.id == "mapping":
        return next((value for key, value in node.value if key.value == str(part)), None)
    if node.id == "sequence" and isinstance(part, int) and part < len(node.value):
        return node.value[part]
    return None


def _refuse_repeated_keys(root: Any, label: str) -> None:
    """Refuse a repeated key in a mapping; YAML would silently use its last value."""
    seen: set[int] = set()  # aliases may form a circle
    pending = [root]
    while pending:
        node = pending.pop()
        if id(node) in seen or node.id == "scalar":
            continue
        seen.add(id(node))
        if node.id == "sequence":
            pending.extend(node.value)
            continue
        keys: set[str] = set()
        for key, value in cast("list[tuple[Any, Any]]", node.value):
            # a list or mapping as a key is not shown: with its aliases it could be huge
            if key.id != "scalar":
                raise ConfigurationError(
                    f"{label}, line {key.start_mark.line + 1}: expected a text as a key, got a "
                    f"{key.id}"
                )
            if str(key.value) in keys:
                raise ConfigurationError(
                    f"{label}, line {key.start_mark.line + 1}: {key.value!r} stands there twice"
                )
            keys.add(str(key.value))
            pending.append(value)
