"""The pytest plugin, in projects of other people: each test runs pytest in a folder of its own."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from smartcam.registry import INTERPRETERS, PROTOCOLS

pytest_plugins = ["pytester"]

# pytester forgets what a nested run imported, and the next one would make second copies of it
_LOADED = [
    importlib.import_module(name)
    for name in ("smartcam.client", "smartcam.testing._threads", "numpy", "yaml")
]
_PLUGINS = [one.load(info.name) for one in (INTERPRETERS, PROTOCOLS) for info in one.available()]

SYNCHRONOUS = """
    import socket

    CONNECT = bytes.fromhex("50535642 00000000 01000000")

    def test_socket(emulated_camera):
        with socket.create_connection((emulated_camera.host, emulated_camera.port)) as client:
            client.sendall(CONNECT)
            answer = client.recv(16, socket.MSG_WAITALL)
            assert answer == bytes.fromhex("50535642 04000000 01000000 01000000")
            client.sendall(bytes.fromhex("50535642 00000000 02000000"))
        emulated_camera.log.expect("Connect", "ConnectAnswer", "Disconnect", timeout=60)
        emulated_camera.log.expect_disconnect_before_close(timeout=60)
"""

ASYNCHRONOUS = """
    import pytest

    @pytest.mark.smartcam(application=7, interpret_as="localizations")
    MARK
    async def test_trigger(camera, emulated_camera):
        result = await camera.trigger()
        assert {part.feature_id for part in result.value} == set(emulated_camera.scene.pieces)
        emulated_camera.log.expect("Connect", "Trigger", "ResultContainer")
        emulated_camera.log.expect_nothing_while_busy()
