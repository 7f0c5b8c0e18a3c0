"""The wizard's site: a page that shows its steps, and HTTP calls for the services."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from smartcam.calibration.codes import Code
from smartcam.exceptions import CalibrationError
from smartcam.web.errors import RefusedError
from smartcam.web.routes import Ask, Call, as_table
from smartcam.web.site import API, Site

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from types import TracebackType
    from typing import Self

    from smartcam.calibration.wizards.services import CalibrationService

__all__ = ["CALLS", "WizardSite"]


class WizardSite:
    """A page and HTTP calls that drive the wizards of calibrations.

    It runs in the event loop that the service's actions run in. Whoever uses it at the same time
    uses one sequence: a token tells which step a call meant.

    ::

        async with WizardSite(service) as site:
            site.url    # http://127.0.0.1:PORT/

    Args:
        service: the calibrations' folder and their wizards; closed by who made it.
        host: address to listen on; nothing but this.
        port: port to listen on, 0 for a free one.
        token: what every call must carry in ``Authorization: Bearer``: 16 letters, digits, ``-``
            and ``_`` at least. None: nothing on a loopback address; on any other one is made.

    Attributes:
        service: as given.

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
        self.service: CalibrationService = service
        self._site = Site(self, CALLS, "wizard", host=host, port=port, token=token)

    @property
    def url(self) -> str:
        """Address of the page; with a token it stands behind ``#``."""
        return self._site.url

    @property
    def api(self) -> str:
        """Address in front of the calls' paths, ``http://HOST:PORT``."""
        return self._site.base

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.stop()

    async def start(self) -> None:
        """Open the port; does nothing if it is started already.

        Raises:
            ConfigurationError: it cannot listen there.

        Cancellation: leaves it stopped.
        """
        await self._site.start()

    async def stop(self) -> None:
        """Close the port and every connection; does nothing if stopped.

        Cancellation: takes effect when all is closed, in less than half a second.
        """
        await self._site.stop()


# ---------------------------------------------------------------------- what calls take


