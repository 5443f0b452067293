"""The service: rows of many vehicles in, estimates out; nothing that was acknowledged is lost or counted twice."""

import contextlib
import json
import re
import shutil
import socket
import subprocess
import sys
import time
from typing import Any, ClassVar

import numpy as np
import pytest
from planted import library_of
from servers import free_port

from hdev_jax.errors import InputError
from hdev_jax.fleet import demo_log
from hdev_jax.online.service import Fleet, Journal, RefusedError, UnavailableError, sheets_in
from hdev_jax.online.service.given import checked
from hdev_jax.online.service.journal import postgresql
from hdev_jax.physics import Effect, Size, library
from hdev_jax.physics.effect import Car, Parameters, Point, Row, Stage

pytest.importorskip("fastapi", reason="fastapi is in the extra serve")
from fastapi.testclient import TestClient

from hdev_jax.online.service.app import Limits, app_of, digest_of
from hdev_jax.verbs.live.serve import serve

A, B = ({"Authorization": f"Bearer {t}"} for t in ("token a", "token b"))
TOKENS = {"a": digest_of("token a"), "b": digest_of("token b")}


@pytest.fixture(scope="module")
def sheets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sheets")
    files = demo_log(3, trips=1).write(folder / "log", truth=False)
    (folder / "sheets").mkdir()
    shutil.copy(files["sheet"], folder / "sheets" / "default.toml")
    return folder / "sheets"


@pytest.fixture(scope="module")
def rows():
    frame = demo_log(3, trips=2).frame.groupby("trip_id").head(90)
    keep = ["trip_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg",
            "grade_rad", "energy_wh"]  # fmt: skip
    return json.loads(frame[keep].to_json(orient="records"))


def named(rows, vehicle):
    return [{"vehicle_id": vehicle, **r} for r in rows]


@pytest.fixture
def fleet(tmp_path, sheets):
    return Fleet(Journal(tmp_path / "state.sqlite"), sheets_in(sheets), watch=False)


@pytest.fixture
def client(fleet):
    return TestClient(app_of(fleet, TOKENS, Limits(body=200_000, rows=300)))


@pytest.fixture(params=["sqlite", "postgresql"])
def journals(request, tmp_path):
    """What `--state` says: a database that is new, by its name."""
    urls: dict[str, str] = {}

    def place(name):
        if request.param == "sqlite":
            return str(tmp_path / f"{name}.sqlite")
        if name not in urls:
            urls[name] = request.getfixturevalue("postgres").database()
        return urls[name]

    return place


@pytest.fixture
def opened(sheets):
    """Fleets at a database, closed at the end."""
    with contextlib.ExitStack() as stack:

        def fleet(place):
            made = Fleet(Journal(place), sheets_in(sheets), watch=False)
            stack.callback(made.close)
            return made

        yield fleet


def numbers(fleet, vehicle="T1"):
    return fleet._current(("a", vehicle)).followed.live.numbers


def test_the_service_knows_what_rows_one_by_one_tell(fleet, rows, sheets):
    from hdev_jax.inference.sheet import read_sheet
    from hdev_jax.online.followed import Followed

    fleet.put("a", checked(named(rows, "T1")))
    alone = Followed(read_sheet(sheets / "default.toml"), watch=False)
    used = fleet.known("a", "T1")["rows"]["used"]
    for row in rows[:used]:
        list(alone.take([row]))
    assert used > 150
    np.testing.assert_allclose(numbers(fleet), alone.live.numbers, rtol=1e-9, atol=1e-9)


