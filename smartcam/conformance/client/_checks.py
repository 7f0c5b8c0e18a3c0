"""The rules for a client, each with its scene, its weight and its source.

Sources are the keys of the list in ``docs/sources.md``.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.conformance._dialects import EVERY_DIALECT, SMART_DIALECTS
from smartcam.conformance.client import _rules as rules
from smartcam.conformance.client._scenes import SCENES

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.conformance.client._runs import ClientRun
    from smartcam.conformance.client._scenes import Scene


class Grade(enum.Enum):
    """The weight of a check."""

    MUST = "must"
    """A client that breaks the rule is wrong: a test fails."""
    SHOULD = "should"
    """A client that follows the rule is better, but the documents leave it open, or it costs
    effort: only reported."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientCheck:
    """A rule with the scene in which it is checked."""

    name: str  # name of the check, in reports and for ``-k``
    scene: Scene  # the camera and the task
    rule: Callable[[ClientRun], str | None]  # returns the client's mistake, or None
    reason: str  # reason of the rule: what the camera's documents say, or what a client needs
    source: str  # source in the documents: published, derived or inferred
    grade: Grade = Grade.MUST  # weight of a breach
    dialects: tuple[str, ...] = EVERY_DIALECT  # dialects that the check is about

    def applies(self, dialect: str, transport: str) -> bool:
        """Return True if the check applies to this kind of camera."""
        scene = self.scene
        return (
            dialect in self.dialects and dialect in scene.dialects and transport in scene.transports
        )


_NEEDS_BOUND = "a client that waits without a bound stops the machine it works for"
_MOSTLY_SILENT = "every refusal but one is silence"

