"""Faults as data, and which of them a message brings about."""

from __future__ import annotations

import pickle
from typing import Any, get_args

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from smartcam.emulator import EmulatedCamera, ManualClock, faults
from smartcam.emulator._inside import MESSAGE_NAMES, BaseFault, DeviceFault
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import Frame
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from tests.emulator.inside import FaultQueue, WireFault
from tests.emulator.inside import _matching as matching
from tests.machines import MESSAGES

EXAMPLES: list[dict[str, Any]] = [
    {"kind": "delay", "seconds": 0.5, "overtaken": True},
    {"kind": "split", "after": 3, "pause": 0.1},
    {"kind": "coalesce", "count": 2, "seconds": 0.1},
    {"kind": "truncate", "keep": 3, "then": "reset"},
    {"kind": "corrupt", "offset": -1, "xor": 255},
    {"kind": "drop", "on": "Query", "nth": 3, "times": None},
    {"kind": "duplicate", "copies": 2},
    {"kind": "insert", "data": "ff00", "where": "after"},
    {"kind": "half_open", "seconds": 1.0},
    {"kind": "reset", "when": "after"},
    {"kind": "close", "on": 0x20, "sender": "camera"},
    {"kind": "refuse", "seconds": 1.0},
    {"kind": "busy_for_ever", "on": "SwitchApplication"},
    {"kind": "overtrigger", "count": 2},
    {"kind": "second_client"},
    {"kind": "reboot", "seconds": 1.0},
    {"kind": "switch_application", "application": 3, "running": True},
    {"kind": "stop", "sender": "client"},
    {"kind": "start", "on": "ResultContainer"},
    {"kind": "condition", "condition": "overheat", "active": False},
    {"kind": "late_result", "seconds": 1.0},
    {"kind": "no_result", "when": "after", "on": "Trigger"},
    {"kind": "extra_result", "count": 2},
    {"kind": "digital_input", "on": "StatusReport", "nth": 2},
    {"kind": "byte_order", "endian": 1},
    {"kind": "move_part", "part": "square", "x": 0.1, "y": 0.2},
    {"kind": "remove_part", "part": "square"},
    {"kind": "clear_faults", "when": "after", "on": "Disconnect"},
]


def test_table_has_every_fault() -> None:
    classes = {
        kind
        for kind in vars(faults).values()
        if isinstance(kind, type)
        and issubclass(kind, (WireFault, DeviceFault))
        and "kind" in kind.model_fields
    }
    assert set(faults.FAULTS.values()) == classes
    assert list(faults.FAULTS) == [example["kind"] for example in EXAMPLES]
    assert {kind.__name__ for kind in classes} <= set(faults.__all__)


def test_every_message_can_be_named() -> None:
    assert dict(MESSAGE_NAMES) == {row.type.__name__: row.type for row in MESSAGES} | {
        "DisconnectAnswer": m.DisconnectAnswer,
        "GetStatus": m.GetStatus,
        "ResetErrors": m.ResetErrors,
        "ResetErrorsAnswer": m.ResetErrorsAnswer,
        "SetClockAnswer": m.SetClockAnswer,
        "SetInputAnswer": m.SetInputAnswer,
        "TriggerAnswer": m.TriggerAnswer,
    }


@pytest.mark.parametrize("given", EXAMPLES, ids=[example["kind"] for example in EXAMPLES])
def test_fault_survives_mapping_json_and_pickle(given: dict[str, Any]) -> None:
    (fault,) = faults.make_faults([given])
    assert type(fault) is faults.FAULTS[given["kind"]]
    assert faults.make_faults([fault]) == (fault,)
    assert faults.make_faults([fault.model_dump()]) == (fault,)
    assert faults.make_faults([fault.model_dump(mode="json")]) == (fault,)
    adapter: TypeAdapter[faults.Fault] = TypeAdapter(faults.Fault)
    assert adapter.validate_json(fault.model_dump_json()) == fault
    assert pickle.loads(pickle.dumps(fault)) == fault  # noqa: S301  our own
    with pytest.raises(ValidationError, match="frozen"):
        fault.nth = 2


