"""The check of ``conftest.py``, tried on tests that leak on purpose."""

from __future__ import annotations

import textwrap

import pytest

from tests import ROOT

pytest_plugins = ["pytester"]

HEAD = """
    import asyncio
    import pytest
    left = []
"""


def run(pytester: pytest.Pytester, test: str) -> pytest.RunResult:
    pytester.makeini("[pytest]\nasyncio_mode = auto\nasyncio_default_fixture_loop_scope = function")
    pytester.makeconftest((ROOT / "tests" / "conftest.py").read_text(encoding="utf-8"))
    pytester.makepyfile(textwrap.dedent(HEAD) + textwrap.dedent(test))
    return pytester.runpytest_inprocess("-p", "no:cacheprovider")


@pytest.mark.parametrize(
    ("leak", "name"),
    [
        ("left.append(asyncio.create_task(asyncio.sleep(60), name='leaked'))", "*Task*leaked*"),
        (
            "left.append(await asyncio.start_server(lambda r, w: None, '127.0.0.1', 0))",
            "*left behind*<Server sockets*",
        ),
        (
            "left.append(await asyncio.get_running_loop().create_datagram_endpoint("
            "asyncio.DatagramProtocol, local_addr=('127.0.0.1', 0)))",
            "*left behind*_SelectorDatagramTransport*",
        ),
    ],
)
def test_no_leaks_something_left_behind_fails_the_test(
    pytester: pytest.Pytester, leak: str, name: str
) -> None:
    result = run(pytester, f"async def test_it():\n    {leak}\n")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines([name])


def test_no_leaks_paused_transport_left_behind_fails_the_test(pytester: pytest.Pytester) -> None:
    result = run(
        pytester,
        """
        async def test_it():
            peers = []
            made = lambda reader, writer: peers.append(writer)
            server = await asyncio.start_server(made, "127.0.0.1", 0)
            _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            while not peers:
                await asyncio.sleep(0)
            peers[0].transport.abort()
            server.close()
            left.append(writer)
            writer.transport.pause_reading()
        """,
    )
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*left behind*_SelectorSocketTransport*"])


def test_no_leaks_hypothesis_test_that_leaks_fails(pytester: pytest.Pytester) -> None:
    result = run(
        pytester,
        """
        from hypothesis import given, strategies as st

        @given(number=st.integers())
        async def test_it(number):
            left.append(asyncio.create_task(asyncio.sleep(60)))
        """,
    )
    result.assert_outcomes(passed=1, errors=1)


def test_no_leaks_clean_and_synchronous_tests_pass(pytester: pytest.Pytester) -> None:
    result = run(
        pytester,
        """
        async def test_cancelled():
            asyncio.create_task(asyncio.sleep(60)).cancel()

        @pytest.fixture
        async def server():
            server = await asyncio.start_server(lambda r, w: None, "127.0.0.1", 0)
            yield server
            server.close()

        async def test_fixture_closes(server):
            assert server.sockets

        def test_synchronous():
            with pytest.raises(RuntimeError):
                asyncio.get_running_loop()
        """,
    )
    result.assert_outcomes(passed=3)
