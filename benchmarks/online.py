"""Row by row: one row from Python, a log by scan, and many vehicles at once, each with what it takes to compile.

`python benchmarks/online.py` prints what was measured and whether it is within the limits: one row at most 200 µs, and
10,000 vehicles at 1 Hz on half a core. Beside it, in the same run, the closed form of `inference/linear.py` by `scan`.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.runner.pages.site import wrapped
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import Prior, Statistics, follow
from hdev_jax.inference.sheet import Sheet
from hdev_jax.online import State, Watch, scan, start, update
from hdev_jax.online.live import Live

LIMITS = {"one_row_us": 200.0, "vehicles_core": 0.5}
PAGE = Path(__file__).parents[1] / "docs" / "online_speed.md"
CHANNELS = ("mass_kg", "grade_rad", "ambient_temp_c", "wind_speed_mps", "wind_from_rad", "heading_rad", "soc")


def sheet() -> Sheet:
    """A truck with four coefficients to estimate."""
    return Sheet(
        mass_kg=29e3, road={"c_rr": (0.006, 0.0008), "cda_m2": (5.6, 0.5)}, driveline={"efficiency": (0.91, 0.02)},
        battery={"auxiliary_w": (1000.0, 1000.0)},
    )  # fmt: skip


def rows_of(state: State, seed: int = 1) -> np.ndarray:
    """A synthetic log as rows `[row, column]`."""
    frame = synthetic_log(seed=seed, trips=8, rows_per_trip=250).frame
    named = {"measured": frame["energy_wh"], "trip": frame["trip_id"].str[1:].astype(float)}
    return np.stack([np.asarray(named.get(c, frame.get(c)), float) for c in state.form.columns], axis=1)


def page(m: dict[str, Any]) -> str:
    """The measurements as a page of the site."""
    rows = [
        ("one row from Python (`Live`), median", f"{m['one_row_us']:.0f} µs", f"{LIMITS['one_row_us']:.0f} µs"),
        (f"the same with {m['candidates']} forms of effects watched, their columns given",
         f"{m['one_row_watched_us']:.0f} µs", ""),
        ("computing these columns for one row, not included above", f"{m['columns_of_one_row_us'] / 1e3:.1f} ms", ""),
        ("one row of a log, by `scan`", f"{m['scan_us']:.1f} µs", ""),
        ("recursive least squares alone, for comparison: white noise, no random intercepts, no kernel "
         "(`inference/linear.py`)",
         f"{m['closed_form_scan_us']:.1f} µs", ""),
        (f"{m['vehicles']:,} vehicles at once, by `vmap`", f"{m['vehicles_rows_per_s']:,.0f} rows a second", ""),
        ("10,000 vehicles at 1 Hz, CPU time alone", f"{m['vehicles_core']:.2f} of a core",
         f"{LIMITS['vehicles_core']:g}"),
        ("compiling: one row, one row watched, many vehicles",
         ", ".join(f"{m[f'{k}_compile_s']:.1f} s" for k in ("one_row", "one_row_watched", "vehicles")), ""),
    ]  # fmt: skip
    lines = [
        "# Estimates row by row: time", "",
        "Made by `python benchmarks/online.py --write`: a truck with four coefficients and seven channels, float64, "
        f"{m['cores']} cores, one thread (load average before the run: {m['load']:.1f}). Each row is predicted by "
        f"{m['members']} models of the noise, which are weighted and updated. *Cores* counts CPU time; *rows a second* "
        "is by the clock, on a machine with other work.", "",
        "| | measured | target, at most |", "|---|---:|---:|",
        *(f"| {what} | {value} | {limit} |" for what, value, limit in rows),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Print what was measured; 1 where a limit is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--write", action="store_true", help="write docs/online_speed.md")
    given = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    out: dict[str, Any] = {"cores": os.cpu_count(), "vehicles": given.vehicles, "load": os.getloadavg()[0]}
    state, _ = start(sheet(), CHANNELS)
    watch = Watch.of(state)
    watching, _ = start(sheet(), CHANNELS, candidates=watch.candidates)
    rows = rows_of(state)
    columns = watch.columns(rows)
    out["members"] = len(state.form.members)
    out["candidates"] = len(watch.candidates)
    for name, begun, each in (("one_row", state, np.zeros((len(rows), 0))), ("one_row_watched", watching, columns)):
        live = Live(begun)
        started = time.perf_counter()
        live(rows[0], each[0])
        out[f"{name}_compile_s"] = time.perf_counter() - started
        seconds = []
        for row, c in zip(rows[1:], each[1:], strict=True):
            started = time.perf_counter()
            live(row, c)
            seconds.append(time.perf_counter() - started)
        out[f"{name}_us"] = 1e6 * float(np.median(seconds))
        out[f"{name}_p99_us"] = 1e6 * float(np.quantile(seconds, 0.99))
    seconds = []
    for row in rows[:20]:
        started = time.perf_counter()
        watch.columns(row[None])
        seconds.append(time.perf_counter() - started)
    out["columns_of_one_row_us"] = 1e6 * float(np.median(seconds))
    scan(state, rows)[0].mean.block_until_ready()
    x, r = jnp.asarray(np.random.default_rng(0).normal(size=(len(rows), 4))), jnp.asarray(rows[:, 6])
    closed = jax.jit(lambda x, r: follow(Prior.of_table(np.zeros(4), np.ones(4), 10.0), Statistics.zero(4), x, r))
    jax.block_until_ready(closed(x, r))
    ours, theirs = [], []
    for _ in range(given.repeats):  # in turn, so that what else the machine does falls on both
        started = time.perf_counter()
        scan(state, rows)[0].mean.block_until_ready()
        ours.append(time.perf_counter() - started)
        started = time.perf_counter()
        jax.block_until_ready(closed(x, r))
        theirs.append(time.perf_counter() - started)
    out["scan_us"] = 1e6 * float(np.median(ours)) / len(rows)
    out["closed_form_scan_us"] = 1e6 * float(np.median(theirs)) / len(rows)
    out["scan_over_closed_form"] = out["scan_us"] / out["closed_form_scan_us"]

    n = given.vehicles
    many = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)).copy(), state)
    step = jax.jit(jax.vmap(update), donate_argnums=0)
    at = jnp.asarray(np.broadcast_to(rows[0], (n, rows.shape[1])))
    started = time.perf_counter()
    many, now = step(many, at)
    now.predicted.block_until_ready()
    out["vehicles_compile_s"] = time.perf_counter() - started
    walls, cores = [], []
    for row in rows[1 : 2 + given.repeats]:
        at = jnp.asarray(np.broadcast_to(row, (n, rows.shape[1])))
        started, cpu = time.perf_counter(), time.process_time()
        many, now = step(many, at)
        now.predicted.block_until_ready()
        walls.append(time.perf_counter() - started)
        cores.append(time.process_time() - cpu)
    out["vehicles_rows_per_s"] = n / float(np.median(walls))
    out["vehicles_core"] = float(np.median(cores)) / n * 10_000
    for key, value in out.items():
        print(f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}")
    if given.json:
        given.json.write_text(json.dumps(out, indent=1) + "\n")
    if given.write:
        PAGE.write_text(wrapped(page(out)))
    missed = [f"{k} {out[k]:.3g}, at most {limit:g}" for k, limit in LIMITS.items() if out[k] > limit]
    print("within the limits" if not missed else "MISSED\n  " + "\n  ".join(missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
