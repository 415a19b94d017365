"""Every page in a real browser: it draws, zooms, sorts, searches and prints without an error or a request."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from pyproj import Transformer

from pipeline.show.report import page_name
from tests.show.report.conftest import FAILED, REASON, RUNS

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

PAGES = ["index.html", *(f"runs/{page_name(run)}" for run in (*RUNS, FAILED))]


def visit(browser: Chrome, out: Path, page: str, fragment: str = "") -> None:
    browser.get("about:blank")
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get((out / "report" / page).resolve().as_uri() + fragment)
    assert browser.execute_script("return document.body.dataset.ready") == "yes"


def errors(browser: Chrome) -> list[str]:
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


def requested(browser: Chrome) -> list[str]:
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]


def drawn(browser: Chrome) -> int:
    found: int = browser.execute_script("return document.querySelectorAll('.plot svg[data-drawn]').length")
    return found


def shown_s(browser: Chrome) -> tuple[float, float]:
    """The stretch of time that the page says it shows [s]."""
    lo, hi = browser.execute_script("return [document.body.dataset.lo, document.body.dataset.hi]")
    return float(lo) / 1000.0, float(hi) / 1000.0


def times_on(browser: Chrome, plot: str) -> list[str]:
    """The times written under a drawing."""
    script = """const plot = document.getElementById(arguments[0]);
        return [...plot.querySelectorAll('text')].map(t => t.textContent).filter(t => /^[0-9]+:[0-9]+/.test(t))"""
    found: list[str] = browser.execute_script(script, plot)
    return found


def press(browser: Chrome, key: str) -> None:
    browser.find_element("tag name", "body").send_keys(key)


@pytest.mark.parametrize("page", PAGES)
def test_opens_from_disk_alone(browser: Chrome, out: Path, page: str) -> None:
    visit(browser, out, page)
    assert errors(browser) == []
    assert [url for url in requested(browser) if not url.startswith("data:")] == [browser.current_url]
    script = "return [...document.querySelectorAll('.plot')].filter(p => p.clientWidth && !p.firstChild).length"
    assert browser.execute_script(script) == 0
    assert drawn(browser) > 3 or REASON in browser.find_element("tag name", "main").text


def test_no_script_of_others_runs(browser: Chrome, out: Path) -> None:
    """What slipped through the escaping would be stopped by the policy."""
    page = out / "report" / "runs" / "jump_two.html"
    evil = out / "report" / "evil.html"
    put_in = "<script>document.body.dataset.evil = 1</script><img src=x onerror='document.body.dataset.evil = 1'>"
    evil.write_text(page.read_text().replace("</main>", put_in + "</main>"))
    try:
        visit(browser, out, "evil.html")
        assert browser.execute_script("return document.body.dataset.evil") is None
        assert any("Content Security Policy" in message for message in errors(browser))
    finally:
        evil.unlink()


def test_hazards_zoom_and_keys(browser: Chrome, out: Path) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    visit(browser, out, "runs/jump_two.html")
    script = "return JSON.parse(document.getElementById('data').textContent).solutions.primary.hazards[0]"
    hazard = browser.execute_script(script)
    before = shown_s(browser)
    browser.find_element("css selector", "a[data-hazard='0']").click()
    # The page hears of its new address after the click.
    WebDriverWait(browser, 30).until(lambda opened: shown_s(opened) != before)
    lo, hi = shown_s(browser)
    assert before[0] < lo <= hazard["t_onset"] / 1000.0
    assert hazard["t_detected"] / 1000.0 <= hi < before[1]
    assert hi - lo < 60.0
    assert "VB_JUMP_1A" in browser.find_element("id", "window").text
    assert len(browser.find_elements("css selector", "tr.chosen")) == 1
    onset = browser.execute_script("return new Date(arguments[0]).toISOString().slice(11, 16)", hazard["t_onset"])
    for plot in ("speed", "along", "bands", "monitors-along"):
        assert times_on(browser, f"plot-s0-{plot}")[0].startswith(onset), plot
    press(browser, "+")
    inner = shown_s(browser)
    assert inner[1] - inner[0] == pytest.approx((hi - lo) / 2.0, rel=0.01)
    press(browser, "0")
    assert shown_s(browser) == before
    press(browser, "n")
    assert shown_s(browser) == (lo, hi)
    press(browser, "[")
    WebDriverWait(browser, 30).until(lambda opened: opened.current_url.endswith("jump_one_no_odometer.html"))
    assert errors(browser) == []


def test_a_hazard_of_another_solution_by_its_address(browser: Chrome, out: Path) -> None:
    visit(browser, out, "index.html")
    browser.find_element("css selector", "section#s0 a[href*='drift_early']").click()
    assert browser.current_url.endswith("#s=egnos%20v2%20%26%20%3C3&h=0")
    shown = [
        part.get_attribute("data-solution")
        for part in browser.find_elements("css selector", ".solution")
        if part.is_displayed()
    ]
    assert shown == ["egnos v2 & <3"]
    once = drawn(browser)
    browser.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    assert drawn(browser) == 2 * once
    browser.execute_script("window.dispatchEvent(new Event('afterprint'))")
    assert drawn(browser) == 2 * once
    assert errors(browser) == []


def test_dragging_over_one_drawing_zooms_all(browser: Chrome, out: Path) -> None:
    from selenium.webdriver import ActionChains

    visit(browser, out, "runs/jump_two.html")
    lo, hi = shown_s(browser)
    plot = browser.find_element("css selector", "#plot-s0-speed svg[data-drawn]")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", plot)
    frame_px = plot.size["width"] - 128 - 14
    ActionChains(browser, 0).move_to_element(plot).click_and_hold().move_by_offset(200, 0).release().perform()
    begin, end = shown_s(browser)
    assert end - begin == pytest.approx((hi - lo) * 200 / frame_px, rel=0.02)
    assert lo < begin < end < hi


def test_coordinates_of_a_plan(browser: Chrome, out: Path) -> None:
    """Places up to 60 km away against PROJ; a click tells the place, and nothing is fetched for it."""
    visit(browser, out, "runs/jump_two.html")
    latitude, longitude = 50.02, 14.41
    to_plane = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 +step "
        f"+proj=topocentric +ellps=WGS84 +lon_0={longitude} +lat_0={latitude} +h_0=0"
    )
    for north, east in ((0.0, 0.0), (0.2, 0.3), (-0.4, -0.5)):
        x, y, _ = to_plane.transform(longitude + east, latitude + north, 0.0)
        found = browser.execute_script("return Plans.geodetic(...arguments)", [latitude, longitude], x, y)
        assert found == pytest.approx([latitude + north, longitude + east], abs=1e-7)
    before = browser.find_element("css selector", "#figure-s0-plan output").text
    browser.find_element("css selector", "#plot-s0-plan svg[data-drawn]").click()
    place = browser.find_element("css selector", "#figure-s0-plan .place")
    shown = place.find_element("css selector", "output").text
    assert shown != before
    assert shown.replace(", ", "/") in place.find_element("css selector", "a").get_attribute("href")
    assert [url for url in requested(browser) if not url.startswith(("data:", "file:"))] == []


def test_small_errors_are_seen_beside_large_ones(browser: Chrome, out: Path) -> None:
    """A jump of 500 m: the limit of 20 m stands at more than a tenth of the height."""
    visit(browser, out, "runs/jump_two.html")
    script = """const axis = Scales.wide({ lo: -25, hi: 525 }, 20), scale = Scales.scale(axis, 100, 0);
        return [scale.at(525), scale.at(20) - scale.at(40), scale.at(0) - scale.at(20), scale.value(scale.at(303))]"""
    top, doubled, limit, back = browser.execute_script(script)
    assert (top, back) == (pytest.approx(0.0), pytest.approx(303.0))
    assert doubled > 5.0
    assert limit > 10.0
    texts = browser.find_element("id", "plot-s0-along").text
    assert "logarithmic beyond ±20" in texts


def column(browser: Chrome, index: int) -> list[str]:
    script = """return [...document.getElementById('table-runs').tBodies[0].rows].filter(r => !r.hidden)
        .map(r => r.cells[arguments[0]].textContent)"""
    found: list[str] = browser.execute_script(script, index)
    return found


def test_runs_are_sorted_and_searched(browser: Chrome, out: Path) -> None:
    visit(browser, out, "index.html")
    heads = browser.find_elements("css selector", "#table-runs th")
    assert sum(head.is_displayed() for head in heads) == 10
    browser.find_element("css selector", "#runs .all input").click()
    assert all(head.is_displayed() for head in heads)
    names = [head.text.replace("\n", " ").split(" ↕")[0] for head in heads]
    ids, whys = (column(browser, names.index(name)) for name in ("run", "why"))
    assert ids[:2] == ["jump_one_no_odometer", FAILED]
    assert whys[1] == REASON
    distance = names.index("distance [m]")
    for descending in (False, True):
        browser.execute_script("arguments[0].click()", heads[distance].find_element("css selector", "button"))
        *known, last = column(browser, distance)
        values = [float(text.replace("\u202f", "")) for text in known]
        assert values == sorted(values, reverse=descending)
        assert last == "–"
    printed = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    assert len(printed["data"]) > 100_000
    field = browser.find_element("id", "search-table-runs")
    field.send_keys("drift egnos")
    assert column(browser, names.index("run")) == ["drift_early"]
    assert errors(browser) == []


def contrast(browser: Chrome, selector: str) -> float:
    """WCAG 2.1 contrast of an element's text with the page."""
    script = """const rgb = (text) => text.match(/[\\d.]+/g).slice(0, 3).map(Number);
      const light = (c) => rgb(c).map(v => v / 255).map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
        .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
      const node = document.querySelector(arguments[0]);
      const one = light(node instanceof SVGElement ? getComputedStyle(node).fill : getComputedStyle(node).color);
      let under = node;
      const clear = (one) => /, 0\\)$|transparent/.test(getComputedStyle(one).backgroundColor);
      while (under.parentElement && clear(under)) under = under.parentElement;
      const back = light(getComputedStyle(under).backgroundColor);
      return (Math.max(one, back) + 0.05) / (Math.min(one, back) + 0.05);"""
    found: float = browser.execute_script(script, selector)
    return found


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_readable_in_both_schemes(browser: Chrome, out: Path, scheme: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        visit(browser, out, "runs/jump_one_no_odometer.html")
        back = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert (back == "rgb(255, 255, 255)") == (scheme == "light")
        looked_at = ("h2", ".verdict strong", ".tile.bad dd", ".tile.good dd", "td.bad", "td.good", "dt", ".notice")
        for selector in (*looked_at, "#plot-s0-speed text"):
            assert contrast(browser, selector) >= 4.5, selector
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


OVERLAPPING = """
    const bad = [];
    for (const svg of document.querySelectorAll('svg[data-drawn]')) {
        const written = [...svg.querySelectorAll('text')].filter((one) => one.textContent.trim());
        const texts = written.filter((one) => one.getClientRects().length);
        const boxes = texts.map((one) => one.getBoundingClientRect());
        for (let i = 0; i < boxes.length; i += 1) for (let j = 0; j < i; j += 1) {
            const [a, b] = [boxes[i], boxes[j]];
            const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
            const high = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
            const named = [svg.parentElement.id, texts[i].textContent, texts[j].textContent];
            if (wide > 2 && high > 4) bad.push(named.join(' | '));
        }
    }
    return bad"""


@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (820, "light"), (1300, "dark")])
@pytest.mark.parametrize("page", PAGES)
def test_nothing_overlaps_or_runs_over_at_any_width(
    browser: Chrome, out: Path, tmp_path: Path, page: str, width: int, scheme: str
) -> None:
    screen = {"width": width, "height": 1200, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        visit(browser, out, page)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        assert browser.execute_script(OVERLAPPING) == []
        shot = tmp_path / f"{width}-{scheme}.png"
        assert browser.save_screenshot(str(shot))
        assert len(set(shot.read_bytes())) > 100, "an empty picture"
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_on_paper_the_heads_of_tables_are_text(browser: Chrome, out: Path) -> None:
    """Buttons would not be repeated on the next sheet."""
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        visit(browser, out, "index.html")
        heads = browser.find_elements("css selector", "table.data th:not(.more)")
        assert heads
        assert not any(head.find_element("tag name", "button").is_displayed() for head in heads)
        assert all(head.find_element("class name", "printed").is_displayed() for head in heads)
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