def test_rows_twice_late_and_out_of_order(fleet, rows, journals, opened):
    fleet.put("a", checked(named(rows, "T1")))
    other = opened(journals("other"))
    shuffled = [*rows]
    for k in range(0, len(rows) - 1, 7):  # neighbours, a few seconds apart; trips stay in order
        if rows[k]["trip_id"] == rows[k + 1]["trip_id"]:
            shuffled[k : k + 2] = shuffled[k : k + 2][::-1]
    told = [other.put("a", checked(named(part, "T1"))) for part in (shuffled[:50], shuffled[:50], shuffled[50:])]
    assert [t["repeated"] for t in told] == [0, 50, 0]
    assert other.known("a", "T1")["rows"] == fleet.known("a", "T1")["rows"]
    np.testing.assert_array_equal(numbers(other), numbers(fleet))
    late = {**rows[10], "time_s": rows[10]["time_s"] + 0.5}
    far = {**rows[-1], "time_s": 1e9}  # a clock at fault must not make all that follows late
    other.put("a", checked(named([late, far], "T1")))
    assert other.known("a", "T1")["rows"]["late"] == 1
    assert other.known("a", "T1")["rows"]["far ahead"] == 1
    np.testing.assert_array_equal(numbers(other), numbers(fleet))


def test_a_start_from_the_journal_is_as_if_it_had_never_stopped(fleet, rows, journals, opened):
    for part in (rows[:60], rows[60:100], rows[100:]):
        fleet.put("a", checked(named(part, "T1")))
    first = opened(journals("again"))
    first.put("a", checked(named(rows[:60], "T1")))
    first.close()  # its state is written
    second = opened(journals("again"))
    second.put("a", checked(named(rows[60:100], "T1")))  # in the journal alone
    third = opened(journals("again"))
    third.put("a", checked(named(rows[100:], "T1")))
    with pytest.raises(UnavailableError, match="another hdev serve now uses this database"):
        second.put("a", checked(named(rows[:1], "T2")))  # it has not noticed, and must not lead the rows astray
    np.testing.assert_array_equal(numbers(third), numbers(fleet))
    assert third.known("a", "T1")["rows"] == fleet.known("a", "T1")["rows"]


def test_rows_whose_answer_was_lost_count_once(fleet, rows, journals, opened, monkeypatch):
    """They were kept, and nobody was told: sent again they are repeated, and used all the same."""
    fleet.put("a", checked(named(rows, "T1")))
    other = opened(journals("lost"))
    client = TestClient(app_of(other, TOKENS))
    post = lambda part: client.post("/v1/rows", json={"rows": named(part, "T1")}, headers=A)  # noqa: E731
    put, used = other.journal.put, other.put("a", checked(named(rows[:60], "T1")))
    assert other.known("a", "T1")["rows"]["used"] > 0, "it is in memory"

    def cut_off(*arguments):
        put(*arguments)
        raise UnavailableError("connection lost with s3cret")

    monkeypatch.setattr(other.journal, "put", cut_off)
    answer = post(rows[60:100])
    assert (answer.status_code, answer.headers["Retry-After"]) == (503, "5")
    assert "s3cret" not in answer.text
    monkeypatch.setattr(other.journal, "put", put)
    assert post(rows[60:100]).json() == {"accepted": 0, "repeated": 40}
    assert post(rows[100:]).json()["accepted"] + used["accepted"] == len(rows) - 40
    np.testing.assert_array_equal(numbers(other), numbers(fleet))
    assert other.known("a", "T1")["rows"] == fleet.known("a", "T1")["rows"]


def test_a_database_that_goes_away_while_rows_come(fleet, rows, postgres, opened, monkeypatch):
    monkeypatch.setattr(postgresql, "RETRY_S", 0.0)
    fleet.put("a", checked(named(rows, "T1")))
    other = opened(postgres.database())
    client = TestClient(app_of(other, TOKENS))
    post = lambda part, name="T1": client.post("/v1/rows", json={"rows": named(part, name)}, headers=A)  # noqa: E731
    assert post(rows[:60]).status_code == 200
    assert client.get("/v1/vehicles/T1", headers=A).status_code == 200
    postgres.stop()
    try:
        for _ in range(3):
            assert post(rows[60:100]).status_code == 503
        assert post(rows[:9], "T2").status_code == 503
        assert client.get("/v1/vehicles/T1", headers=A).status_code == 503, "it may have rows that nobody was told of"
        assert client.get("/healthz").status_code == 200
    finally:
        postgres.start()
    assert post(rows[50:]).json() == {"accepted": len(rows) - 60, "repeated": 10}
    assert [v["vehicle_id"] for v in client.get("/v1/vehicles", headers=A).json()] == ["T1"]
    np.testing.assert_array_equal(numbers(other), numbers(fleet))


