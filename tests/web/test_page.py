"""The emulator's page in a real browser, with real clients at the cameras."""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest
import pytest_asyncio

import smartcam
from smartcam.emulator import EmulatedCamera, EmulatedInSight, ManualClock, Scenario
from smartcam.emulator._inside import PIECES
from smartcam.emulator.faults import FAULTS
from smartcam.exceptions import ConnectionLostError
from smartcam.models import Status
from smartcam.web import EmulatorSite
from tests.handmade import until
from tests.processes import free_port
from tests.web.browser import BROWSER_MARKS, PATIENCE, new_page, nothing_wrong, see
from tests.web.sitekit import TOKEN

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from playwright.async_api import Page, ViewportSize

    from smartcam.emulator import WireCamera

pytestmark = BROWSER_MARKS

LIVE = "#live[data-state=live]"
HELLO = "text: string[20]"


class View(NamedTuple):
    """A page, the cameras it shows and their site."""

    page: Page
    cameras: dict[str, WireCamera]
    site: EmulatorSite

    @property
    def emulator(self) -> EmulatedCamera:
        emulator = next(iter(self.cameras.values()))
        assert isinstance(emulator, EmulatedCamera)
        return emulator

    @property
    def url(self) -> str:
        return next(iter(self.cameras.values())).url

    async def see(self, selector: str, text: str = "") -> None:
        """Wait until something is to be seen, with a text."""
        await see(self.page, selector, text)

    async def text(self, selector: str) -> str:
        return await self.page.locator(selector).inner_text()


SIZE: ViewportSize = {"width": 1440, "height": 1000}


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def page() -> AsyncIterator[Page]:
    """The one page of all tests; each opens a site of its own in it."""
    async with new_page(**SIZE) as page:
        yield page


@contextlib.asynccontextmanager
async def opened(
    page: Page, *cameras: WireCamera, token: str | None = None, at: str | None = None, port: int = 0
) -> AsyncIterator[View]:
    """Show cameras; what the browser finds wrong with the page fails the test."""
    async with contextlib.AsyncExitStack() as stack:
        stack.enter_context(nothing_wrong(page))
        for camera in cameras:
            await stack.enter_async_context(camera)
        named = {camera.name: camera for camera in cameras}
        site = await stack.enter_async_context(EmulatorSite(named, token=token, port=port))
        await page.goto(site.url if at is None else site.origin + at)
        view = View(page, named, site)
        if at is None:
            await view.see(LIVE)
            await view.see("#camera-title", cameras[0].name)
        yield view
        await page.goto("about:blank")


def greeting(**options: Any) -> EmulatedCamera:
    return EmulatedCamera(**{"active": 21, "running": True, **options})


# ---------------------------------------------------------------------- the camera and its buttons


async def test_page_shows_the_camera_and_its_client(page: Page) -> None:
    async with opened(page, greeting(quirks={"reboot_time": 3})) as view:
        assert await view.text("#url") == view.emulator.url
        await view.see("#facts", "21 greeting, triggered")
        await view.see("#facts", "reboot_time 3")
        await view.see("#facts", "none has the session")
        async with smartcam.connect(view.emulator.url):
            await view.see("#facts", view.emulator.sessions[0])
        await view.see("#facts", "none has the session")
        assert await page.title() == "camera · smartcam emulator"


async def test_trigger_button_brings_the_client_a_result(page: Page) -> None:
    async with opened(page, greeting()) as view:
        async with smartcam.connect(view.emulator.url, interpret_as=HELLO) as camera:
            waiting = asyncio.create_task(camera.next_result(timeout=PATIENCE))
            await page.click("#trigger")
            await view.see("#told", "an inspection began")  # which does not stand there for long
            assert (await waiting).value.text == "Hello World"
            await view.see("#log tr.out", 'application 21: text "Hello World"')
        await page.click("#stop")
        await view.see("#mode", "stopped")
        await page.click("#trigger")
        await view.see("#told", "not taken: the camera is stopped")


