"""Random calls of several clients, checked with the nodeset's own XML."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import gzip
import random
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import pytest

pytest.importorskip("asyncua")

from asyncua import ua

import smartcam.outlets
from tests import ROOT
from tests.outlets.opcuakit import Heard, Plc, cell, plc
from tests.outlets.outletkit import until

pytestmark = pytest.mark.real_time

XML = Path(smartcam.outlets.__file__).parent / "_opcua" / "MachineVision.NodeSet2.xml.gz"
MACHINE = "VisionStateMachine"
JOBS = f"{MACHINE}.AutomaticModeStateMachine"
CALL_SECONDS = 300.0
APPLICATIONS = [
    {
        "id": 1,
        "layout": "n: int32",
        "cycle": [{"n": n} for n in range(500)],
        "load_time": 0.01,
        "processing_time": 0.005,
    },
    {
        "id": 3,
        "layout": "n: int32",
        "cycle": [{"n": n} for n in range(500)],
        "load_time": 0.01,
        "processing_time": 0.002,
        "rate": 100,
    },
]


class Arrow(NamedTuple):
    """A transition as the XML has it: numeric ids of states, the states' owner, name of a cause."""

    source: int
    target: int
    owner: str
    cause: str


def arrows() -> dict[int, Arrow]:
    """Read the transitions from the XML, by their ids."""
    root = ET.fromstring(gzip.decompress(XML.read_bytes()))  # noqa: S314 - of this project
    nodes = {one.get("NodeId"): one for one in root if one.get("NodeId")}

    def told(node: Any, kind: str) -> Iterator[str]:
        for one in node.iter("{http://opcfoundation.org/UA/2011/03/UANodeSet.xsd}Reference"):
            if one.get("ReferenceType") == kind and one.get("IsForward", "true") == "true":
                yield str(one.text)

    found: dict[int, Arrow] = {}
    for key, node in nodes.items():
        ends = [*told(node, "FromState"), *told(node, "ToState")]
        if len(ends) == 2:
            source, target = (int(one.split("=")[-1]) for one in ends)
            causes = [
                nodes[one].get("BrowseName", "").split(":")[1] for one in told(node, "HasCause")
            ]
            owner = str(nodes[ends[0]].get("ParentNodeId"))
            found[int(str(key).split("=")[-1])] = Arrow(source, target, owner, "".join(causes))
    return found


def test_arrows_of_the_drawing_are_transitions_of_the_nodeset() -> None:
    drawing = ET.fromstring((ROOT / "docs" / "opcua.svg").read_text())  # noqa: S314 - our own
    drawn = [one.get("data-transition") for one in drawing.iter() if one.get("data-transition")]
    root = ET.fromstring(gzip.decompress(XML.read_bytes()))  # noqa: S314 - of this project
    known = {one.get("BrowseName", "").partition(":")[2] for one in root}
    assert len(drawn) == len(set(drawn)) == 15
    assert known.issuperset(drawn)


class Books:
    """Questions of clients, and their answers."""

    def __init__(self) -> None:
        self.done: collections.Counter[str] = collections.Counter()
        self.jobs: dict[str, tuple[str, bool, datetime]] = {}
        self.calls = 0


async def one_call(client: Plc, books: Books, chance: random.Random) -> None:
    """Do a random call; it ends, and its answer is kept."""
    number = books.calls = books.calls + 1
    meas = f"m{number}"
    structure = {name: getattr(ua, f"{name}DataType") for name in ("MeasId", "PartId", "ProductId")}
    ids = [
        structure["MeasId"](Id=meas),
        structure["PartId"](Id=""),
        None,
        None,
        ua.Variant([], ua.VariantType.Variant, is_array=True),
    ]
    recipe = chance.choice(["counted", "1", "3", "unknown"])
    choices: list[tuple[float, str, list[Any]]] = [
        (0.1, f"{MACHINE}.Halt", [ua.Variant(0, ua.VariantType.Int32), "test"]),
        (0.4, f"{MACHINE}.Reset", [ua.Variant(0, ua.VariantType.Int32), "test"]),
        (8, f"{MACHINE}.SelectModeAutomatic", []),
        (5, "RecipeManagement.PrepareRecipe", [recipe, None]),
        (0.5, "RecipeManagement.UnprepareRecipe", [recipe, None]),
        (30, f"{JOBS}.StartSingleJob", ids),
        (1, f"{JOBS}.StartContinuous", ids),
        (1, f"{JOBS}.Stop", [ua.Variant(0, ua.VariantType.Int32), ""]),
        (1, f"{JOBS}.Abort", [ua.Variant(0, ua.VariantType.Int32), ""]),
        (2, f"{MACHINE}.Halt", ["no number"]),
        (
            2,
            "ResultManagement.GetResultById",
            ["no such result", ua.Variant(0, ua.VariantType.Int32)],
        ),
    ]
    _, path, arguments = chance.choices(choices, [one for one, _, _ in choices])[0]
    asked = datetime.now(UTC)
    with contextlib.suppress(ua.UaStatusCodeError):
        async with asyncio.timeout(CALL_SECONDS):
            answer = await client.call(path, *arguments)
        error = answer[-1] if isinstance(answer, list) else answer
        if error == 0:
            name = path.rpartition(".")[2]
            if name == "PrepareRecipe" and not answer[1]:
                name = "pending"  # it may end later, or be forestalled
            books.done[name] += 1
            if name.startswith("Start"):
                books.jobs[answer[0].Id] = meas, name == "StartSingleJob", asked
    if chance.random() < 0.5:
        await asyncio.sleep(chance.random() * 0.05)  # so that jobs come to their end, too


