"""The page of a sweep in a headless browser: no error, its slider moves, its points tell their settings."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from warp_dvct.bench.page import write_page
from warp_dvct.bench.pictures import save_pictures, save_truth
from warp_dvct.bench.references import Reference
from warp_dvct.bench.rows import provenance
from warp_dvct.errors import OptionError

POINTS = {  # name: method, group, value, seconds, FLIP
    "draft": ("delta-cones", "preset", "draft", 0.2, 0.04),
    "balanced": ("delta-cones", "preset", "balanced", 0.5, 0.02),
    "rays=16": ("delta-cones", "gather.rays", "16", 0.45, 0.03),
    "rays=64": ("delta-cones", "gather.rays", "64", 0.5, 0.021),
    "samples=4": ("path-trace", "samples", "4", 1.0, 0.05),
}


def rows(tmp: Path) -> list[dict]:
    """Rows as a sweep writes them, with pictures whose brightness tells them apart."""
    rng = np.random.default_rng(1)
    noise = rng.uniform(0, 0.2, (18, 32, 3)).astype(np.float32)
    cover = np.zeros((18, 32, 1), np.float32)
    save_truth(tmp, "room", Reference(noise + 0.1, 0 * noise, np.dstack([0 * noise, cover]), 0.01))
    made = []
    for k, (name, (method, group, value, seconds, flip)) in enumerate(POINTS.items()):
        save_pictures(tmp, f"key{k}", noise + 0.1 * k, np.full((18, 32), flip))
        areas = {"picture": flip, "affected": 2 * flip, "real": flip, "object": None}
        row = {"kind": "tradeoff", "key": f"key{k}", "stage": "room", "width": 32, "height": 18, "name": name}
        row |= {"method": method, "group": group, "value": value, "quality": "balanced", "device": "cpu"}
        row |= {"settings": {"gather.rays": value} if group == "gather.rays" else {}, "bytes": 2**20 * (k + 1)}
        row |= {"seconds": [seconds], "cpu_seconds": [seconds], "passes": {}, "flicker": None}
        row |= {"cpu_passes": {"gather": 0.6 * seconds, "direct": 0.4 * seconds} if k < 4 else {}}
        row |= {"errors": {"FLIP": areas, "RMSE": areas, "relMSE": areas}, "truth_key": "t"}
        row |= {"truth": {"samples": 64, "bounces": 8, "noise": 0.01}, **provenance()}
        made.append(row)
    return made


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """A page of two stages."""
    tmp = tmp_path_factory.mktemp("sweep")
    made = rows(tmp)
    command = "warp-dvct bench tradeoff --stage '</script><b>'"  # must not end the page's data
    return write_page(tmp / "html", tmp, {"room": made, "attic": made[:2]}, [command])


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium; the tests that need it are skipped where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chromium, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("no browser: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in ("--headless=new", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1200,2000"):
        options.add_argument(flag)
    if os.geteuid() == 0:
        options.add_argument("--no-sandbox")  # as root Chromium refuses to start with it
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    running = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield running
    running.quit()


@pytest.fixture
def shown(browser, page):
    """The page, loaded afresh; at the end the console must hold no error."""
    browser.get(page.as_uri())
    yield browser
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def find(browser, selector: str):
    """Elements by a CSS selector."""
    return browser.find_elements("css selector", selector)


def text(browser, selector: str) -> str:
    """The text of the only element."""
    (element,) = find(browser, selector)
    return element.text


def test_every_point_is_drawn_and_the_balanced_preset_is_shown(shown):
    assert len(find(shown, ".point")) == len(POINTS)
    assert "balanced" in text(shown, "#settings")
    assert "quartering gather.rays from 64 to 16" in text(shown, "#words")
    assert provenance()["machine"]["processor"] in text(shown, "#machine")
    assert "--stage '</script><b>'" in text(shown, "#machine pre")


def test_a_click_on_a_point_shows_its_settings_passes_and_picture(shown):
    points = {p.get_attribute("aria-label"): p for p in find(shown, ".point")}
    points["rays=16"].click()
    assert "gather.rays=16" in text(shown, "#settings")
    assert "0.450 s" in text(shown, "#settings")
    bars = [float(bar.get_attribute("width")) for bar in find(shown, ".bar")]
    assert bars[1] / bars[0] == pytest.approx(2 / 3, abs=0.01)
    assert "270.0 ms" in text(shown, "#bars")
    points["samples=4"].click()
    assert find(shown, ".bar") == []
    points["draft"].click()
    assert shown.execute_script("return document.getElementById('right').value") == "key0"


def test_hovering_names_the_point(shown):
    from selenium.webdriver import ActionChains

    point = next(p for p in find(shown, ".point") if p.get_attribute("aria-label") == "draft")
    ActionChains(shown).move_to_element(point).perform()
    assert text(shown, "#tip") == "draft\n0.200 s, FLIP 0.0400"


def test_the_slider_uncovers_the_left_picture(shown):
    from selenium.webdriver.common.keys import Keys

    (slider,) = find(shown, "#slider")
    clip = "return getComputedStyle(document.getElementById('over')).clipPath"
    assert shown.execute_script(clip) == "inset(0px 50% 0px 0px)"
    slider.send_keys(Keys.END)
    assert shown.execute_script(clip) == "inset(0px 0% 0px 0px)"
    slider.send_keys(Keys.HOME)
    assert shown.execute_script(clip) == "inset(0px 100% 0px 0px)"
    loaded = "return ['under', 'above', 'map'].every((id) => document.getElementById(id).naturalWidth === 32)"
    assert shown.execute_script(loaded)


def test_pictures_differ_and_another_stage_can_be_chosen(shown):
    source = "return document.getElementById('under').src"
    first = shown.execute_script(source)
    assert first.startswith("data:image/jpeg;base64,")
    find(shown, "#stages button")[1].click()
    assert "attic" in text(shown, "#case")
    assert len(find(shown, ".point")) == 2


def test_the_page_asks_for_nothing_else(page):
    html = page.read_text()
    assert "default-src 'none'" in html
    for word in ("http://", "https://", 'src="', "@import", "url("):
        assert word not in html.replace("http://www.w3.org/2000/svg", ""), word
    content = html.split('id="data">')[1].split("</script>")[0]
    assert [s["name"] for s in json.loads(content)["stages"]] == ["room", "attic"]


def test_nothing_to_show(tmp_path):
    with pytest.raises(OptionError, match="nothing to show"):
        write_page(tmp_path, tmp_path, {"room": []}, [])
    assert list(tmp_path.iterdir()) == []
