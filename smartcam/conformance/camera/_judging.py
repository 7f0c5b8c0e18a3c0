"""Run the checks and questions on a camera, one after the other."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_iterable, check_kind, check_text
from smartcam.conformance.camera._items import ITEMS
from smartcam.conformance.camera._options import ConformanceOptions
from smartcam.conformance.camera._raw_client import LinkClosedError
from smartcam.conformance.camera._report import CameraReport
from smartcam.conformance.camera._results import CameraFinding, CheckOutcome, Item, Question
from smartcam.conformance.camera._session_under_test import CameraUnderTest
from smartcam.conformance.camera._verdicts import Differs, NotObserved, Undescribed
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable


CONNECT_CHECK = "connect-is-answered"
"""Name of the check that fails if there is no camera; then the other checks are not observed."""


def judge(options: ConformanceOptions, names: Iterable[str] | None = None) -> CameraReport:
    """Run all checks and questions, or some, on a camera, and return the report.

    It blocks for a minute or two with the default times: do not call it in an event loop's thread.
    Any other client loses the camera. The active application and the run mode are restored, also if
    an exception, such as Ctrl-C, ends the call.

    Args:
        options: options of the examination.
        names: names of the checks and questions; None for all.

    Raises:
        ConfigurationError: the address cannot work, or a name is unknown.
    """
    check_kind(options, ConformanceOptions, "options", "ConformanceOptions", "judge")
    wanted_names = None
    if names is not None:
        name_list = check_iterable(names, "names", "names of checks", "judge")
        wanted_names = {check_text(name, "names", "judge") for name in name_list}
    unknown = sorted((wanted_names or set()) - {item.name for item in ITEMS})
    if unknown:
        raise ConfigurationError(f"there is no check or question {unknown[0]!r}")
    camera = CameraUnderTest(options)
    report = CameraReport(camera)
    try:
        for item in ITEMS:
            if wanted_names is None or item.name in wanted_names:
                report.add(judge_item(camera, item))
    finally:
        camera.restore(retry=True)
    return report


def judge_item(camera: CameraUnderTest, item: Item) -> CameraFinding:
    """Run one check or question, and undo its changes of the camera.

    Each wait has a limit, which the options set.
    """
    camera.clear_message_log()
    started_at = time.monotonic()
    was_gone = bool(camera.gone_reason)
    try:
        result = _run_item(camera, item)
        wire = tuple(camera.message_log)
    finally:
        camera.restore()
    if camera.gone_reason and not was_gone and result["outcome"] is not CheckOutcome.DIFFERS:
        result = {
            "outcome": CheckOutcome.DIFFERS,
            "expected": "the camera is still there",
            "observed": camera.gone_reason,
        }
    failed = result["outcome"] in {CheckOutcome.DIFFERS, CheckOutcome.UNDESCRIBED}
    source, grade = item.source(camera.known_dialect)
    return CameraFinding(
        item=item,
        source=source,
        grade=grade,
        wire=wire if failed else (),
        seconds=time.monotonic() - started_at,
        **result,
    )


def _run_item(camera: CameraUnderTest, item: Item) -> dict[str, Any]:
    try:
        reason = _reason_not_applicable(camera, item)
        if reason:
            return {"outcome": CheckOutcome.NOT_APPLICABLE, "text": reason}
        camera.require_allowed(item.needs)
        value = item.run(camera)
    except Undescribed as exc:
        return {
            "outcome": CheckOutcome.UNDESCRIBED,
            "expected": exc.expected,
            "observed": exc.observed,
        }
    except Differs as exc:
        return {"outcome": CheckOutcome.DIFFERS, "expected": exc.expected, "observed": exc.observed}
    except LinkClosedError as exc:
        return {
            "outcome": CheckOutcome.DIFFERS,
            "expected": "the link stays up",
            "observed": str(exc),
        }
    except NotObserved as exc:
        return {"outcome": CheckOutcome.NOT_OBSERVED, "text": str(exc)}
    if isinstance(item, Question):
        return {"outcome": CheckOutcome.OBSERVED, "value": value}
    return {"outcome": CheckOutcome.AS_DOCUMENTED, "text": value or ""}


def _reason_not_applicable(camera: CameraUnderTest, item: Item) -> str:
    """Return the reason why a check does not apply here, "" if it applies."""
    try:
        dialect = camera.dialect
    except Differs as exc:
        if item.name == CONNECT_CHECK:
            raise
        raise NotObserved(f"the camera answers in no dialect: {exc.observed}") from exc
    if camera.gone_reason and item.name != CONNECT_CHECK and dialect in item.dialects:
        raise NotObserved(f"the camera is gone: {camera.gone_reason}")
    if dialect not in item.dialects:
        return f"only in {' and '.join(item.dialects)}; this camera speaks {dialect}"
    if camera.transport not in item.transports:
        return f"only over {item.transports[0].upper()}"
    return ""
