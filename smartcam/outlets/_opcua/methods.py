"""Carry out the methods of a camera, with checked arguments and a timeout."""

from __future__ import annotations

import asyncio
import itertools
import logging
from typing import TYPE_CHECKING, Any, NamedTuple

from asyncua import ua

from smartcam._user_code import ENDS_PROGRAM, text_of
from smartcam.exceptions import SmartCamError
from smartcam.outlets._opcua.jobs import NOT_FOUND, UnknownRecipeError, code_of
from smartcam.outlets._opcua.machine import WrongStateError
from smartcam.outlets._opcua.nodes import AUTOMATIC_MACHINE, STATE_MACHINE
from smartcam.outlets._opcua.nodeset import node_ids

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from smartcam.outlets._opcua.book import KeptResult, ResultBook
    from smartcam.outlets._opcua.nodes import CameraNodes
    from smartcam.outlets._opcua.system import VisionSystem
    from smartcam.outlets._opcua.values import VisionValues

logger: logging.Logger = logging.getLogger("smartcam.outlets")

MAX_TEXT_CHARACTERS = 1000
"""Largest number of characters of an id or a text that a client gives."""

MAX_LISTED = 100
"""Largest number of results or recipes in one answer; a client requests further ones with a larger
``StartIndex``."""

CALL_TIMEOUT = 700.0
"""Seconds after which a call is cancelled, which is longer than every timeout of a camera."""

_PYTHON_TYPES = {1: bool, 6: int, 7: int}
"""Python types of arguments, by the numbers of OPC UA's types."""

_DERIVED_TYPES = {"Handle": 7, "ResultStateDataType": 6, "TriStateBooleanDataType": 6}
"""Numbers of the built-in types from which types of the nodeset are derived."""


class MethodArgumentError(Exception):
    """A client's argument does not have the method's type."""


class Method(NamedTuple):
    """A method that a client may call.

    Attributes:
        carry_out: function that carries out the method with plain Python arguments, and returns
            the outputs except for the last one, ``Error``.
        failed_outputs: outputs of a call that failed, except for ``Error``.
    """

    carry_out: Callable[..., Awaitable[list[ua.Variant]]]
    failed_outputs: tuple[ua.Variant, ...] = ()


