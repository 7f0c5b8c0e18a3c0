"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

from typing import Any

from tests.budgets.inputs import JSON
from tests.budgets.parser import Make, Parser, fill, fill_text, streamed
from tests.web.inside import (
    CallBody,
    RefusedError,
    SiteConnection,
    SiteConnections,
    _parse_json,
    _validate,
)


class _Item(CallBody):
    name: str
    number: int = 0


class _Body(CallBody):
    items: list[_Item]


def _body(data: bytes | str) -> None:
    _validate(
        _Body, _parse_json("application/json", data.encode() if isinstance(data, str) else data)
    )


_BODIES: dict[str, Make] = {
    **JSON,
    "items": fill_text('{"name":"a"},', '{"items":[', '{"name":"b"}]}'),
    "wrong items": fill_text('{"name":1,"x":2},', '{"items":[', "{}]}"),
}


class _Transport:
    """A transport, as far as a connection asks it."""

    def get_extra_info(self, name: str) -> Any:
        return None

    def is_closing(self) -> bool:
        return False

    def abort(self) -> None:
        pass


def _heads(pieces: list[bytes]) -> None:
    import asyncio

    async def come() -> None:
        visitor = SiteConnection(SiteConnections(asyncio.Protocol))
        visitor.connection_made(_Transport())  # type: ignore[arg-type]
        for piece in pieces:
            visitor.data_received(piece)
        visitor.connection_lost(None)

    asyncio.run(come())


_HEADS: dict[str, Make] = {
    "headers": fill(b"a: b\r\n", b"GET / HTTP/1.1\r\n", b"\r\n"),
    "half ends": fill(b"\r\n\r"),
    "a long line": fill(b"a"),
}

PARSERS: tuple[Parser, ...] = (
    Parser(
        "pages: bodies of calls",
        _body,
        _BODIES,
        256 << 10,
        "web._routes.MAX_BODY_BYTES",
        refuses=(RefusedError,),
        needs=("aiohttp",),
    ),
    Parser(
        "pages: heads of requests",
        _heads,
        streamed(_HEADS),
        32 << 10,
        "web._connections.MAX_HEAD_BYTES",
        needs=("aiohttp",),
    ),
)
