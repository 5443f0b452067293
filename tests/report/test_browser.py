"""The report in a real browser: nothing overflows on a desk or a phone, in light and dark, and no error is logged."""

import html
import json
import re
import subprocess

import pytest
from chromium import CHROMIUM, FLAGS

import hdev_jax
from hdev_jax.fleet import synthetic_log

OF_A_FILE = ["--allow-file-access-from-files", "--enable-logging=stderr", "--virtual-time-budget=4000"]
# A page that holds the report in a frame of a given width and writes down what it measures there.
FRAME = """<!doctype html><iframe id="f" src="report.html" style="width:{width}px;height:900px;border:0"></iframe>
<pre id="found"></pre><script>
document.getElementById("f").onload = () => {{
  const d = document.getElementById("f").contentDocument, wide = d.documentElement;
  const boxes = [...d.querySelectorAll("body *")].filter(e => !e.closest(".scroll") || e.matches(".scroll"));
  const first = d.querySelector("figure img"), zoom = d.getElementById("zoom");
  const figures = [...d.querySelectorAll("figure img")];
  first.click();
  const opened = zoom.open && zoom.firstElementChild.alt === first.alt, image = zoom.firstElementChild;
  const at = image.getBoundingClientRect(), x = at.left + at.width / 2;
  const wheel = {{deltaY: -400, clientX: x, clientY: at.top + at.height / 2, cancelable: true}};
  zoom.dispatchEvent(new WheelEvent("wheel", wheel));
  const now = image.getBoundingClientRect(), by = now.width / at.width;
  const stays = Math.abs(now.left - (x - by * (x - at.left)));
  zoom.click();
  document.getElementById("found").textContent = JSON.stringify({{
    width: wide.clientWidth, scroll: wide.scrollWidth,
    out: boxes.filter(e => e.getBoundingClientRect().right > wide.clientWidth + 1).map(e => e.outerHTML.slice(0, 80)),
    zooms: opened && !zoom.open, closer: by, stays: stays,
    series: figures.filter(i => i.src.startsWith("data:image/svg")).length,
    unnamed: figures.filter(i => !i.alt || !i.complete || !i.naturalWidth).map(i => i.outerHTML.slice(0, 80)),
    figures: figures.length, heading: d.querySelector(".answer").textContent.trim(),
    background: getComputedStyle(d.body).backgroundColor, ink: getComputedStyle(d.body).color,
  }});
}};</script>"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    effects = {"headwind": {"scale": 0.98}}
    log = synthetic_log(seed=3, trips=9, rows_per_trip=80, effects=effects, noise_level=0.02)
    sheet = hdev_jax.read_sheet(log.write(folder / "log", truth=False)["sheet"])
    hdev_jax.diagnose(log.frame, sheet, only=["headwind", "auxiliary_power"]).report(folder / "report.html")
    return folder


@pytest.mark.drawn
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)])
def test_nothing_overflows_and_no_error_is_logged(width, dark, report, tmp_path):
    page = report / f"frame_{width}.html"
    page.write_text(FRAME.format(width=width))
    flags = [*FLAGS, *OF_A_FILE, f"--user-data-dir={tmp_path}", f"--window-size={width + 60},1000"]
    flags += ["--blink-settings=preferredColorScheme=0"] if dark else ["--blink-settings=preferredColorScheme=1"]
    done = subprocess.run([CHROMIUM, *flags, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120)
    said = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    assert said, done.stderr[-2000:]
    found = json.loads(html.unescape(said.group(1)))
    assert found["scroll"] <= found["width"], found["out"]
    assert found["out"] == []
    assert found["unnamed"] == [], "a figure without a description, or one that does not load"
    assert found["figures"] >= 3
    assert found["zooms"], "a click enlarges a figure, another closes it"
    assert found["closer"] == pytest.approx(2.718, rel=0.02), "the wheel zooms in"
    assert found["stays"] < 2, "what is at the pointer stays there"
    assert found["series"] >= 1, "time series are lines, sharp at any size"
    assert found["heading"].startswith("The declared model misses")
    assert "CONSOLE" not in done.stderr, done.stderr[-2000:]
    page_is, ink = (sum(map(int, re.findall(r"\d+", found[k])[:3])) for k in ("background", "ink"))
    assert (page_is > 600) is not dark, "the page follows the reader's colour scheme"
    assert abs(page_is - ink) > 450, "ink that is read on its page"