class Methods:
    """The methods of a camera.

    Args:
        system: states and jobs of the camera.
        nodes: nodes of the camera.
        values: values of the server.
        book: results that clients may request.
        wait_published: function that waits until earlier events and values are published.
    """

    def __init__(
        self,
        system: VisionSystem,
        nodes: CameraNodes,
        values: VisionValues,
        book: ResultBook,
        wait_published: Callable[[], Awaitable[None]],
    ) -> None:
        self._system, self._nodes, self._values, self._book = system, nodes, values, book
        self._wait_published = wait_published

    def table(self) -> dict[str, Method]:
        """Return the methods by the paths of their nodes below the camera's."""
        return {**self._states_table(), **self._results_table(), **self._plain_table()}

    def _states_table(self) -> dict[str, Method]:
        job = (self._id("JobIdDataType", ""),)
        recipe = (self._id("RecipeIdInternalDataType", ""),)
        return {
            f"{STATE_MACHINE}.Halt": Method(self._change_method("Halt", "Halted")),
            f"{STATE_MACHINE}.Reset": Method(self._change_method("Reset", "Preoperational")),
            f"{STATE_MACHINE}.SelectModeAutomatic": Method(
                self._change_method("SelectModeAutomatic", "Operational")
            ),
            f"{STATE_MACHINE}.ConfirmAll": Method(self._confirm),
            f"{AUTOMATIC_MACHINE}.Stop": Method(self._end_method("Stop")),
            f"{AUTOMATIC_MACHINE}.Abort": Method(self._end_method("Abort")),
            f"{AUTOMATIC_MACHINE}.StartSingleJob": Method(self._start_method(single=True), job),
            f"{AUTOMATIC_MACHINE}.StartContinuous": Method(self._start_method(single=False), job),
            "RecipeManagement.PrepareRecipe": Method(self._prepare, (*recipe, _boolean(False))),
            "RecipeManagement.UnprepareRecipe": Method(self._unprepare, recipe),
            "RecipeManagement.GetRecipeListFiltered": Method(self._recipes, _empty_list_outputs()),
        }

    def _results_table(self) -> dict[str, Method]:
        null = ua.Variant()
        components = (_boolean(False), _number(0), *[null] * len(_COMPONENTS))
        return {
            "ResultManagement.GetResultById": Method(self._result_by_id, (_number(0), null)),
            "ResultManagement.GetResultComponentsById": Method(self._components, components),
            "ResultManagement.GetResultListFiltered": Method(self._results, _empty_list_outputs()),
            "ResultManagement.ReleaseResultHandle": Method(self._release),
        }

    def _plain_table(self) -> dict[str, Method]:
        text = ua.Variant("", ua.VariantType.String)
        return {
            "Plain.StartJob": Method(self._start_plain, (text,)),
            "Plain.PrepareRecipe": Method(self._prepare_plain, (_boolean(False),)),
            "Plain.GetResult": Method(self._result_plain, (_error(0), text, text)),
        }

    async def call(
        self, method: Method, types: Sequence[int], arguments: Sequence[ua.Variant]
    ) -> ua.CallMethodResult | ua.StatusCode | list[ua.Variant]:
        """Carry out a method, and return the outputs; the last output is the error's number.

        Args:
            method: the method.
            types: numbers of the arguments' types; 0 for ids and lists.
            arguments: the client's arguments.
        """
        if len(arguments) != len(types):
            too_few = len(arguments) < len(types)
            codes = ua.StatusCodes
            return ua.StatusCode(
                codes.BadArgumentsMissing if too_few else codes.BadTooManyArguments
            )
        try:
            values = [
                _argument(argument, kind) for argument, kind in zip(arguments, types, strict=True)
            ]
        except MethodArgumentError:
            return _wrong_arguments(arguments, types)
        try:
            async with asyncio.timeout(CALL_TIMEOUT):
                outputs = await method.carry_out(*values)
                await self._wait_published()
        except WrongStateError:
            return ua.StatusCode(ua.StatusCodes.BadInvalidState)
        except (SmartCamError, TimeoutError, LookupError) as exc:
            self._nodes.show_message(str(exc), type(exc).__name__, None)
            code = NOT_FOUND if isinstance(exc, LookupError) else code_of(exc)
            return [*method.failed_outputs, _error(code)]
        except asyncio.CancelledError:
            raise
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("outlet: camera %s", self._nodes.name)
            self._nodes.show_message(text_of(exc), type(exc).__name__, None)
            return ua.StatusCode(ua.StatusCodes.BadInternalError)
        return [*outputs, _error(0)]

    def _id(self, kind: str, text: str) -> ua.Variant:
        identity = self._values.identity(kind, text)
        return ua.Variant(identity, ua.VariantType.ExtensionObject)

    # ------------------------------------------------------------------ states and jobs

    def _change_method(self, name: str, target: str) -> Callable[..., Awaitable[list[ua.Variant]]]:
        async def change(_cause: int = 0, reason: str = "") -> list[ua.Variant]:
            self._system.change_state(name, target, reason)
            return []

        return change

    async def _confirm(self, _comment: Any) -> list[ua.Variant]:
        self._nodes.confirm_trouble()
        return []

    def _end_method(self, name: str) -> Callable[..., Awaitable[list[ua.Variant]]]:
        async def end(_cause: int, reason: str) -> list[ua.Variant]:
            self._system.end_job(name, reason)
            return []

        return end

    def _start_method(self, *, single: bool) -> Callable[..., Awaitable[list[ua.Variant]]]:
        async def start(
            meas: Any, part: Any, recipe: Any, product: Any, _more: Any
        ) -> list[ua.Variant]:
            ids = (
                self._client_id("MeasIdDataType", meas),
                self._client_id("PartIdDataType", part),
                self._client_id("ProductIdDataType", product),
            )
            job = self._system.start_job(ids, _text(recipe), single=single)
            return [self._id("JobIdDataType", job.id)]

        return start

    def _client_id(self, kind: str, value: Any) -> Any:
        """Return the client's id, which the result will have; None without an id."""
        text, description = _text(value), getattr(value, "Description", None)
        if not text and description is None:
            return None
        identity = self._values.identity(kind, text)
        if description is not None and len(description.Text or "") <= MAX_TEXT_CHARACTERS:
            identity.Description = description
        return identity

    async def _start_plain(self, meas: str, part: str, recipe: str) -> list[ua.Variant]:
        """Start a single job for a client that does not support structures."""
        (job,) = await self._start_method(single=True)(meas, part, recipe, None, None)
        return [ua.Variant(job.Value.Id, ua.VariantType.String)]

    async def _prepare_plain(self, recipe: str) -> list[ua.Variant]:
        """Prepare a recipe for a client that does not support structures."""
        _, completed = await self._prepare(recipe, None)
        return [completed]

    async def _result_plain(self, job: str) -> list[ua.Variant]:
        """Return state, values and error of a job's result as plain values."""
        kept = next(
            self._book.find_results(self._nodes.name, lambda kept: kept.result.job_id == job), None
        )
        if not job or kept is None:
            raise KeyError(f"there is no result of job {job!r:.80}")
        state = ua.Variant(kept.result.state, ua.VariantType.Int32)
        text = ua.Variant(kept.values_json, ua.VariantType.String)
        return [state, text, ua.Variant(kept.result.error, ua.VariantType.String)]

    # ------------------------------------------------------------------ recipes

    async def _prepare(self, external: Any, internal: Any) -> list[ua.Variant]:
        application = self._system.application_of(_text(external), _text(internal))
        completed = await self._system.prepare(application)
        return [self._id("RecipeIdInternalDataType", str(application)), _boolean(completed)]

    async def _unprepare(self, external: Any, internal: Any) -> list[ua.Variant]:
        application = self._system.application_of(_text(external), _text(internal))
        if application != self._system.prepared_application:
            raise UnknownRecipeError(f"recipe {application} is not prepared")
        self._system.unprepare()
        return [self._id("RecipeIdInternalDataType", str(application))]

    async def _recipes(
        self, external: Any, product: Any, prepared: int, max_count: int, first: int, timeout: int
    ) -> list[ua.Variant]:
        del timeout  # the answer does not need a handle
        ready, name = self._system.prepared_application, _text(external)
        numbers = dict.fromkeys(self._system.recipes.values())
        if self._system.application:
            numbers[self._system.application] = None
        matching = [
            number
            for number in numbers
            if prepared not in (0, 1) or (number == ready) == bool(prepared)
            if not name or name in (self._system.recipe_name(number), str(number))
            if not _text(product)
        ]
        page = matching[first : first + _limit(max_count)]
        listed = [self._values.identity("RecipeIdInternalDataType", str(number)) for number in page]
        complete = first + len(page) >= len(matching)
        return [_boolean(complete), _number(len(page)), _number(0), _list(listed)]

    # ------------------------------------------------------------------ results

    def _kept_result(self, result: Any) -> KeptResult:
        text = _text(result)
        kept = self._book.get(text, self._nodes.name)
        if kept is None:
            raise KeyError(f"there is no result {text!r:.120}")
        return kept

    async def _result_by_id(self, result: Any, timeout: int) -> list[ua.Variant]:
        kept = self._kept_result(result)
        value = ua.Variant(kept.structure, ua.VariantType.ExtensionObject)
        return [_number(self._book.new_handle(timeout)), value]

    async def _components(self, result: Any, timeout: int) -> list[ua.Variant]:
        value = self._kept_result(result).structure
        handle = _number(self._book.new_handle(timeout))
        outputs = [_boolean(bool(value.HasTransferableDataOnFile)), handle]
        for name, value_type in _COMPONENTS:
            component = getattr(value, name)
            outputs.append(ua.Variant() if component is None else ua.Variant(component, value_type))
        return outputs

    async def _results(self, state: int, *arguments: Any) -> list[ua.Variant]:
        *ids, max_count, first, timeout = arguments
        wanted = [
            (name, text)
            for name, filter_id in zip(_FILTERS, ids, strict=True)
            if (text := _text(filter_id))
        ]

        def matches(kept: KeptResult) -> bool:
            if state and kept.result.state != state:
                return False
            identities = [getattr(kept.structure, name) for name, _ in wanted]
            texts = [text for _, text in wanted]
            return all(
                identity is not None and identity.Id == text
                for identity, text in zip(identities, texts, strict=True)
            )

        limit = _limit(max_count)
        matching = self._book.find_results(self._nodes.name, matches)
        page = [*itertools.islice(matching, first, first + limit + 1)]
        listed = [kept.structure for kept in page[:limit]]
        handle = _number(self._book.new_handle(timeout))
        return [_boolean(len(page) <= limit), _number(len(listed)), handle, _list(listed)]

    async def _release(self, handle: int) -> list[ua.Variant]:
        if not self._book.release(handle):
            raise KeyError(f"there is no handle {handle}")
        return []