async def walk(folder: Path, calls: int, clients: int, seed: int) -> tuple[Books, Heard]:
    """Have clients call at random, and return what they did and what was heard."""
    books = Books()
    chance = random.Random(seed)  # noqa: S311 - of a test
    emulator = {"applications": APPLICATIONS, "active": 1}
    more: dict[str, Any] = {"recipes": {"counted": 1}, "kept_results": 100_000}
    async with (
        cell(folder, emulator, {1: "n: int32", 3: "n: int32"}, **more) as there,
        contextlib.AsyncExitStack() as stack,
    ):
        plcs = [await stack.enter_async_context(plc(there.url)) for _ in range(clients + 1)]
        listener = plcs.pop()
        heard = await listener.hear(1018, 1024, 1025)

        async def play(client: Plc, own: random.Random) -> None:
            while books.calls < calls:
                await one_call(client, books, own)

        await asyncio.gather(*(play(one, random.Random(chance.random())) for one in plcs))  # noqa: S311
        with contextlib.suppress(ua.UaStatusCodeError):
            await listener.call(f"{MACHINE}.Reset", ua.Variant(0, ua.VariantType.Int32), "")
            books.done["Reset"] += 1
        singles = {job for job, (_, single, _) in books.jobs.items() if single}
        await until(lambda: singles <= {one.JobId.Id for one in heard.of(1024)}, 300)
        await until(lambda: heard.of(1018)[-1].ToState.Text == "Preoperational", 300)
    return books, heard


def check_transitions(books: Books, heard: Heard) -> None:
    """Each change of state is one of the XML, follows the one before, and has its own cause."""
    known, here = arrows(), dict[str, int]()
    causes: collections.Counter[str] = collections.Counter()
    for told in heard.of(1018):
        values = vars(told)
        arrow = known[values["Transition/Id"].Identifier]
        ends = values["FromState/Id"].Identifier, values["ToState/Id"].Identifier
        assert ends == (arrow.source, arrow.target)
        before = here.get(arrow.owner)
        assert before in (None, arrow.source), told.Message.Text
        here[arrow.owner] = arrow.target
        if told.ToState.Text == "Operational":
            here["ns=1;i=1021"] = 5056  # Initialized, where the jobs' machine begins
        causes[arrow.cause] += 1
    del causes[""]
    late = causes["PrepareRecipe"] - books.done["PrepareRecipe"]
    assert 0 <= late <= books.done["pending"]
    causes["PrepareRecipe"] -= late
    assert +causes == collections.Counter(
        {name: count for name, count in books.done.items() if count and name in CAUSES}
    )


CAUSES = {one.cause for one in arrows().values()} - {""}


def check_results(books: Books, heard: Heard) -> None:
    """Each single job has exactly one result, with its own ids, of a trigger after its call."""
    results = heard.of(1024)
    for told in results:
        job = told.JobId.Id
        if not job:
            assert told.MeasId is None
            continue
        meas, _, asked = books.jobs[job]
        assert told.MeasId.Id == meas
        if told.ProcessingTimes is not None:
            assert told.ProcessingTimes.StartTime >= asked, job
    singles = [job for job, (_, single, _) in books.jobs.items() if single]
    counts = collections.Counter(one.JobId.Id for one in results)
    assert [counts[job] for job in singles] == [1] * len(singles)
    assert any(one.ResultState == 1 for one in results)
    acquired = collections.Counter[str]()
    for told in heard.events:
        job = told.JobId.Id if told.EventType.Identifier in (1024, 1025) else ""
        if told.EventType.Identifier == 1025:
            acquired[job] += 1
        elif job and told.ResultState == 1:
            acquired[job] -= 1  # each result behind its own acquisition
            assert acquired[job] >= 0
    assert all(acquired[job] <= 1 for job in singles)


@pytest.mark.long
async def test_random_calls_of_clients_move_along_the_nodeset_and_mix_up_no_results(
    tmp_path: Path,
) -> None:
    books, heard = await walk(tmp_path, 150, clients=2, seed=1)
    check_transitions(books, heard)
    check_results(books, heard)


@pytest.mark.long
@pytest.mark.widest
async def test_ten_thousand_random_calls_of_five_clients(tmp_path: Path) -> None:
    books, heard = await walk(tmp_path, 10_000, clients=5, seed=2)
    check_transitions(books, heard)
    check_results(books, heard)
    assert len(books.jobs) > 200
