"""`hdev follow --mqtt`: rows from a real broker, which may go away; a stop, whenever it is, costs nothing."""

import contextlib
import io
import json
import os
import queue
import signal
import threading
import time

import pytest
from servers import PASSWORD, Broker, free_port

from hdev_jax import progress
from hdev_jax.errors import InputError
from hdev_jax.fleet import synthetic_log
from hdev_jax.online.followed import Followed
from hdev_jax.verbs.live import mqtt
from hdev_jax.verbs.live.follow import follow
from hdev_jax.verbs.live.mqtt import Topic, place_of

SHEET = {"mass_kg": 29e3, "road": {"c_rr": (0.006, 0.0008), "cda_m2": (5.6, 0.5)}, "driveline": {"efficiency": 0.91}}
KEPT = ["trip_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg", "grade_rad",
        "energy_wh"]  # fmt: skip


@pytest.fixture(scope="module")
def rows():
    return synthetic_log(seed=5, trips=2, rows_per_trip=60).frame[KEPT].groupby("trip_id").head(40).to_dict("records")


@pytest.fixture(scope="module")
def broker(tmp_path_factory):
    broker = Broker(tmp_path_factory.mktemp("broker"))
    yield broker
    broker.stop()


@pytest.fixture
def send(broker):
    """Send messages, each text, or rows as JSON; what the broker has when this returns stays."""
    import paho.mqtt.publish as publish

    def send(topic, *messages, retain=False):
        each = [m if isinstance(m, str | bytes) else json.dumps(m) for m in messages]
        publish.multiple(
            [{"topic": topic, "payload": m, "qos": 1, "retain": retain} for m in each], "127.0.0.1", broker.port
        )

    return send


@pytest.fixture
def until(monkeypatch):
    """After so many rows something happens, while others are waited for; Ctrl-C at the end."""
    whole = Topic.batches
    monkeypatch.setattr(mqtt, "IDLE_S", 0.1)

    def until(*steps):
        todo = [*steps]

        def batches(self, waiting):
            count, late = 0, time.monotonic() + 60.0
            for batch in whole(self, waiting):
                yield batch
                count += len(batch)
                while todo and count >= todo[0][0]:
                    todo.pop(0)[1]()
                assert time.monotonic() < late, f"{count} rows came"
                if not todo:
                    raise KeyboardInterrupt

        monkeypatch.setattr(Topic, "batches", batches)

    return until


@pytest.fixture
def said(monkeypatch):
    lines = []
    monkeypatch.setattr(progress, "step", lines.append)
    return lines