async def test_trigger_that_nobody_hears_says_so_and_shows_what_was_seen(page: Page) -> None:
    async with opened(page, EmulatedCamera(active=7, running=True)) as view:
        await page.click("#trigger")
        await view.see("#told", "No client listens, so nobody gets the result.")
        await view.see("#part-seen", "Application 7 reported 7 parts")
        assert await page.locator("[data-reported] polygon").count() == 7
        await page.select_option("#application", "21")
        await page.click("#switch button")
        await view.see("#part-seen", "does not look at the table; 7 tangram does")
        await page.locator("[data-reported]").first.wait_for(state="hidden")


async def test_page_of_another_make_shows_what_that_camera_has(page: Page) -> None:
    plan = Scenario(protocol="insight", name="line 2", active=7, running=True)
    async with opened(page, EmulatedInSight.from_scenario(plan)) as view:
        assert not await page.is_visible("#picture, #reboot, #endian, [data-condition]")
        await view.see("#facts", "7Counter.job, triggered")
        async with smartcam.connect(f"{view.url}?cells=A1") as camera:
            await camera.trigger()
            await view.see("#log tr.out", "code 1")
            await view.see("#latency-last", "in 1")
            await page.click("text=Lost link")
            await view.see("#told", "With its next message")
            with pytest.raises(ConnectionLostError):
                await camera.trigger()
        await view.see("#fired", "reset")
        await page.click("#stop")
        await view.see("#mode", "stopped")


async def test_search_for_the_dialect_is_no_error(page: Page) -> None:
    async with (
        opened(page, greeting(dialect="thesis")) as view,
        smartcam.connect(view.url.partition("?")[0]),
    ):
        await view.see("#log tr:not(.marked)", "tried dialect handbook; this camera speaks")
        assert await page.locator("#log tr.marked").count() == 0


async def test_buttons_change_what_the_client_sees(page: Page) -> None:
    async with opened(page, greeting()) as view, smartcam.connect(view.emulator.url) as camera:
        await page.click("#stop")
        await camera.wait_status(lambda status: Status.RUNNING not in status, timeout=PATIENCE)
        await view.see("li[data-bit=RUNNING][data-on=false]")
        await page.click("#start")
        await camera.wait_status(lambda status: Status.RUNNING in status, timeout=PATIENCE)
        await view.see("li[data-bit=WAITING_FOR_TRIGGER][data-on=true]")
        hot = "[data-condition=overheat]"
        await page.click(hot)
        await camera.wait_status(lambda status: Status.OVERHEAT in status, timeout=PATIENCE)
        await view.see(f"{hot}[aria-pressed=true]")
        await view.see("li[data-bit=OVERHEAT][data-on=true]")
        await page.click(hot)
        await camera.wait_status(lambda status: Status.OVERHEAT not in status, timeout=PATIENCE)
        await view.see(f"{hot}[aria-pressed=false]")
        await page.select_option("#application", "3")
        await page.check("#switch-running")
        busy = asyncio.create_task(
            camera.wait_status(lambda status: Status.BUSY in status, timeout=PATIENCE)
        )
        await page.click("#switch button")
        await busy
        await view.see("#mode", "running")
        await view.see("#facts", "3 part check, triggered")
        assert await camera.query_application() == 3


async def test_byte_order_is_that_of_the_next_result(page: Page) -> None:
    async with opened(page, EmulatedCamera(active=3, running=True)) as view:
        layout = "passed: bool, count: int32, x: real32, y: real32, code: string[8]"
        async with smartcam.connect(view.emulator.url, interpret_as=layout) as camera:
            await page.select_option("#endian", "1")
            await until(lambda: view.emulator.device.endian == 1)
            result = await camera.trigger()
    assert (result.value.count, result.raw[1:5].hex()) == (2, "00000002")


async def test_reboot_is_seen_and_the_client_comes_back(page: Page) -> None:
    clock = ManualClock()
    async with opened(page, greeting(clock=clock)) as view:
        async with smartcam.connect(view.emulator.url) as camera:
            events = camera.events()
            await page.fill("#reboot-seconds", "0.4")
            await page.click("#reboot button")
            await view.see("#mode", "rebooting")
            clock.advance(0.4)
            async with asyncio.timeout(PATIENCE):
                async for event in events:
                    if isinstance(event, smartcam.Reconnected):
                        break
            await view.see("#mode", "stopped")
            await view.see("#facts", view.emulator.sessions[0])
        await view.see(LIVE)


