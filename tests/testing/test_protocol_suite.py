"""The suite for authors of protocols, run with smartcam's own; ``tests/conformance`` has the rest.

The bytes of conversations in frames come from the dialect's table, which golden vectors prove
(``test_vectors.py``); those of In-Sight are written out.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import pytest

from smartcam.exceptions import FrameError, MessageError
from smartcam.models import Status
from smartcam.protocols import BVS, Transport
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK, INSIGHT, ONLINE
from smartcam.testing import Conversation, Received, Sent, WireSuite
from smartcam.testing._suites.protocols.conversations import Step
from tests import ROOT
from tests.machines import B16, BID, THESIS
from tests.protocols.insight_lines import BITMAP, GREETING, IMAGE_LINES
from tests.testing.acme_page import MODULE, TESTS, acme_is_known

if TYPE_CHECKING:
    from smartcam.protocols import FramedDialect

pytest_plugins = ["pytester"]

__all__ = ["acme_is_known"]

EXAMPLE = ROOT / "examples" / "smartcam-acme"

RUNNING = Status.RUNNING | Status.WAITING_FOR_TRIGGER
CLOCK = {"year": 2016, "month": 6, "day": 25, "hour": 10, "minute": 11, "second": 12}


def carried(dialect: FramedDialect, message: m.Message) -> m.Message:
    """Return a message as it comes out of a dialect: what it leaves out has its default."""
    left = set(dialect.fields(type(message)))
    defaults = {
        field.name: field.default
        for field in dataclasses.fields(message)
        if field.name not in left and field.default is not dataclasses.MISSING
    }
    return dataclasses.replace(message, **defaults)


def framed(dialect: FramedDialect, transport: Transport) -> Conversation:
    """Return a conversation of client and camera in frames: answered requests, and results."""

    def came(*messages: m.Message) -> list[Step]:
        told = [carried(dialect, one) for one in messages if dialect.has(type(one))]
        if transport is Transport.UDP:
            return [Received(dialect.encode(one), (one,)) for one in told]
        return [Received(b"".join(map(dialect.encode, told)), tuple(told))] if told else []

    def sent(message: m.Message) -> list[Step]:
        return [Sent(message, dialect.encode(message))] if dialect.has(type(message)) else []

    status = m.StatusReport(status=RUNNING)
    steps: list[Step] = [*sent(m.Connect()), *came(m.ConnectAnswer(version=1))]
    steps += [*sent(m.Query()), *came(m.QueryAnswer(application=21))]
    steps += [*sent(m.GetStatus()), *came(status)]
    steps += [*sent(m.GetClock()), *came(m.ClockAnswer(**CLOCK))]
    steps += [*sent(m.SwitchApplication(application=5)), *came(m.SwitchAnswer(application=5))]
    steps += [*sent(m.ResetErrors()), *came(m.ResetErrorsAnswer(), status)]
    steps += [*sent(m.Trigger()), *came(m.TriggerAnswer())]
    steps += came(*(m.ResultContainer(application=5, data=bytes([n] * n)) for n in range(3)))
    steps += [*sent(m.Disconnect()), *came(m.DisconnectAnswer())]
    name = f"{dialect.label} over {transport.value}"
    return Conversation(
        name=name, steps=steps, dialect=dialect.name, transport=transport, quirks=dialect.quirks
    )


def broken(
    dialect: FramedDialect, data: bytes, error: type[FrameError | MessageError]
) -> Conversation:
    """Return a session that the camera breaks off with nonsense."""
    answer = m.ConnectAnswer(version=1)
    return Conversation(
        name=f"{dialect.label}, {error.__name__}",
        steps=[
            Sent(m.Connect(), dialect.encode(m.Connect())),
            Received(dialect.encode(answer), (answer,)),
            Received(data, (error,)),
        ],
        dialect=dialect.name,
    )


class TestBvs(WireSuite):
    protocol = BVS
    conversations = (
        *(
            framed(dialect, transport)
            for dialect in (
                *BVS.dialects.values(),
                *(B16.with_quirks([one]) for one in B16.wire_quirks),
            )
            for transport in Transport
        ),
        broken(HANDBOOK, b"GET / HTTP/1.1\r\n", FrameError),
        broken(THESIS, THESIS.header.pack(0x12, 1 << 20), FrameError),
        broken(B16, B16.header.pack(0x30, 1) + b"1", MessageError),
        broken(BID, BID.header.pack(0x12, 1) + b"1", MessageError),
    )

    @pytest.mark.sampled(every=3)
    def test_what_waits_for_more_has_a_bound(self, conversation: Conversation) -> None:
        super().test_what_waits_for_more_has_a_bound(conversation)


LOGGING_IN: list[Step] = [
    Sent(m.Connect(), b""),
    Received(b"Welcome to In-Sight(tm)  8502P Session 0\r\nUser: ", (), b"op\r\n"),
    Received(b"Password: ", (), b"f00l\r\n"),
    Received(b"User Logged In\r\n", (m.ConnectAnswer(code=1, version=1),)),
]
CELLS = (m.CellValue("A001", "12.5"), m.CellValue("B001", None))


class TestInSight(WireSuite):
    protocol = INSIGHT
    conversations = (
        Conversation(
            name="a session",
            dialect="native",
            parameters={"user": "op", "password": "f00l", "cells": "A1,B1"},
            steps=[
                *LOGGING_IN,
                Sent(m.GetStatus(), b"GO\r\n"),
                Received(b"1\r\n", (m.StatusReport(status=ONLINE),)),
                Sent(m.Query(), b"GJ\r\n"),
                Received(b"1\r\n7\r\n", (m.QueryAnswer(code=1, application=7),)),
                Sent(m.Stop(), b"SO0\r\n"),
                Received(b"1\r\n", (m.StopAnswer(code=1),)),
                Sent(m.SwitchApplication(application=12), b"SJ12\r\n"),
                Received(b"1\r\n", (), b"GJ\r\n"),
                Received(b"1\r\n12\r\n", (m.SwitchAnswer(code=1, application=12),)),
                Sent(m.Start(), b"SO1\r\n"),
                Received(b"1\r\n", (m.StartAnswer(code=1),)),
                Sent(m.Trigger(), b"SW8\r\n"),
                Received(b"1\r\n", (m.TriggerAnswer(code=1),), b"GJ\r\n"),
                Received(b"1\r\n12\r\n", (), b"GVA001\r\n"),
                Received(b"1\r\n12.5\r\n", (), b"GVB001\r\n"),
                Received(b"-1\r\n", (), b"GJ\r\n"),
                Received(
                    b"1\r\n12\r\n",
                    (
                        m.ResultContainer(
                            application=12, data=b'{"A001": "12.5", "B001": null}', cells=CELLS
                        ),
                    ),
                ),
                Sent(m.ReadImage(), b"RI\r\n"),
                Received(b"1\r\n50\r\n" + IMAGE_LINES, (m.Image(code=1, data=BITMAP),)),
                Sent(m.Disconnect(), b""),
            ],
        ),
        Conversation(
            name="a wrong password",
            dialect="native",
            steps=[
                Sent(m.Connect(), b""),
                Received(GREETING, (), b"admin\r\n"),
                Received(b"Password: ", (), b"\r\n"),
                Received(b"Invalid Password\r\n", (m.ConnectAnswer(code=-6, version=1),)),
            ],
        ),
        Conversation(
            name="no camera",
            dialect="native",
            steps=[Sent(m.Connect(), b""), Received(b"SSH-2.0-OpenSSH_9.2\r\n", (FrameError,))],
        ),
    )


# ---------------------------------------------------------------------- as an author runs it


OPTIONS = ("-p", "no:cacheprovider", "-rs", "-o", "asyncio_default_fixture_loop_scope=function")


def test_page_shows_the_example_word_by_word() -> None:
    assert (EXAMPLE / "acme_camera.py").read_text(encoding="utf-8") == MODULE


def test_camera_of_the_page_takes_about_forty_lines() -> None:
    lines = [line for line in MODULE.splitlines() if line.strip()]
    assert len(lines) < 50


def test_page_shows_tests_that_pass(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(acme_camera=MODULE, test_acme=TESTS)
    pytester.syspathinsert()
    result = pytester.runpytest_inprocess(*OPTIONS, "-o", "asyncio_mode=auto")
    result.assert_outcomes(passed=77, skipped=10)
    result.stdout.fnmatch_lines(
        ["*Acme has no application 3", "*LiveAcme cannot restart the camera"]
    )


def test_suite_without_what_it_needs_reports_it(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        from smartcam.testing import ProtocolSuite

        class TestNothing(ProtocolSuite):
            pass
        """
    )
    result = pytester.runpytest_inprocess(*OPTIONS)
    result.stdout.fnmatch_lines(["*TestNothing.protocol: expected a Protocol*"])


def test_suite_without_conversations_or_worlds_skips_and_says_why(
    pytester: pytest.Pytester,
) -> None:
    pytester.makepyfile(
        """
        from smartcam.protocols._insight.dialect import INSIGHT
        from smartcam.testing import ProtocolSuite

        class TestBare(ProtocolSuite):
            protocol = INSIGHT
        """
    )
    result = pytester.runpytest_inprocess(*OPTIONS)
    assert result.parseoutcomes()["passed"] == 14
    result.stdout.fnmatch_lines_random(
        ["*TestBare.camera_kinds is empty", "*TestBare.conversations has none"]
    )
