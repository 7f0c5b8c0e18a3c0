"""JSON Schemas in the documents, held against those of the code."""

from __future__ import annotations

from typing import Any


def plain(schema: Any) -> Any:
    """Return a schema without what pydantic's versions spell in different ways."""
    if isinstance(schema, list):
        return [plain(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    found = {key: plain(value) for key, value in schema.items()}
    for one in found.get("anyOf", ()):  # pydantic 2.7 gives it the default of another field
        one.pop("default", None)
    if "const" in found:
        found.pop("enum", None)
    if found.get("additionalProperties") is True:
        del found["additionalProperties"]
    (found_all,) = found.pop("allOf", [{}])
    return {**found, **found_all}