class _Body(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Start(_Body):
    name: str = Field(max_length=1000)
    wizard: str = "plane"
    parameters: dict[str, Any] = Field(default_factory=dict)
    fresh: bool = False


class _Answers(_Body):
    token: str
    answers: dict[str, Any] = Field(default_factory=dict)


class _Token(_Body):
    token: str


class _Export(_Body):
    name: str
    target: str
    form: str | None = None


class _Load(_Body):
    name: str


class _Pose(_Body):
    x: float = Field(allow_inf_nan=False)
    y: float = Field(allow_inf_nan=False)
    theta: float = Field(default=0.0, allow_inf_nan=False)
    frame: str | None = None


# ---------------------------------------------------------------------- what calls do

_STATUS = {
    Code.NOT_FOUND: 404,
    Code.NO_SEQUENCE: 409,
    Code.NO_CALIBRATION: 409,
    Code.STALE_STEP: 409,
    Code.NOT_POSSIBLE: 409,
    Code.IN_USE: 409,
    Code.NOT_WRITTEN: 500,
}
"""HTTP status by what a call is refused for; 422 for the rest."""


def _refused(error: CalibrationError) -> RefusedError:
    came, expected = [*re.split(r"[;:] expected ", str(error), maxsplit=1), ""][:2]
    status = next((code for kind, code in _STATUS.items() if kind == error.code), 422)
    field = {"field": "code", "came": error.code, "expected": ""}
    return RefusedError(status, came, expected or "what the folder and its wizard can do", (field,))


def _guarded(
    handler: Callable[[CalibrationService, Any], object],
) -> Callable[[WizardSite, Ask], object]:
    """Return a handler of a call, of what does it to the service, given the body."""

    def answer(site: WizardSite, ask: Ask) -> object:
        try:
            return handler(site.service, ask.body)
        except CalibrationError as exc:
            raise _refused(exc) from exc
        except OSError as exc:
            raise RefusedError(500, f"the folder: {exc.strerror}", "one to write to") from exc

    return answer


def _awaited(
    handler: Callable[[CalibrationService, Any], Awaitable[dict[str, Any]]],
) -> Callable[[WizardSite, Ask], object]:
    async def answer(site: WizardSite, ask: Ask) -> object:
        try:
            return await handler(site.service, ask.body)
        except CalibrationError as exc:
            raise _refused(exc) from exc
        except OSError as exc:
            raise RefusedError(500, f"the journal: {exc.strerror}", "one to write to") from exc

    return answer


def _calls(_site: WizardSite, _ask: Ask) -> object:
    return {"calls": as_table(CALLS)}


def _state(service: CalibrationService, _body: object) -> object:
    return {"calibrations": service.names, "wizards": service.wizards, "name": service.name}


def _start(service: CalibrationService, body: _Start) -> object:
    return service.start(body.name, body.wizard, body.parameters, fresh=body.fresh)


def _export(service: CalibrationService, body: _Export) -> object:
    return {"file": service.export(body.name, body.target, body.form)}


def _load(service: CalibrationService, body: _Load) -> object:
    calibration = service.load(body.name)
    return {"name": body.name, "model": calibration.model, "robot_frame": calibration.robot_frame}


def _transform(service: CalibrationService, body: _Pose) -> object:
    return {"pose": service.transform(body.x, body.y, body.theta, body.frame)}


_Row = Call["WizardSite"]

CALLS: tuple[_Row, ...] = (
    _Row(method="GET", path=API, about="These calls.", handler=_calls),
    _Row(
        method="GET",
        path=f"{API}/calibrations",
        about="Names of the calibrations and of the wizards, and the one that is under way.",
        handler=_guarded(_state),
    ),
    _Row(
        method="POST",
        path=f"{API}/start",
        about="Start a wizard under a name, or go on with the one that was broken off; answers its "
        "step. `wizard` is `plane`, `drift` to check a calibration, `sheet` or `hand-eye`, which "
        "look at pictures. With `fresh` begin anew in any case.",
        handler=_guarded(_start),
        body=_Start,
        sample='{"name": "table"}',
    ),
    _Row(
        method="GET",
        path=f"{API}/step",
        about="The current step: what to show, and the JSON Schema of what is asked for.",
        handler=_guarded(lambda service, _: service.session.current),
    ),
    _Row(
        method="POST",
        path=f"{API}/step",
        about="Answer the step of that token; answers the next one, or the same with `errors`. "
        "May be made again if its answer was lost.",
        handler=_awaited(lambda service, body: service.session.submit(body.token, body.answers)),
        body=_Answers,
        sample='{"token": "...", "answers": {}}',
    ),
    _Row(
        method="POST",
        path=f"{API}/undo",
        about="Go back to the step before; its answers stand there as defaults.",
        handler=_awaited(lambda service, body: service.session.undo(body.token)),
        body=_Token,
        sample='{"token": "..."}',
    ),
    _Row(
        method="POST",
        path=f"{API}/repeat",
        about="Do the action of the step before again.",
        handler=_awaited(lambda service, body: service.session.repeat(body.token)),
        body=_Token,
        sample='{"token": "..."}',
    ),
    _Row(
        method="POST",
        path=f"{API}/abort",
        about="End it without a result; what was measured stays in the journal.",
        handler=_awaited(lambda service, body: service.session.abort(body.token)),
        body=_Token,
        sample='{"token": "..."}',
    ),
    _Row(
        method="POST",
        path=f"{API}/export",
        about="Copy a calibration to a file of `exports/`: `.json` whole, `.yaml` its matrix, "
        "or with `form` its frame as another program reads it.",
        handler=_guarded(_export),
        body=_Export,
        sample='{"name": "table", "target": "table.yaml"}',
    ),
    _Row(
        method="POST",
        path=f"{API}/load",
        about="Load a calibration by its name, or an exported one by its path in the folder.",
        handler=_guarded(_load),
        body=_Load,
        sample='{"name": "table"}',
    ),
    _Row(
        method="POST",
        path=f"{API}/transform",
        about="The robot's pose for one in the camera's plane, by the loaded calibration.",
        handler=_guarded(_transform),
        body=_Pose,
        sample='{"x": 0.1, "y": 0.05, "theta": 0.0}',
    ),
)
"""All calls; ``docs/calibrating.md`` shows them."""
