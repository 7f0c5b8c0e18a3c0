"""Rules that a client's messages and results must follow.

Each rule is a function that gets a :class:`~smartcam.conformance.client._runs.ClientRun` and
returns the client's mistake as text, or None if the client follows the rule.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART_DIALECTS
from smartcam.conformance.client._scenes import read_container
from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols.messages import Request, Sender

if TYPE_CHECKING:
    from smartcam.conformance.client._runs import ClientRun, RecordedMessage

STATUS_GRACE = 0.05
"""Seconds after a status was sent in which the client may not have received it yet."""


def _find_wrong_result(run: ClientRun) -> str | None:
    """Return the first mistake in the client's results; too few results are no mistake."""
    scene, sent_run_numbers, last_run = run.scene, run.sent_run_numbers, -1
    for number, data in enumerate(run.outcome.results, 1):
        label = f"result {number}, {data[:32].hex(' ') or 'empty'},"
        content = read_container(data)
        if content is None:
            return f"{label} is {len(data)} bytes long; expected 8 after the application's id"
        application, run_number = content
        if application != scene.application:
            return f"{label} is of application {application}, not of {scene.application}"
        if run_number not in sent_run_numbers:
            return f"{label} was never sent"
        if run_number in scene.stale:
            return f"{label} is of an inspection that was under way before the client's trigger"
        if run_number == last_run:
            return f"{label} is of the same inspection as the one before"
        if run_number < last_run:
            return f"{label} is of an earlier inspection than the one before"
        last_run = run_number
    if len(run.outcome.results) > scene.result_count:
        return f"it gave {len(run.outcome.results)} results, {scene.result_count} were wanted"
    return None


def _end_text(run: ClientRun) -> str:
    error = run.outcome.error
    return "it says that all is well" if error is None else f"it failed: {error}"


def ends(run: ClientRun) -> str | None:
    """The client ends in time, with the right results or with an error."""
    outcome = run.outcome
    if not outcome.ended_in_time:
        return f"it was still under way after {run.timeout:g} s"
    mistake = _find_wrong_result(run)
    if mistake is None and outcome.error is None and len(outcome.results) < run.scene.result_count:
        count = len(outcome.results)
        return f"it says that all is well, and gave {count} of {run.scene.result_count} results"
    return mistake


def fails(run: ClientRun) -> str | None:
    """The client ends in time, with an error and without a result."""
    outcome = run.outcome
    if outcome.ended_in_time and (outcome.results or outcome.error is None):
        count = len(outcome.results)
        return f"{_end_text(run)}, and gave {count} result{'s' if count != 1 else ''}"
    return ends(run)


def gives_results(run: ClientRun) -> str | None:
    """The client gives exactly the results that its task asks for."""
    mistake = ends(run)
    if mistake is None and run.outcome.error is not None:
        return _end_text(run)
    if mistake is None and len(run.outcome.results) < run.scene.result_count:
        return f"it gave {len(run.outcome.results)} of {run.scene.result_count} results"
    return mistake


def sends_whole_messages(run: ClientRun) -> str | None:
    """The client sends only messages of the dialect."""
    for _, request in run.requests:
        if request.error is not None and "came in state" in request.error:
            continue  # a message, at the wrong time
        if request.error is not None or request.message is None:
            return f"the camera ignores {request.hex or 'it'}: {request.error or 'no such message'}"
    return None


def connects_first(run: ClientRun) -> str | None:
    """The client sends only Connect, and Disconnect before it, until the answer to Connect."""
    connected_peers: set[str] = set()
    for message in run.messages:
        if isinstance(message.message, m.ConnectAnswer):
            connected_peers.add(message.peer)
        elif (
            message.sender is Sender.CLIENT
            and message.peer not in connected_peers
            and not isinstance(message.message, (m.Connect, m.Disconnect))
        ):
            return f"{_message_name(message)} came before Connect was answered"
    if not connected_peers:
        return "it did not connect"
    return None


def disconnects(run: ClientRun) -> str | None:
    """The client's last message is Disconnect."""
    last_messages: dict[str, RecordedMessage] = {}
    for message in run.messages:
        if message.sender is Sender.CLIENT:
            last_messages[message.peer] = message
    if not last_messages:
        return "it did not connect"
    unfinished = [
        request
        for request in last_messages.values()
        if not isinstance(request.message, m.Disconnect)
    ]
    return f"its last word was {_message_name(unfinished[0])}" if unfinished else None


