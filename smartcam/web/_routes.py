"""Define a site's HTTP calls in a table: the method, path, arguments and handler of each call.

A call gets a JSON body or a query, which pydantic checks, and answers with JSON. Most handlers are
plain functions: when such a function returns, the call is done.
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
from smartcam.web._connections import connection_of
from smartcam.web._errors import RefusedError, short_repr, wrong_fields_error

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.web._guard import Guard

_log = logging.getLogger("smartcam.web")

MAX_BODY_BYTES = 1 << 18
"""Largest number of bytes of a call's body: room for an emulator's fault that inserts
64 kB, written in hex."""

READ_TIMEOUT = 10.0
"""Seconds within which a call's body must have been received."""

C = TypeVar("C")

_Method: TypeAlias = Literal["GET", "POST", "PUT", "DELETE"]
Action: TypeAlias = "Callable[[C, CallRequest], object]"
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
_Model = type[BaseModel] | TypeAdapter[Any]


class CallBody(BaseModel):
    """The base of calls' bodies: refuses unknown fields, and values of other types."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", strict=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class CallRequest:
    """The request of a call, with its checked arguments."""

    request: web.Request  # the request; its body was read
    path: Mapping[str, str]  # the variable parts of the path
    query: Any  # the checked query; None if the call has no query
    body: Any  # the checked body; None if the call has no body


@dataclass(frozen=True, kw_only=True)
class _Call(Generic[C]):
    """A row of a table of calls."""

    method: _Method  # HTTP method
    path: str  # path with variable parts in braces
    about: str  # text on purpose and answer, for people
    # function that gets the site and the request, and returns the answer or a coroutine of it
    handler: Action[C]
    query: type[BaseModel] | None = None  # the query's model; None: the call has no query
    body: _Model | None = None  # the body's model; None: the call has no body
    optional: bool = False  # whether the body may be missing
    sample: str = ""  # an example of a body, for people

    async def answer(self, site: C, request: web.Request) -> web.StreamResponse:
        """Answer a request.

        Raises:
            RefusedError: the request cannot be done.
        """
        call = CallRequest(
            request=request,
            path=request.match_info,
            query=_check_query(self.query, request),
            body=await self._read_body(request),
        )
        connection = connection_of(request)
        with contextlib.nullcontext() if connection is None else connection.running_handler():
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
                408, "an unfinished body", f"the whole body within {READ_TIMEOUT:g} s"
            ) from exc
        if not data:
            if self.body is None or self.optional:
                return None if self.body is None else _validate(self.body, {})
            raise RefusedError(422, "no body", f"JSON, for example {self.sample}")
        value = _parse_json(request.content_type, data)
        if self.body is None:
            if value == {}:
                return None
            raise RefusedError(422, f"the body {short_repr(value)}", "no body")
        return _validate(self.body, value)


def _parse_json(content_type: str, data: bytes) -> Any:
    if content_type != "application/json":
        raise RefusedError(
            415,
            f"a body of type {short_repr(content_type)}",
            "Content-Type: application/json (with curl: --json)",
        )
    try:
        return json.loads(data, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as exc:
        raise RefusedError(400, f"a body that is no JSON: {exc}", "JSON") from exc


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")


def _validate(model: _Model, value: object) -> Any:
    try:
        if isinstance(model, TypeAdapter):
            return model.validate_python(value)
        return model.model_validate(value)
    except ValidationError as exc:
        raise wrong_fields_error(exc) from exc


def _check_query(model: type[BaseModel] | None, request: web.Request) -> Any:
    query = dict(request.query)
    if model is not None:
        return _validate(model, query)
    if query:
        raise RefusedError(422, f"the query {short_repr(query)}", "none")
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
        self, method: _Method, path: str, *, about: str = "", **options: Any
    ) -> Callable[[Action[C]], Action[C]]:
        """Make the decorated function a call's handler.

        The page describes the call by ``about``, or else by the handler's docstring. ``options``
        are the fields ``query``, ``body``, ``optional`` and ``sample`` of the call.
        """

        def declare(handler: Action[C]) -> Action[C]:
            text = about or " ".join((handler.__doc__ or "").split())
            row = _Call(method=method, path=path, about=text, handler=handler, **options)
            self._rows.append(row)
            return handler

        return declare

    def add_row(self, row: _Call[Any], path: str, handler: Action[C]) -> None:
        """Add a call of another table, with another path and another handler."""
        self._rows.append(dataclasses.replace(row, path=path, handler=handler))

    def as_json(self) -> list[dict[str, Any]]:
        """Return a row for JSON of each call: ``method``, ``path``, ``about``, ``body``."""
        return [
            {
                "method": call.method,
                "path": call.path,
                "about": call.about,
                "body": call.sample or None,
            }
            for call in self
        ]


def routes(calls: Calls[C], site: C) -> list[web.RouteDef]:
    """Return the calls for aiohttp's router."""

    def handler(call: _Call[C]) -> _Handler:
        async def answer(request: web.Request) -> web.StreamResponse:
            return await call.answer(site, request)

        return answer

    return [web.route(call.method, call.path, handler(call)) for call in calls]


def middleware(guard: Guard, prefix: str) -> Any:
    """Return the middleware of all handlers.

    It bounds connections, has ``guard`` check each request, and refuses with JSON. The paths of
    calls begin with ``prefix``.
    """

    @web.middleware
    async def serve(request: web.Request, handler: _Handler) -> web.StreamResponse:
        connection = connection_of(request)
        with (
            contextlib.nullcontext() if connection is None else connection.serving_request(request)
        ):
            response = await answer(request, handler)
        if not request.content.is_eof():
            response.force_close()
        return response

    async def answer(request: web.Request, handler: _Handler) -> web.StreamResponse:
        try:
            guard.check(request, is_call=request.path.startswith(prefix))
            return await handler(request)
        except RefusedError as exc:
            refusal = exc
        except web.HTTPException as exc:
            refusal = _translated_error(exc, prefix)
        except LinkError:  # a ConnectionError of a camera, not of the HTTP client
            refusal = _internal_error(request)
        except ConnectionError:
            refusal = RefusedError(400, "a connection that ended", "the whole of a request")
        except ConfigurationError as exc:
            refusal = RefusedError(422, str(exc), "values that can be used")
        except Exception:  # noqa: BLE001  no error may be without an answer
            refusal = _internal_error(request)
        call = f"{request.method} {request.path}"
        return _json(refusal.status, refusal.as_json(short_repr(call)[1:-1]), refusal.headers)

    return serve


def _internal_error(request: web.Request) -> RefusedError:
    """Log the exception that is handled now, and return the refusal for the client."""
    _log.exception("! %s %s: a fault of smartcam", request.method, request.path)
    return RefusedError(500, "a fault of smartcam", "a report of it, with the log")


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