_FILTERS = (
    "MeasId",
    "PartId",
    "ExternalRecipeId",
    "InternalRecipeId",
    "ExternalConfigurationId",
    "InternalConfigurationId",
    "ProductId",
    "JobId",
)
_OBJECT = ua.VariantType.ExtensionObject
_COMPONENTS = (
    ("IsPartial", ua.VariantType.Boolean),
    ("IsSimulated", ua.VariantType.Boolean),
    ("ResultState", ua.VariantType.Int32),
    ("MeasId", _OBJECT),
    ("PartId", _OBJECT),
    ("ExternalRecipeId", _OBJECT),
    ("InternalRecipeId", _OBJECT),
    ("ProductId", _OBJECT),
    ("ExternalConfigurationId", _OBJECT),
    ("InternalConfigurationId", _OBJECT),
    ("JobId", _OBJECT),
    ("CreationTime", ua.VariantType.DateTime),
    ("ProcessingTimes", _OBJECT),
    ("ResultContent", ua.VariantType.Variant),
)


def type_number(data_type: ua.NodeId, rank: int) -> int:
    """Return the number of an argument's type; 0 for ids, lists and other structures."""
    if rank >= 0:
        return 0
    if data_type.NamespaceIndex == 0:
        number = int(data_type.Identifier)
        return 0 if number in (ua.ObjectIds.Structure, ua.ObjectIds.BaseDataType) else number
    derived = {node_ids()[name]: number for name, number in _DERIVED_TYPES.items()}
    return derived.get(int(data_type.Identifier), 0)


