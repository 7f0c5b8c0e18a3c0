"""Roles, policies, and what a client tries: what every protocol has."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError, FrameError, MessageError
from smartcam.models import Capabilities, Status
from smartcam.protocols import (
    BVS,
    CodeMeaning,
    Dialect,
    Frame,
    Machine,
    Protocol,
    RawRequest,
    Role,
    Transport,
    Verdict,
)
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, POLICIES, Policy, ReadableFrame
from tests.machines import B16, BID, CODE, NO_ID, THESIS
from tests.protocols.inside import UNDOCUMENTED

CAMERA, CLIENT = m.Sender.CAMERA, m.Sender.CLIENT
TCP, UDP = Transport.TCP, Transport.UDP


# ---------------------------------------------------------------------- roles and policies


def test_role_sends_as_itself_and_receives_from_the_other() -> None:
    assert (Role.CLIENT.sends, Role.CLIENT.receives) == (CLIENT, CAMERA)
    assert (Role.CAMERA.sends, Role.CAMERA.receives) == (CAMERA, CLIENT)


def test_policies_only_a_client_on_tcp_fails_and_only_a_camera_wants_exact_lengths() -> None:
    assert dict(POLICIES) == {
        (Role.CLIENT, TCP): Policy(
            fatal=(FrameError, MessageError), exact_length=False, bounded=True
        ),
        (Role.CLIENT, UDP): Policy(fatal=(), exact_length=False, bounded=True),
        (Role.CAMERA, TCP): Policy(fatal=(), exact_length=True),
        (Role.CAMERA, UDP): Policy(fatal=(), exact_length=True),
    }
    assert not any(policy.reports_malformed for policy in POLICIES.values())


def test_verdicts_are_the_four_that_a_request_can_have() -> None:
    assert [one.value for one in Verdict] == ["done", "busy", "unknown", "refused"]
    assert CodeMeaning("not documented", Verdict.REFUSED) == UNDOCUMENTED


# ---------------------------------------------------------------------- a dialect of another kind


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Spoken(Dialect):
    """A dialect of words, with what every dialect must say and no more."""

    room: str = "hall"

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(dialect=self.name, switch=True, get_clock=True)

    @property
    def application_ids(self) -> range:
        return range(10)

    def code(self, code: int, request: type[m.Message] | None = None) -> CodeMeaning:
        return UNDOCUMENTED

    def has(self, message_type: type[m.Message]) -> bool:
        return message_type in {m.Query, m.QueryAnswer, m.GetClock}

    def message_id(self, message: m.Message | type[m.Message]) -> int:
        raise self.unsupported(message if isinstance(message, type) else type(message))

    def make_readable(self, sender: m.Sender, frame: Frame) -> ReadableFrame:
        return ReadableFrame(None, frame.payload.decode(), None, frame.payload)

    def raw_request(self, message_id: int | str, payload: bytes) -> RawRequest:
        return RawRequest(m.Query(), m.QueryAnswer, expects_answer=True, known=True)

    def body(self, answer: m.Message) -> bytes:
        return b""

    def with_parameters(self, parameters: Mapping[str, str]) -> Spoken:
        if parameters.get("room") == "":
            raise ConfigurationError("a room has a name")
        options: dict[str, Any] = dict(parameters)
        return dataclasses.replace(self, **options)


SPOKEN = Spoken(name="spoken", about="words", source="made for the tests")


def protocol(**options: Any) -> Protocol:
    """Return a protocol of two dialects that says what it has to."""
    return Protocol(
        name="made",
        schemes={"made": TCP},
        default_port=1,
        models=(),
        dialects={"spoken": SPOKEN, "b16": B16},
        machine=Machine,
        **options,
    )


def test_dialect_without_more_has_no_quirks_and_all_fields() -> None:
    assert (SPOKEN.quirks, SPOKEN.label) == ((), "spoken")
    assert SPOKEN.fields(m.QueryAnswer) == ("code", "application")
    report = m.StatusReport(status=Status(1))
    assert SPOKEN.reinterpret_status(report, BID) is report
    assert SPOKEN.with_quirks([]) is SPOKEN
    with pytest.raises(ConfigurationError) as caught:
        SPOKEN.with_quirks(["loud"])
    assert str(caught.value) == "dialect spoken has no quirk 'loud'; it has none"


def test_dialect_answers_where_the_answer_is_one_of_its_messages() -> None:
    assert SPOKEN.answers(m.Query)
    assert not SPOKEN.answers(m.GetClock)
    assert not SPOKEN.answers(m.Start)


def test_dialect_unsupported_names_itself_the_message_and_what_it_can() -> None:
    error = SPOKEN.unsupported(m.Start)
    assert str(error) == "dialect spoken has no Start; it can: switch, get_clock"


# ---------------------------------------------------------------------- what a client tries


@pytest.mark.parametrize(
    ("transport", "groups"),
    [
        (TCP, [(B16, BID, CODE), (HANDBOOK,), (THESIS,)]),
        (UDP, [(HANDBOOK,), (B16, BID, CODE), (THESIS,)]),
    ],
)
def test_tries_without_a_dialect_are_the_most_probable_first(
    transport: Transport, groups: list[tuple[Dialect, ...]]
) -> None:
    assert BVS.dialect_groups(transport) == groups
    assert {one.name for group in groups for one in group} == {*BVS.dialects}


@pytest.mark.parametrize("transport", Transport)
@pytest.mark.parametrize(
    ("name", "group"),
    [("handbook", (HANDBOOK,)), ("thesis", (THESIS,)), ("b16", (B16, CODE)), ("bid", (BID,))],
)
def test_tries_of_a_pinned_dialect_are_it_and_its_quirks(
    name: str, group: tuple[Dialect, ...], transport: Transport
) -> None:
    assert BVS.dialect_groups(transport, name) == [group]


@pytest.mark.parametrize("transport", Transport)
def test_tries_of_pinned_quirks_are_that_one(transport: Transport) -> None:
    assert BVS.dialect_groups(transport, "b16", ["code"]) == [(CODE,)]
    assert BVS.dialect_groups(transport, "b16", ["no_id"]) == [(NO_ID,)]
    both = B16.with_quirks(["code", "no_id"])
    assert BVS.dialect_groups(transport, "b16", ("no_id", "code")) == [(both,)]


def test_tries_of_an_unknown_quirk_is_reported() -> None:
    with pytest.raises(ConfigurationError) as caught:
        BVS.dialect_groups(TCP, "handbook", ["code"])
    assert str(caught.value) == "dialect handbook has no quirk 'code'; it has none"


def test_tries_without_detection_are_the_dialects_one_by_one() -> None:
    assert protocol().dialect_groups(UDP) == [(SPOKEN,), (B16,)]
    assert protocol().dialect_groups(UDP, "b16") == [(B16,)]
    known = protocol(detection={TCP: ((B16, SPOKEN),)})
    assert known.dialect_groups(TCP) == [(B16, SPOKEN)]
    assert known.dialect_groups(UDP) == [(SPOKEN,), (B16,)]


def test_tries_of_a_dialect_that_is_not_found_out_are_that_one() -> None:
    made = protocol(detection={TCP: ((B16,),)})
    assert made.dialect_groups(TCP, "spoken") == [(SPOKEN,)]


def test_tries_with_parameters_hand_them_to_every_dialect() -> None:
    made = protocol(parameters={"room": "where"})
    (first,), (second,) = made.dialect_groups(TCP, parameters={"room": "attic"})
    assert isinstance(first, Spoken)
    assert (first.room, second) == ("attic", B16)
    with pytest.raises(ConfigurationError, match=r"^a room has a name$"):
        made.dialect_groups(TCP, "spoken", parameters={"room": ""})
