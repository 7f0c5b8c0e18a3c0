"""The fleet's page in a real browser: 5,000 made-up cameras, and a few emulated ones."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
import pytest_asyncio

import smartcam
import smartcam.fleet
from smartcam.exceptions import InterpretationError
from smartcam.fleet import FleetFile, FleetServer
from smartcam.fleet._inside import FleetOutlets
from smartcam.layout import Layout
from smartcam.models import Status
from smartcam.web import FleetSite
from tests.processes import free_port
from tests.web.browser import BROWSER_MARKS, PATIENCE, new_page, nothing_wrong, see
from tests.web.madeup import MadeUpFleet, names
from tests.web.sitekit import TOKEN

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from playwright.async_api import Page

    from smartcam.fleet import Fleet

pytestmark = BROWSER_MARKS

LIVE = "#live[data-state=live]"
COUNT = 5000
FEW = 300
CELL = FleetFile.model_validate(
    {
        "cameras": {
            "line1/cam1": {"emulated": {}, "application": 7, "interpret_as": "localizations"},
            "line1/cam2": {"emulated": {}, "application": 21},
        }
    }
)

OUTLETS = """\
listen: tcp/127.0.0.1:PORT
cameras:
  line1/cam2: {emulated: {}, application: 1, interpret_as: "n: int64, m: int64, k: int64"}
outlets:
  results: {kind: sqlite, file: results.sqlite}
  broker: {kind: mqtt, broker: 'mqtt://127.0.0.1:NOBODY'}
"""

MEASURED = """\
applications:
  - {id: 5, layout: "(x: real32 mm, a: real32 deg)*", constant: [{x: 0.0125, a: 1.5707964}]}