"""


LOOP_SCOPE = ("-o", "asyncio_default_fixture_loop_scope=function")
"""pytest-asyncio warns where it is not said."""


def run(pytester: pytest.Pytester, source: str, *options: str, **passed: int) -> pytest.RunResult:
    pytester.makepyfile(source)
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", *LOOP_SCOPE, *options)
    result.assert_outcomes(**passed)
    return result


def test_synchronous_test_has_a_camera(pytester: pytest.Pytester) -> None:
    run(pytester, SYNCHRONOUS, passed=1)


@pytest.mark.parametrize(
    ("mark", "options"),
    [
        ("@pytest.mark.asyncio", ["asyncio_mode=strict"]),
        ("", ["asyncio_mode=auto"]),
        (
            '@pytest.mark.asyncio(loop_scope="session")',
            ["asyncio_mode=strict", "asyncio_default_fixture_loop_scope=function"],
        ),
        ("", ["asyncio_mode=auto", "asyncio_default_fixture_loop_scope=session"]),
    ],
)
def test_asyncio_test_has_a_client(
    pytester: pytest.Pytester, mark: str, options: list[str]
) -> None:
    given = [part for option in options for part in ("-o", option)]
    run(pytester, ASYNCHRONOUS.replace("MARK", mark), "-p", "no:anyio", *given, passed=1)


@pytest.mark.long
def test_anyio_test_has_a_client_in_asyncio(pytester: pytest.Pytester) -> None:
    pytest.importorskip("anyio", reason="needs anyio, of the extra dev")
    source = ASYNCHRONOUS.replace("MARK", "@pytest.mark.anyio") + (
        '\n    @pytest.fixture\n    def anyio_backend():\n        return "asyncio"\n'
    )
    run(pytester, source, "-p", "no:asyncio", passed=1)


@pytest.mark.long
def test_client_needs_asyncio_the_emulated_camera_does_not(pytester: pytest.Pytester) -> None:
    pytest.importorskip("trio", reason="needs trio, of the extra dev")
    pytest.importorskip("anyio", reason="needs anyio, of the extra dev")
    source = """
        import anyio
        import pytest

        pytestmark = pytest.mark.anyio

        @pytest.fixture
        def anyio_backend():
            return "trio"

        async def test_client(camera):
            pass

        async def test_stream(emulated_camera):
            stream = await anyio.connect_tcp(emulated_camera.host, emulated_camera.port)
            async with stream:
                await stream.send(bytes.fromhex("50535642 00000000 01000000"))
                await emulated_camera.received(1)
    """
    result = run(pytester, source, "-p", "no:asyncio", passed=1, failed=1)
    result.stdout.fnmatch_lines(["*the fixture camera needs asyncio, and this test runs on*"])


def test_client_in_a_synchronous_test_is_a_mistake(pytester: pytest.Pytester) -> None:
    result = run(pytester, "def test_client(camera): pass", failed=1)
    result.stdout.fnmatch_lines(["the fixture camera needs an asynchronous test*"])


def test_fixture_of_another_can_open_the_client(pytester: pytest.Pytester) -> None:
    source = """
        import pytest
        import pytest_asyncio
        import smartcam

        @pytest_asyncio.fixture
        async def stopped(camera):
            await camera
            await camera.stop()
            return camera

        @pytest.mark.asyncio
        @pytest.mark.smartcam(application=21)
        async def test_stopped(stopped):
            assert smartcam.Status.RUNNING not in stopped.status
    """
    run(pytester, source, "-o", "asyncio_mode=strict", passed=1)


def test_client_is_closed_after_a_failure(pytester: pytest.Pytester) -> None:
    source = """
        import pytest

        emulator = None

        @pytest.mark.asyncio
        async def test_fails(camera, emulated_camera):
            global emulator
            emulator = emulated_camera
            assert False

        def test_after():
            emulator.log.expect("Connect", "Disconnect", timeout=60)
    """
    run(pytester, source, passed=1, failed=1)


def test_marker_says_what_the_camera_is(pytester: pytest.Pytester) -> None:
    pytester.makefile(
        ".yaml",
        line="""
        active: 5
        applications:
          - {id: 5, layout: "n: int32", constant: [4]}
        timeline:
          - {command: jam, do: {kind: stop}}
        """,
    )
    source = """
        import pytest
        import smartcam

        pytestmark = pytest.mark.smartcam(scenario="line.yaml", dialect="thesis", running=True)

        @pytest.mark.smartcam(
            transport="udp", interpret_as="n: int32", connect={"name": "line"}, seed=4,
            faults=[{"kind": "no_result", "on": "Trigger"}], quirks={"reboot_time": 1},
        )
        @pytest.mark.asyncio
        async def test_marked(camera, emulated_camera):
            assert emulated_camera.url.startswith("bvs+udp://")
            assert emulated_camera.url.endswith("?dialect=thesis")
            assert (emulated_camera.seed, camera.name) == (4, "line")
            with pytest.raises(smartcam.TriggerTimeoutError):
                await camera.trigger(timeout=0.1)
            assert (await camera.trigger()).value.n == 4
            emulated_camera.command("jam")
            await camera.wait_status(lambda status: not status & 0x80)

        @pytest.mark.smartcam(manual_clock=True, timeline=[{"at": 9, "do": {"kind": "stop"}}])
        def test_time_is_moved(emulated_camera):
            emulated_camera.advance(8.999)
            assert emulated_camera.device.running
            emulated_camera.advance(0.001)
            assert not emulated_camera.device.running
    """
    run(pytester, source, passed=2)


@pytest.mark.parametrize(
    ("marker", "text"),
    [
        ("colour='red'", "the marker smartcam has no option 'colour'; it has active, *"),
        ("7", "the marker smartcam takes keyword arguments only, such as application=7"),
        ("dialect='b17'", "*emulator: dialect 'b17' is unknown; known are handbook*"),
        ("scenario='none.yaml'", "the marker smartcam: scenario none.yaml: *No such file*"),
        ("applications=[1]", "the marker smartcam: application 1: *valid dictionary*"),
    ],
)
def test_wrong_marker_is_reported(pytester: pytest.Pytester, marker: str, text: str) -> None:
    source = f"""
        import pytest

        @pytest.mark.smartcam({marker})
        def test_marked(emulated_camera):
            pass
    """
    said = run(pytester, source, errors=1).stdout
    said.fnmatch_lines([text])
    said.no_fnmatch_line("*Traceback*")
    said.no_fnmatch_line("*smartcam/emulator*")


def test_scenario_is_looked_for_beside_the_test_and_below_the_root(
    pytester: pytest.Pytester,
) -> None:
    pytester.makeini("[pytest]")
    (pytester.path / "scenarios").mkdir()
    (pytester.path / "scenarios" / "a.yaml").write_text("active: 3", encoding="utf-8")
    folder = pytester.mkpydir("checks")
    (folder / "b.yaml").write_text("active: 9", encoding="utf-8")
    (folder / "test_paths.py").write_text(
        """
