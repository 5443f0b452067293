"""Load on `hdev serve` on this machine: rows a second and the times of its answers; and what a kill costs.

    python benchmarks/service.py --vehicles 100 --seconds 20
    python benchmarks/service.py --kills 20
    python benchmarks/service.py --kills 20 --state postgresql://hdev@127.0.0.1/empty

Needs the extras `serve` and `test`. Rows are the demo's, sent by a few clients, each row once.
"""

import argparse
import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import httpx2 as httpx
import numpy as np

from experiments.live import running
from hdev_jax.fleet import demo_log

__all__ = ["main"]

COLUMNS = ["trip_id", "time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps", "mass_kg", "grade_rad",
           "energy_wh"]  # fmt: skip


def main() -> int:
    """Run it."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--vehicles", type=int, default=100)
    arguments.add_argument("--rate", type=float, default=5000.0, help="rows a second that are sent")
    arguments.add_argument("--seconds", type=float, default=20.0)
    arguments.add_argument("--batch", type=int, default=100, help="rows of a request, of one vehicle each")
    arguments.add_argument("--clients", type=int, default=4)
    arguments.add_argument("--kills", type=int, default=0, help="instead: kill -9 it so many times while rows come")
    arguments.add_argument("--state", help="an empty database of PostgreSQL (default: a file of SQLite)")
    a = arguments.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder, log = Path(name), demo_log(3, trips=12)
        files = log.write(folder / "log", truth=False)
        (folder / "sheets").mkdir()
        shutil.copy(files["sheet"], folder / "sheets" / "default.toml")
        rows = json.loads(str(log.frame[COLUMNS].to_json(orient="records")))
        if a.kills:
            return _killed(folder, rows, a.kills, a.state or str(folder / "state.sqlite"))
        _loaded(folder, rows, a)
    return 0


def _loaded(folder: Path, rows: list[dict[str, Any]], a: argparse.Namespace) -> None:
    """Rows come at a fixed rate, whatever the answers take: an answer's time counts from when its rows were due."""
    for watch in ((), ("--no-watch",)):
        for f in folder.glob("state.sqlite*"):
            f.unlink()
        name = "unwatched" if watch else "V"  # a server keeps the rows of the round before
        with running(folder, *watch, *(("--state", a.state) if a.state else ())) as (url, _):
            with httpx.Client(timeout=300) as http:  # what compiles, compiles first
                for part in (rows[:300], rows[300:600]):
                    body = {"rows": [{"vehicle_id": f"{name} warm", **r} for r in part]}
                    http.post(f"{url}/v1/rows", json=body).raise_for_status()
                    http.get(f"{url}/v1/vehicles/{name} warm").raise_for_status()
            parts = [(v, at) for at in range(0, len(rows) - a.batch, a.batch) for v in range(a.vehicles)]
            parts = parts[: int(a.rate * a.seconds / a.batch)]
            every = [json.dumps({"rows": [{"vehicle_id": f"{name}{v}", **r} for r in rows[at : at + a.batch]]}).encode()
                     for v, at in parts]  # fmt: skip
            begun, times = time.monotonic() + 0.1, []

            def client(k: int, url: str = url, every: list[bytes] = every, begun: float = begun,
                       times: list[float] = times) -> None:  # fmt: skip
                with httpx.Client(timeout=60) as http:
                    for i in range(k, len(every), a.clients):
                        due = begun + i * a.batch / a.rate
                        time.sleep(max(due - time.monotonic(), 0.0))
                        http.post(f"{url}/v1/rows", content=every[i]).raise_for_status()
                        times.append(time.monotonic() - due)

            threads = [threading.Thread(target=client, args=(k,)) for k in range(a.clients)]
            for t in threads:
                t.start()
            for t in threads:
                t.join()
            sent_s = time.monotonic() - begun
            httpx.get(f"{url}/v1/vehicles", timeout=600).raise_for_status()  # every row is used then
            used_s, ms = time.monotonic() - begun, 1e3 * np.quantile(times, [0.5, 0.99])
            count = a.batch * len(every)
            print(
                f"{'not watched' if watch else 'effects watched'}: {count:,} rows at {a.rate:,.0f} a second: "
                f"acknowledged {count / sent_s:,.0f} a second, used {count / used_s:,.0f} a second; answers after "
                f"{ms[0]:.0f} ms in the median, 99 % by {ms[1]:.0f} ms; requests of {a.batch} rows, {a.clients} "
                f"clients, {len({v for v, _ in parts})} vehicles, load of the machine {os.getloadavg()[0]:.1f}",
                flush=True,
            )


def _killed(folder: Path, rows: list[dict[str, Any]], kills: int, state: str) -> int:
    """Kill it while a batch is on its way, start it, send the batch again; then compare with one that ran through."""
    from hdev_jax.online.service import Fleet, Journal, sheets_in
    from hdev_jax.online.service.given import checked

    size, rng = max(len(rows) // (kills + 1), 1), np.random.default_rng(0)
    for k in range(kills + 1):
        part = {"rows": [{"vehicle_id": "T", **r} for r in rows[k * size : (k + 1) * size]]}
        with running(folder, "--no-watch", "--state", state) as (url, process):
            if k < kills:
                killer = threading.Timer(float(rng.uniform(0.0, 1.0)), lambda p=process: p.send_signal(signal.SIGKILL))
                killer.start()
                with contextlib.suppress(httpx.TransportError):
                    for i in range(0, len(part["rows"]), 10):
                        body = {"rows": part["rows"][i : i + 10]}
                        httpx.post(f"{url}/v1/rows", json=body, timeout=60)
                process.wait()
        with running(folder, "--no-watch", "--state", state) as (url, _):
            httpx.post(f"{url}/v1/rows", json=part, timeout=120).raise_for_status()
    import jax

    jax.config.update("jax_enable_x64", True)
    through = Fleet(Journal(":memory:"), sheets_in(folder / "sheets"), watch=False)
    through.put("fleet", checked([{"vehicle_id": "T", **r} for r in rows[: (kills + 1) * size]]))
    again = Fleet(Journal(state), sheets_in(folder / "sheets"), watch=False)
    own, other = (f.known("fleet", "T") for f in (again, through))
    same = own == other
    print(f"{kills} kills: {'the same' if same else 'ANOTHER'} state and counts as without: {own and own['rows']}")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
