"""Find the records of a result's value, and the file of its picture, for stores and servers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path


def picture_of(pattern: str, folder: Path, fields: Mapping[str, Any]) -> Path | None:
    """Return the file of a result's picture; None if it does not exist inside the folder.

    Args:
        pattern: path of the file, with ``{camera}``, ``{application}``, ``{number}`` and
            ``{sequence}``.
        folder: folder of relative paths.
        fields: fields of the result.
    """
    for name in ("camera", "application", "number", "sequence"):
        pattern = pattern.replace(f"{{{name}}}", str(fields.get(name, "")))
    path = folder / pattern
    is_inside = path.resolve().is_relative_to(folder.resolve())
    return path if is_inside and path.is_file() else None


def records_of(value: Any) -> list[dict[str, Any]] | None:
    """Return the records of a value as mappings of plain values; None if it has no records."""
    if isinstance(value, dict):
        fields = cast("dict[str, Any]", value)
        lists = [name for name, field in fields.items() if isinstance(field, list)]
        if len(lists) == 1 and all(isinstance(item, dict) for item in fields[lists[0]]):
            head = {name: field for name, field in fields.items() if name != lists[0]}
            return [_flatten_pose({**head, **item}) for item in fields[lists[0]]] or [
                _flatten_pose(head)
            ]
        return [_flatten_pose(fields)]
    if isinstance(value, list) and all(isinstance(item, dict) for item in value):
        return [_flatten_pose(item) for item in cast("list[dict[str, Any]]", value)]
    return None


def _flatten_pose(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record with the pose of a localization as plain values."""
    pose = record.get("pose")
    if not isinstance(pose, dict) or "orientation" not in pose:
        return record
    parts = cast("dict[str, dict[str, Any]]", pose)
    quaternion = {f"q{axis}": value for axis, value in parts["orientation"].items()}
    others = {name: value for name, value in record.items() if name != "pose"}
    errors = (parts.get("sigma") or {}).items()
    sigmas = {name if "_" in name else f"sigma_{name}": value for name, value in errors}
    return {**others, **parts["position"], **quaternion, **sigmas}
