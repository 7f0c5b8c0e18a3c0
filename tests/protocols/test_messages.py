"""The words: what their annotations say, and that nobody can change them."""

from __future__ import annotations

import dataclasses

import pytest
from machines import EXAMPLES, label

from smartcam.models import Status
from smartcam.protocols import messages as m

CAMERA, CLIENT = m.Sender.CAMERA, m.Sender.CLIENT

each_message = pytest.mark.parametrize("message", EXAMPLES[:-1], ids=label)


def test_wire_fields_are_what_the_annotations_say_in_order() -> None:
    assert m.wire_fields(m.StatusReport) == (("status", m.Wire.WORD), ("endian", m.Wire.WORD))
    assert m.wire_fields(m.ResultContainer) == (
        ("application", m.Wire.WORD),
        ("data", m.Wire.DATA),
    )
    assert m.wire_fields(m.SetSequenceNumber) == (("number", m.Wire.UINT32),)
    assert m.wire_fields(m.Connect) == ()
    assert m.wire_fields(m.UnknownMessage) == ()


@each_message
def test_message_is_frozen_and_has_no_other_attributes(message: m.Message) -> None:
    assert not hasattr(message, "__dict__")
    names = [field.name for field in dataclasses.fields(message)] or ["sender"]
    with pytest.raises((dataclasses.FrozenInstanceError, TypeError, AttributeError)):
        setattr(message, names[0], 1)


@each_message
def test_message_sender_is_the_clients_for_requests_only(message: m.Message) -> None:
    assert message.sender is (CLIENT if isinstance(message, m.Request) else CAMERA)


def test_wire_fields_of_an_acknowledgement_begin_with_its_code() -> None:
    assert m.wire_fields(m.TriggerAnswer) == (("code", m.Wire.WORD),)
    assert m.wire_fields(m.Image) == (("code", m.Wire.WORD), ("data", m.Wire.DATA))
    assert [name for name, _ in m.wire_fields(m.ClockAnswer)][:2] == ["code", "year"]
    assert m.wire_fields(m.MalformedMessage) == ()


def test_fields_that_a_dialect_may_leave_out_have_defaults() -> None:
    assert m.StatusReport(status=Status(0)).endian == 0
    assert m.ResultContainer(data=b"").application == m.UNNAMED_APPLICATION == -1
    assert m.ConnectAnswer(version=1).code == m.QueryAnswer(application=1).code == 0


@each_message
def test_message_answer_is_a_report_of_the_camera(message: m.Message) -> None:
    if isinstance(message, m.Request) and message.answer is not None:
        assert issubclass(message.answer, m.Report)
