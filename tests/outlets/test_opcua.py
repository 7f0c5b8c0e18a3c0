"""Cameras as vision systems of OPC UA, for asyncua's client, with structures and without."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("asyncua")

from asyncua import ua

from smartcam.emulator import EmulatedCamera, faults
from smartcam.exceptions import ConfigurationError
from smartcam.outlets import Outlets
from tests.outlets.opcuakit import LAYOUT, Cell, Plc, cell, free_port, plc
from tests.outlets.outletkit import until

pytestmark = pytest.mark.real_time

JOBS = "VisionStateMachine.AutomaticModeStateMachine"
RESULT_READY = (
    "CreationTime, ExternalConfigurationId, ExternalRecipeId, InternalConfigurationId, "
    "InternalRecipeId, IsPartial, IsSimulated, JobId, MeasId, PartId, ProcessingTimes, ProductId, "
    "ResultContent, ResultId, ResultState, EventId, EventType, SourceNode, SourceName, Time, "
    "ReceiveTime, LocalTime, Message, Severity"
)
"""Fields of the event, by the nodeset and Part 5 of OPC UA."""
NO_CAUSE = (ua.Variant(0, ua.VariantType.Int32), "test")
PARTS = {
    "id": 1,
    "layout": LAYOUT,
    "cycle": [{"passed": True, "count": n, "x": 0.0125, "code": "AB"} for n in range(1, 100)],
    "load_time": 0.05,
    "processing_time": 0.01,
}
FREE = {"id": 3, "layout": "n: int32", "constant": {"n": 5}, "rate": 50, "load_time": 0.05}


@contextlib.asynccontextmanager
async def ready(folder: Path, **more: Any) -> AsyncIterator[tuple[Cell, Plc]]:
    """Have a camera with application 1, ready for jobs, and a client."""
    emulator = {"applications": [PARTS, FREE], "active": 1, **more.pop("emulator", {})}
    specs = {1: LAYOUT, 3: "n: int32"}
    async with cell(folder, emulator, specs, **more) as there, plc(there.url) as client:
        await client.wait_for("Ready")
        yield there, client


async def refused(client: Plc, path: str, *arguments: Any) -> str:
    """Return the name of the status by which a call was refused."""
    with pytest.raises(ua.UaStatusCodeError) as caught:
        await client.call(path, *arguments)
    return type(caught.value).__name__


async def test_a_job_gives_its_result_as_structures_events_and_plain_variables(
    tmp_path: Path,
) -> None:
    async with ready(tmp_path, recipes={"housing": 1}) as (_, client):
        heard = await client.hear(1024, 1018, 1013, 1023, 1025)
        job = await client.start_job("m-1", "p-1", "housing")
        await until(lambda: bool(heard.of(1023)))
        (told,) = heard.of(1024)
        ids = told.JobId, told.MeasId, told.PartId, told.ExternalRecipeId, told.InternalRecipeId
        assert [one.Id for one in ids] == [job, "m-1", "p-1", "housing", "1"]
        assert (told.IsPartial, told.IsSimulated, told.ResultState) == (False, True, 1)
        fields = RESULT_READY.split(", ")
        missing = {one for one in fields if vars(told)[one] is None}
        assert missing == {"ExternalConfigurationId", "ProductId"}  # nobody gave these
        assert told.CreationTime >= told.ProcessingTimes.StartTime
        assert told.InternalConfigurationId.Id == ""
        await client.client.load_data_type_definitions()
        value, error = (
            await client.call(
                "ResultManagement.GetResultById", told.ResultId, ua.Variant(0, ua.VariantType.Int32)
            )
        )[1:]
        assert error == 0
        (record,) = value.ResultContent
        made = record.Value
        assert (made.passed, made.count, made.code) == (True, 1, "AB")
        assert made.x == pytest.approx(0.0125)
        assert value.JobId.Id == job
        plain = {
            name: await client.node(f"Plain.{name}").read_value()
            for name in ("JobId", "MeasId", "Recipe", "Application", "Records", "Count", "Value")
        }
        said = json.loads(plain.pop("Value"))
        assert said["count"] == 1
        assert list(plain.values()) == [job, "m-1", "housing", 1, 1, 1]
        assert await client.node("Plain.App1.count").read_value() == 1
        assert await client.node("Plain.App1.x").read_value() == pytest.approx(0.0125)
        order = [one.EventType.Identifier for one in heard.events]
        assert order == [1013, 1018, 1025, 1024, 1023, 1018]
        assert heard.of(1025)[0].JobId.Id == job
        for told in heard.of(1018):
            assert all(vars(told)[f"{one}/Id"] for one in ("FromState", "ToState", "Transition"))


@pytest.mark.long
async def test_clients_without_structures_and_clients_that_only_call_do_the_same(
    tmp_path: Path,
) -> None:
    async with ready(tmp_path, recipes={"housing": 1}) as (_, client):
        job, error = await client.call("Plain.StartJob", "m-2", "", "housing")
        assert error == 0
        await client.wait_for("Ready")
        state, value, why, error = await client.call("Plain.GetResult", job)
        assert (state, json.loads(value)["count"], why, error) == (1, 1, "", 0)
        listed = await client.call(
            "ResultManagement.GetResultListFiltered",
            ua.Variant(0, ua.VariantType.Int32),
            "m-2",
            *[None] * 6,
            job,
            *[ua.Variant(0, ua.VariantType.UInt32)] * 2,
            ua.Variant(1, ua.VariantType.Int32),
        )
        complete, count, handle, (result,), error = listed
        assert (complete, count, error) == (True, 1, 0)
        found = await client.call(
            "ResultManagement.GetResultComponentsById",
            result.ResultId.Id,
            ua.Variant(0, ua.VariantType.Int32),
        )
        assert (found[4], found[5].Id, found[12].Id, found[-1]) == (1, "m-2", job, 0)
        release = "ResultManagement.ReleaseResultHandle", ua.Variant(handle, ua.VariantType.UInt32)
        assert [await client.call(*release), await client.call(*release)] == [0, -7]
        *_, error = await client.call("Plain.GetResult", "another")
        assert error == -7


@pytest.mark.long
async def test_recipes_have_names_and_numbers_and_wrong_calls_are_told(tmp_path: Path) -> None:
    own = {"free": 3, "housing": 3, "lid": 1}  # of the camera: the settings' names win
    async with ready(tmp_path, names=own, recipes={"housing": 1}) as (there, client):
        heard = await client.hear(1018, 1022)
        assert (await client.call("RecipeManagement.PrepareRecipe", "lid", None))[0].Id == "1"
        await client.wait_for("Ready")
        prepare, none = "RecipeManagement.PrepareRecipe", None
        internal, _, error = await client.call(prepare, "free", none)
        assert (internal.Id, error) == ("3", 0)
        await client.wait_for("Ready")
        assert there.camera.active_application == 3
        assert (await client.call(prepare, none, "1"))[0].Id == "1"
        await client.wait_for("Ready")
        await until(lambda: [said.InternalId.Id for said in heard.of(1022)] == ["1", "3", "1"])
        one, three = (ua.Variant(number, ua.VariantType.UInt32) for number in (1, 3))
        for number in (three, "3"):  # and not the recipe that is ready
            assert (await client.call("Plain.StartJob", "m", "p", number))[-1] == -2
        assert await refused(client, "Plain.StartJob", "m", "p", True) == "BadInvalidArgument"
        assert (await client.call(prepare, none, one))[0].Id == "1"
        await client.wait_for("Ready")
        for external, number in (("unknown", none), ("housing", "3"), (none, none)):
            assert (await client.call(prepare, external, number))[-1] == -2
        most = [ua.Variant(one, ua.VariantType.UInt32) for one in (1, 1)]
        _, count, _, (second,), error = await client.call(
            "RecipeManagement.GetRecipeListFiltered",
            none,
            none,
            ua.Variant(2, ua.VariantType.Int32),
            *most,
            ua.Variant(0, ua.VariantType.Int32),
        )
        assert (count, second.Id, error) == (1, "3", 0)
        assert (await client.call("RecipeManagement.UnprepareRecipe", "housing", none))[-1] == 0
        assert await client.state() == "Initialized"
        ids = [None] * 4 + [ua.Variant([], ua.VariantType.Variant, is_array=True)]
        assert await refused(client, f"{JOBS}.StartSingleJob", *ids) == "BadInvalidState"
        assert await refused(client, f"{JOBS}.Stop", *NO_CAUSE) == "BadInvalidState"
        of = client.client.get_node(ua.NodeId(7096, client.vision))  # the type's Stop
        with pytest.raises(ua.UaStatusCodeError, match="BadInvalidState"):
            await client.node(JOBS).call_method(of, *NO_CAUSE)
        assert await refused(client, f"{JOBS}.Stop") == "BadArgumentsMissing"
        assert await refused(client, f"{JOBS}.Stop", *NO_CAUSE, "x") == "BadTooManyArguments"
        assert await refused(client, f"{JOBS}.Stop", "a", "b") == "BadInvalidArgument"
        assert await refused(client, prepare, "x" * 5000, none) == "BadInvalidArgument"


@pytest.mark.long
async def test_continuous_execution_gives_results_of_its_job_until_it_is_stopped(
    tmp_path: Path,
) -> None:
    async with ready(tmp_path) as (there, client):
        heard = await client.hear(1024)
        assert (await client.call("RecipeManagement.PrepareRecipe", "3", None))[-1] == 0
        await client.wait_for("Ready")
        meas = getattr(ua, "MeasIdDataType")(Id="all")  # noqa: B009
        more = [None] * 3 + [ua.Variant([], ua.VariantType.Variant, is_array=True)]
        job, error = await client.call(f"{JOBS}.StartContinuous", meas, *more)
        assert error == 0
        await until(lambda: sum(one.JobId.Id == job.Id for one in heard.of(1024)) >= 5)
        assert {one.MeasId.Id for one in heard.of(1024) if one.JobId.Id == job.Id} == {"all"}
        assert await refused(client, f"{JOBS}.StartSingleJob", None, *more) == "BadInvalidState"
        assert await client.call(f"{JOBS}.Stop", *NO_CAUSE) == 0
        assert await client.state() == "Ready"
        await until(lambda: ("stop", {"timeout": 10.0}) in there.commands)
        assert await client.call("VisionStateMachine.Halt", *NO_CAUSE) == 0
        assert await client.state() == "Halted"
        assert await client.call("VisionStateMachine.Reset", *NO_CAUSE) == 0
        assert await client.call("VisionStateMachine.SelectModeAutomatic") == 0
        assert await client.state() == "Initialized"


@pytest.mark.long
async def test_a_job_without_a_result_fails_under_its_id_and_the_late_result_has_none(
    tmp_path: Path,
) -> None:
    late = faults.LateResult(seconds=1.0)
    async with ready(tmp_path, trigger_timeout=0.2) as (there, client):
        there.emulator.inject(late)
        heard = await client.hear(1024, 1037)
        job = await client.start_job("late")
        await until(lambda: len(heard.of(1024)) >= 2)
        failed, unasked = heard.of(1024)
        assert (failed.JobId.Id, failed.ResultState, failed.MeasId.Id) == (job, 4, "late")
        assert "timeout" in failed.Message.Text.lower() or "no result" in failed.Message.Text
        assert (unasked.JobId.Id, unasked.ResultState, unasked.MeasId) == ("", 1, None)
        await client.wait_for("Ready")
        again = await client.start_job("again")
        await until(lambda: len(heard.of(1024)) == 3)
        assert heard.of(1024)[-1].JobId.Id == again


@pytest.mark.long
async def test_a_camera_that_is_lost_is_an_error_until_it_is_back(tmp_path: Path) -> None:
    async with ready(tmp_path) as (there, client):
        heard = await client.hear(1018, 1019, 1020, 1036)
        there.emulator.inject(faults.Refuse(seconds=1.0))
        there.emulator.inject(faults.Reset())
        await until(lambda: bool(heard.of(1020)))
        await client.wait_for("Ready")
        (error,) = heard.of(1019)
        assert (error.FromState.Text, error.ToState.Text) == ("Operational", "Error")
        lost, back = (one for one in heard.of(1036))
        assert (lost.Retain, back.Retain) == (True, False)
        assert lost.ErrorString
        assert [one.ToState.Text for one in heard.of(1018)] == ["Error", "Operational", "Ready"]


@pytest.mark.long
async def test_pictures_are_read_from_temporary_files(tmp_path: Path) -> None:
    picture = tmp_path / "pictures" / "1.png"
    picture.parent.mkdir()
    picture.write_bytes(bytes(range(256)) * 10)
    async with ready(tmp_path, pictures="pictures/{application}.png") as (_, client):
        await client.start_job()
        await client.wait_for("Ready")
        key = await client.node("Plain.ResultId").read_value()
        options = getattr(ua, "ResultTransferOptions")  # noqa: B009
        asked = options(Id=getattr(ua, "ResultIdDataType")(Id=key))  # noqa: B009
        transfer = client.node("ResultManagement.ResultTransfer")
        node, handle, _ = await transfer.call_method("0:GenerateFileForRead", asked)
        file = client.client.get_node(node)
        assert await (await file.get_child("0:Size")).read_value() == 2560
        of = ua.Variant(handle, ua.VariantType.UInt32)
        parts = [
            await file.call_method("0:Read", of, ua.Variant(2000, ua.VariantType.Int32))
            for _ in range(3)
        ]
        assert b"".join(parts) == picture.read_bytes()
        await file.call_method("0:Close", of)
        with pytest.raises(ua.UaStatusCodeError):
            await file.call_method("0:Read", of, ua.Variant(1, ua.VariantType.Int32))
        asked.Id.Id = "another"
        with pytest.raises(ua.UaStatusCodeError):
            await transfer.call_method("0:GenerateFileForRead", asked)


@pytest.mark.long
async def test_the_command_serves_one_camera_without_a_fleet(tmp_path: Path) -> None:
    url = f"opc.tcp://127.0.0.1:{free_port()}"
    (tmp_path / "outlets.yaml").write_text(
        f"outlets: {{opcua: {{listen: '{url}', anonymous: control, unencrypted: true}}}}\n"
    )
    async with EmulatedCamera(active=7) as emulator:
        arguments = ("outlet", emulator.url, str(tmp_path / "outlets.yaml"), "--name", "line1/cam1")
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "smartcam", *arguments, "--application", "7"),
            stdout=asyncio.subprocess.DEVNULL,
        )
        try:
            async with plc(url) as client:
                await client.wait_for("Ready")
                job = await client.start_job("alone")
                await client.wait_for("Ready")
                state, value, _, error = await client.call("Plain.GetResult", job)
        finally:
            process.send_signal(signal.SIGINT)
            assert await process.wait() == 0
    assert (state, error) == (1, 0)
    assert value


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"listen": "http://a"}, "expected opc.tcp://HOST:PORT"),
        ({"listen": "opc.tcp://0.0.0.0"}, "expected opc.tcp://HOST:PORT"),
        ({"listen": "opc.tcp://0.0.0.0:4840"}, "nobody could log in"),
        (
            {"listen": "opc.tcp://a:1", "users": {"plc": "geheim"}},
            "a secret is never in this file itself",
        ),
        ({"listen": "opc.tcp://a:1", "anonymous": "all"}, "anonymous"),
        ({"listen": "opc.tcp://a:1", "anonymous": "read", "key": "a"}, "both certificate and key"),
    ],
)
def test_wrong_settings_are_told_and_secrets_never(
    tmp_path: Path, settings: dict[str, Any], told: str
) -> None:
    with pytest.raises(ConfigurationError, match=told) as caught:
        Outlets({"opcua": settings}, tmp_path)
    assert "geheim" not in str(caught.value)
