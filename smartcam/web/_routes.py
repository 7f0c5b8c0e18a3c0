"""HTTP calls as a table: method, path, arguments, handler.

A call gets a JSON body or a query, which pydantic checks, and answers JSON. Handlers are plain
functions: their effect on an emulator is complete when they return.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import inspect
import json
import logging
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, NoReturn, TypeAlias, TypeVar

from aiohttp import web
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from smartcam.exceptions import ConfigurationError, LinkError
from smartcam.models import jsonable
from smartcam.web._connections import visitor_of
from smartcam.web._errors import RefusedError, shown, wrong_fields_error

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.web._guard import Guard

_log = logging.getLogger("smartcam.web")

MAX_BODY_BYTES = 1 << 18
"""Largest number of bytes of a call's body: room for a fault that inserts 64 kB, in hex."""

READ_TIMEOUT = 10.0
"""Seconds within which a call's body must have come."""

C = TypeVar("C")

_Method: TypeAlias = Literal["GET", "POST", "PUT", "DELETE"]
Action: TypeAlias = "Callable[[C, CallRequest], object]"
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
_Model = type[BaseModel] | TypeAdapter[Any]


class CallBody(BaseModel):
    """A call's body: only its fields, with exactly their types."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", strict=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class CallRequest:
    """The request of a call, with its checked arguments."""

    request: web.Request  # the request; its body was read
    path: Mapping[str, str]  # the variable parts of the path
    query: Any  # the call's query, checked; None if it takes none
    body: Any  # the call's body, checked; None if it takes none


@dataclass(frozen=True, kw_only=True)
class _Call(Generic[C]):
    """A row of a table of calls."""

    method: _Method  # HTTP method
    path: str  # path with variable parts in braces
    about: str  # purpose and answer, for people
    # handler: gets the site and the request; returns the answer, or raises RefusedError. An
    # event stream returns a coroutine.
    handler: Action[C]
    query: type[BaseModel] | None = None  # the query's model; None: it takes none
    body: _Model | None = None  # the body's model; None: it takes none
    optional: bool = False  # whether the body may be missing
    sample: str = ""  # a body, for people

    async def answer(self, site: C, request: web.Request) -> web.StreamResponse:
        """Answer a request.

        Raises:
            RefusedError: the request cannot be done.
        """
        call = CallRequest(
            request=request,
            path=request.match_info,
            query=_checked_query(self.query, request),
            body=await self._read_body(request),
        )
        visitor = visitor_of(request)
        with contextlib.nullcontext() if visitor is None else visitor.answer():
            value = self.handler(site, call)
            if inspect.isawaitable(value):
                value = await value
        return value if isinstance(value, web.StreamResponse) else _json(200, value)

    async def _read_body(self, request: web.Request) -> Any:
        try:
            async with asyncio.timeout(READ_TIMEOUT):
                data = await request.read()
        except TimeoutError as exc:
            raise RefusedError(
                408, "an unfinished body", f"the whole of it within {READ_TIMEOUT:g} s"
            ) from exc
        if not data:
            if self.body is None or self.optional:
                return None if self.body is None else _validate(self.body, {})
            raise RefusedError(422, "no body", f"JSON, for example {self.sample}")
        value = _parsed(request.content_type, data)
        if self.body is None:
            if value == {}:
                return None
            raise RefusedError(422, f"the body {shown(value)}", "no body")
        return _validate(self.body, value)


def _parsed(content_type: str, data: bytes) -> Any:
    if content_type != "application/json":
        raise RefusedError(
            415,
            f"a body of type {shown(content_type)}",
            "Content-Type: application/json (with curl: --json)",
        )
    try:
        return json.loads(data, parse_constant=_no_constant)
    except (ValueError, RecursionError) as exc:
        raise RefusedError(400, f"a body that is no JSON: {exc}", "JSON") from exc


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")


def _validate(model: _Model, value: object) -> Any:
    try:
        if isinstance(model, TypeAdapter):
            return model.validate_python(value)
        return model.model_validate(value)
    except ValidationError as exc:
        raise wrong_fields_error(exc) from exc


def _checked_query(model: type[BaseModel] | None, request: web.Request) -> Any:
    given = dict(request.query)
    if model is not None:
        return _validate(model, given)
    if given:
        raise RefusedError(422, f"the query {shown(given)}", "none")
    return None


def _json(status: int, value: object, headers: Mapping[str, str] | None = None) -> web.Response:
    text = json.dumps(jsonable(value), allow_nan=False)
    return web.json_response(text=f"{text}\n", status=status, headers=headers)


class Calls(Generic[C]):
    """A table of calls, in the order in which their handlers are written."""

    def __init__(self) -> None:
        self._rows: list[_Call[C]] = []

    def __iter__(self) -> Iterator[_Call[C]]:
        return iter(self._rows)

    def add(
        self, method: _Method, path: str, *, about: str = "", **takes: Any
    ) -> Callable[[Action[C]], Action[C]]:
        """Make the decorated function a call's handler; its docstring describes the call.

        ``about`` describes a call that needs more room; ``takes`` are ``query``, ``body``,
        ``optional`` and ``sample`` of the call.
        """

        def declare(handler: Action[C]) -> Action[C]:
            text = about or " ".join((handler.__doc__ or "").split())
            row = _Call(method=method, path=path, about=text, handler=handler, **takes)
            self._rows.append(row)
            return handler

        return declare

    def adopt(self, row: _Call[Any], path: str, handler: Action[C]) -> None:
        """Add another table's call, at a path of this table, with another handler."""
        self._rows.append(dataclasses.replace(row, path=path, handler=handler))

    def as_json(self) -> list[dict[str, Any]]:
        """Return the calls as JSON-able rows: ``method``, ``path``, ``about``, ``body``."""
        return [
            {"method": c.method, "path": c.path, "about": c.about, "body": c.sample or None}
            for c in self
        ]


