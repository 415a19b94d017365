"""Every page in a real browser: it draws, zooms, sorts and searches without an error or a request."""

from __future__ import annotations

import functools
import json
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

from pipeline.report import page_name
from tests.report.conftest import FAILED, REASON, RUNS

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

PAGES = ["index.html", *(f"runs/{page_name(run)}" for run in (*RUNS, FAILED))]


def address(out: Path, page: str, fragment: str = "") -> str:
    return (out / "report" / page).resolve().as_uri() + fragment


def visit(browser: Chrome, url: str) -> None:
    browser.get("about:blank")
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(url)
    assert browser.execute_script("return document.body.dataset.ready") == "yes"


def errors(browser: Chrome) -> list[str]:
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


def requested(browser: Chrome) -> list[str]:
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]


@pytest.fixture(scope="module")
def server(out: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(out / "report"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}/"
        running.shutdown()
        thread.join()


@pytest.mark.parametrize("page", PAGES)
def test_opens_from_disk_without_error_or_request(browser: Chrome, out: Path, page: str) -> None:
    visit(browser, address(out, page))
    assert errors(browser) == []
    root = (out / "report").resolve().as_uri()
    urls = requested(browser)
    assert any(url.endswith(".css") for url in urls)
    assert [url for url in urls if not url.startswith((root, "data:"))] == []
    empty = browser.execute_script("return [...document.querySelectorAll('.plot')].filter(p => !p.firstChild).length")
    shown = browser.execute_script("return document.querySelectorAll('.js-plotly-plot').length")
    hidden = browser.execute_script("return document.querySelectorAll('[hidden] .plot').length")
    assert empty == hidden
    assert shown > 0 or FAILED in browser.page_source or "odd" in page


def test_opens_from_a_server(browser: Chrome, server: str) -> None:
    for page in ("index.html", f"runs/{RUNS[0]}.html"):
        visit(browser, server + page)
        assert errors(browser) == []
        assert {urlsplit(url).netloc for url in requested(browser) if not url.startswith("data:")} == {
            urlsplit(server).netloc
        }
        assert browser.execute_script("return document.querySelectorAll('.js-plotly-plot').length") > 3


def ranges(browser: Chrome) -> set[tuple[float, float]]:
    """The time axes of all drawings, to 10 ms."""
    found = browser.execute_script(
        """return [...document.querySelectorAll('.solution:not([hidden]) .js-plotly-plot')]
        .filter(p => p.layout.xaxis.type === 'date')
        .map(p => p.layout.xaxis.range.map(r => typeof r === 'number' ? r : Date.parse(r.replace(' ', 'T') + 'Z')))"""
    )
    assert len(found) > 8
    return {(round(lo, -1), round(hi, -1)) for lo, hi in found}


def hazard_of(browser: Chrome, solution: str, number: int) -> dict[str, float]:
    script = "return JSON.parse(document.getElementById('data').textContent).solutions[arguments[0]].hazards"
    found: dict[str, float] = browser.execute_script(script, solution)[number]
    return found


def test_hazard_link_zooms_every_drawing(browser: Chrome, out: Path) -> None:
    visit(browser, address(out, "runs/jump_two.html"))
    (before,) = ranges(browser)
    hazard = hazard_of(browser, "primary", 0)
    browser.find_element("css selector", "a[data-hazard='0']").click()
    (after,) = ranges(browser)
    assert before[0] < after[0] <= hazard["t_onset"]
    assert hazard["t_detected"] <= after[1] < before[1]
    assert after[1] - after[0] < 60_000
    plan = "return document.getElementById('plot-s0-plan').layout.xaxis.range"
    east = browser.execute_script(plan)
    assert east[1] - east[0] < 9000
    assert "VB_JUMP_1A" in browser.find_element("id", "window").text
    chosen = browser.find_elements("css selector", "tr.chosen")
    assert len(chosen) == 1
    assert errors(browser) == []


def test_hazard_of_another_solution_by_address(browser: Chrome, out: Path) -> None:
    visit(browser, address(out, "index.html"))
    links = browser.find_elements("css selector", "section#s0 a[href*='drift_early']")
    assert len(links) == 1
    links[0].click()
    assert browser.current_url.endswith("#s=egnos%20v2%20%26%20%3C3&h=0")
    hazard = hazard_of(browser, "egnos v2 & <3", 0)
    ((lo, hi),) = ranges(browser)
    assert lo <= hazard["t_onset"] <= hi
    shown = browser.execute_script(
        "return [...document.querySelectorAll('.solution')].filter(s => !s.hidden).map(s => s.dataset.solution)"
    )
    assert shown == ["egnos v2 & <3"]


def test_zooming_one_drawing_zooms_all(browser: Chrome, out: Path) -> None:
    visit(browser, address(out, "runs/jump_two.html"))
    ((lo, hi),) = ranges(browser)
    wanted = [lo + 0.4 * (hi - lo), lo + 0.5 * (hi - lo)]
    done = browser.execute_async_script(
        "Plotly.relayout('plot-s0-speed', {'xaxis.range[0]': arguments[0], 'xaxis.range[1]': arguments[1]})"
        ".then(() => arguments[2](true))",
        *wanted,
    )
    assert done
    ((begin, end),) = ranges(browser)
    assert [begin, end] == [pytest.approx(time, abs=20) for time in wanted]


def test_tools_work_by_keyboard(browser: Chrome, out: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    visit(browser, address(out, "runs/jump_two.html"))
    ((lo, hi),) = ranges(browser)
    button = browser.find_element("css selector", "button[data-move='in']")
    button.send_keys(Keys.ENTER)
    ((inner_lo, inner_hi),) = ranges(browser)
    assert inner_hi - inner_lo == pytest.approx((hi - lo) / 2, rel=0.01)
    browser.find_element("css selector", "button[data-move='next']").send_keys(Keys.SPACE)
    hazard = hazard_of(browser, "primary", 0)
    ((lo, hi),) = ranges(browser)
    assert lo <= hazard["t_onset"] <= hi


def column(browser: Chrome, table: str, index: int) -> list[str]:
    script = """return [...document.getElementById(arguments[0]).tBodies[0].rows].filter(r => !r.hidden)
        .map(r => r.cells[arguments[1]].textContent)"""
    found: list[str] = browser.execute_script(script, table, index)
    return found


def test_runs_are_sorted_and_searched(browser: Chrome, out: Path) -> None:
    visit(browser, address(out, "index.html"))
    heads = browser.find_elements("css selector", "#table-runs th")
    names = [head.text.split()[0] for head in heads]
    verdicts, ids = (column(browser, "table-runs", names.index(name)) for name in ("verdict", "run_id"))
    assert set(verdicts[: ids.index(FAILED)]) <= {"unsafe"}
    assert column(browser, "table-runs", names.index("error"))[ids.index(FAILED)] == REASON
    duration = next(number for number, head in enumerate(heads) if head.text.startswith("distance"))
    button = heads[duration].find_element("css selector", "button")
    button.click()
    values = column(browser, "table-runs", duration)
    assert values[-1] == "–"
    known = [float(text.replace("\u202f", "")) for text in values[:-1]]
    assert known == sorted(known)
    assert heads[duration].get_attribute("aria-sort") == "ascending"
    button.click()
    values = column(browser, "table-runs", duration)
    assert values[-1] == "–"
    assert [float(text.replace("\u202f", "")) for text in values[:-1]] == sorted(known, reverse=True)
    field = browser.find_element("id", "search-table-runs")
    field.send_keys("drift egnos")
    assert column(browser, "table-runs", names.index("run_id")) == ["drift_early"]
    field.clear()
    field.send_keys("not in order")
    assert column(browser, "table-runs", names.index("run_id")) == [FAILED]


def test_failed_run_has_a_page_with_its_reason(browser: Chrome, out: Path) -> None:
    visit(browser, address(out, "index.html"))
    browser.find_element("partial link text", "broken").click()
    assert REASON in browser.find_element("tag name", "main").text
    assert browser.find_element("tag name", "h1").text.startswith(f"Run {FAILED}")
    assert errors(browser) == []


def contrast(browser: Chrome, selector: str) -> float:
    """WCAG 2.1 contrast of an element's text with the page."""
    script = """const rgb = (text) => text.match(/[\\d.]+/g).slice(0, 3).map(Number);
      const light = (c) => rgb(c).map(v => v / 255).map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
        .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
      const style = getComputedStyle(document.querySelector(arguments[0]));
      const one = light(arguments[1] ? style.fill : style.color);
      const back = light(getComputedStyle(document.body).backgroundColor);
      return (Math.max(one, back) + 0.05) / (Math.min(one, back) + 0.05);"""
    found: float = browser.execute_script(script, selector, selector.endswith("text"))
    return found


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_readable_in_both_schemes(browser: Chrome, out: Path, scheme: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    try:
        visit(browser, address(out, "runs/jump_two.html"))
        back = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert (back == "rgb(255, 255, 255)") == (scheme == "light")
        for selector in ("h2", "a[data-hazard]", "dt", ".badge", "td.bad", "#plot-s0-speed .xtick text"):
            assert contrast(browser, selector) >= 4.5, selector
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_prints_no_wider_than_the_paper(browser: Chrome, out: Path) -> None:
    visit(browser, address(out, "runs/jump_two.html"))
    widest = "return Math.max(...[...document.querySelectorAll('.main-svg')].map(s => s.width.baseVal.value))"
    before = browser.execute_script(widest)
    browser.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    assert browser.execute_script(widest) <= 960 < before
    browser.execute_script("window.dispatchEvent(new Event('afterprint'))")
    assert browser.execute_script(widest) == pytest.approx(before, abs=30)
    printed = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    assert len(printed["data"]) > 100_000
    assert errors(browser) == []
