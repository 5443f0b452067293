"""The service's page in a real browser: vehicles appear as they drive, whatever their names are."""

import json
import shutil
import threading
import time

import pytest
from chromium import CHROMIUM, opened

from hdev_jax.fleet import demo_log
from hdev_jax.online.service import Fleet, Journal, sheets_in
from hdev_jax.online.service.given import checked

pytest.importorskip("uvicorn", reason="uvicorn is in the extra serve")
import uvicorn

from hdev_jax.online.service.app import app_of

NAMES = ("T1", "<img src=x onerror=alert(1)>")
SEEN = """new Promise(done => {{
  const look = () => {{
    const cards = [...document.querySelectorAll("article")].map(c => ({{
      name: c.querySelector("h2").textContent, text: c.innerText, drawn: c.querySelectorAll("svg path").length}}));
    if ({until}) done({{cards, state: document.body.innerText, images: document.images.length,
                        width: innerWidth, scroll: document.documentElement.scrollWidth}});
    else setTimeout(look, 50);
  }}; look(); }})"""


@pytest.fixture
def served(tmp_path):
    log = demo_log(3, trips=1)
    (tmp_path / "sheets").mkdir()
    shutil.copy(log.write(tmp_path / "log", truth=False)["sheet"], tmp_path / "sheets" / "default.toml")
    keep = ["trip_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg",
            "grade_rad", "energy_wh"]  # fmt: skip
    rows = json.loads(log.frame[keep].head(120).to_json(orient="records"))
    fleet = Fleet(Journal(tmp_path / "state.sqlite"), sheets_in(tmp_path / "sheets"), watch=False)
    server = uvicorn.Server(
        uvicorn.Config(app_of(fleet), port=0, log_level="warning", lifespan="off", timeout_graceful_shutdown=1)
    )
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.02)
    yield fleet, rows, f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}/"
    server.should_exit = True
    thread.join()
    fleet.close()


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_page_shows_vehicles_as_they_drive(served, tmp_path):
    fleet, rows, url = served
    for name in NAMES:
        fleet.put("fleet", checked([{"vehicle_id": name, **r} for r in rows[:80]]))
    with opened(url, tmp_path / "browser", width=390) as page:
        first = page.value(SEEN.format(until="cards.length === 2"))
        assert {c["name"] for c in first["cards"]} == {*NAMES}
        assert first["images"] == 0, "a name is text"
        assert all(c["drawn"] == 3 and "road.c_rr" in c["text"] for c in first["cards"])
        assert first["scroll"] <= first["width"], "nothing overflows on a phone"
        assert "2 vehicles" in first["state"]
        before = next(c["text"] for c in first["cards"] if c["name"] == "T1")
        fleet.put("fleet", checked([{"vehicle_id": "T1", **r} for r in rows[80:]]))
        moved = SEEN.format(until=f"cards.some(c => c.name === 'T1' && c.text !== {json.dumps(before)})")
        assert "rows used" in next(c["text"] for c in page.value(moved)["cards"] if c["name"] == "T1")
        assert page.errors == []
