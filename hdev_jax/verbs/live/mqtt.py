"""Rows of a stream as messages of an MQTT topic."""

import contextlib
import hashlib
import importlib
import os
import queue
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

from hdev_jax import progress
from hdev_jax.errors import InputError
from hdev_jax.verbs.live.lines import Batch, Waiting, rows_of_json

__all__ = ["Place", "Topic", "place_of", "subscribed"]

EXTRA = "hdev follow --mqtt needs paho-mqtt: pip install 'hdev_jax[mqtt]'"
PORTS = {"mqtt": 1883, "mqtts": 8883}
PASSWORD = "HDEV_MQTT_PASSWORD"
QOS = 1  # a message comes again until it is acknowledged
KEEPALIVE_S = 30
ANSWER_S = 10.0  # what a broker has for its answers at the start
LONGEST_WAIT_S = 30  # between two attempts to reach it again
IDLE_S = 1.0  # without a message: then it may be time to save
MOST = 500  # rows taken at a time
FULL = 10  # messages; brokers send no more than some that are not acknowledged (mosquitto: 20)


class Place(NamedTuple):
    """Where a topic is."""

    host: str
    port: int
    topic: str
    tls: bool
    user: str | None
    password: str | None

    @property
    def shown(self) -> str:
        """How messages name it: no user, no password."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"mqtt{'s' if self.tls else ''}://{host}:{self.port}/{self.topic}"


def place_of(url: str) -> Place:
    """`mqtt://[USER[:PASSWORD]@]HOST[:PORT]/TOPIC`, or `mqtts://…`. Raises `InputError`, which shows nothing of it."""
    scheme, _, rest = url.partition("://")
    server, _, topic = rest.partition("/")  # by hand: in a topic # is a wildcard, ? a character
    topic = unquote(topic)
    with contextlib.suppress(ValueError):
        parts = urlsplit(f"//{server}")
        port = parts.port or PORTS.get(scheme)
        if scheme in PORTS and parts.hostname and port and _is_filter(topic):
            user, password = (None if x is None else unquote(x) for x in (parts.username, parts.password))
            return Place(parts.hostname, port, topic, scheme == "mqtts", user, password or os.environ.get(PASSWORD))
    raise InputError(
        "--mqtt: mqtt://HOST:PORT/TOPIC is expected (mqtts:// with TLS), + for one level of the topic and # for all "
        f"below; a user goes before the host, USER@HOST, and the password into {PASSWORD}"
    )


def _is_filter(topic: str) -> bool:
    """Whether a topic is one, wildcards being whole levels; an @ is rather the end of a password with a / in it."""
    levels = topic.split("/")
    plain = all(level in ("+", "#") or not set(level) & {"+", "#"} for level in levels)
    return bool(topic) and plain and "#" not in levels[:-1] and "@" not in topic and topic.isprintable()


class _Message(NamedTuple):
    payload: bytes
    mid: int
    qos: int


class Topic:
    """A subscription. `batches` gives rows, `kept` acknowledges them: what is not acknowledged comes again."""

    def __init__(self, place: Place, client: Any, came: "queue.SimpleQueue[_Message | str]"):
        self.place: Place = place
        self.again: Callable[[], None] = lambda: None  # called where what comes next may have been there
        self._client, self._came = client, came
        self._given: list[_Message] = []

    @property
    def full(self) -> bool:
        """Whether the broker waits, or soon will, until some messages are acknowledged."""
        return len(self._given) >= FULL

    def batches(self, waiting: Waiting = contextlib.nullcontext) -> Iterator[Batch]:
        """Rows as they come, all that are there at a time, none after a while without any; None for what does not
        read. It does not end by itself."""
        last = None
        while True:
            found: Batch = []
            turn: str | None = None
            with contextlib.suppress(queue.Empty):
                with waiting():
                    came = self._came.get(timeout=IDLE_S)
                while isinstance(came, _Message):
                    self._given.append(came)
                    found += rows_of_json(came.payload)
                    if len(found) >= MOST:  # the next one stays where it is
                        break
                    came = self._came.get_nowait()
                turn = came if isinstance(came, str) else None
            yield found
            if turn is not None:
                if turn != last:
                    progress.step(f"{self.place.shown}: {turn or 'there again'}")
                last = turn
                self._given.clear()  # these come again, or were lost with the broker
                if not turn:
                    self.again()

    def kept(self) -> None:
        """All rows that were given need not come again."""
        for message in self._given:
            self._client.ack(message.mid, message.qos)
        self._given.clear()


@contextlib.contextmanager
def subscribed(url: str, state: str | Path | None) -> Iterator[Topic]:
    """A topic's messages until the block ends. With a `state` the broker keeps those that come while nobody is there.

    **Raises:** `InputError` where the broker cannot be reached at the start, or refuses.
    """
    place = place_of(url)
    try:
        mqtt: Any = importlib.import_module("paho.mqtt.client")
    except ImportError as e:
        raise InputError(EXTRA) from e
    name = f"{socket.gethostname()} {Path(state).resolve()} {place.topic}" if state is not None else ""
    client = mqtt.Client(
        mqtt.CallbackAPIVersion.VERSION2, manual_ack=True, clean_session=state is None,
        client_id=f"hdev{hashlib.sha256(name.encode()).hexdigest()[:16]}" if name else "",
    )  # fmt: skip
    client.reconnect_delay_set(1, LONGEST_WAIT_S)
    if place.user is not None or place.password is not None:
        client.username_pw_set(place.user or "", place.password)
    if place.tls:
        client.tls_set()
    came: queue.SimpleQueue[_Message | str] = queue.SimpleQueue()
    first: queue.SimpleQueue[str] = queue.SimpleQueue()  # the broker's answers at the start; "": fine
    began = False

    def answered(what: str) -> None:
        if not began:
            first.put(what)
        elif what:
            came.put(f"{what}; waiting for it")

    def connected(client: Any, data: Any, flags: Any, why: Any, properties: Any) -> None:
        if why.is_failure:
            return answered(f"refused: {why}")
        if began:
            came.put("")  # before any message that comes again
        client.subscribe(place.topic, QOS)
        return None

    client.on_connect = connected
    client.on_subscribe = lambda c, d, mid, why, p: answered(
        f"the topic is refused: {why[0]}" if why[0].is_failure else ""
    )
    client.on_disconnect = lambda c, d, flags, why, p: answered(f"gone: {why}")
    client.on_message = lambda c, d, m: came.put(_Message(m.payload, m.mid, m.qos))
    try:
        client.connect(place.host, place.port, KEEPALIVE_S)
    except (OSError, ValueError) as e:  # also a name that is none of a host
        raise InputError(f"--mqtt {place.shown}: cannot be reached ({getattr(e, 'strerror', None) or e})") from None
    client.loop_start()
    try:
        try:
            what = first.get(timeout=ANSWER_S)
        except queue.Empty:
            what = f"no answer for {ANSWER_S:.0f} s"
        if what:
            raise InputError(f"--mqtt {place.shown}: {what}")
        began = True
        progress.step(f"{place.shown}: waiting for rows")
        yield Topic(place, client, came)
    finally:
        client.disconnect()
        client.loop_stop()