import pytest

@pytest.mark.parametrize("active", [
    pytest.param(3, marks=pytest.mark.smartcam(scenario="scenarios/a.yaml")),
    pytest.param(9, marks=pytest.mark.smartcam(scenario="b.yaml")),
])
def test_path(emulated_camera, active):
    assert emulated_camera.device.active_application == active
""",
        encoding="utf-8",
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", *LOOP_SCOPE, "checks")
    result.assert_outcomes(passed=2)


def test_fleet_has_two_cameras_or_those_of_a_scenario(pytester: pytest.Pytester) -> None:
    pytester.makefile(".yaml", cell="cameras: [{name: left}, {name: right, dialect: bid}]")
    source = """
        import pytest
        import smartcam

        @pytest.mark.asyncio
        async def test_two(emulated_fleet):
            assert list(emulated_fleet) == ["camera1", "camera2"]
            for url in emulated_fleet.urls.values():
                async with smartcam.connect(url) as camera:
                    assert camera.active_application == 1

        @pytest.mark.smartcam(cameras=3, application=9)
        def test_three(emulated_fleet):
            assert [one.device.running for one in emulated_fleet.values()] == [True] * 3

        @pytest.mark.smartcam(scenario="cell.yaml")
        def test_scenario(emulated_fleet):
            assert [one.dialect for one in emulated_fleet.values()] == ["handbook", "bid"]
    """
    run(pytester, source, passed=3)


@pytest.mark.long
def test_workers_of_xdist_do_not_meet(pytester: pytest.Pytester) -> None:
    pytest.importorskip("xdist", reason="needs pytest-xdist, of the extra dev")
    pytester.makepyfile(
        """
        import pytest
        import smartcam

        @pytest.mark.parametrize("n", range(20))
        @pytest.mark.smartcam(application=21)
        @pytest.mark.asyncio
        async def test_trigger(camera, emulated_camera, n):
            await camera.trigger()
            emulated_camera.log.expect("Connect", "Trigger")
            assert len([m for m in emulated_camera.log.received if "Connect" in str(m)]) <= 2
        """
    )
    pytester.runpytest_subprocess("-n", "2", *LOOP_SCOPE).assert_outcomes(passed=20)


def test_suite_that_does_not_use_it_imports_nothing_heavy(tmp_path: Path) -> None:
    (tmp_path / "test_nothing.py").write_text(
        "import sys\n\ndef test_nothing():\n"
        "    heavy = {'asyncio', 'numpy', 'pydantic', 'construct', 'yaml', 'aiohttp',\n"
        "        'smartcam.emulator', 'smartcam.client', 'smartcam.testing._threads'}\n"
        "    assert 'smartcam.pytest_plugin' in sys.modules\n"
        # pdb, which pytest imports, has it from then on
        "    heavy -= {'asyncio'} if sys.version_info >= (3, 14) else set()\n"
        "    assert heavy.isdisjoint(sys.modules)\n",
        encoding="utf-8",
    )
    # without the other plugins, which import what they like
    options = ["-q", "-p", "no:cacheprovider", "-p", "smartcam.pytest_plugin"]
    done = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-m", "pytest", *options, str(tmp_path)],
        env={"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert "1 passed" in done.stdout, done.stdout + done.stderr


def test_marker_and_fixtures_are_listed(pytester: pytest.Pytester) -> None:
    result = pytester.runpytest_inprocess("--markers", *LOOP_SCOPE)
    result.stdout.fnmatch_lines(["@pytest.mark.smartcam(application=None, interpret_as=None,*"])
    result = pytester.runpytest_inprocess("--fixtures", *LOOP_SCOPE)
    result.stdout.fnmatch_lines_random(
        ["camera -- *", "emulated_camera -- *", "emulated_fleet -- *"]
    )
