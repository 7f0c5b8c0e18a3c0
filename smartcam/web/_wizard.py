"""Define the wizard's site: a page that shows its steps, and HTTP calls for the services."""

from __future__ import annotations

import asyncio
import functools
import inspect
import re
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from smartcam.web._errors import RefusedError
from smartcam.web._routes import CallBody, CallRequest, Calls
from smartcam.web._site import API, Site

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.calibration.wizards import CalibrationService

    Handler = Callable[[CalibrationService, Any], object | Awaitable[object]]


class WizardSite(Site):
    """A page and HTTP calls that drive the wizards of calibrations.

    The site runs in the event loop in which the service's actions run. Users who work at the same
    time share one wizard: each call names the step that it answers, by the step's token.

    ::

        async with WizardSite(service) as site:
            site.url    # http://127.0.0.1:PORT/

    Args:
        service: the calibrations' folder and their wizards; closed by its maker.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        token: token that every call must carry in ``Authorization: Bearer``: at least 16 letters,
            digits, ``-`` and ``_``. None: no token on a loopback address; else one is made.

    Attributes:
        service: the given service.

    Raises:
        ConfigurationError: the token cannot be used.
    """

    def __init__(
        self,
        service: CalibrationService,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        super().__init__(CALLS, "wizard", host=host, port=port, token=token)
        self.service: CalibrationService = service


# ---------------------------------------------------------------------- arguments of calls


class _StartBody(CallBody):
    name: str = Field(max_length=1000)
    wizard: str = "plane"
    parameters: dict[str, Any] = Field(default_factory=dict)
    fresh: bool = False


class _Answers(CallBody):
    token: str
    answers: dict[str, Any] = Field(default_factory=dict)


class _StepToken(CallBody):
    token: str


class _Export(CallBody):
    name: str
    target: str
    form: str | None = None


class _Load(CallBody):
    name: str


class _CameraPose(CallBody):
    x: float = Field(allow_inf_nan=False)
    y: float = Field(allow_inf_nan=False)
    theta: float = Field(default=0.0, allow_inf_nan=False)
    frame: str | None = None


# ---------------------------------------------------------------------- calls

_STATUS = {
    Code.NOT_FOUND: 404,
    Code.NO_SEQUENCE: 409,
    Code.NO_CALIBRATION: 409,
    Code.STALE_STEP: 409,
    Code.NOT_POSSIBLE: 409,
    Code.IN_USE: 409,
    Code.NOT_WRITTEN: 500,
}
"""HTTP status by the code of a refusal; 422 for codes that are not listed."""


def _refused_error(error: CalibrationError) -> RefusedError:
    cause, expected = [*re.split(r"[;:] expected ", str(error), maxsplit=1), ""][:2]
    status = next((status for code, status in _STATUS.items() if code == error.code), 422)
    field = {"field": "code", "received": error.code, "expected": ""}
    return RefusedError(
        status, cause, expected or "what the folder and its wizard can do", (field,)
    )


CALLS: Calls[WizardSite] = Calls()
"""All calls; ``docs/calibrating.md`` shows them."""


def _call(
    method: Literal["GET", "POST"], path: str, *, writes: str = "folder", **options: Any
) -> Callable[[Handler], Handler]:
    """Make the decorated function a call's handler, which gets the service and the body.

    ``path`` follows the prefix of all calls; ``writes`` names the file or folder that the call
    writes; for ``options`` see :meth:`~smartcam.web._routes.Calls.add`.
    """

    def declare(handler: Handler) -> Handler:
        @CALLS.add(method, f"{API}{path}", **options)
        @functools.wraps(handler)
        async def answer(site: WizardSite, call: CallRequest) -> object:
            try:
                value = handler(site.service, call.body)
                return await value if inspect.isawaitable(value) else value
            except CalibrationError as exc:
                raise _refused_error(exc) from exc
            except OSError as exc:
                raise RefusedError(
                    500, f"the {writes}: {exc.strerror}", f"a {writes} that can be written"
                ) from exc

        return handler

    return declare


@CALLS.add("GET", API)
def _calls(_site: WizardSite, _request: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@_call("GET", "/calibrations")
def _state(service: CalibrationService, _body: object) -> object:
    """Names of the calibrations and of the wizards, and of the running wizard."""
    return {"calibrations": service.names, "wizards": service.wizards, "name": service.name}


@_call("GET", "/listing")
async def _listing(service: CalibrationService, _body: object) -> object:
    """A row for each calibration: its date, its error, its last check."""
    return {"listing": await asyncio.to_thread(lambda: service.listing)}


@_call("POST", "/start", body=_StartBody, sample='{"name": "table"}')
def _start(service: CalibrationService, body: _StartBody) -> object:
    """Start a wizard under a name, or continue an interrupted one; returns its current step.

    `wizard` is `plane`, `drift` (checks a calibration), `sheet` or `hand-eye` (both use pictures).
    `fresh` begins anew in any case. `resumed` has the date of a continued wizard, and its
    answers.
    """
    view = service.start(body.name, body.wizard, body.parameters, fresh=body.fresh)
    return {**view, "resumed": service.session.resumed}


@_call("GET", "/step")
def _step(service: CalibrationService, _body: object) -> object:
    """The current step: the texts to show, and the JSON Schema of the answers."""
    return {**service.session.current, "resumed": service.session.resumed}


@_call("POST", "/step", writes="journal", body=_Answers, sample='{"token": "...", "answers": {}}')
def _submit(service: CalibrationService, body: _Answers) -> object:
    """Answer the step of that token; returns the next step, or the same with `errors`.

    May be made again if its answer was lost.
    """
    return service.session.submit(body.token, body.answers)


@_call("POST", "/undo", writes="journal", body=_StepToken, sample='{"token": "..."}')
def _undo(service: CalibrationService, body: _StepToken) -> object:
    """Go back to the step before; its answers stand there as defaults."""
    return service.session.undo(body.token)


@_call("POST", "/repeat", writes="journal", body=_StepToken, sample='{"token": "..."}')
def _repeat(service: CalibrationService, body: _StepToken) -> object:
    """Do the action of the step before again."""
    return service.session.repeat(body.token)


@_call("POST", "/abort", writes="journal", body=_StepToken, sample='{"token": "..."}')
def _abort(service: CalibrationService, body: _StepToken) -> object:
    """End the wizard without a result; the measurements stay in the journal."""
    return service.session.abort(body.token)


@_call(
    "POST",
    "/export",
    about="Copy a calibration to a file of `exports/`: all of it to `.json`, its matrix to `.yaml` "
    "or, with `form`, its transform in another program's format.",
    body=_Export,
    sample='{"name": "table", "target": "table.yaml"}',
)
def _export(service: CalibrationService, body: _Export) -> object:
    return {"file": service.export(body.name, body.target, body.form)}


@_call("POST", "/load", body=_Load, sample='{"name": "table"}')
def _load(service: CalibrationService, body: _Load) -> object:
    """Load a calibration by its name, or an exported one by its path in the folder."""
    calibration = service.load(body.name)
    return {"name": body.name, "model": calibration.model, "robot_frame": calibration.robot_frame}


@_call("POST", "/transform", body=_CameraPose, sample='{"x": 0.1, "y": 0.05, "theta": 0.0}')
def _transform(service: CalibrationService, body: _CameraPose) -> object:
    """Convert a pose in the camera's plane to the robot's frame, by the loaded calibration."""
    return {"pose": service.transform(body.x, body.y, body.theta, body.frame)}
