"""A viewer can delay, never deny: every key of the bus, and what an agent makes of what comes.

The first half reads the rules that the engine is given (``test_access.py`` shows that it keeps
them); the second half is what an agent does about calls that the rules let through.
"""

from __future__ import annotations

import asyncio
import inspect
import os
import socket
from pathlib import Path
from typing import Any

import pytest

import smartcam
import smartcam.fleet
from smartcam.exceptions import LocalProtocolError, ReservationLostError, TriggerTimeoutError
from smartcam.fleet import FleetCamera
from smartcam.fleet._inside import Bus, Keys, patterns_overlap
from tests.client.clientkit import gone
from tests.fleet.fleetkit import FLEET, NAME, PATIENCE, NumberedCamera, Plant, end_of, until
from tests.fleet.framekit import FramePlant
from tests.fleet.inside import (
    RIGHTS,
    SERVICES,
    ProgramName,
    TriggerCall,
    decode,
    decode_trigger_reply,
    encode,
    encode_trigger,
    in_words,
    names_pattern,
)
from tests.fleet.inside import agent as _agent
from tests.fleet.inside import camera_frames as _frames
from tests.fleet.inside import json_services as _services
from tests.fleet.plainkit import SILENT, plant
from tests.fleet.plantkit import CAMERA, certified, joined, plant_file, url_of

KEYS, ANY = Keys(FLEET), Keys("*")

LOOKING = frozenset(name for name, one in SERVICES.items() if not one.is_command)

VIEWER_DOES: dict[str, set[str]] = {
    "agent": {"watch"},
    "camera": {"watch"},
    "program": set(),
    "command": set(),
    "ask": set(),
    "reload": set(),
    "reply": {"subscribe"},
    "frames": {"subscribe"},
    "states": {"subscribe"},
    "results": {"subscribe"},
    "bundle": {"subscribe"},
    "summary": {"query"},
    "outlets": {"query"},
    "listing": {"query"},
    "topic": {"subscribe"},
    "service": set(),
    "start": set(),
    "thesis": set(),
    "thesis_topic": {"subscribe"},
}
"""Rights of a viewer to each key of the bus as it is for an operator. Nothing that is said or
answered there, nobody's presence: those have keys of a viewer's own."""

ARGUMENTS = {
    "agent": "line1",
    "camera": "line1/cam3",
    "program": "operator-robot-0.secret",
    "role": "operator",
    "start": "17-3",
    "kind": "results",
    "name": "trigger",
}


def keys() -> dict[str, str]:
    """Return one key of each kind that there is, as an operator, or an agent for it, has it."""
    made: dict[str, str] = {}
    for name, method in inspect.getmembers(KEYS, inspect.ismethod):
        if name not in {"__init__", "tail"}:
            wanted = inspect.signature(method).parameters
            made[name] = method(*(ARGUMENTS[one] for one in wanted))
    return made


def test_viewer_may_do_nothing_at_a_key_of_an_operator_but_hear_and_look() -> None:
    found = {
        name: {
            right.use
            for right in RIGHTS
            if "viewer" in right.roles
            and any(patterns_overlap(pattern, key) for pattern in right.keys)
        }
        for name, key in keys().items()
    }
    assert found == VIEWER_DOES


@pytest.mark.parametrize("does", ["put", "answer", "announce"])
def test_roles_share_no_key_under_which_anything_is_said_or_present(does: str) -> None:
    """Whoever could say it could say it in the place of another role's program."""
    of = [
        (role, pattern)
        for right in RIGHTS
        if right.use == does
        for role in right.roles
        for pattern in right.keys
    ]
    for role, pattern in of:
        for other, theirs in of:
            if role != other:
                assert not patterns_overlap(pattern, theirs), (role, pattern, other, theirs)


def test_viewer_asks_agents_only_what_changes_nothing() -> None:
    may = [
        one
        for right in RIGHTS
        if right.use == "query" and "viewer" in right.roles
        for one in right.keys
    ]
    asked = {ANY.summary("*"), ANY.listing("**"), ANY.outlets("*", "*")}
    assert {*may} == asked | {ANY.service("**", name) for name in LOOKING}


def test_name_is_that_of_who_knows_its_secret() -> None:
    one, other = ProgramName.new("operator"), ProgramName.new("operator")
    assert one.is_genuine
    assert ProgramName.from_token(one.token) == one
    assert patterns_overlap(names_pattern("operator"), one.name)
    assert not patterns_overlap(names_pattern("viewer"), one.token)
    for forged in (
        ProgramName(one.name, other.secret),
        ProgramName(one.name, ""),
        ProgramName(one.name.replace("operator", "admin", 1), one.secret),
        ProgramName.from_token(one.name),
        ProgramName.from_token(""),
    ):
        assert not forged.is_genuine
    assert ProgramName.new("of somebody else's authority").role == "anyone"