def _argument(argument: ua.Variant, kind: int) -> Any:
    """Return a client's argument as a plain value; ids and lists are returned unchanged."""
    value = argument.Value
    python_type = _PYTHON_TYPES.get(kind)
    if python_type is not None:
        if not isinstance(value, python_type) or (python_type is int and isinstance(value, bool)):
            raise MethodArgumentError
        return value
    if kind == ua.ObjectIds.String:
        return _text(value)
    if kind == 0 and not isinstance(value, list):
        _text(value)  # raises for a wrong id
    return value


def _text(value: Any) -> str:
    """Return the text of a client's id, which may be a structure, a text, a number, or None.

    Raises:
        MethodArgumentError: the id is of another type, or too long.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)  # the number of a recipe
    text = value if isinstance(value, str) else getattr(value, "Id", None)
    while text is not None and not isinstance(text, str):  # an id within an id
        text = getattr(text, "Id", None)
    is_empty = value is None or (isinstance(value, ua.ExtensionObject) and not value.Body)
    if text is None and not is_empty and not hasattr(value, "Id"):
        raise MethodArgumentError
    text = (text or "").strip()
    if len(text) > MAX_TEXT_CHARACTERS:
        raise MethodArgumentError
    return text


def _wrong_arguments(arguments: Sequence[ua.Variant], types: Sequence[int]) -> ua.CallMethodResult:
    """Return the answer to a call whose arguments have wrong types, with a status for each one."""
    result = ua.CallMethodResult()
    result.StatusCode = ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
    for argument, kind in zip(arguments, types, strict=True):
        status = ua.StatusCode()
        try:
            _argument(argument, kind)
        except MethodArgumentError:
            status = ua.StatusCode(ua.StatusCodes.BadTypeMismatch)
        result.InputArgumentResults.append(status)
    return result


def _limit(requested: int) -> int:
    return min(requested, MAX_LISTED) if requested else MAX_LISTED


def _error(code: int) -> ua.Variant:
    return ua.Variant(code, ua.VariantType.Int32)


def _boolean(value: bool) -> ua.Variant:
    return ua.Variant(value, ua.VariantType.Boolean)


def _number(value: int) -> ua.Variant:
    return ua.Variant(value, ua.VariantType.UInt32)


def _list(values: list[Any]) -> ua.Variant:
    return ua.Variant(values, ua.VariantType.ExtensionObject, is_array=True)


def _empty_list_outputs() -> tuple[ua.Variant, ...]:
    return _boolean(True), _number(0), _number(0), _list([])
