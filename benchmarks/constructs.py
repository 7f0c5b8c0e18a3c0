"""Localizations in construct, which is untyped: flat records, without a pose."""

from __future__ import annotations

from typing import Any

import construct

__all__ = ["parse_localizations"]

_RECORDS = construct.GreedyRange(
    construct.Struct(
        "feature_id" / construct.PaddedString(50, "utf8"),
        "quality" / construct.Float32l,
        "photo_index" / construct.Int32sl,
        "x" / construct.Float32l,
        "y" / construct.Float32l,
        "theta" / construct.Float32l,
    )
)


def parse_localizations(data: bytes) -> Any:
    """Return the records of a container, as construct's Containers."""
    return _RECORDS.parse(data)
