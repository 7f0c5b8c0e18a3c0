"""The suite as an author runs it: the tests that ``docs/adding-a-camera.md`` shows."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from acme_page import MODULE, TESTS, acme

if TYPE_CHECKING:
    import pytest

pytest_plugins = ["pytester"]

OPTIONS = ("-p", "no:cacheprovider", "-rs", "-o", "asyncio_default_fixture_loop_scope=function")


def test_page_shows_a_camera_that_the_client_can_use() -> None:
    with acme.installed():
        asyncio.run(acme.main())


def test_page_shows_tests_that_pass(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(acme_camera=MODULE, test_acme=TESTS)
    pytester.syspathinsert()
    result = pytester.runpytest_inprocess(*OPTIONS, "-o", "asyncio_mode=auto")
    result.assert_outcomes(passed=75, skipped=10)
    result.stdout.fnmatch_lines(
        ["*Acme has no application 3", "*AcmeSite cannot restart the camera"]
    )


def test_suite_without_what_it_needs_says_so(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        from smartcam.testing.suites.protocols import ProtocolSuite

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
        from smartcam.protocols.insight.dialect import INSIGHT
        from smartcam.testing.suites.protocols import ProtocolSuite

        class TestBare(ProtocolSuite):
            protocol = INSIGHT
        """
    )
    result = pytester.runpytest_inprocess(*OPTIONS)
    assert result.parseoutcomes()["passed"] == 14
    result.stdout.fnmatch_lines_random(
        ["*TestBare.worlds is empty", "*TestBare.conversations has none"]
    )