def told(url, **options):
    """The lines of JSON, parsed, even where it ends by an exception."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(ZeroDivisionError):
        follow(SHEET, json=True, watch=False, mqtt=url, **options)
    return [json.loads(line) for line in out.getvalue().splitlines()]


def through(rows):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        follow(SHEET, rows, json=True, watch=False)
    return [json.loads(line) for line in out.getvalue().splitlines()]


def nothing():
    pass


def fail():
    raise ZeroDivisionError


def test_messages_are_rows_and_what_does_not_read_is_counted(broker, send, rows, until, said):
    send("trucks/17/status", "online", retain=True)  # what else is there must not end it
    send("trucks/17/trip", {"status": "driving", "energy": 3}, retain=True)
    url = f"mqtt://127.0.0.1:{broker.port}/trucks/+/#"
    mixed = [rows[0], rows[1:30], '{"time_s": 3', rows[30], b"", b"\xff\xfe", [*rows[31:70], 5], *rows[70:]]
    until((2, lambda: send("trucks/17/rows", *mixed)), (80 + 5, nothing))
    with contextlib.redirect_stdout(io.StringIO()) as out:
        summary = follow(SHEET, watch=False, mqtt=url)
    assert summary is not None
    assert "80 rows, 80 used, 2 trips, 5 unreadable" in summary
    assert sum(line.startswith("T0") for line in out.getvalue().splitlines()) == 80
    assert [line for line in said if "no target" in line], said
    send("trucks/17/status", "", retain=True)
    send("trucks/17/trip", "", retain=True)


def test_whenever_it_stops_nothing_is_lost_or_counted_twice(broker, send, rows, until, tmp_path):
    """Ctrl-C, or an end that saves nothing: what was sent meanwhile comes, what was not saved comes again."""
    options = {"url": f"mqtt://127.0.0.1:{broker.port}/stopped", "state": tmp_path / "s.state"}
    until((0, lambda: send("stopped", *rows[:25])), (25, nothing))
    parts, whole = told(**options), through(rows)
    send("stopped", *rows[25:33])  # nobody is there
    until((8, fail))
    assert told(**options) == whole[25:33]
    send("stopped", *rows[33:])
    until((len(rows) - 25, nothing))
    assert parts + told(**options) == whole


def test_a_broker_that_goes_away_is_waited_for(broker, send, rows, until, said, tmp_path):
    def away():
        broker.stop()
        broker.start()
        send("away", rows[8:40], *rows[40:])

    until((0, lambda: send("away", *rows[:8])), (8, away), (8 + len(rows), nothing))  # 8 are not saved: they come again
    found = told(f"mqtt://127.0.0.1:{broker.port}/away", state=tmp_path / "s.state")
    assert found == through(rows)
    assert [line.split(": ")[1] for line in said] == ["waiting for rows", "gone", "there again"]


@pytest.mark.skipif(threading.current_thread() is not threading.main_thread(), reason="signals go to the main thread")
def test_asked_to_end_it_uses_what_is_there_and_saves(broker, send, rows, until, said, tmp_path, monkeypatch):
    """A signal that comes while rows are used waits for them; one that comes while it waits does not."""
    send("ended", rows[:30], retain=True)
    user = f"truck:{PASSWORD.replace(' ', '%20')}@"
    options = {"url": f"mqtt://{user}127.0.0.1:{broker.port}/ended", "state": tmp_path / "s.state"}
    asked = lambda *_: os.kill(os.getpid(), signal.SIGTERM)  # noqa: E731
    take, begun = Followed.take, threading.Event()

    def slow(self, records):
        if not begun.is_set():
            begun.set()
            asked()
        return take(self, records)

    monkeypatch.setattr(Followed, "take", slow)
    until((9_999, nothing))
    assert told(**options) == through(rows[:30])
    threading.Timer(0.3, asked).start()
    assert told(**options) == [], "it had them"
    assert PASSWORD not in "".join(said)


def test_what_is_no_topic_is_one_line_without_a_password(broker, monkeypatch):
    def refused(url, **options):
        with pytest.raises(InputError) as e:
            follow(SHEET, mqtt=url, watch=False, **options)
        assert "geheim" not in str(e.value)
        return str(e.value)

    for url in ("mqtt://h", "mqtt:///t", "http://u:geheim@h/t", "mqtt://h:port/t", "mqtt://h/a#", "mqtt://h/a/#/b",
                "mqtt://u:ge/heim@h/t", "mqtt://u:geheim@h:99999/t", "mqtt://[u:geheim@h/t", "broker/t"):  # fmt: skip
        assert "mqtt://HOST:PORT/TOPIC is expected" in refused(url)
    assert "cannot be reached" in refused(f"mqtt://u:geheim@127.0.0.1:{free_port()}/t")
    assert "refused: Not authorized" in refused(f"mqtt://truck:geheim@127.0.0.1:{broker.port}/t")
    assert "leave one of them out" in refused("mqtt://h/t", rows=[])
    monkeypatch.setenv("HDEV_MQTT_PASSWORD", "from elsewhere")
    place = place_of("mqtts://tr%40ck@h/a/+/b?/%23")
    assert place == ("h", 8883, "a/+/b?/#", True, "tr@ck", "from elsewhere")


def test_every_message_is_given_and_acknowledged_however_many_are_there():
    came, acknowledged = queue.SimpleQueue(), []

    class Client:
        def ack(self, mid, qos):
            acknowledged.append(mid)

    for mid in range(12):
        came.put(mqtt._Message(json.dumps([{"time_s": 100 * mid + k} for k in range(100)]).encode(), mid, 1))
    topic, got = Topic(place_of("mqtt://here/t"), Client(), came), []
    for batch in topic.batches():
        got += batch
        topic.kept()
        if len(got) >= 1200 or not batch:
            break
    assert [r["time_s"] for r in got] == list(range(1200))
    assert acknowledged == list(range(12))


@pytest.mark.parametrize("url", ["ssl://u:p@h:8883/t", "wss://h:443/t", "http://h:80/t"])
def test_another_scheme_is_refused_and_not_sent_in_clear(url):
    with pytest.raises(InputError, match="mqtt://HOST:PORT/TOPIC is expected"):
        place_of(url)