async def test_command_button_gives_the_scenarios_command(page: Page, tmp_path: Any) -> None:
    path = tmp_path / "line.yaml"
    path.write_text("timeline: [{command: too-hot, do: {kind: condition, condition: overheat}}]\n")
    async with opened(page, EmulatedCamera(scenario=path)) as view:
        await page.click("#commands button >> text=too-hot")
        await view.see("li[data-bit=OVERHEAT][data-on=true]")
    assert [one.fault.kind for one in view.emulator.fired] == ["condition"]


# ---------------------------------------------------------------------- faults


async def test_fault_from_the_form_hits_the_client(page: Page) -> None:
    async with (
        opened(page, greeting()) as view,
        smartcam.connect(view.emulator.url, interpret_as=HELLO) as camera,
    ):
        await page.select_option("#kind", "drop")
        await page.fill("#f-on", "ResultContainer")
        await page.fill("#f-nth", "2")
        await page.click("#fault button.primary")
        await view.see("#waiting", "drop at ResultContainer, from the 2nd")
        assert [one.nth for one in view.emulator.faults] == [2]
        await camera.trigger()
        with pytest.raises(smartcam.TriggerTimeoutError):
            await camera.trigger(timeout=0.2)
        await view.see("#fired", "drop")
        await view.see("#waiting", "None waits.")
        await view.see("#log tr.marked", "drop")


async def test_fault_form_has_every_kind_and_tells_what_is_wrong(page: Page) -> None:
    async with opened(page, greeting()) as view:
        for kind in ("corrupt", "insert", "busy_for_ever", "switch_application", "split"):
            await page.select_option("#kind", kind)
            names = await page.eval_on_selector_all("#fault [name]", "all => all.map(e => e.name)")
            assert set(names) == set(FAULTS[kind].model_fields) - {"kind"}
        await page.select_option("#kind", "corrupt")
        await page.fill("#f-offset", "3")
        await page.click("#fault button.primary")
        await view.see("#fault-error", "exactly one of xor and value")
        await page.fill("#f-xor", "255")
        await page.click("#fault button.primary")
        await view.see("#waiting", "corrupt offset 3, xor 255")
        assert await view.text("#fault-error") == ""


async def test_fault_of_every_type_of_field_is_injected_as_meant(page: Page) -> None:
    async with opened(page, greeting()) as view:
        await page.select_option("#kind", "insert")
        await page.select_option("#f-message", "StatusReport")
        await page.fill("#f-fields", "status=16 endian=0")
        await page.select_option("#f-where", "after")
        await page.fill("#f-on", "0x30")
        await page.fill("#f-times", "")
        await page.select_option("#f-sender", "camera")
        await page.click("#fault button.primary")
        await view.see("#waiting", "insert")
        (fault,) = view.emulator.faults
        assert fault.model_dump(exclude_unset=True, exclude={"kind"}) == {
            "message": "StatusReport",
            "fields": {"status": 16, "endian": 0},
            "where": "after",
            "on": 0x30,
            "times": None,
            "sender": "camera",
        }
        await page.click("#faults-clear")
        await view.see("#waiting", "None waits.")
        assert view.emulator.faults == []


async def test_device_fault_without_a_message_happens_at_once(page: Page) -> None:
    async with opened(page, greeting()) as view:
        await page.select_option("#kind", "busy_for_ever")
        await page.click("#fault button.primary")
        await view.see("li[data-bit=BUSY][data-on=true]")
        await view.see("#fired", "busy for ever")
        await page.click("#faults-clear")
        await view.see("li[data-bit=BUSY][data-on=false]")


# ---------------------------------------------------------------------- the scene


async def centre(page: Page, selector: str) -> tuple[float, float]:
    box = await page.locator(selector).first.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


async def test_scene_has_true_and_reported_poses(page: Page) -> None:
    async with opened(page, EmulatedCamera(active=7, running=True)) as view:
        await view.see("#part-seen", "Drag a part to move it.")
        assert await page.locator("#picture .piece").count() == len(PIECES)
        async with smartcam.connect(view.emulator.url, interpret_as="localizations") as camera:
            await camera.trigger()
            await view.see("#part-seen", "Application 7 reported 7 parts")
            for name in PIECES:
                true = await centre(page, f"[data-part={name}] .body")
                reported = await centre(page, f"[data-reported={name}] polygon")
                assert math.dist(true, reported) < 2  # pixels of the screen