# ---------------------------------------------------------------------- at an agent


FIRST_CALL = 1000
"""No other program of a test has as many calls."""


class Stranger:
    """A program by hand: it says at the bus what it likes, under any name.

    Args:
        bus: an end of its own.
        who: whose name it says.
    """

    def __init__(self, bus: Bus, who: ProgramName) -> None:
        self.bus, self.who = bus, who
        self.calls = FIRST_CALL
        self.replies: list[dict[str, Any]] = []
        bus.subscribe(KEYS.reply(who.name), self._hear)

    def _hear(self, _: str, payload: bytes) -> None:
        if decode_trigger_reply(payload, "a reply") is None:
            said = decode(payload, "a reply").fields
            if said["call"] > FIRST_CALL:  # else it is another's
                self.replies.append(said)

    def ask(self, do: str = "", *, role: str | None = None, **fields: Any) -> None:
        """Ask as a role, by default that of its name."""
        key = KEYS.ask(role or self.who.role, "agent", NAME)
        self._say(key, do, fields)

    def command(self, do: str = "", **fields: Any) -> None:
        self._say(KEYS.command("agent", NAME), do, fields)

    def _say(self, key: str, do: str, fields: dict[str, Any]) -> None:
        self.calls += 1
        said = {"program": self.who.token, "call": self.calls, "timeout": 600.0, **fields}
        self.bus.put(key, encode({**said, "do": do} if do else said, ()))

    async def answers(self, count: int) -> list[dict[str, Any]]:
        """Wait for so many replies."""
        await until(lambda: len(self.replies) >= count)
        return self.replies


async def stranger(plant: Plant, role: str = "viewer", who: ProgramName | None = None) -> Stranger:
    end = plant.bus.new_connection()
    await end.open(1.0)
    return Stranger(end, ProgramName.new(role) if who is None else who)


def who_of(camera: FleetCamera[Any]) -> ProgramName:
    return ProgramName.from_token(camera._program.token)


async def test_name_of_another_gets_nothing_and_changes_nothing() -> None:
    """Whoever hears a program's name can neither call, nor cancel, nor be present as it."""
    async with Plant(NumberedCamera(time=0.2)) as plant, plant.camera() as robot:
        await robot.trigger()
        name, agent = who_of(robot).name, plant.agent
        guest = agent._programs[name]
        for who in (ProgramName(name, "0" * 16), ProgramName(name, "")):
            forger = await stranger(plant, who=who)
            following = robot._program._call_count + 1
            async with robot.reserve():
                triggering = asyncio.ensure_future(robot.trigger())
                await until(lambda: guest.running_counts[True])
                for number in range(1, following + 20):
                    for call in (number, FIRST_CALL + number):
                        forger.ask("query_application", role="anyone", call=call)
                        forger.ask("hello", role="anyone", call=call)
                    forger.ask(role="anyone", cancel=number)
                    forger.ask(role="anyone", come=0, call=number)
                    forger.command("trigger", call=number)
                    forger.command(cancel=number)
                token = forger.bus.announce(KEYS.program(who.token))
                await asyncio.sleep(0.05)
                token.close()  # which ends nobody else's
                assert (await triggering).number
                assert agent.shared_cameras[NAME].gate.holder == name
            assert forger.replies == []
            assert agent._programs == {name: guest}
            assert (await robot.trigger()).number


async def test_question_counts_as_one_of_the_role_whose_key_it_comes_under() -> None:
    async with Plant() as plant:
        one = await stranger(plant, "operator")
        one.bus.announce(KEYS.program(one.who.token))
        one.ask("hello", role="viewer")  # as a viewer's certificate lets it
        one.ask("hello")
        (answer,) = await one.answers(1)
        assert answer["call"] == FIRST_CALL + 2


async def test_order_by_another_name_is_not_done() -> None:
    async with Plant() as plant, plant.camera() as robot:
        who, met = who_of(robot), robot._caller.require()
        forger = await stranger(plant, who=ProgramName(who.name, "1" * 16))
        order = TriggerCall(7000, met.epoch, 1e9, 5.0, None, None, 1, True, False, None)
        forger.bus.put(KEYS.command("agent", NAME), encode_trigger(forger.who.token, order))
        forger.bus.put(KEYS.ask("anyone", "agent", NAME), encode_trigger(who.token, order))
        await robot.query_application()  # which came behind
        assert plant.box.runs == 0
        assert (await robot.trigger()).value.run == 1


