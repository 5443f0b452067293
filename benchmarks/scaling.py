"""Scoring every candidate on logs of up to ten million rows: `python benchmarks/scaling.py [ROWS …] [--write]`.

A synthetic log comes in pieces that are made as they are read: the demo's truck on the roads of 262 trips, over and
over, each time with noise of its own. The vehicle is calibrated on the first piece; what is timed is `look_through`,
from the first reading to the scores. Each size runs in a process of its own, so that peaks do not mix, and compiles on
two pieces first. With --write the table is kept in docs/scaling.md. Exit status 1 where a limit is missed.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

__all__ = ["main"]

SIZES = (10_000, 100_000, 550_000, 1_000_000, 10_000_000)
TRIPS = 262  # of 250 rows: a chunk
NOISE_AR = 0.9
LEAST_EFFECTS = 40  # scored on the log, each by columns of its own
LIMITS = {550_000: (60.0, 3.0), 10_000_000: (np.inf, 4.0)}  # rows: seconds after compiling, GB
PER_ROW = 1.5  # seconds a row of the largest log over those of 100,000 rows, at most
DOC = Path(__file__).parents[1] / "docs" / "scaling.md"


def measure(rows: int, seed: int) -> dict[str, float]:
    """One size: what there is to score, seconds to compile and to run, peak memory [GB]."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from hdev_jax.diagnosis.scores.stream import Piece, look_through
    from hdev_jax.fleet import demo_log
    from hdev_jax.inference import calibrate, cluster_rows, padded
    from hdev_jax.inference.sheet import read_sheet
    from hdev_jax.logs import read_log
    from hdev_jax.physics import LIBRARY
    from hdev_jax.problem import prepare

    made = demo_log(seed, trips=TRIPS)
    _more_channels(made.frame, np.random.default_rng(seed))
    with tempfile.TemporaryDirectory() as folder:
        files = made.write(folder, truth=False)
        problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    base, clean = problem.segments, made.truth["noise_free"].to_numpy()

    def pieces(rows: int) -> Iterator[Piece]:
        for i, start in enumerate(range(0, rows, len(base))):
            n = min(len(base), rows - start)
            white = np.random.default_rng([seed, i]).standard_normal(n)
            noise = made.noise_rms * signal.lfilter([np.sqrt(1 - NOISE_AR**2)], [1, -NOISE_AR], white)
            part = base.take(np.arange(n))
            yield replace(part, trip=part.trip + i * TRIPS), clean[:n] + noise

    segments, measured = next(pieces(min(rows, len(base))))
    fit = calibrate(problem.vehicle, problem.table, padded(segments, measured), problem.target, cluster_rows(segments))

    def run(rows: int):
        start = time.perf_counter()
        scores = look_through(lambda: pieces(rows), fit, list(LIBRARY.values()), problem.target)
        return time.perf_counter() - start, scores

    few = min(rows, 2 * len(base))
    first, again = run(few)[0], run(few)[0]
    seconds, scores = run(rows)
    best = max(scores.best.values(), key=lambda s: s.gain).candidate.id
    return {
        "rows": rows, "trips": scores.baseline.trips, "clusters": scores.white.count, "compile_s": first - again,
        "run_s": seconds, "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
        "effects": len({c.id for c in scores.source.candidates}), "ways": len(scores.source.candidates),
        "columns": scores.source.width, "best": best,
    }  # fmt: skip


def _more_channels(frame: Any, rng: np.random.Generator) -> None:
    """Channels that the demo's log lacks, so that more of the library can be tried: a gap to the vehicle ahead,
    people on board, the kind of surface."""
    n = len(frame)
    frame["gap_m"] = rng.uniform(15.0, 120.0, n)
    frame["passengers"] = rng.integers(0, 40, n)
    frame["road_surface"] = rng.integers(0, 3, n)


def table(results: list[dict], cores: int) -> list[str]:
    """The page, line by line."""
    from hdev_jax.inference.clusters import MOST_CLUSTERS

    r = results[-1]
    lines = [
        "# Scoring and the length of a log",
        "",
        "Made by `python benchmarks/scaling.py --write`. All logs are synthetic: the demo's truck with a few more",
        "channels, AR(1) noise, a headwind that the sheet does not declare. The time is that of scoring all candidates",
        "once: rows (generated, not read from a file), noise, generalised least squares of the coefficients, columns",
        "of the candidates, whitening, Gram matrices, scores. The vehicle was calibrated on the first part of the log.",
        f"A cluster is a trip; with more than {MOST_CLUSTERS} trips, neighbouring trips share a cluster.",
        "",
        f"Candidates: {r['effects']} effects in {r['ways']} forms, with {r['columns']} columns (a form: the effect",
        f"with given thresholds and time constants; forms share columns); {cores} cores, float64.",
        "",
        "| rows (synthetic) | trips | clusters | compiling [s] | running [s] | s per million rows | peak memory [GB] |",
        "|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for r in results:
        lines.append(
            f"| {r['rows']:,} | {r['trips']:,} | {r['clusters']} | {r['compile_s']:.1f} | {r['run_s']:.1f} | "
            f"{r['run_s'] / r['rows'] * 1e6:.1f} | {r['peak_gb']:.2f} |"
        )
    return lines


def missed(results: list[dict]) -> list[str]:
    """What is over its limit."""
    out = []
    by_rows = {r["rows"]: r for r in results}
    for rows, (seconds, memory) in LIMITS.items():
        if (r := by_rows.get(rows)) and (r["run_s"] > seconds or r["peak_gb"] > memory):
            out.append(f"{rows:,} rows: {r['run_s']:.0f} s and {r['peak_gb']:.1f} GB, at most {seconds} s, {memory} GB")
    per_row = {n: r["run_s"] / n for n, r in by_rows.items()}
    if 100_000 in per_row and (ratio := per_row[max(per_row)] / per_row[100_000]) > PER_ROW:
        out.append(f"{max(per_row):,} rows: {ratio:.2f} times the seconds a row of 100,000, at most {PER_ROW}")
    few = [r for r in results if r["effects"] < LEAST_EFFECTS]
    return out + [f"{r['effects']} effects ({r['columns']} columns), at least {LEAST_EFFECTS} expected" for r in few]


def main(argv: list[str] | None = None) -> int:
    """Measure, print, and with `--write` keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", type=int, default=SIZES)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--write", action="store_true", help="keep the table in docs/scaling.md")
    parser.add_argument("--here", action="store_true", help="measure one size in this process and print it as JSON")
    options = parser.parse_args(argv)
    if options.here:
        print(json.dumps(measure(options.rows[0], options.seed)))
        return 0
    results = []
    for rows in sorted(options.rows):
        command = [sys.executable, __file__, str(rows), "--seed", str(options.seed), "--here"]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        results.append(r := json.loads(done.stdout.splitlines()[-1]))
        print(
            f"{rows:>12,} rows, {r['effects']} effects, {r['columns']} columns: compiling {r['compile_s']:.1f} s, "
            f"running {r['run_s']:.1f} s, {r['run_s'] / rows * 1e6:.1f} s per million rows, {r['peak_gb']:.2f} GB",
            flush=True,
        )
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    lines = table(results, cores)
    print("\n".join(lines))
    if options.write:
        DOC.write_text("\n".join(lines) + "\n", encoding="utf-8")
    over = missed(results)
    print("within the limits" if not over else "MISSED\n  " + "\n  ".join(over))
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