def routes(calls: Calls[C], site: C) -> list[web.RouteDef]:
    """Return the calls for aiohttp's router."""

    def handler(call: _Call[C]) -> _Handler:
        async def answer(request: web.Request) -> web.StreamResponse:
            return await call.answer(site, request)

        return answer

    return [web.route(call.method, call.path, handler(call)) for call in calls]


def middleware(guard: Guard, prefix: str) -> Any:
    """Return the middleware of all handlers: the connection's place, the guard, refusals as JSON.

    Paths that are calls have the prefix.
    """

    @web.middleware
    async def placed(request: web.Request, handler: _Handler) -> web.StreamResponse:
        visitor = visitor_of(request)
        with contextlib.nullcontext() if visitor is None else visitor.request(request):
            response = await guarded(request, handler)
        if not request.content.is_eof():
            response.force_close()
        return response

    async def guarded(request: web.Request, handler: _Handler) -> web.StreamResponse:
        try:
            guard.check(request, is_call=request.path.startswith(prefix))
            return await handler(request)
        except RefusedError as exc:
            refusal = exc
        except web.HTTPException as exc:
            refusal = _translated_error(exc, prefix)
        except LinkError:  # a ConnectionError, but of a camera and not of the client
            refusal = _internal_error(request)
        except ConnectionError:
            refusal = RefusedError(400, "a connection that ended", "the whole of a request")
        except ConfigurationError as exc:
            refusal = RefusedError(422, str(exc), "what this camera has")
        except Exception:  # noqa: BLE001  the last place: the client is told
            refusal = _internal_error(request)
        tried = f"{request.method} {request.path}"
        return _json(refusal.status, refusal.as_json(shown(tried)[1:-1]), refusal.headers)

    return placed


def _internal_error(request: web.Request) -> RefusedError:
    """Log the exception that is being handled, and return the refusal for the client."""
    _log.exception("! %s %s: a fault of ours", request.method, request.path)
    return RefusedError(500, "a fault of ours", "this to be reported, with the log")


def _translated_error(error: web.HTTPException, prefix: str) -> RefusedError:
    match error:
        case web.HTTPMethodNotAllowed():
            allowed = ", ".join(sorted(error.allowed_methods))
            return RefusedError(
                405, f"the method {error.method}", allowed, headers={"Allow": allowed}
            )
        case web.HTTPRequestEntityTooLarge():
            return RefusedError(413, "a larger body", f"{MAX_BODY_BYTES} bytes at most")
        case web.HTTPNotFound():
            return RefusedError(404, "an unknown path", f"one of those that GET {prefix} lists")
        case _:
            return RefusedError(error.status, error.reason, "a request of HTTP 1.1")