def test_one_fleet_never_sees_another(client, rows):
    assert client.post("/v1/rows", json={"rows": named(rows[:60], "T1")}, headers=A).json()["accepted"] == 60
    assert [v["vehicle_id"] for v in client.get("/v1/vehicles", headers=A).json()] == ["T1"]
    assert client.get("/v1/vehicles", headers=B).json() == []
    assert client.get("/v1/vehicles/T1", headers=A).status_code == 200
    for path in ("/v1/vehicles/T1", "/v1/vehicles/none"):
        assert client.get(path, headers=B).status_code == 404, "not even that it exists"
    assert client.post("/v1/vehicles/T1/forecast", json={"rows": rows[:2]}, headers=B).status_code == 404
    for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic token a"}):
        assert client.get("/v1/vehicles", headers=headers).status_code == 401
        assert client.post("/v1/rows", json={"rows": []}, headers=headers).status_code == 401


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"speed_start_mps": "fast"}, "speed_start_mps"),
        ({"time_s": None}, "time_s"),
        ({"vehicle_id": ""}, "vehicle_id"),
        ({"vehicle_id": "x" * 300}, "vehicle_id"),
        ({"vehicle_id": "south/17"}, "vehicle_id"),
        ({"trip_id": "\ud800"}, "trip_id"),
        ({"energy_wh": True}, "energy_wh"),
        ({"mass_kg": [1]}, "mass_kg"),
        ({"mass_kg": 10**400}, "mass_kg"),
        ({"trip_id": {"a": 1}}, "trip_id"),
    ],
)
def test_of_a_bad_batch_nothing_is_kept_and_the_field_is_named(client, fleet, rows, change, field):
    batch = named(rows[:3], "T1")
    batch[1] = {**batch[1], **change}
    answer = client.post("/v1/rows", content=json.dumps({"rows": batch}), headers=A)
    assert answer.status_code == 422
    assert answer.json()["detail"][0]["loc"] == ["rows", 1, field]
    assert fleet.names("a") == []


def test_bodies_that_are_none_and_limits(client, rows):
    post = lambda **k: client.post("/v1/rows", headers=A, **k).status_code  # noqa: E731
    assert post(content=b"{") == 422
    assert post(content=b"[1]") == 422
    assert post(content=b"[" * 90_000) == 422
    assert post(json={"rows": 3}) == 422
    assert post(content=b'{"rows": [{"vehicle_id": "T", "time_s": NaN}]}') == 422
    assert post(json={"rows": named(rows * 2, "T1")}) == 413, "more rows than a request may have"
    assert post(content=b'{"rows": []' + b" " * 300_000 + b"}") == 413
    slow = TestClient(app_of(Fleet(Journal(":memory:"), lambda *_: pytest.fail("asked")), TOKENS, Limits(rows_per_s=1)))
    answer = slow.post("/v1/rows", json={"rows": named(rows, "T1")}, headers=A)
    assert answer.status_code == 429
    assert int(answer.headers["Retry-After"]) > 100


def test_rows_that_come_faster_than_they_are_used_are_to_wait(fleet, rows):
    busy = TestClient(app_of(fleet, TOKENS, Limits(behind=50)))
    with fleet._lock:  # as if a form of rows were being compiled: what is acknowledged is kept all the same
        first = busy.post("/v1/rows", json={"rows": named(rows[:60], "T1")}, headers=A)
        then = busy.post("/v1/rows", json={"rows": named(rows[60:70], "T1")}, headers=A)
    assert first.json()["accepted"] == 60
    assert then.status_code == 503
    assert int(then.headers["Retry-After"]) > 0
    assert fleet.known("a", "T1")["rows"]["waiting"] > 0
    assert fleet.behind == 0
    assert busy.post("/v1/rows", json={"rows": named(rows[60:70], "T1")}, headers=A).json()["accepted"] == 10


