"""The suite for pytest: one test for each check and question, and the report at the end."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import pytest

from smartcam.conformance.camera._items import ITEMS
from smartcam.conformance.camera._judging import judge_item
from smartcam.conformance.camera._options import OPTION_PARSERS, ConformanceOptions
from smartcam.conformance.camera._report import CameraReport
from smartcam.conformance.camera._results import CameraFinding, CheckOutcome, Item
from smartcam.conformance.camera._session_under_test import CameraUnderTest
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Mapping

SKIP_NO_CAMERA = (
    "no camera was named: pytest --pyargs smartcam.conformance.camera --camera-url bvs://HOST"
)

SKIP_PARALLEL = (
    "a camera serves one client, and pytest-xdist would start several: give -n0, or leave -n out"
)


class _Reports:
    """A pytest plugin that shows the reports at the end of the run."""

    NAME: ClassVar[str] = "smartcam-conformance"

    def __init__(self) -> None:
        self.reports: dict[str, CameraReport] = {}

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        path = terminalreporter.config.getoption("--camera-report", None)
        for number, report in enumerate(self.reports.values()):
            terminalreporter.section("smartcam: is it a BVS camera?")
            terminalreporter.write_line(report.text())
            if path is None:
                continue
            report_path = path if not number else f"{path}.{number + 1}"
            try:
                report.write(report_path)
            except ConfigurationError as exc:
                terminalreporter.write_line(str(exc), red=True)
            else:
                terminalreporter.write_line(f"the report as JSON: {report_path}")


def _get_reports(config: pytest.Config) -> _Reports:
    """Return the plugin that shows the reports; the first call registers it with pytest."""
    reports = config.pluginmanager.get_plugin(_Reports.NAME)
    if not isinstance(reports, _Reports):
        reports = _Reports()
        config.pluginmanager.register(reports, _Reports.NAME)
    return reports


class CameraConformance:
    """Run all checks and questions on a camera: subclass it and give the camera's address.

    ::

        class TestOurCamera(CameraConformance):
            camera_url = "bvs://192.168.0.10"
            camera_options = {"other_application": 3}

    If the address comes from a fixture, override :meth:`camera_address`. Other values come from
    pytest's options ``--camera-...``. Without an address the tests are skipped.

    The tests are synchronous and need no plugin for event loops. Each test restores the active
    application and whether it runs. The report is shown at the end of the run.

    Attributes:
        camera_url: the camera's address, None to take ``--camera-url``.
        camera_options: fields of
            :class:`~smartcam.conformance.camera.ConformanceOptions` by their names.
    """

    camera_url: ClassVar[str | None] = None
    camera_options: ClassVar[Mapping[str, Any]] = {}

    @pytest.fixture
    def camera_address(self, request: pytest.FixtureRequest) -> str | None:
        """The camera's address, None without one."""
        address: str | None = self.camera_url or request.config.getoption("--camera-url", None)
        return address

    @pytest.fixture
    def camera_report(
        self, request: pytest.FixtureRequest, camera_address: str | None
    ) -> CameraReport:
        """The report for the tests of this class; they are skipped without a camera."""
        config = request.config
        if not camera_address:
            pytest.skip(SKIP_NO_CAMERA)
        if hasattr(config, "workerinput") and camera_address == config.getoption(
            "--camera-url", None
        ):
            pytest.skip(SKIP_PARALLEL)
        reports = _get_reports(config).reports
        key = f"{type(self).__module__}.{type(self).__qualname__} {camera_address}"
        if key not in reports:
            try:
                camera = CameraUnderTest(self._make_options(config, camera_address))
            except ConfigurationError as exc:
                pytest.exit(str(exc), returncode=pytest.ExitCode.USAGE_ERROR)
            reports[key] = CameraReport(camera)
            suite = request.node.getparent(pytest.Class)
            suite.addfinalizer(partial(camera.restore, retry=True))
        return reports[key]

    def _make_options(self, config: pytest.Config, url: str) -> ConformanceOptions:
        fields: dict[str, Any] = {}
        for option, (field, parse) in OPTION_PARSERS.items():
            text = config.getoption(option, None)
            if text is None:
                continue
            try:
                fields[field] = parse(text)
            except ConfigurationError:
                raise
            except ValueError as exc:
                raise ConfigurationError(f"{option}: {exc}") from exc
        try:
            return ConformanceOptions(url=url, **{**fields, **self.camera_options})
        except TypeError as exc:
            raise ConfigurationError(f"camera_options: {exc}") from exc

    @pytest.mark.parametrize("item", ITEMS, ids=lambda item: item.name)
    def test_camera(self, camera_report: CameraReport, item: Item) -> None:
        """The camera follows the documents; where there is none, a quirk's value describes it."""
        finding = judge_item(camera_report.camera, item)
        camera_report.add(finding)
        if finding.failed:
            pytest.fail(_failure_text(finding), pytrace=False)
        elif finding.outcome is CheckOutcome.NOT_OBSERVED:
            pytest.skip(f"not observed, because {finding.text}")
        elif finding.outcome is CheckOutcome.NOT_APPLICABLE:
            pytest.skip(finding.text)


def _failure_text(finding: CameraFinding) -> str:
    return "\n".join(
        [
            f"{finding.item.about} ({finding.source}, {finding.grade})",
            f"expected: {finding.expected}",
            f"observed: {finding.observed}",
            *finding.wire,
        ]
    )