async def test_presence_of_another_does_not_keep_a_reservation() -> None:
    async with Plant() as plant, plant.cameras(2) as (robot, other):
        forger = await stranger(plant, who=ProgramName(who_of(robot).name, "2" * 16))
        forger.bus.announce(KEYS.program(forger.who.token))
        forger.bus.announce(KEYS.program(forger.who.name))
        with pytest.raises(ReservationLostError):
            await _vanish_inside_a_block(robot, other)


async def _vanish_inside_a_block(robot: FleetCamera[Any], other: FleetCamera[Any]) -> None:
    async with robot.reserve():
        assert isinstance(await gone(other.trigger(timeout=0.2)), TriggerTimeoutError)
        end_of(robot).detach()  # it is gone without a word
        assert (await other.trigger(timeout=5.0)).value.run == 1


async def test_program_without_presence_is_forgotten_and_so_is_what_it_has() -> None:
    async with Plant() as plant, plant.camera() as robot:
        one = await stranger(plant, "operator")
        one.ask("hello")
        epoch = (await one.answers(1))[0]["epoch"]
        one.command("reserve", epoch=epoch)
        await until(lambda: plant.agent.shared_cameras[NAME].gate.holder == one.who.name)
        begun = asyncio.get_running_loop().time()
        await robot.trigger(timeout=60.0)
        waited = asyncio.get_running_loop().time() - begun
        assert waited <= _agent.PRESENCE_TIMEOUT + 1.0  # of the loop's time, which no machine's is
        assert [*plant.agent._programs] == [who_of(robot).name]


async def test_program_whose_presence_comes_late_stays() -> None:
    async with Plant() as plant:
        one = await stranger(plant, "operator")
        one.ask("hello")
        await one.answers(1)
        await asyncio.sleep(_agent.PRESENCE_TIMEOUT / 2)
        token = one.bus.announce(KEYS.program(one.who.token))
        await asyncio.sleep(_agent.PRESENCE_TIMEOUT * 2)
        assert [*plant.agent._programs] == [one.who.name]
        token.close()
        await until(lambda: not plant.agent._programs)


async def test_crowd_of_viewers_keeps_no_operator_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_agent, "MAX_PROGRAMS_PER_ROLE", 3)
    async with Plant() as plant:
        crowd = [await stranger(plant) for _ in range(6)]
        for one in crowd:
            one.bus.announce(KEYS.program(one.who.token))
            one.ask("hello")
        robots = [await stranger(plant, "operator") for _ in range(3)]
        for one in robots:
            one.bus.announce(KEYS.program(one.who.token))
            one.ask("hello")
            await one.answers(1)
        assert sum(len(one.replies) for one in crowd) == 3
        for end in [one.bus for one in crowd]:
            await end.close()
        await until(lambda: len(plant.agent._programs) == 3)
        later = await stranger(plant)
        later.bus.announce(KEYS.program(later.who.token))
        later.ask("hello")
        assert "answer" in (await later.answers(1))[0]  # the places of who went are free