async def test_part_that_is_dragged_lies_there_for_the_client(page: Page) -> None:
    async with opened(page, EmulatedCamera(active=7, running=True)) as view:
        pieces = view.emulator.scene.pieces
        async with smartcam.connect(view.emulator.url, interpret_as="localizations") as camera:
            x, y = await centre(page, "[data-part=square] .body")
            left, _ = await centre(page, "[data-part=big_triangle_1] .cross")
            right, _ = await centre(page, "[data-part=square] .cross")
            scale = (right - left) / (PIECES["square"].x - PIECES["big_triangle_1"].x)
            await page.mouse.move(x, y)
            await page.mouse.down()
            await page.mouse.move(x - 0.04 * scale, y - 0.03 * scale, steps=4)
            await page.mouse.up()
            await until(lambda: abs(pieces["square"].x - 0.2) < 0.001)
            await until(lambda: abs(pieces["square"].y - 0.095) < 0.001)
            assert pieces["square"].theta == PIECES["square"].theta
            result = await camera.trigger()
            seen = next(one for one in result.value if one.feature_id == "square")
            assert math.dist(seen.pose.position[:2], pieces["square"][:2]) < 0.0005
            await view.see("#part-seen", "Reported at x 200")


async def test_part_obeys_the_keyboard(page: Page) -> None:
    async with opened(page, EmulatedCamera()) as view:
        pieces = view.emulator.scene.pieces
        await page.focus("[data-part=square]")
        for key in ("ArrowRight", "ArrowRight", "Shift+ArrowUp", ","):
            await page.keyboard.press(key)
        x, y, theta = PIECES["square"]
        wanted = (x + 0.002, y + 0.010, theta + math.radians(1))
        await until(lambda: pieces["square"] == pytest.approx(wanted))
        await page.keyboard.press("Delete")
        await view.see("#told", "square is off the table")
        assert "square" not in pieces


async def test_part_form_puts_takes_off_and_puts_back(page: Page) -> None:
    async with opened(page, EmulatedCamera()) as view:
        pieces = view.emulator.scene.pieces
        for field, value in (("name", "bolt"), ("x", "100"), ("y", "20.5"), ("theta", "90")):
            await page.fill(f"#part-{field}", value)
        await page.click("#part button >> text=Put")
        await until(lambda: pieces.get("bolt") == pytest.approx((0.1, 0.0205, math.pi / 2)))
        await view.see("#picture [data-part=bolt][aria-pressed=true]")
        await page.click("#part-remove")
        await until(lambda: "bolt" not in pieces)
        pieces.clear()
        await page.locator("#picture .piece").first.wait_for(state="hidden")
        await page.click("#scene-reset")
        await until(lambda: pieces == PIECES)


# ---------------------------------------------------------------------- the log


async def test_log_shows_messages_as_they_come(page: Page) -> None:
    async with opened(page, greeting()) as view:
        await view.see("#log-hint", f'smartcam watch "{view.emulator.url}"')
        async with smartcam.connect(view.emulator.url, interpret_as=HELLO) as camera:
            await view.see("#log", "ConnectAnswer")
            await camera.trigger()
            row = page.locator("#log tr.entry", has_text="ResultContainer")
            await row.locator(".opener").click()
            await view.see("#log tr.detail", '"text": "Hello World"')
            await view.see("#log tr.detail", "0000  15 00 00 00 48 65 6c 6c")
            await view.see("#log tr.detail", "0x20")
            await row.locator(".opener").click()
            assert await page.locator("#log tr.detail").count() == 0