def test_a_vehicle_without_a_sheet_is_refused_in_one_line(tmp_path, sheets, rows):
    (tmp_path / "own").mkdir()
    shutil.copy(sheets / "default.toml", tmp_path / "own" / "T1.toml")
    client = TestClient(app_of(Fleet(Journal(":memory:"), sheets_in(tmp_path / "own"), watch=False), TOKENS))
    answer = client.post("/v1/rows", json={"rows": named(rows[:2], "T2")}, headers=A)
    assert answer.status_code == 422
    assert "no sheet for vehicle 'T2'" in answer.json()["detail"][0]["msg"]
    assert client.post("/v1/rows", json={"rows": named(rows[:2], "../T1")}, headers=A).status_code == 422
    for folder, words in ((tmp_path / "none", "no such folder"), (tmp_path, None)):
        if words:
            with pytest.raises(InputError, match=words):
                sheets_in(folder)


def test_the_rest_of_the_way(client, rows):
    client.post("/v1/rows", json={"rows": named(rows[:90], "T1")}, headers=A)
    ask = lambda **k: client.post("/v1/vehicles/T1/forecast", json=k, headers=A)  # noqa: E731
    told = ask(rows=rows[60:90], soc=0.5, capacity_wh=3e5).json()
    true = sum(r["energy_wh"] for r in rows[60:90])
    assert told["interval_wh"][0] < true < told["interval_wh"][1]
    assert told["soc_at_end"][0] == pytest.approx(0.5 - told["energy_wh"] / 3e5)
    assert ask(rows=[]).status_code == 422
    assert ask(rows=[{"speed_start_mps": 3.0}]).json()["detail"][0]["loc"] == ["rows", 0, "duration_s"]
    assert ask(rows=rows[:2], soc="half").status_code == 422
    assert ask(rows=rows[:2], soc=0.5, capacity_wh=0).status_code == 422
    assert ask(rows=5).status_code == 422
    assert ask(rows=[{**rows[0], "duration_s": 0}]).status_code == 422
    with pytest.raises(RefusedError):
        checked([3])


def test_what_a_row_is_taken_for_does_not_depend_on_its_batch(tmp_path, sheets, rows):
    """Samples among intervals, a row without a target first, a field that only some have."""
    mixed = [{k: v for k, v in r.items() if k != "energy_wh"} if i == 0 else dict(r) for i, r in enumerate(rows[:60])]
    mixed[20] = {"trip_id": mixed[20]["trip_id"], "time_s": mixed[20]["time_s"], "speed_mps": 9.0, "energy_wh": 50.0}
    mixed[30]["ambient_temp_c"] = 3.0
    whole, single = (Fleet(Journal(tmp_path / f"{k}.sqlite"), sheets_in(sheets), watch=False) for k in (1, 2))
    whole.put("a", checked(named(mixed, "T1")))
    for row in mixed:
        single.put("a", checked(named([row], "T1")))
    assert whole.known("a", "T1")["rows"] == single.known("a", "T1")["rows"]
    np.testing.assert_array_equal(numbers(whole), numbers(single))


def test_a_state_of_another_watch_begins_again(tmp_path, sheets, rows):
    first = Fleet(Journal(tmp_path / "s.sqlite"), sheets_in(sheets), watch=False)
    first.put("a", checked(named(rows, "T1")))
    first.close()
    with library_of(["air_density", "auxiliary_power"]):  # no other test has a watch of this sheet
        again = Fleet(Journal(tmp_path / "s.sqlite"), sheets_in(sheets), watch=True)
        assert again.known("a", "T1")["rows"]["used"] > 150


