"""Invalid fields of JSON requests: every service refuses them, and sends nothing."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tests.argument_table import (
    JSON_FIELDS,
    JSON_KINDS,
    JSON_ODD,
    JSON_SERVICES,
    JSON_THESIS,
)
from tests.fleet.inside import SERVICES, THESIS, JsonRequest
from tests.fleet.plainkit import NAME, PREFIX, Plant, plant

BASE: dict[str, dict[str, Any]] = {
    "switch_application": {"application": 1},
    "set_input": {"input": "00"},
    "set_sequence_number": {"number": 1},
    "set_clock": {"when": "2030-01-31T12:00:00"},
    "set_feature": {"name": "Gain", "value": 1},
    "execute_feature": {"name": "UserSetLoad"},
    "ChangeApplication": {"application_id": 1},
}
"""Fields of a request beside the odd one."""

REFUSALS = {"ConfigurationError", "LayoutError", "PluginError"}

ELSEWISE = {
    "epoch": {"ConnectionLostError"},  # of another start of the agent
    "deadline": {"TriggerTimeoutError", "ResponseTimeoutError"},  # which is over
}
"""Errors that are right answers, too, for some fields."""

MAX_ANSWER = 2000
"""Bytes of a refusal, however large what it refuses."""

EMPTY_IS_NOT_SAID = {"id", "epoch", "deadline"}
"""Fields of the thesis' interface for which an empty text counts as not said."""


def test_every_field_of_every_service_is_in_the_table() -> None:
    for services, table in ((SERVICES, JSON_SERVICES), (THESIS, JSON_THESIS)):
        fields = {name: {*one.request.model_fields} for name, one in services.items()}
        assert fields == {name: {*JSON_FIELDS, *own} for name, own in table.items()}
    assert {*JsonRequest.model_fields} == {*JSON_FIELDS}


async def judge(place: Plant, key: str, payload: str, kinds: set[str]) -> str:
    """Return what is wrong with the answer of a request that cannot be; empty: nothing."""
    before = len(place.camera.log)
    answers = await place.client.ask_raw(f"{PREFIX}/{key}", payload.encode())
    if len(place.camera.log) != before:
        return "something was sent"
    if len(answers) != 1:
        return f"{len(answers)} answers"
    ((_, data),) = answers
    if len(data) > MAX_ANSWER:
        return f"an answer of {len(data)} bytes"
    said = json.loads(data)
    if not said["error"]:
        return f"done: {data[:80]!r}"
    return "" if said["kind"] in kinds else f"{said['kind']}: {said['error']}"


def request(fields: dict[str, Any], field: str, odd: str) -> str:
    """Return a request with one odd field, as it is said."""
    said = [f"{json.dumps(name)}: {json.dumps(value)}" for name, value in fields.items()]
    return "{" + ", ".join([*said, f"{json.dumps(field)}: {odd}"]) + "}"


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("service", [*SERVICES, *THESIS])
async def test_odd_fields_are_refused_and_nothing_is_sent(service: str) -> None:
    plain = service in SERVICES
    fields = {**JSON_FIELDS, **(JSON_SERVICES if plain else JSON_THESIS)[service]}
    key = f"service/{NAME}/{service}" if plain else f"thesis/{service}"
    found = []
    async with plant() as place:
        for field, kind in fields.items():
            given = {**BASE.get(service, {})}
            if not plain:
                given["camera_name"] = NAME
                if field == "port":
                    given["con_address"] = "127.0.0.1"
            given.pop(field, None)
            may = JSON_KINDS[kind]
            if not plain and field in EMPTY_IS_NOT_SAID:
                may |= {"empty text"}
            for odd in JSON_ODD.keys() - may:
                payload = request(given, field, JSON_ODD[odd])
                wrong = await judge(place, key, payload, REFUSALS | ELSEWISE.get(field, set()))
                if wrong:
                    found.append(f"{field}={odd}: {wrong}")
        assert found == []
        assert place.server.shared_cameras[NAME].results.next_number == 1
        assert (await place.client.call("trigger"))["error"] == ""


@pytest.mark.parametrize("service", ["trigger", "stop", "status", "results"])
async def test_odd_requests_are_refused(service: str) -> None:
    odd = {name: text for name, text in JSON_ODD.items() if name != "dict"}
    odd |= {"no JSON": "{", "a field more": '{"of_nobody": 1}', "bytes": "\x00\x01"}
    async with plant() as place:
        found = {
            name: wrong
            for name, text in odd.items()
            if (wrong := await judge(place, f"service/{NAME}/{service}", text, REFUSALS))
        }
        assert found == {}
        assert place.server.shared_cameras[NAME].results.next_number == 1