async def test_questions_do_not_use_up_what_commands_may(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither those of its own program, nor those of other roles."""
    monkeypatch.setattr(_agent, "MAX_CALLS_PER_PROGRAM", 2)
    monkeypatch.setattr(_agent, "MAX_QUESTIONS_PER_ROLE", 4)
    async with Plant() as plant, plant.camera() as robot:
        asked = [await stranger(plant) for _ in range(4)]
        for one in asked:
            one.bus.announce(KEYS.program(one.who.token))
            one.ask("hello")
            await one.answers(1)
        waiting = [asyncio.ensure_future(robot.wait_ready()) for _ in range(2)]
        for one in asked:
            for _ in range(3):
                one.ask("query_application", epoch=plant.agent.epoch)
        assert (await robot.trigger()).value.run == 1  # which comes right behind
        await asyncio.gather(*waiting)
        for one in asked:
            await one.answers(4)
        assert sum("error" in said for one in asked for said in one.replies) == 12 - 4


async def test_streams_of_viewers_do_not_use_up_those_of_operators(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_frames, "MAX_STREAMS_PER_ROLE", 2)
    async with FramePlant(zenoh=False) as plant, plant.streaming():
        crowd = [await stranger(plant) for _ in range(3)]
        robot = await stranger(plant, "operator")
        for one in (*crowd, robot):
            one.bus.announce(KEYS.program(one.who.token))
            one.ask("hello")
            epoch = (await one.answers(1))[0]["epoch"]
            one.ask("next_frame", epoch=epoch, arguments={"stream": 1})
            await one.answers(2)
        assert ["error" in one.replies[1] for one in (*crowd, robot)] == [False, False, True, False]


# ---------------------------------------------------------------------- without smartcam


async def test_questions_push_no_command_out_of_the_memory_of_ids(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_services, "MAX_ANSWERS_REMEMBERED", 3)
    monkeypatch.setattr(_services, "MAX_ANSWER_BYTES_REMEMBERED", 3000)
    async with plant() as place:
        call = place.client.call
        first = await call("trigger", id="only-once")
        published = await place.client.thesis("EnablePublishing", id="p", topic_for_outputs="out")
        for name in sorted(LOOKING - {"frame", "read_image", "wait_ready"}):
            for number in range(5):
                await call(name, id=f"{name}-{number}")
        await call("status", id="only-once")  # nor is a question's id a command's
        assert await call("trigger", id="only-once") == first
        again = await place.client.thesis("EnablePublishing", id="p", topic_for_outputs="out")
        assert again == published


async def test_questions_under_way_keep_no_command_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_services, "MAX_CONCURRENT_CALLS", 2)
    async with plant() as place:
        call = place.client.call
        await call("switch_application", application=SILENT)
        silent = asyncio.ensure_future(call("trigger", timeout=5))
        asked = [asyncio.ensure_future(call("query_application")) for _ in range(3)]
        assert (await call("set_sequence_number", number=7))["error"] == ""
        kinds = [one.get("kind") for one in await asyncio.gather(*asked)]
        assert kinds.count(LocalProtocolError.__name__) == 1
        await silent


# ---------------------------------------------------------------------- with certificates


@pytest.mark.long
@pytest.mark.real_time
async def test_flood_of_a_viewer_over_tls_has_nothing_of_an_operator_refused(
    tmp_path: Path,
) -> None:
    """Under the robot's name, and under 40 of its own; and a robot that comes meanwhile gets in."""
    folder = await certified(tmp_path)
    file = plant_file(folder)
    async with smartcam.fleet.serve(file) as server:
        await server.wait_first_attempts()
        port = server.address.port
        async with (
            joined(f"tls/localhost:{port}", folder / "dashboard") as viewer,
            smartcam.connect(url_of(port, folder / "robot")) as robot,
        ):
            assert isinstance(robot, FleetCamera)
            await robot.trigger()
            own = [ProgramName.new("viewer") for _ in range(40)]
            for one in own:
                viewer.announce(KEYS.program(one.token))
            viewer.announce(KEYS.program(robot._program.name))
            fields = {"do": "hello", "arguments": {}, "timeout": 600.0}
            forged = {**fields, "program": robot._program.name}

            def ask(key: str, number: int, said: dict[str, Any]) -> None:
                viewer.put(key, encode({**said, "call": number}, ()))

            async def flood() -> None:
                for number in range(1, 401):
                    for one in own:
                        ask(
                            KEYS.ask("viewer", "line1", CAMERA),
                            number,
                            fields | {"program": one.token},
                        )
                    ask(KEYS.ask("operator", "line1", CAMERA), number, forged)
                    ask(KEYS.ask("viewer", "line1", CAMERA), number, forged)
                    ask(KEYS.command("line1", CAMERA), number, {**forged, "do": "stop"})
                    await asyncio.sleep(0)

            flooding = asyncio.ensure_future(flood())
            asked = 0
            while not flooding.done() or asked < 5:
                asked += 1
                assert (await robot.trigger(timeout=PATIENCE)).raw
                await robot.query_application(timeout=PATIENCE)
            await flooding
            another = smartcam.connect(url_of(port, folder / "robot"))
            assert isinstance(another, FleetCamera)
            async with another, another.reserve(timeout=PATIENCE):
                viewer.announce(KEYS.program(another._program.name))
                assert (await another.trigger(timeout=PATIENCE)).raw
            assert (await robot.trigger(timeout=PATIENCE)).raw


def test_name_of_a_program_is_told_in_words() -> None:
    name = ProgramName.new("operator", "robot-1").name
    assert (
        in_words(name)
        == f"robot-1 on {socket.gethostname().partition('.')[0].lower()}, pid {os.getpid()}"
    )
    assert in_words("cell.4") == "cell.4"  # of a program without smartcam
    assert ProgramName.from_token(ProgramName.new("operator").token).is_genuine