CHECKS: tuple[ClientCheck, ...] = (
    # ------------------------------------------------------------------ the conversation
    ClientCheck(
        name="triggers",
        scene=SCENES["trigger"],
        rule=rules.gives_results,
        reason="a trigger is answered by a result container: its id, then the bytes",
        source="SC-B33, MV27, published",
    ),
    ClientCheck(
        name="triggers_three_times",
        scene=SCENES["trigger_3"],
        rule=rules.gives_results,
        reason="each inspection has its own result, in order",
        source="SC-B33, MV27, published",
    ),
    ClientCheck(
        name="sends_whole_messages",
        scene=SCENES["trigger"],
        rule=rules.sends_whole_messages,
        reason="what is no message is ignored without an answer",
        source="SC-A28, MV25, published",
    ),
    ClientCheck(
        name="sends_whole_messages_in_a_switch",
        scene=SCENES["switch"],
        rule=rules.sends_whole_messages,
        reason="what is no message is ignored without an answer",
        source="SC-A28, MV25, published",
    ),
    ClientCheck(
        name="connects_first",
        scene=SCENES["trigger"],
        rule=rules.connects_first,
        reason="before Connect is answered nothing but Connect is heard",
        source="SC-A28, SC-A29, published; what happens to the rest: inferred",
    ),
    ClientCheck(
        name="disconnects",
        scene=SCENES["trigger"],
        rule=rules.disconnects,
        reason="a session ends with Disconnect, then the socket is closed",
        source="SC-A28, SC-C40, published",
    ),
    ClientCheck(
        name="triggers_as_often_as_told",
        scene=SCENES["trigger_3"],
        rule=rules.triggers_as_told,
        reason="each trigger is an inspection",
        source="SC-C50, published",
    ),
    ClientCheck(
        name="asks_one_at_a_time",
        scene=SCENES["trigger"],
        rule=rules.asks_one_at_a_time,
        reason="an answer carries nothing but its id, so one request of a kind can be open",
        source="SC-A29, published; that it matters: derived",
        grade=Grade.SHOULD,
    ),
    ClientCheck(
        name="watches",
        scene=SCENES["watch"],
        rule=rules.gives_results,
        reason="an application that runs by itself sends results without being asked",
        source="MV31, SC-C50, published",
    ),
    ClientCheck(
        name="watches_without_triggers",
        scene=SCENES["watch"],
        rule=rules.never_triggers,
        reason="an application that runs by itself ignores triggers",
        source="SC-C50, published",
        grade=Grade.SHOULD,
    ),
    # ------------------------------------------------------------------ switching
    ClientCheck(
        name="switches",
        scene=SCENES["switch"],
        rule=rules.gives_results,
        reason="stop, switch, start; then results are the new application's",
        source="SC-B34, published",
    ),
    ClientCheck(
        name="stops_before_a_switch",
        scene=SCENES["switch"],
        rule=rules.stops_first,
        reason="the application must be stopped first",
        source="SC-B34, published",
        dialects=SMART_DIALECTS,
    ),
    ClientCheck(
        name="waits_for_the_switch",
        scene=SCENES["switch"],
        rule=rules.waits_for_switch,
        reason="the answer comes after the switch, which takes several 100 ms",
        source="SC-B34, published",
    ),
    ClientCheck(
        name="waits_for_a_late_switch_answer",
        scene=SCENES["late_switch_answer"],
        rule=rules.waits_for_switch,
        reason="statuses can come between the request and its answer: they are not the answer",
        source="SC-B33, SC-B34, derived",
    ),
    ClientCheck(
        name="switches_with_a_late_answer",
        scene=SCENES["late_switch_answer"],
        rule=rules.gives_results,
        reason="statuses can come between the request and its answer: they are not the answer",
        source="SC-B33, SC-B34, derived",
    ),
    ClientCheck(
        name="waits_until_busy_falls",
        scene=SCENES["busy_after_switch"],
        rule=rules.is_quiet_while_busy,
        reason="BUSY is set while the application is loaded; its order with the answer is open",
        source="SC-B33, published; the order: inferred",
    ),
    ClientCheck(
        name="switches_with_busy_after_it",
        scene=SCENES["busy_after_switch"],
        rule=rules.gives_results,
        reason="while BUSY is set no inspection begins",
        source="SC-B33, published; the order: inferred",
    ),
    ClientCheck(
        name="reports_refused_switch",
        scene=SCENES["refused_switch"],
        rule=rules.fails,
        reason="the answer says code 1 (in the dialect bid 0x1a), and the id that is still active",
        source="SC-B34, ID-a 229, published",
    ),
    # ------------------------------------------------------------------ bytes and messages
    ClientCheck(
        name="reads_byte_by_byte",
        scene=SCENES["byte_by_byte"],
        rule=rules.gives_results,
        reason="TCP keeps no boundaries: a message may come in any pieces",
        source="SC-C40, published; derived for pieces",
    ),
    ClientCheck(
        name="reads_several_at_once",
        scene=SCENES["coalesced"],
        rule=rules.gives_results,
        reason="several messages may share a segment; only the length field separates them",
        source="SC-C40, published",
    ),
    ClientCheck(
        name="passes_over_unknown_messages",
        scene=SCENES["unknown_messages"],
        rule=rules.gives_results,
        reason="a later firmware may have more messages; their length says where they end",
        source="inferred",
        grade=Grade.SHOULD,
    ),
    ClientCheck(
        name="passes_over_unknown_status_bits",
        scene=SCENES["unknown_bits"],
        rule=rules.gives_results,
        reason="bits without a name may be set",
        source="SC-A30, SC-B33: bits 3, 5, 6 and from 10 on have no name; may be set: inferred",
        grade=Grade.SHOULD,
    ),
    ClientCheck(
        name="takes_no_status_for_an_answer",
        scene=SCENES["status_between"],
        rule=rules.gives_results,
        reason="a status comes after every change, also between a request and its answer",
        source="SC-A30, ID-b 210, published",
    ),
    ClientCheck(
        name="takes_no_other_applications_result",
        scene=SCENES["result_of_another"],
        rule=rules.ends,
        reason="a container begins with the id of the application that made it",
        source="SC-B33, SC-C45, published",
    ),
    # ------------------------------------------------------------------ owners of results
    ClientCheck(
        name="takes_no_earlier_result",
        scene=SCENES["inspection_under_way"],
        rule=rules.gives_results,
        reason="a result that comes before the trigger, or of an inspection under way, is older",
        source="SC-C50, published for Waiting for Trigger; derived",
    ),
    ClientCheck(
        name="triggers_when_the_camera_waits",
        scene=SCENES["inspection_under_way"],
        rule=rules.triggers_when_waiting,
        reason="Waiting for Trigger tells whether a trigger would be taken",
        source="SC-C50, published",
        grade=Grade.SHOULD,
    ),
    ClientCheck(
        name="takes_no_result_twice",
        scene=SCENES["sent_twice"],
        rule=rules.gives_results,
        reason="a program with two send tools may send two containers for one trigger",
        source="inferred",
        grade=Grade.SHOULD,
    ),
    # ------------------------------------------------------------------ missing answers
    ClientCheck(
        name="fails_where_triggers_are_dropped",
        scene=SCENES["overtriggered"],
        rule=rules.fails,
        reason="a trigger that is dropped shows in the status only: Overtriggered",
        source="SC-A30, SC-B33, published",
    ),
    ClientCheck(
        name="fails_without_a_result",
        scene=SCENES["no_result"],
        rule=rules.fails,
        reason="nothing answers a trigger; " + _NEEDS_BOUND,
        source="SC-A28, published",
    ),
    ClientCheck(
        name="fails_where_busy_never_falls",
        scene=SCENES["busy_for_ever"],
        rule=rules.fails,
        reason="while BUSY is set no inspection begins; " + _NEEDS_BOUND,
        source="SC-A30, published; the rest: inferred",
    ),
    ClientCheck(
        name="ends_where_the_camera_is_stopped",
        scene=SCENES["stopped"],
        rule=rules.ends,
        reason="a stopped application ignores triggers; " + _MOSTLY_SILENT,
        source="MV31, published",
    ),
    ClientCheck(
        name="fails_where_connect_is_not_answered",
        scene=SCENES["no_connect_answer"],
        rule=rules.fails,
        reason="a camera is silent to what it does not understand; " + _NEEDS_BOUND,
        source="SC-A28, derived",
    ),
    ClientCheck(
        name="ends_where_query_is_not_answered",
        scene=SCENES["no_query_answer"],
        rule=rules.ends,
        reason="a camera is silent to what it does not understand; " + _NEEDS_BOUND,
        source="SC-A28, derived",
    ),
    ClientCheck(
        name="fails_where_nothing_listens",
        scene=SCENES["nothing_listens"],
        rule=rules.fails,
        reason="a restart takes about 30 s, in which nothing is received",
        source="MV31, published",
    ),
    # ------------------------------------------------------------------ broken links
    ClientCheck(
        name="fails_where_the_camera_closes",
        scene=SCENES["closed"],
        rule=rules.fails,
        reason="a newcomer takes the session, a restart ends it: the connection is closed",
        source="SC-A28, published for UDP; for TCP inferred",
    ),
    ClientCheck(
        name="fails_where_the_camera_resets",
        scene=SCENES["reset"],
        rule=rules.fails,
        reason="a restart ends the connection without a word",
        source="MV31, published; by a reset: inferred",
    ),
    ClientCheck(
        name="fails_where_the_camera_is_gone",
        scene=SCENES["half_open"],
        rule=rules.fails,
        reason="a pulled cable shows as silence only; " + _NEEDS_BOUND,
        source="ID-a 52, published: a dead TCP peer is not noticed promptly",
    ),
    ClientCheck(
        name="reports_cut_result",
        scene=SCENES["cut_result"],
        rule=rules.fails,
        reason="a container has as many bytes as its header says, or it is no container",
        source="SC-A28, published for the length field",
    ),
    ClientCheck(
        name="fails_where_garbage_comes",
        scene=SCENES["garbage"],
        rule=rules.fails,
        reason="after bytes that make no frame nothing can be trusted; " + _NEEDS_BOUND,
        source="inferred",
    ),
    ClientCheck(
        name="reports_impossible_length",
        scene=SCENES["length_bomb"],
        rule=rules.fails,
        reason="a container has about 64 kB at most; " + _NEEDS_BOUND,
        source="HAL 15, published",
    ),
)
"""Every check, in the order of a report."""