def test_without_tokens_no_other_site_may_call(sheets):
    fleet = Fleet(Journal(":memory:"), sheets_in(sheets), watch=False)
    here = TestClient(app_of(fleet), base_url="http://127.0.0.1:8000")
    assert here.get("/v1/vehicles").status_code == 200
    assert here.get("/v1/vehicles", headers={"Origin": "https://example.org"}).status_code == 403
    assert TestClient(app_of(fleet), base_url="http://rebound.example").get("/v1/vehicles").status_code == 403


def test_names_stay_text_and_the_page_loads_nothing(client, rows):
    hostile = "<img src=x onerror=alert(1)>'; DROP TABLE rows; --"
    client.post("/v1/rows", json={"rows": named(rows[:30], hostile)}, headers=A)
    assert client.get("/v1/vehicles", headers=A).json()[0]["vehicle_id"] == hostile
    page = client.get("/")
    assert "innerHTML" not in page.text, "what vehicles send goes in as text"
    assert not re.findall(r"https?://(?!www\.w3\.org/)", page.text)
    assert "default-src 'none'" in page.headers["Content-Security-Policy"]
    assert "/v1/rows" in client.get("/openapi.json").json()["paths"]


def test_a_database_of_something_else_is_refused(tmp_path):
    (tmp_path / "text").write_text("no database" * 100)
    with pytest.raises(InputError, match="no database of hdev serve"):
        Journal(tmp_path / "text")
    (tmp_path / "tokens.toml").write_text('a = "short"')
    with pytest.raises(InputError, match="64 hexadecimal digits"):
        serve(tmp_path, tmp_path / "s", tokens=tmp_path / "tokens.toml")
    with pytest.raises(InputError, match="--tokens says which fleets"):
        serve(tmp_path, tmp_path / "s", host="0.0.0.0")


def test_where_another_program_listens_the_database_stays_as_it_is(tmp_path, sheets, fleet, rows):
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        s.listen()
        with pytest.raises(InputError, match=r"--host 127.0.0.1 --port \d+: cannot listen there"):
            serve(sheets, tmp_path / "state.sqlite", port=s.getsockname()[1])
    assert fleet.put("a", checked(named(rows[:3], "T1")))["accepted"] == 3


def test_killed_while_rows_come_it_loses_and_repeats_none(fleet, rows, sheets, journals, opened):
    """The next start, here in this process, has what the one that was killed had acknowledged."""
    import httpx2 as httpx

    port, place = free_port(), str(journals("killed"))
    command = [sys.executable, "-m", "hdev_jax.cli", "serve", "--sheets", str(sheets), "--state", place, "--port",
               str(port), "--no-watch"]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        for _ in range(600):
            try:
                httpx.get(f"http://127.0.0.1:{port}/healthz")
            except httpx.TransportError:
                time.sleep(0.1)
            else:
                break
        for batch in (rows[:45], rows[45:90]):
            sent = {"rows": named(batch, "T1")}
            assert httpx.post(f"http://127.0.0.1:{port}/v1/rows", json=sent, timeout=120).status_code == 200
    finally:
        process.kill()  # whatever it is at
        process.wait()
    again = opened(place)
    told = again.put("fleet", checked(named(rows[45:], "T1")))  # the sender is not sure of its last batch
    assert told == {"accepted": len(rows) - 90, "repeated": 45}
    fleet.put("fleet", checked(named(rows, "T1")))
    assert again.known("fleet", "T1")["rows"] == fleet.known("fleet", "T1")["rows"]
    live = [f._current(("fleet", "T1")).followed.live.numbers for f in (again, fleet)]
    np.testing.assert_array_equal(*live)


def test_a_state_that_had_other_numbers_is_made_again_from_the_rows(tmp_path, sheets, rows):
    first = Fleet(Journal(tmp_path / "s.sqlite"), sheets_in(sheets), watch=False)
    first.put("a", checked(named(rows, "T1")))
    expected, version = first.known("a", "T1"), first.version
    assert version > 0
    first.close()
    journal = Journal(tmp_path / "s.sqlite")
    kept = journal.kept("a", "T1")
    del kept.about["stream"]["so_far"]
    journal.keep([("a", "T1", kept)])
    again = Fleet(journal, sheets_in(sheets), watch=False)
    assert again.known("a", "T1") == expected
    assert again.version > 0, "listeners hear of what a start has used"