def asks_one_at_a_time(run: ClientRun) -> str | None:
    """The client has at most one open request of a kind, since answers do not name their request.

    After a trigger it may send a second Query or Get status: their answers come in order.
    """
    open_requests: set[tuple[str, type[m.Message]]] = set()
    for recorded in run.messages:
        message = recorded.message
        if isinstance(message, Request) and message.answer and run.dialect.answers(type(message)):
            key = (recorded.peer, message.answer)
            if key in open_requests:
                return (
                    f"{_message_name(recorded)} came although the one before was not answered yet"
                )
            open_requests.add(key)
        if isinstance(message, m.Trigger):  # then a second query is allowed
            open_requests -= {(recorded.peer, m.QueryAnswer), (recorded.peer, m.StatusReport)}
        elif message is not None and recorded.sender is Sender.CAMERA:
            open_requests.discard((recorded.peer, type(message)))
    return None


def triggers_as_told(run: ClientRun) -> str | None:
    """The client sends the number of triggers in its task."""
    count = sum(isinstance(request.message, m.Trigger) for _, request in run.requests)
    if count != run.scene.result_count:
        return f"it sent {count} triggers, {run.scene.result_count} were asked for"
    return None


def never_triggers(run: ClientRun) -> str | None:
    """The client does not trigger an application that runs by itself."""
    count = sum(isinstance(request.message, m.Trigger) for _, request in run.requests)
    return f"it sent {count} triggers" if count else None


def triggers_when_waiting(run: ClientRun) -> str | None:
    """The client triggers only while the camera's last status has Waiting for Trigger."""
    for index, request in run.requests:
        if isinstance(request.message, m.Trigger):
            status = run.status_before(index)
            if status is None or Status.WAITING_FOR_TRIGGER not in status:
                status_text = (
                    "no status had been sent" if status is None else f"the status was {status}"
                )
                return f"Trigger came when {status_text}"
    return None


def stops_first(run: ClientRun) -> str | None:
    """The client stops the application before it loads another."""
    running = run.scene.running
    for _, request in run.requests:
        if isinstance(request.message, (m.Start, m.Stop)):
            running = isinstance(request.message, m.Start)
        elif isinstance(request.message, m.SwitchApplication):
            if running and run.dialect.name in SMART_DIALECTS:
                return f"{_message_name(request)} came while the application ran"
            return None
    return "it did not send SwitchApplication"


def waits_for_switch(run: ClientRun) -> str | None:
    """The client gives no command between SwitchApplication and its answer."""
    switching: RecordedMessage | None = None
    for message in run.messages:
        if isinstance(message.message, m.SwitchApplication):
            switching = message
        elif isinstance(message.message, m.SwitchAnswer):
            return None
        elif switching is not None and _is_command(message):
            seconds = message.time - switching.time
            name = _message_name(message)
            return f"{name} came {seconds:.3f} s after SwitchApplication, before its answer"
    return None if switching is not None else "it did not send SwitchApplication"


def is_quiet_while_busy(run: ClientRun) -> str | None:
    """The client gives no command while the camera's last status has BUSY."""
    busy_since: float | None = None
    for message in run.messages:
        if isinstance(message.message, m.StatusReport) and not message.lost:
            busy = Status.BUSY in message.message.status
            busy_since = None if not busy else message.time if busy_since is None else busy_since
        elif (
            busy_since is not None
            and _is_command(message)
            and message.time - busy_since > STATUS_GRACE
        ):
            seconds = message.time - busy_since
            return f"{_message_name(message)} came {seconds:.3f} s after BUSY was sent"
    return None


def _is_command(recorded: RecordedMessage) -> bool:
    """Return True if a message is a command; queries and the session's end are not."""
    harmless = (m.Query, m.GetStatus, m.GetClock, m.Connect, m.Disconnect)
    return recorded.sender is Sender.CLIENT and not isinstance(recorded.message, harmless)


def _message_name(recorded: RecordedMessage) -> str:
    return recorded.hex if recorded.message is None else type(recorded.message).__name__