async def test_log_is_filtered_paused_and_cleared(page: Page) -> None:
    async with (
        opened(page, greeting()) as view,
        smartcam.connect(view.emulator.url, interpret_as=HELLO) as camera,
    ):
        await camera.trigger()
        await view.see("#log", "ResultContainer")
        await page.fill("#log-filter", "hello")
        assert await page.locator("#log tr.entry").count() == 1
        await view.see("#log-state", "1 of ")
        await page.fill("#log-filter", "")
        await page.select_option("#log-direction", "in")
        assert await page.locator("#log tr.out").count() == 0
        await page.check("#log-marked")
        assert await page.locator("#log tr.entry").count() == 0
        await page.uncheck("#log-marked")
        await page.select_option("#log-direction", "")

        await page.click("#log-pause")
        before = await page.locator("#log tr.entry").count()
        await camera.trigger()
        await view.see("#log-state", "came since the pause")
        assert await page.locator("#log tr.entry").count() == before
        await page.click("#log-pause")
        await until(lambda: len(view.emulator.log) > before)
        await page.wait_for_function(
            "n => document.querySelectorAll('#log tr.entry').length > n", arg=before
        )

        await page.click("#log-clear")
        await view.see("#log-empty")
        assert len(view.emulator.log) == 0


async def test_log_keeps_the_document_small(page: Page) -> None:
    async with opened(page, EmulatedCamera()) as view, smartcam.connect(view.emulator.url):
        for number in range(1000):
            view.emulator.device.set_endian(number % 2)
        last = str(view.emulator.log.since(0)[1] - 1)
        await page.wait_for_selector(f"#log tr[data-serial='{last}']")
        assert await page.locator("#log tr").count() == 300
        await view.see("#log-state", "300 messages · older ones: GET")


# ---------------------------------------------------------------------- cameras, token, outage


async def test_page_shows_one_of_several_cameras(page: Page) -> None:
    one, other = greeting(name="left"), EmulatedCamera(name="right/2", active=7)
    async with opened(page, one, other) as view:
        await page.click("#cameras >> text=right/2")
        await view.see("#camera-title", "right/2")
        await view.see("#facts", "7 tangram")
        assert "camera=right%2F2" in page.url
        await page.click("#start")
        await until(lambda: other.device.running)
        await view.see("#cameras a[aria-current=true][data-mode=running]", "right/2")
        one.device.stop()
        await view.see("#cameras a[aria-current=false][data-mode=stopped]", "left")
        await page.reload()
        await view.see("#camera-title", "right/2")


async def test_page_takes_the_token_from_its_address_and_hides_it(page: Page) -> None:
    async with opened(page, greeting(), token=TOKEN) as view:
        assert TOKEN in view.site.url
        assert TOKEN not in page.url
        await page.click("#stop")
        await until(lambda: not view.emulator.device.running)
        await page.reload()
        await view.see(LIVE)


async def test_page_without_the_token_asks_for_it(page: Page) -> None:
    async with opened(page, greeting(), token=TOKEN, at="/") as view:
        await view.see("#gate", "needs its token")
        assert await page.locator("#main").is_hidden()
        await page.fill("#token", "not the right one")
        await page.click("#gate button")
        await view.see("#gate-error", "an Authorization with another token")
        await page.fill("#token", TOKEN)
        await page.click("#gate button")
        await view.see(LIVE)
        await view.see("#camera-title", "camera")


async def test_page_comes_back_with_its_site(page: Page) -> None:
    async with opened(page, greeting(), port=free_port()) as view:
        await view.site.stop()
        await view.see("#live[data-state=lost]", "not connected, trying again")
        again = EmulatorSite(view.cameras, port=view.site.port)
        async with again:
            await view.see(LIVE)
            await page.click("#stop")
            await until(lambda: not view.emulator.device.running)


UNNAMED = """() => [...document.querySelectorAll('#main button, #main input, #main select')]
    .filter(e => !(e.textContent.trim() && e.tagName === 'BUTTON') && !e.labels?.length
                 && !e.getAttribute('aria-label')).map(e => e.outerHTML)"""


async def test_page_fits_a_narrow_screen_the_dark_and_a_screen_reader(page: Page) -> None:
    async with opened(page, greeting()):
        assert await page.evaluate(UNNAMED) == []
        for width in (1440, 1024, 390):
            await page.set_viewport_size({"width": width, "height": 800})
            wide = await page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width
        light = await page.evaluate("getComputedStyle(document.body).backgroundColor")
        await page.emulate_media(color_scheme="dark")
        assert await page.evaluate("getComputedStyle(document.body).backgroundColor") != light
        await page.emulate_media(color_scheme="light")
        await page.set_viewport_size(SIZE)
