"""The status page in a real headless Chromium, over a daemon with a moving scene. What it shows and
filters is tried in every run of the tests, the rest at night."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.support.process import ArbiterProcess
from tests.support.status_page import get, port_of
from tests.support.waiting import until
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.fakegpu import GPU_FILE
from vram_arbiter.schemas.runtime.fakegpu_folder import locked, replace
from vram_arbiter.schemas.runtime.ports import free_port

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")
pytestmark = [
    pytest.mark.e2e,
    pytest.mark.heavy,
    pytest.mark.skipif(
        not (CHROMIUM.exists() and DRIVER.exists()),
        reason="needs Debian's chromium and chromium-driver (.ci/setup full installs them as root)",
    ),
]
SHOWN_S = 60.0
NAME = "<script>window.harm=1</script>"
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> "Iterator[Chrome]":
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    profile = tmp_path_factory.mktemp("chromium")
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    for flag in (*FLAGS, f"--user-data-dir={profile}", "--window-size=1240,1400"):
        options.add_argument(flag)
    made = webdriver.Chrome(options=options, service=Service(str(DRIVER)))
    try:
        yield made
    finally:
        made.quit()
        shutil.rmtree(profile, ignore_errors=True)


@pytest.fixture(scope="module")
def shown_arbiter() -> Iterator[ArbiterProcess]:
    made = ArbiterProcess(arguments=["--http", str(free_port())], prepared=True)
    try:
        yield made.start()
    finally:
        made.close()


@pytest.fixture(scope="module")
def page(browser: "Chrome", shown_arbiter: ArbiterProcess) -> "Iterator[Page]":
    """The page over a scene: a detector in use, for which a request waits, then its eviction."""
    port, gpu = port_of(shown_arbiter), shown_arbiter.gpu_folder / GPU_FILE
    with locked(gpu.parent):
        sensors = {"utilization": 0.87, "temperature_c": 64.0}
        replace(gpu, json.dumps({**json.loads(gpu.read_text()), "sensors": sensors}))
    until(lambda: get(port, "/events", method="HEAD").status == 200)
    shown = Page(browser, f"http://127.0.0.1:{port}/")
    with WireClient(shown_arbiter.endpoint) as client:
        shown.client = client.hello("scene")
        yield shown


class Page:
    """What a user sees and does."""

    client: WireClient

    def __init__(self, browser: "Chrome", url: str) -> None:
        self.browser = browser
        browser.get(url)

    def run(self, script: str) -> Any:
        return self.browser.execute_script(f"return {script}")

    def text(self, selector: str) -> str:
        found: str = self.run(f"document.querySelector({selector!r})?.innerText ?? ''")
        return found

    def texts(self, selector: str) -> list[str]:
        found: list[str] = self.run(
            f"[...document.querySelectorAll({selector!r})].map((one) => one.innerText)"
        )
        return found

    def with_a_lease(self) -> None:
        """Show the table of leases, whichever tests ran before."""
        if not self.texts("#lease-rows tr"):
            lease = self.client.granted("resident", GIB >> 1, evictable=False)
            self.client.ask("ready", lease_id=lease["lease_id"], token=lease["token"])
        self.until(lambda: self.texts("#lease-rows tr"), "a lease is shown")

    def until(self, true: Callable[[], object], what: str) -> None:
        from selenium.webdriver.support.wait import WebDriverWait

        WebDriverWait(self.browser, SHOWN_S, 0.05).until(lambda _: true(), what)

    def colors(self, scheme: str) -> str:
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        found: str = self.run("getComputedStyle(document.body).backgroundColor")
        return found


def test_a_lease_a_wait_and_an_eviction_are_shown_as_they_happen(page: Page) -> None:
    client = page.client
    page.until(lambda: page.text("#link") == "live", "the page is live")
    lease = client.granted("detector", 5 * GIB, min_residency_s=0.0, priority=60)
    on = {"lease_id": lease["lease_id"], "token": lease["token"]}
    client.ask("ready", **on)
    client.ask("use_begin", **on, use_id="u1")
    other = client.granted(NAME, GIB, evictable=False)
    client.ask("ready", lease_id=other["lease_id"], token=other["token"])
    page.until(lambda: len(page.texts("#lease-rows tr")) == 2, "two lease rows")
    row, harmless = page.texts("#lease-rows tr")
    assert "detector" in row
    assert "5.00 GiB" in row
    assert NAME in harmless
    assert page.run("window.harm === undefined && document.scripts.length === 1")
    assert "detector 5.00 GiB" in page.run("document.querySelector('.bar').ariaLabel")
    page.until(lambda: page.text(".figures").endswith("capacity · 87 % busy · 64 °C"), "sensors")
    chart = "document.querySelector('canvas').ariaLabel"
    page.until(lambda: "detector 5.00 GiB" in page.run(chart), "the chart has the lease")
    chips = page.run(
        "[...document.querySelectorAll('#lease-rows .chip')].map((i) => i.classList[1])"
    )
    parts = page.run("[...document.querySelectorAll('.bar i')].map((i) => i.className)")
    assert len(set(chips)) == 2
    assert set(chips) < set(parts)  # a consumer has one color

    assert page.run("document.querySelector('#demands').hidden")
    client.ask("demand", consumers=[{"consumer": NAME, "in_flight": 3, "waiting": 1200}])
    page.until(lambda: page.texts("#demand-rows td") == [NAME, "3", "1,200", "scene"], "requests")

    waiter = client.acquire("grab", 4 * GIB)["lease"]["lease_id"]
    reason = f"[data-lease={waiter!r}] .reason"
    page.until(lambda: "5.00 GiB from detector, in use" in page.text(reason), "the wait's reason")
    assert "needs 4.00 GiB" in page.text(f"[data-lease={waiter!r}]")
    client.ask("use_end", **on, use_id="u1")
    client.push("revoke")
    eviction = f"#eviction-list [data-lease={lease['lease_id']!r}]"
    page.until(lambda: "revoking" in page.text(eviction), "the eviction has begun")
    client.ask("revoke_ack", **on)
    page.until(lambda: "quiescing" in page.text(eviction), "it quiesces")
    client.ask("unloading", **on)
    page.until(lambda: "unloading" in page.text(eviction), "it unloads")
    client.ask("release", **on)
    page.until(lambda: "verified" in page.text(eviction), "its memory is verified")
    told = page.text(eviction)
    assert all(f"{phase} " in told for phase in ("revoke", "quiesce", "unload", "verify"))
    assert "grab needs the room" in told
    widths = page.run(
        f'[...document.querySelectorAll("{eviction} .track i")].map((one) => one.offsetWidth)'
    )
    assert len(widths) == 4
    assert min(widths) >= 18, "the longest phase left two pixels to the others"
    page.until(lambda: not page.texts("#waiters li"), "no request waits")
    grab = client.push("granted")["lease"]
    client.ask("ready", lease_id=waiter, token=grab["token"])


def test_history_is_filtered(page: Page) -> None:
    def pick(selector: str, value: str) -> None:
        page.run(
            f"((one) => {{ one.value = {value!r}; one.dispatchEvent(new Event('input', "
            f"{{bubbles: true}})); }})(document.querySelector({selector!r}))"
        )

    kinds = "#events .kind"
    page.until(lambda: "switch" in page.texts(kinds), "the events are shown")
    assert page.texts(kinds).count("switch") == 1, "two of three loads evicted no lease"
    assert not {"use_began", "revoke_acked"} & set(page.texts(kinds)), "quiet kinds"
    pick("#kind", "use_began")
    page.until(lambda: set(page.texts(kinds)) == {"use_began"}, "one kind")
    pick("#kind", "switch")
    page.until(lambda: set(page.texts(kinds)) == {"switch"}, "loads too, where they are asked for")
    told = page.texts("#events .quiet")
    assert len(told) == 3
    assert sum("verif" in line for line in told) == 1, "nothing was evicted, nothing was verified"
    pick("#kind", "")
    pick("#consumer", NAME)
    page.until(lambda: set(page.texts("#events .name")) == {NAME}, "one consumer")
    pick("#text", "GRANTED")
    page.until(lambda: page.texts(kinds) == ["granted"], "one text")
    pick("#text", "nothing has this")
    page.until(lambda: page.text("#events-empty") == "No event fits.", "none")
    pick("#text", "")
    pick("#consumer", "")


@pytest.mark.nightly
def test_the_keyboard_reaches_everything_in_order_and_all_has_a_name(page: Page) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    page.with_a_lease()
    page.run("(document.activeElement.blur(), scrollTo(0, 0))")
    body, order = page.browser.find_element(By.TAG_NAME, "body"), list[str]()
    body.send_keys(Keys.TAB)
    for _ in range(40):
        focused = page.browser.switch_to.active_element
        if focused.tag_name == "body":
            break
        assert focused.accessible_name, focused.get_attribute("outerHTML")
        order.append(focused.get_attribute("id") or focused.tag_name + focused.text)
        if order[-1] == "canvas":
            focused.send_keys(Keys.ARROW_LEFT)
            assert "measured" in page.text("output")
        focused.send_keys(Keys.TAB)
    shown = ["aSkip to the leases", "button1 min", "button3 min", "button10 min"]
    shown += ["button60 min"]
    shown += ["buttoncharged", "buttonreserve", "canvas", "buttonquiesce"]
    shown += ["buttonCharged", "buttonTier", "kind", "consumer", "text"]
    assert order[: len(shown)] == shown
    for landmark in ("main", "section[aria-labelledby]", "[role=status][aria-live]"):
        assert page.run(f"document.querySelector({landmark!r}) !== null")


@pytest.mark.nightly
def test_terms_are_explained_on_focus_and_under_the_pointer(page: Page) -> None:
    """The page named charged, reserve, quiesce and tier, and only the documentation said what they
    are. A change of the GPU keeps the focus and its explanation; Escape hides it."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    def told() -> list[str]:
        found = page.texts(".tip:not([hidden])")
        return [one.partition(" ")[0] + one[-1] for one in found]

    page.with_a_lease()
    page.browser.execute_cdp_cmd("Emulation.setFocusEmulationEnabled", {"enabled": True})
    page.run("(document.activeElement.blur(), scrollTo(0, 0))")
    terms = page.browser.find_elements(By.CSS_SELECTOR, ".term")
    assert [one.text for one in terms] == ["charged", "reserve", "quiesce", "Charged", "Tier"]
    first = page.text(".figures")
    page.run("document.querySelector('.legend .term').focus()")
    assert told() == ["Bytes."]
    granted = page.client.granted("another", GIB, evictable=False)
    page.until(lambda: page.text(".figures") != first, "the GPU has changed")
    assert page.run("document.activeElement.innerText") == "reserve"
    terms[1].send_keys(Keys.ESCAPE)
    assert told() == []
    page.run("document.activeElement.blur()")
    ActionChains(page.browser).move_to_element(terms[2]).perform()
    page.until(lambda: told() == ["The."], "quiesce is explained")
    ActionChains(page.browser).move_to_element(terms[4]).perform()
    page.until(lambda: told() == ["Where."], "tier is explained")
    page.client.ask("release", lease_id=granted["lease_id"], token=granted["token"])


@pytest.mark.nightly
def test_dark_light_and_a_phone(page: Page) -> None:
    light, dark = page.colors("light"), page.colors("dark")
    assert light != dark
    for width in (390, 320):
        size = {"width": width, "height": 844, "deviceScaleFactor": 2, "mobile": True}
        page.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        assert page.run("document.documentElement.scrollWidth") <= width
    page.browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    page.colors("light")


@pytest.mark.nightly
def test_a_page_without_its_daemon_says_since_when_and_comes_back(
    page: Page, shown_arbiter: ArbiterProcess
) -> None:
    shown_arbiter.kill()
    page.until(lambda: page.text("#link").startswith("stale since "), "it is stale")
    assert "reconnecting" in page.text("#link")
    assert page.run("document.body.classList.contains('stale')")
    shown_arbiter.start()
    page.until(lambda: page.text("#link") == "live", "it is live again")
    errors = [one["message"] for one in page.browser.get_log("browser")]
    away = ("ERR_", "status of 502 (Bad Gateway)")  # the observer's, and the daemon's
    unexpected = [one for one in errors if not any(word in one for word in away)]
    assert unexpected == []  # above all: nothing that the policy refused