def test_brakes_that_drag_let_go_on_the_rest_of_the_trip(tmp_path, sheets, rows):
    text = (sheets / "default.toml").read_text()
    (tmp_path / "sheets").mkdir()
    drag = "\n[effects.brake_drag]\nforce_n = 3000.0\ntau_s = 20.0\n"
    (tmp_path / "sheets" / "default.toml").write_text(text + drag)
    fleet = Fleet(Journal(tmp_path / "s.sqlite"), sheets_in(tmp_path / "sheets"), watch=False)
    sent = [{**r, "brake_pressure_pa": 5e5 if k >= 30 else 0.0} for k, r in enumerate(rows[:60])]
    fleet.put("a", checked(named(sent, "T1")))
    ahead = [{"duration_s": 10.0, "speed_start_mps": 15.0, "speed_end_mps": 15.0, "grade_rad": 0.0,
              "brake_pressure_pa": 0.0, "mass_kg": 3e4} for _ in range(60)]  # fmt: skip
    told = fleet.ahead("a", "T1", ahead)["energy_wh"]
    late = fleet.ahead("a", "T1", [{**r, "time_s": 1e6 + 10.0 * k} for k, r in enumerate(ahead)])["energy_wh"]
    assert told == late, "times of rows to come are their durations added up"
    dragged = fleet.ahead("a", "T1", ahead[:2])["energy_wh"] * 30.0
    assert told < 0.95 * dragged


def test_a_sheet_may_declare_an_effect_of_ones_own(sheets, rows, tmp_path):
    class Lamp(Effect):
        """A load of so much while it is lit."""

        needs: ClassVar[tuple[str, ...]] = ("lit",)
        id: ClassVar[str] = "lamp"
        label: ClassVar[str] = "lamp"
        stage: ClassVar[Stage] = "battery"
        equation: ClassVar[str] = "P"
        parameters: ClassVar[Parameters] = (Size("power_w", "W", 0.0, 100.0, 0.0, 1e5),)
        power_w: Any

        def power(self, row: Row, car: Car, point: Point) -> Any:
            return self.power_w * row.channels["lit"]

    (tmp_path / "own").mkdir()
    default = (sheets / "default.toml").read_text()
    (tmp_path / "own" / "plain.toml").write_text(default)
    (tmp_path / "own" / "lit.toml").write_text(f"{default}\n[effects.lamp]\npower_w = 36000.0\n")
    with pytest.raises(InputError, match="lamp"):
        sheets_in(tmp_path / "own")
    sheet_for, place = sheets_in(tmp_path / "own", library([Lamp])), str(tmp_path / "state.sqlite")
    fleet = Fleet(Journal(place), sheet_for, watch=False, effects_sha256="1")
    client = TestClient(app_of(fleet, TOKENS))
    for vehicle in ("plain", "lit"):
        sent = client.post("/v1/rows", json={"rows": named([{**r, "lit": 1.0} for r in rows[:20]], vehicle)}, headers=A)
        assert sent.status_code == 200, sent.text
    # of the first row: no error before it is known, which the next one's prediction takes up
    seen = {v: client.get(f"/v1/vehicles/{v}", headers=A).json()["recent"][0]["predicted"] for v in ("plain", "lit")}
    assert seen["lit"] - seen["plain"] == pytest.approx(36000.0 * rows[0]["duration_s"] / 3600.0)
    of = fleet._of(sheet_for("a", "lit"))
    fleet.close()
    for sha256 in ("1", "2"):  # a state that is kept is not one of another effect of this id
        again = Fleet(Journal(place), sheet_for, watch=False, effects_sha256=sha256)
        assert (again._of(sheet_for("a", "lit")) == of) is (sha256 == "1")
        again.close()
