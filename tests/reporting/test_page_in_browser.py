"""The page in a headless Chromium: nothing goes wrong in its script, and what it reads and zooms is right."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess

import numpy as np
import pytest

import seaopt as so

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
PLACE = 0.4  # of the sensitivity's axis
CHECK = """
<script>
addEventListener("load", () => {
  const plot = document.querySelector("#fig-sensitivity .plot");
  const chart = charts.find((one) => one.plot === plot) || new Chart(plot);
  const pane = chart.panes[0], [left, top, right, bottom] = pane.box, found = {};
  chart.show([left + PLACE * (right - left), (top + bottom) / 2]);
  found.readout = chart.readout.innerText;
  const before = pane.paths.map((one) => one.node.getAttribute("d"));
  chart.zoomBy(0.25);
  found.zoomed = [pane.x.value(pane.x.from), pane.x.value(pane.x.to)];
  found.ticks = [...pane.layer.querySelectorAll("text")].map((one) => Number(one.textContent));
  found.moved = pane.paths.some((one, k) => one.node.getAttribute("d") !== before[k]);
  const other = document.querySelector("#fig-tracking .plot");
  const linked = charts.find((one) => one.plot === other) || new Chart(other);
  chart.zoomBy(0.5);
  found.linked = [linked.panes[0].x.value(linked.panes[0].x.from), linked.panes[0].x.value(linked.panes[0].x.to)];
  found.again = [pane.x.value(pane.x.from), pane.x.value(pane.x.to)];
  chart.press(new KeyboardEvent("keydown", { key: "Escape" }));
  found.whole = pane.x.whole && pane.y.whole && linked.panes[0].x.whole;
  const key = document.querySelector("#fig-sensitivity .key button");
  const curve = document.getElementById(key.dataset.ids.split(" ")[0]);
  key.click();
  found.hidden = getComputedStyle(curve).display;
  const paper = () => getComputedStyle(document.body).backgroundColor;
  const light = paper(), button = document.getElementById("theme");
  button.click(); button.click();
  found.dark = [button.textContent, light !== paper()];
  found.unnamed = [...document.querySelectorAll("svg[role=img], .wide, nav, section")].filter((one) =>
    !one.getAttribute("aria-label") && !one.getAttribute("aria-labelledby")).length;
  const levels = [...document.querySelectorAll("h1, h2, h3, h4")].map((one) => Number(one.tagName[1]));
  found.skipped = levels.filter((level, k) => k && level > levels[k - 1] + 1).length;
  const frame = document.createElement("iframe");
  frame.style.width = "400px"; frame.src = "page.html";
  frame.addEventListener("load", () => {
    found.narrow = frame.contentDocument.documentElement.scrollWidth - frame.clientWidth;
    const out = document.createElement("pre");
    out.id = "found"; out.textContent = JSON.stringify(found); document.body.append(out);
  });
  document.body.append(frame);
});
</script>
"""


@pytest.fixture(scope="module")
def browser():
    found = next((path for path in map(shutil.which, BROWSERS) if path), None)
    if found is None:
        pytest.skip("no Chromium on this machine; the page is not looked at in a browser")
    return found


def run(browser, folder, *options):
    command = [browser, "--headless=new", "--disable-gpu", "--allow-file-access-from-files", "--enable-logging=stderr"]
    command += ["--no-sandbox"] if os.geteuid() == 0 else []
    profile = f"--user-data-dir={folder / 'profile'}"
    return subprocess.run([*command, profile, *options], capture_output=True, text=True, check=False, timeout=300)


@pytest.fixture(scope="module")
def page(controller, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    return so.write_report([controller], folder / "page.html")


def test_figures_are_read_and_zoomed(browser, page, controller):
    text = page.read_text(encoding="utf-8")
    tried = page.with_name("tried.html")
    tried.write_text(text.replace("</body>", CHECK.replace("PLACE", str(PLACE)) + "</body>"), encoding="utf-8")
    done = run(browser, page.parent, "--virtual-time-budget=20000", "--dump-dom", f"file://{tried}")
    assert not re.findall(r".*CONSOLE.*", done.stderr)
    (answer,) = re.findall(r'<pre id="found">(.*?)</pre>', done.stdout)
    found = json.loads(answer)
    axis = controller.plot.sensitivity()
    f, size = axis.lines[0].get_data()
    low, high = np.log10(axis.get_xlim())
    at = int(np.argmin(np.abs(np.log10(f) - (low + PLACE * (high - low)))))
    hz, db = (
        float(number) for number in re.findall(r"frequency ([\d.]+) Hz\s+.*?: (-?[\d.]+) dB", found["readout"])[0]
    )
    assert hz == pytest.approx(f[at], rel=1e-3) and db == pytest.approx(size[at], abs=2e-3)
    first, last = found["zoomed"]
    assert np.log10(last / first) == pytest.approx(0.25 * (high - low), rel=1e-6)
    inside = [tick for tick in found["ticks"] if first <= tick <= last]
    assert found["moved"] and len(inside) >= 2
    assert found["linked"] == pytest.approx(found["again"], rel=1e-3)
    assert found["whole"] and found["hidden"] == "none" and found["dark"] == ["Colours: dark", True]
    assert found["unnamed"] == found["skipped"] == 0
    assert found["narrow"] <= 0


def test_the_page_prints(browser, page):
    printed = page.with_name("page.pdf")
    run(browser, page.parent, f"--print-to-pdf={printed}", f"file://{page}")
    assert printed.read_bytes().startswith(b"%PDF") and printed.stat().st_size > 20_000