"""


class Checked(NamedTuple):
    """A value with a verdict."""

    ok: bool


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    """The one page of all tests; each opens a site of its own in it."""
    async with new_page(1280, 800) as page:
        yield page


@contextlib.asynccontextmanager
async def opened(page: Page, fleet: Fleet, **options: Any) -> AsyncIterator[FleetSite]:
    """Show a fleet; what the browser finds wrong with the page fails the test."""
    with nothing_wrong(page):
        async with FleetSite(fleet, **options) as site:
            await page.goto(site.url)
            await page.locator(LIVE).wait_for()
            await page.locator(".camera").first.wait_for()
            yield site
            await page.goto("about:blank")


async def gone(page: Page, selector: str) -> None:
    """Wait until something is in the document no more."""
    await page.locator(selector).first.wait_for(state="detached")


def row(name: str) -> str:
    return f".camera[data-camera='{name}']"


async def visible(page: Page) -> list[str]:
    """Return the cameras that are on the screen, from above."""
    found: list[str] = await page.evaluate(
        """() => {
          const box = document.querySelector("#box").getBoundingClientRect();
          return [...document.querySelectorAll(".camera")]
            .map((one) => [one.getBoundingClientRect(), one.dataset.camera])
            .filter(([at]) => at.top >= box.top - 1 && at.bottom <= box.bottom + 1)
            .sort(([one], [other]) => one.top - other.top).map(([, name]) => name);
        }"""
    )
    return found


async def test_outlets_have_their_accounts_and_what_failed_with_whole_texts(
    page: Page, tmp_path: Path
) -> None:
    file = tmp_path / "fleet.yaml"
    port, nobody = free_port(), free_port()
    file.write_text(OUTLETS.replace("PORT", str(port)).replace("NOBODY", str(nobody)))
    server = FleetServer(file)
    async with (
        FleetOutlets(server),
        server,
        smartcam.fleet.open(f"fleet://127.0.0.1:{port}") as fleet,
        opened(page, fleet),
    ):
        async with smartcam.connect(f"fleet://127.0.0.1:{port}/line1/cam2") as camera:
            with pytest.raises(InterpretationError):
                await camera.trigger(timeout=PATIENCE)
        for name, *numbers, state in (  # results, delivered, spooled, dropped
            ("broker", 1, 0, 1, 0, "MqttError: [Errno 111] Connection refused"),
            ("results", 1, 1, 0, 0, "well"),
        ):
            await see(page, "#outlet-counts tr", f"{name}{''.join(map(str, numbers))}{state}")
        await page.click("#failures summary")
        await see(page, "#counted", "1 of 1 failed, 1 errors, 0 lost in 0 gaps")
        await see(page, "#failed tr", "expected 24 bytes, got 150: 126 too many from offset 24")
        for width in (1280, 390):
            await page.set_viewport_size({"width": width, "height": 800})
            cut = "(all) => all.filter((one) => one.scrollWidth > one.clientWidth).length"
            assert await page.eval_on_selector_all(".outlets td, .outlets th", cut) == 0
        await page.set_viewport_size({"width": 1280, "height": 800})


async def test_only_rows_in_sight_are_in_the_document_to_the_last_of_all(page: Page) -> None:
    async with opened(page, MadeUpFleet(names(COUNT)).as_fleet):
        await see(page, "#found", "5,000 cameras")
        await see(page, "[data-total=connected]", "5,000")
        assert (await visible(page))[:3] == names(3)
        assert await page.locator(".camera").count() < 60
        await page.evaluate("document.querySelector('#box').scrollTop = 1e9")
        await see(page, row(names(COUNT)[-1]))
        await gone(page, row(names(1)[0]))
        assert (await visible(page))[-1] == names(COUNT)[-1]
        assert await page.locator(".camera").count() < 60
        last = page.locator(row(names(COUNT)[-1]))
        assert await last.get_attribute("aria-rowindex") == str(COUNT + 1)
        await page.evaluate("document.querySelector('#box').scrollTop = 2500 * 56")
        await see(page, row(names(COUNT)[2500]))
        assert names(COUNT)[2501] in await visible(page)


async def test_search_and_chips_narrow_the_table(page: Page) -> None:
    fleet = MadeUpFleet(names(COUNT))
    async with opened(page, fleet.as_fleet):
        fleet["line03/cam123"].lose("cable unplugged")
        fleet["line04/cam004"].say(Status(0))
        await page.keyboard.press("/")
        await page.keyboard.type("line07 cam01")
        await see(page, "#found", "10 cameras")
        assert await visible(page) == [f"line07/cam01{n}" for n in range(9)]
        await page.fill("#search", "unplugged")
        await see(page, "#found", "1 camera")
        await see(page, row("line03/cam123"), "cable unplugged")
        await page.fill("#search", "nothing like this")
        await page.locator("#none").wait_for()
        await page.fill("#search", "")
        await see(page, "#found", "5,000 cameras")
        await see(page, "[data-filter=stopped]", "1")
        await page.click("[data-filter=stopped]")
        await see(page, "#found", "1 camera")
        assert await visible(page) == ["line04/cam004"]
        assert await page.get_attribute("[data-filter=stopped]", "aria-pressed") == "true"
        await page.reload()  # the address has it
        await see(page, "#found", "1 camera")
        assert page.url.endswith("/?filter=stopped")


async def test_columns_sort(page: Page) -> None:
    fleet = MadeUpFleet(names(FEW))
    async with opened(page, fleet.as_fleet):
        for _ in range(3):
            fleet["line01/cam299"].fail(InterpretationError("too short"))
        fleet["line01/cam288"].fail(InterpretationError("too long"))
        await page.click("#heads [data-sort=errors] button")
        await see(page, row("line01/cam299"), "too short")
        await see(page, row("line01/cam288"), "too long")
        assert (await visible(page))[:2] == ["line01/cam299", "line01/cam288"]
        head = "#heads [data-sort=errors]"
        assert await page.get_attribute(head, "aria-sort") == "descending"
        await page.click("#heads [data-sort=name] button")
        await see(page, row("line01/cam000"))
        await page.click("#heads [data-sort=name] button")
        await see(page, row(names(FEW)[-1]))
        assert (await visible(page))[0] == names(FEW)[-1]


async def test_keys_go_through_the_table(page: Page) -> None:
    async with opened(page, MadeUpFleet(names(FEW)).as_fleet):
        await page.focus("#grid")
        await page.keyboard.press("ArrowDown")
        await page.keyboard.press("ArrowDown")
        chosen = page.locator(".camera[data-chosen=true]")
        assert await chosen.get_attribute("data-camera") == names(3)[2]
        assert await page.get_attribute(
            "#grid", "aria-activedescendant"
        ) == await chosen.get_attribute("id")
        await page.keyboard.press("End")
        await see(page, f"{row(names(FEW)[-1])}[data-chosen=true]")
        await page.keyboard.press("Home")
        await see(page, f"{row(names(1)[0])}[data-chosen=true]")
        await page.keyboard.press("PageDown")
        await gone(page, f"{row(names(1)[0])}[data-chosen=true]")


async def test_camera_goes_and_comes_and_its_results_are_counted(page: Page) -> None:
    fleet = MadeUpFleet(names(FEW))
    async with opened(page, fleet.as_fleet):
        name = "line01/cam002"
        fleet[name].send(Checked(True))
        await see(page, f"{row(name)} .last", "✓ pass")
        fleet[name].send(Checked(False))
        await see(page, f"{row(name)} .last", "✗ fail")
        await see(page, f"{row(name)} .count", "2")
        fleet.lose("a")
        await see(page, f"{row(name)}[data-mode=gone]", "no agent has it")
        await see(page, "[data-total=connected]", "150")
        for one in names(FEW)[::2]:
            fleet.join(one, "c")
        await see(page, f"{row(name)}[data-mode=running]", "c")
        await see(page, "[data-total=connected]", "300")
        await page.locator("#chart rect.passed").first.wait_for()
        assert "failed" in str(await page.get_attribute("#chart", "aria-label"))


async def test_phone_shows_cards_and_never_scrolls_sideways(page: Page) -> None:
    fleet = MadeUpFleet([*names(60), "a-name-with-much-text/in-four/parts-of-it/camera_0123456789"])
    await page.set_viewport_size({"width": 360, "height": 740})
    async with opened(page, fleet.as_fleet, control=True):
        fleet["line01/cam000"].lose("a reason that is longer than any phone is wide " * 3)
        await see(page, row("line01/cam000"), "a reason")
        assert await page.evaluate("document.documentElement.scrollWidth") == 360
        assert not await page.locator("#heads").is_visible()
        await page.select_option("#sort", "state")
        await see(page, row("line01/cam000"))
        assert (await visible(page))[0] == "line01/cam000"
        tall = await page.eval_on_selector(".camera", "one => one.offsetHeight")
        assert tall == 86
        await page.evaluate("document.querySelector('#box').scrollTop = 1e9")
        await see(page, row("line01/cam059"))
    await page.set_viewport_size({"width": 1280, "height": 800})


async def test_one_camera_is_triggered_on_its_page(page: Page) -> None:
    async with (
        smartcam.fleet.open(CELL) as fleet,
        opened(page, fleet, control=True, token=TOKEN) as site,
    ):
        await page.click(f"{row('line1/cam1')} a")
        await page.locator(LIVE).wait_for()
        await see(page, "#name", "line1/cam1")
        await page.click("#trigger")
        await see(page, "#last", "square")
        await see(page, "[data-count=triggered]", "1")
        assert await page.inner_text("#sum") == "adds up"
        await page.click("#back")
        await see(page, f"{row('line1/cam1')} .last", "7 parts")
        assert await page.locator(f"{row('line1/cam1')} .picture polygon").count() == 7
        square = f"{row('line1/cam1')} polygon[data-part=square]"
        assert len(str(await page.get_attribute(square, "points")).split()) == 4
        assert site.view.rows["line1/cam1"].count == 1


async def test_key_opens_a_camera_and_back_finds_the_table_as_it_was(page: Page) -> None:
    async with smartcam.fleet.open(CELL) as fleet, opened(page, fleet):
        await see(page, "[data-total=connected]", "2")
        await page.click("[data-filter=connected]")
        await page.focus("#grid")
        await page.keyboard.press("ArrowDown")
        await see(page, f"{row('line1/cam2')}[data-chosen=true]")
        await page.keyboard.press("Enter")
        await see(page, "#name", "line1/cam2")
        await page.locator(LIVE).wait_for()
        await page.go_back()
        await see(page, row("line1/cam1"))
        assert page.url.endswith("/?filter=connected")


async def test_without_control_there_is_no_trigger_and_an_unknown_camera_is_reported(
    page: Page,
) -> None:
    async with smartcam.fleet.open(CELL) as fleet, opened(page, fleet) as site:
        await page.goto(f"{site.url}camera/line1/cam2")
        await see(page, "#looking", "Looking only")
        assert not await page.locator("#trigger").is_visible()
        await page.goto(f"{site.url}camera/line1/cm2")
        await see(page, "#alarm", "no camera 'line1/cm2'")


async def test_switch_of_units_holds_for_the_table_and_the_page_of_a_camera(
    page: Page, tmp_path: Path
) -> None:
    (tmp_path / "measured.yaml").write_text(MEASURED, encoding="utf-8")
    entry = {
        "emulated": {"scenario": str(tmp_path / "measured.yaml")},
        "application": 5,
        "interpret_as": "table: (x: real32 mm, a: real32 deg)*",
    }
    cell = FleetFile.model_validate({"cameras": {"line1/table": entry}})
    async with smartcam.fleet.open(cell) as fleet, opened(page, fleet):
        await fleet["line1/table"].trigger()
        await see(page, f"{row('line1/table')} .last", "1: x 0.0125 m, a 1.5708 rad")
        await page.check("#practical")
        await see(page, f"{row('line1/table')} .last", "1: x 12.5 mm, a 90 deg")
        await page.click(f"{row('line1/table')} a")
        await see(page, "#last th", "x, mm")
        await see(page, "#last td", "12.5")
        assert await page.is_checked("#practical")
        await page.uncheck("#practical")
        await see(page, "#last th", "x, m")
        await page.go_back()
        await see(page, f"{row('line1/table')} .last", "1: x 0.0125 m, a 1.5708 rad")
        assert not await page.is_checked("#practical")


async def test_row_says_since_when_its_camera_fails_or_is_lost(page: Page) -> None:
    fleet = MadeUpFleet(names(2))
    failing, lost = (fleet[name] for name in names(2))
    async with opened(page, fleet.as_fleet):
        failing.send(Checked(True))
        failing.send(Checked(False), at=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC))
        lost.lose("cable unplugged")
        await see(page, f"{row(failing.name)} .last", ":04:05, 1 in a row · ")
        assert "fails since Jan 2" in await page.inner_text(f"{row(failing.name)} .last")
        await see(page, f"{row(lost.name)} .state", "since ")
        await see(page, f"{row(lost.name)} .state", ": cable unplugged")
        assert await page.locator(f"{row(failing.name)} .trend rect.failed").count() == 1
        label = await page.get_attribute(f"{row(failing.name)} .trend svg", "aria-label")
        assert label is not None
        assert label.startswith("Last ten hours: 1 passed, 1 failed")


async def test_page_begins_with_the_units_of_its_command(page: Page) -> None:
    fleet = MadeUpFleet(names(1))
    async with opened(page, fleet.as_fleet, units=("um",)):
        fleet[names(1)[0]].send(Layout("x: real32 mm, a: real32 deg").parse(bytes(8)))
        await see(page, f"{row(names(1)[0])} .last", "x 0 um, a 0 rad")
        await see(page, "#units", "um")


async def test_server_that_ends_and_comes_back_is_reported(page: Page) -> None:
    fleet = MadeUpFleet(names(20))
    async with opened(page, fleet.as_fleet, port=free_port()) as site:
        await site.stop()
        await see(page, "#live[data-state=lost]")
        await see(page, "#alarm", "does not answer")
        fleet.leave("line01/cam003")
        await site.start()
        await page.locator(LIVE).wait_for()
        await page.locator("#alarm").wait_for(state="hidden")
        await see(page, f"{row('line01/cam003')}[data-mode=gone]", "no agent has it")
        await see(page, "[data-total=connected]", "19")


async def test_browser_that_stalls_is_up_to_date_when_it_goes_on(page: Page) -> None:
    fleet = MadeUpFleet(names(FEW))
    async with opened(page, fleet.as_fleet):
        stalled = asyncio.create_task(
            page.evaluate("{ const end = Date.now() + 1000; while (Date.now() < end); }")
        )
        async with asyncio.timeout(PATIENCE):
            while not stalled.done():
                for name in names(20):
                    fleet[name].send(Checked(True))
                await asyncio.sleep(0.05)
        await stalled
        sent = fleet["line01/cam000"].sent
        assert sent > 5
        await see(page, f"{row('line01/cam000')} .count", str(sent))