def test_fault_is_a_field_of_a_model_with_a_schema() -> None:
    class Plan(BaseModel):
        steps: tuple[faults.Fault, ...]

    plan = Plan.model_validate({"steps": EXAMPLES})
    assert [step.kind for step in plan.steps] == list(faults.FAULTS)
    schema = Plan.model_json_schema()
    assert set(schema["properties"]["steps"]["items"]["discriminator"]["mapping"]) == set(
        faults.FAULTS
    )
    for name, definition in schema["$defs"].items():
        for field, about in definition["properties"].items():
            assert field == "kind" or about["description"], (name, field)


def test_fault_from_yaml_with_a_bare_on() -> None:
    given: list[Any] = [  # as a YAML 1.1 reader gives "on: Query"
        {"kind": "drop", True: "Query"},
        {"kind": "insert", "message": "ConnectAnswer", "fields": {"version": 1}},
    ]
    drop, insert = faults.make_faults(given)
    assert drop == faults.Drop(on="Query")
    assert isinstance(insert, faults.Insert)
    assert insert.inserted == m.ConnectAnswer(version=1)


def test_message_classes_are_names() -> None:
    assert faults.Drop(on=m.Query) == faults.Drop(on="Query")
    assert faults.Drop(on=m.Query).on == "Query"
    insert = faults.Insert(
        message=m.ResultContainer, fields={"application": 3, "data": "ff00"}, where="instead"
    )
    assert insert.inserted == m.ResultContainer(application=3, data=b"\xff\x00")


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({}, "fault 1: value: Unable to extract tag using discriminator 'kind'"),
        ({"kind": "explode"}, "'explode' found using 'kind' does not match"),
        (3, "fault 1: value: "),
        ({"kind": "delay"}, "delay.seconds: Field required"),
        ({"kind": "delay", "seconds": -1}, "delay.seconds: Input should be greater than or equal"),
        ({"kind": "delay", "seconds": float("nan")}, "delay.seconds: "),
        ({"kind": "delay", "seconds": 1, "colour": 2}, "delay.colour: Extra inputs"),
        ({"kind": "drop", "on": "Foo"}, "drop.on: .*no message is called 'Foo'; there are Connect"),
        ({"kind": "drop", "on": "Message"}, "no message is called 'Message'"),
        ({"kind": "drop", "on": True}, "drop.on: .*a message's name or id"),
        ({"kind": "drop", "on": -1}, "drop.on: .*32 bits"),
        ({"kind": "drop", "on": 3.5}, r"drop\.on"),
        ({"kind": "drop", "nth": 0}, "drop.nth: "),
        ({"kind": "drop", "times": 0}, "drop.times: "),
        ({"kind": "drop", "on": "Query", "sender": "camera"}, "drop.sender: .*of the client"),
        ({"kind": "split", "after": 3, "on": "Query"}, "split.on: .*Split cannot act on messages"),
        ({"kind": "split", "after": 3, "sender": "client"}, "split.sender: .*cannot act"),
        ({"kind": "split", "after": 0}, "split.after: "),
        ({"kind": "truncate", "keep": 0, "then": "explode"}, "truncate.then: "),
        ({"kind": "corrupt", "offset": 0}, "corrupt: .*exactly one of xor and value"),
        ({"kind": "corrupt", "offset": 0, "xor": 1, "value": 1}, "exactly one of xor and value"),
        ({"kind": "corrupt", "offset": 0, "xor": 0}, "corrupt.xor: "),
        ({"kind": "insert"}, "insert: .*exactly one of data and message"),
        ({"kind": "insert", "data": "0g"}, "insert.data: .*hexadecimal"),
        ({"kind": "insert", "data": ""}, "insert.data: "),
        ({"kind": "insert", "data": "00" * 65537}, "insert.data: "),
        ({"kind": "insert", "data": "00", "fields": {"a": 1}}, "insert.fields: .*belong to a mess"),
        ({"kind": "insert", "message": "Foo"}, "insert.message: .*no message is called"),
        ({"kind": "insert", "message": "QueryAnswer"}, "QueryAnswer needs values for application"),
        (
            {"kind": "insert", "message": "QueryAnswer", "fields": {"x": 1}},
            "insert.fields: .*QueryAnswer has no field 'x'; it has code, application",
        ),
        (
            {"kind": "insert", "message": "QueryAnswer", "fields": {"application": "1x"}},
            "insert.fields: .*QueryAnswer.application is a number",
        ),
        (
            {"kind": "insert", "message": "SetInput", "fields": {"data": 1}},
            "insert.fields: .*SetInput.data is hex digits",
        ),
        (
            {"kind": "insert", "message": "QueryAnswer", "fields": {"application": 1 << 32}},
            "insert.fields: .*does not fit its fields",
        ),
        ({"kind": "stop", "times": 2}, "stop.times: .*waits for no message"),
        ({"kind": "stop", "times": None}, "stop.times: .*waits for no message"),
        ({"kind": "stop", "nth": 2}, "stop.nth: .*waits for no message"),
        ({"kind": "switch_application", "application": 0}, "switch_application.application: "),
        ({"kind": "switch_application", "application": 99}, "application: .*no application 99"),
        ({"kind": "condition", "condition": "busy"}, "condition.condition: "),
        ({"kind": "overtrigger", "count": 0}, "overtrigger.count: "),
    ],
)  # fmt: skip
def test_wrong_data_is_a_configuration_error_that_names_the_field(given: Any, text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        EmulatedCamera(faults=[given])
    emulator = EmulatedCamera()
    with pytest.raises(ConfigurationError, match=text.replace("fault 1", "fault 2")):
        emulator.inject(faults.Drop(), given)
    assert emulator.faults == []


# ---------------------------------------------------------------------- which message


def queue_of(*given: faults.Fault | dict[str, Any]) -> FaultQueue:
    queue = FaultQueue(HANDBOOK, ManualClock(), {21})
    queue.add(given)
    return queue


def said(queue: FaultQueue, *messages: m.Message) -> list[list[str]]:
    return [[f.kind for f in queue.by_message(queue.camera_wire_faults, one)] for one in messages]


ANSWER = m.QueryAnswer(application=1)
VERSION = m.ConnectAnswer(version=1)


def test_nth_and_times_count_the_messages_that_fit() -> None:
    queue = queue_of(faults.Drop(on="QueryAnswer", nth=2, times=2))
    hits = said(queue, ANSWER, VERSION, ANSWER, VERSION, ANSWER, ANSWER)
    assert hits == [[], [], ["drop"], [], ["drop"], []]
    assert queue.waiting == []
    assert queue.camera_wire_faults == []


def test_times_none_never_ends() -> None:
    queue = queue_of(faults.Drop(times=None))
    assert said(queue, *[ANSWER] * 50) == [["drop"]] * 50
    assert len(queue.waiting) == 1


def test_several_apply_in_the_order_given() -> None:
    queue = queue_of(faults.Duplicate(), faults.Drop(on=0x30), faults.Close(on="QueryAnswer"))
    assert said(queue, ANSWER) == [["duplicate", "drop", "close"]]


def test_id_without_a_sender_is_the_cameras_for_the_wire_and_the_clients_for_the_device() -> None:
    queue = queue_of(faults.Drop(on=0x30), faults.OperatorStop(on=0x30))
    assert [row.fault.kind for row in queue.camera_wire_faults] == ["drop"]
    assert [row.fault.kind for row in queue.client_device_faults] == ["stop"]
    assert queue.by_message(queue.client_device_faults, m.Query()) == [faults.OperatorStop(on=0x30)]


def test_unknown_id_of_a_client_fits_by_number_only() -> None:
    queue = queue_of(faults.Drop(on=0x77, sender="client"), faults.Drop(sender="client", nth=2))
    frame = Frame(0x77, b"x")
    assert len(queue.by_frame(queue.client_wire_faults, frame)) == 1
    assert len(queue.by_frame(queue.client_wire_faults, frame)) == 1
    unknown = m.UnknownMessage(message_id=0x77, payload=b"x")
    assert [fired.message for fired in queue.fired] == [unknown, unknown]


def test_short_body_of_a_client_fits_by_name_and_is_recorded_as_bytes() -> None:
    queue = queue_of(faults.Drop(on="SwitchApplication"))
    queue.by_frame(queue.client_wire_faults, Frame(0x31, b"\1"))
    (fired,) = queue.fired
    assert fired.message == m.UnknownMessage(message_id=0x31, payload=b"\1")
    assert (fired.time, fired.fault) == (0.0, faults.Drop(on="SwitchApplication"))


def test_at_once_is_taken_once_in_order() -> None:
    queue = queue_of(faults.OperatorStop(), faults.Drop(), faults.OperatorStart())
    assert queue.at_once() == [faults.OperatorStop(), faults.OperatorStart()]
    assert queue.at_once() == []
    assert queue.waiting == [faults.Drop()]


def test_equal_faults_wait_each_for_itself() -> None:
    queue = queue_of(*[faults.Drop(on="QueryAnswer")] * 2)
    assert said(queue, ANSWER, ANSWER) == [["drop", "drop"], []]


def test_clear_forgets_all_and_keeps_the_record() -> None:
    queue = queue_of(
        faults.Drop(), faults.OperatorStop(), faults.Drop(on="Query"), faults.OperatorStart(on=1)
    )
    queue.clear()
    assert queue.waiting == []
    assert [
        *queue.camera_wire_faults,
        *queue.client_wire_faults,
        *queue.client_device_faults,
        *queue.at_once(),
    ] == []


def test_queue_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching, "MAX_FAULTS", 3)
    queue = queue_of(faults.Drop(), faults.Drop())
    with pytest.raises(ConfigurationError, match="at most 3 faults can wait"):
        queue.add([faults.Drop(), faults.Drop()])
    assert len(queue.waiting) == 2


