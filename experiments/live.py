"""`make live`: a service on this machine, and vehicles that drive through it at many times real time.

    python -m experiments.live --out out/live --speed 60

Ten synthetic trucks; one of them regenerates no more than 60 kW, and the brakes of another drag, which their sheets do
not know.
The page is at the address that is printed; Ctrl-C ends it.
"""

import argparse
import contextlib
import json
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hdev_jax.fleet import synthetic_log

__all__ = ["main", "running"]

TRUCKS = 10
TRIPS, ROWS = 24, 150
EFFECTS: dict[int, dict[str, Any]] = {
    3: {"regen_limit": {"power_w": 60e3}}, 7: {"brake_drag": {"force_n": 600.0, "tau_s": 60.0}}
}  # fmt: skip
TICK_S = 1.0


def main(argv: Sequence[str] | None = None) -> int:
    """Start the service, drive, stop."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/live"), help="a folder for sheets and the database")
    parser.add_argument("--speed", type=float, default=60.0, help="times real time (default: 60)")
    parser.add_argument("--for", dest="seconds", type=float, help="end after so many seconds")
    parser.add_argument("--port", type=int, default=0, help="port of the page (default: a free one)")
    a = parser.parse_args(argv)
    for old in (a.out / "sheets", a.out / "logs"):
        shutil.rmtree(old, ignore_errors=True)
    for old in a.out.glob("state.sqlite*"):
        old.unlink()
    (a.out / "sheets").mkdir(parents=True)
    rows = _vehicles(a.out)
    with running(a.out, port=a.port) as (url, _), contextlib.suppress(KeyboardInterrupt):
        print(f"open {url}/ : {TRUCKS} synthetic trucks at {a.speed:g} times real time. Ctrl-C ends it.")
        told = "truck_3 regenerates no more than 60 kW, and truck_7's brakes drag: their sheets do not know it."
        print(told, flush=True)
        named = _drive(url, rows, a.speed, a.seconds)
        print(f"alarms: {', '.join(f'{k}: {v}' for k, v in named.items()) or 'none'}")
    return 0


def _vehicles(out: Path) -> pd.DataFrame:
    """Rows of all vehicles in the order of their clock, each with a trip after the other."""
    parts = []
    for k in range(1, TRUCKS + 1):
        made = synthetic_log(seed=40 + k, trips=TRIPS, rows_per_trip=ROWS, effects=EFFECTS.get(k, {}), noise="ar1",
                             ar_coefficient=0.8)  # fmt: skip
        files = made.write(out / "logs" / f"truck_{k}", truth=False)
        shutil.copy(files["sheet"], out / "sheets" / f"truck_{k}.toml")
        parts.append(_clocked(made.frame.assign(vehicle_id=f"truck_{k}")))
    return pd.concat(parts).sort_values("clock_s", kind="stable")


def _clocked(frame: pd.DataFrame) -> pd.DataFrame:
    begin, at = np.zeros(len(frame)), 0.0
    for trip in frame["trip_id"].unique():  # a minute apart
        own = (frame["trip_id"] == trip).to_numpy()
        begin[own] = at
        at += float(frame["time_s"].to_numpy()[own].max()) + 60.0
    return frame.assign(clock_s=frame["time_s"] + begin + frame["duration_s"])


@contextlib.contextmanager
def running(folder: Path, *options: str, port: int = 0) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """`hdev serve` on the folder's `sheets` and `state.sqlite`, until the block ends: its address and process."""
    if not port:
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            port = s.getsockname()[1]
    command = [sys.executable, "-m", "hdev_jax.cli", "serve", "--sheets", str(folder / "sheets"), "--state",
               str(folder / "state.sqlite"), "--port", str(port), *options]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        url = f"http://127.0.0.1:{port}"
        for _ in range(600):
            with contextlib.suppress(urllib.error.URLError, ConnectionError):
                urllib.request.urlopen(f"{url}/healthz")
                break
            if process.poll() is not None:
                raise SystemExit("hdev serve did not start: pip install 'hdev_jax[serve]'")
            time.sleep(0.1)
        yield url, process
    finally:
        process.terminate()
        process.wait()


def _drive(url: str, rows: pd.DataFrame, speed: float, seconds: float | None) -> dict[str, str]:
    """Send rows when their time comes, until all are sent; the alarms so far."""
    clock, begun, at, said = rows["clock_s"].to_numpy(), time.monotonic(), 0, dict[str, str]()
    lines = rows.drop(columns="clock_s")
    while at < len(rows) and (seconds is None or time.monotonic() - begun < seconds):
        until = int(np.searchsorted(clock, (time.monotonic() - begun) * speed, side="right"))
        if until > at:
            _post(f"{url}/v1/rows", {"rows": json.loads(lines.iloc[at:until].to_json(orient="records"))})
            at = until
            for alarm in json.loads(urllib.request.urlopen(f"{url}/v1/alarms").read()):
                if alarm["vehicle_id"] not in said:
                    said[alarm["vehicle_id"]] = alarm["text"]
                    print(f"{alarm['vehicle_id']}: its sheet lacks {alarm['text']}", flush=True)
        time.sleep(TICK_S)
    return said


def _post(url: str, body: Any) -> None:
    request = urllib.request.Request(url, json.dumps(body).encode(), {"Content-Type": "application/json"})
    urllib.request.urlopen(request).read()


if __name__ == "__main__":
    sys.exit(main())