def test_record_is_bounded() -> None:
    queue = queue_of(faults.Drop(times=None))
    said(queue, *[ANSWER] * (faults.MAX_FIRED + 1))
    assert len(queue.fired) == faults.MAX_FIRED


def test_union_and_table_agree() -> None:
    assert set(get_args(get_args(faults.Fault)[0])) == set(faults.FAULTS.values())


@pytest.mark.parametrize(
    ("dialect", "fault", "text"),
    [
        ("handbook", faults.Drop(on="ResetErrors"), "drop.on: dialect handbook has no ResetErrors"),
        ("thesis", faults.Drop(on=m.GetStatus), "drop.on: dialect thesis has no GetStatus"),
        (
            "b16",
            faults.PowerCycle(on="TriggerAnswer"),
            "reboot.on: dialect b16 has no TriggerAnswer",
        ),
        ("bid", faults.NoResult(on="Start"), "no_result.on: dialect bid has no Start"),
        (
            "bid",
            faults.Insert(message="SetSequenceNumber", fields={"number": 1}),
            "insert.message: dialect bid has no SetSequenceNumber",
        ),
        (
            "b16",
            faults.Insert(message="SetInputAnswer"),
            "insert.message: dialect b16 has no SetInputAnswer",
        ),
    ],
)
def test_fault_on_a_message_that_the_dialect_lacks_is_refused(
    dialect: str, fault: BaseFault, text: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        EmulatedCamera(dialect=dialect, faults=[fault])
    assert str(caught.value) == f"fault 1: {text}"


def test_fault_on_a_message_that_the_dialect_lacks_is_refused_later_too() -> None:
    emulator = EmulatedCamera(dialect="b16", quirks={"code": True})
    with pytest.raises(ConfigurationError) as caught:
        emulator.inject(faults.Drop(on="Query"), faults.Drop(on="ResetErrors"))
    assert str(caught.value) == ("fault 2: drop.on: dialect b16 with quirk code has no ResetErrors")
    assert emulator.faults == []
