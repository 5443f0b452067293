"""The kernel against the same equations written by hand, on the demo's vehicle.

    python benchmarks/kernel.py [--rows 1000000] [--repeats 20] [--json FILE]

Contestants: `kernel`, the package's `Vehicle.energy`; `hand`, equations 3-5 of paper 1 as one jitted expression on
arrays; `numpy`, that expression in NumPy. Tasks: the energy of every row, its Jacobian in four parameters (forward
mode), the gradient of a squared-error loss (reverse mode). Compiling is timed apart from running; contestants take
turns, so that a busy machine slows them alike, and ratios are medians of the ratios within a turn.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.inference.parameters import ParameterTable
from hdev_jax.inference.sheet import build, read_sheet
from hdev_jax.physics import Vehicle
from hdev_jax.segments import Segments

SHEET = Path(__file__).parents[1] / "configs" / "vehicles" / "truck_34t.toml"
NAMES = ("road.c_rr", "road.cda_m2", "driveline.efficiency", "road.rotating_mass_factor")
TASKS = ("evaluation", "jacobian", "gradient")
LIMITS = {"kernel/hand": 1.3, "numpy/kernel": 3.0, "compile_s": 3.0}  # at most, at least, under


class Rows(NamedTuple):
    """The columns that the expression by hand reads."""

    mass_kg: Any
    grade_rad: Any
    duration_s: Any
    distance_m: Any
    speed_start_mps: Any
    speed_end_mps: Any


def by_hand(theta: Any, rows: Rows, xp: Any) -> Any:
    """Equations 3-5 of paper 1 [Wh], with `xp` either `numpy` or `jax.numpy`."""
    c_rr, cda_m2, efficiency, rotating = theta[0], theta[1], theta[2], theta[3]
    m, slope, dt, d, v0, v1 = rows
    force = (
        rotating * m * (v1 - v0) / dt
        + m * 9.80665 * (xp.sin(slope) + c_rr * xp.cos(slope))
        + 0.5 * 1.225 * cda_m2 * 0.5 * (v0 * v0 + v1 * v1)
    )
    joules = force * d
    return xp.where(joules > 0, joules / efficiency, joules * efficiency) / 3600.0


def drive(rows: int, seed: int = 0) -> Segments:
    """A made-up log of `rows` segments of 100 m in trips of 1000, with mass, slope and gear."""
    rng = np.random.default_rng(seed)
    ends = 15.0 + 8.0 * np.sin(np.cumsum(rng.normal(0.0, 0.1, rows + 1)))
    duration = 200.0 / (ends[1:] + ends[:-1])
    trip = np.arange(rows) // 1000
    clock = np.cumsum(duration) - duration
    return Segments(
        trip=trip,
        vehicle=np.zeros(rows, dtype=int),
        time_s=clock - clock[trip * 1000],
        duration_s=duration,
        distance_m=np.full(rows, 100.0),
        speed_start_mps=ends[:-1],
        speed_end_mps=ends[1:],
        channels={
            "mass_kg": rng.uniform(16e3, 34e3, rows),
            "grade_rad": rng.normal(0.0, 0.03, rows),
            "gear": rng.integers(1, 5, rows).astype(float),
        },
    )


def cast(tree: Any, dtype: Any) -> Any:
    """Every real leaf in this precision, on the device."""
    return jax.tree.map(
        lambda x: jnp.asarray(x, dtype if np.issubdtype(np.asarray(x).dtype, np.floating) else None), tree
    )


def contestants(segments: Segments, dtype: Any) -> dict[str, dict[str, Callable[[], Any]]]:
    """For each task: by name, a call that returns once its result is there, and `compile:name`, seconds to compile."""
    built = build(read_sheet(SHEET), segments, "road", "energy_wh")
    rows = tuple(r for name in NAMES for r in built.table.rows if r.name == name)
    table = ParameterTable(rows).with_free(**dict.fromkeys(NAMES, True))
    theta = jnp.asarray(table.values(built.vehicle), dtype)
    vehicle, log = cast(built.vehicle, dtype), cast(segments, dtype)
    hand_rows = Rows(
        *(jnp.asarray(log.channels[k]) for k in ("mass_kg", "grade_rad")),
        *(getattr(log, k) for k in ("duration_s", "distance_m", "speed_start_mps", "speed_end_mps")),
    )
    host = Rows(*(np.asarray(x, dtype=np.float64) for x in hand_rows))
    host_theta = np.asarray(theta, dtype=np.float64)

    def kernel(theta: Any, vehicle: Vehicle, log: Segments) -> Any:
        return table.insert(vehicle, theta).energy(log)

    def hand(theta: Any, rows: Rows) -> Any:
        return by_hand(theta, rows, jnp)

    measured = jnp.asarray(1.1 * by_hand(host_theta, host, np), dtype)

    def tasks(f: Callable) -> dict[str, Callable]:
        return {
            "evaluation": f,
            "jacobian": jax.jacfwd(f),
            "gradient": jax.grad(lambda theta, *args: jnp.mean((f(theta, *args) - measured) ** 2)),
        }

    found: dict[str, dict[str, Any]] = {}
    for task in TASKS:
        calls = {}
        for name, f, args in (("kernel", kernel, (theta, vehicle, log)), ("hand", hand, (theta, hand_rows))):
            start = time.perf_counter()
            ready = jax.jit(tasks(f)[task]).lower(*args).compile()
            calls[f"compile:{name}"] = time.perf_counter() - start
            calls[name] = lambda ready=ready, args=args: jax.block_until_ready(ready(*args))
        found[task] = calls
    found["evaluation"]["numpy"] = lambda: by_hand(host_theta, host, np)
    return found


def measure(calls: dict[str, Any], repeats: int) -> dict[str, Any]:
    """Median milliseconds of each contestant, ratios within a turn, and seconds to compile."""
    names = [n for n in calls if not n.startswith("compile:")]
    results = {n: np.asarray(calls[n]()) for n in names}  # warm, and the same answer
    reference = results["hand"].astype(float)
    scale = np.max(np.abs(reference))
    accuracy = 1e-9 if results["hand"].dtype == np.float64 else 1e-4
    for n in names:
        worst = np.max(np.abs(results[n] - reference)) / scale
        if worst > accuracy:
            raise SystemExit(
                f"{n} and hand differ by {worst:.1e} of the largest value; expected {accuracy:.0e} at most"
            )
    times: dict[str, list[float]] = {n: [] for n in names}
    for turn in range(repeats):
        for n in names if turn % 2 else reversed(names):
            start = time.perf_counter()
            calls[n]()
            times[n].append(time.perf_counter() - start)
    ratio = lambda a, b: float(np.median(np.array(times[a]) / np.array(times[b])))  # noqa: E731
    out = {f"{n}_ms": 1e3 * float(np.median(times[n])) for n in names}
    out["kernel/hand"] = ratio("kernel", "hand")
    if "numpy" in names:
        out["numpy/kernel"] = ratio("numpy", "kernel")
    return out | {"compile_s": calls["compile:kernel"], "compile_hand_s": calls["compile:hand"]}


def main(argv: list[str] | None = None) -> int:
    """Print the table; exit status 1 where a limit is missed in float64."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    args = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)

    device = jax.devices()[0]
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    print(f"{args.rows:,} rows, {args.repeats} turns, {device.device_kind}, {cpus} CPUs, JAX {jax.__version__}")
    head = ("dtype", "task", "kernel ms", "hand ms", "numpy ms", "kernel/hand", "numpy/kernel", "compile s", "hand")
    print("{:9}{:12}{:>10}{:>10}{:>10}{:>13}{:>14}{:>11}{:>8}".format(*head))
    segments = drive(args.rows)
    results: dict[str, Any] = {}
    for dtype in (jnp.float64, jnp.float32):
        name = jnp.dtype(dtype).name
        calls = contestants(segments, dtype)
        for task in TASKS:
            r = results[f"{name}/{task}"] = measure(calls[task], args.repeats)
            print(
                f"{name:9}{task:12}{r['kernel_ms']:10.2f}{r['hand_ms']:10.2f}"
                + (f"{r['numpy_ms']:10.2f}" if "numpy_ms" in r else f"{'':10}")
                + f"{r['kernel/hand']:13.2f}"
                + (f"{r['numpy/kernel']:14.2f}" if "numpy/kernel" in r else f"{'':14}")
                + f"{r['compile_s']:11.2f}{r['compile_hand_s']:8.2f}"
            )
    if args.json:
        about = {"rows": args.rows, "repeats": args.repeats, "device": device.device_kind, "cpus": cpus}
        versions = {"jax": jax.__version__, "numpy": np.__version__, "python": platform.python_version()}
        args.json.write_text(json.dumps(about | versions | {"results": results}, indent=1) + "\n", encoding="utf-8")

    missed = []
    for task in TASKS:
        r = results[f"float64/{task}"]
        if r["kernel/hand"] > LIMITS["kernel/hand"]:
            missed.append(
                f"{task}: {r['kernel/hand']:.2f} times the expression by hand, at most {LIMITS['kernel/hand']}"
            )
        if r["compile_s"] >= LIMITS["compile_s"]:
            missed.append(f"{task}: {r['compile_s']:.1f} s to compile, expected under {LIMITS['compile_s']:.0f}")
    if (r := results["float64/evaluation"])["numpy/kernel"] < LIMITS["numpy/kernel"]:
        missed.append(
            f"evaluation: {r['numpy/kernel']:.2f} times faster than NumPy, at least {LIMITS['numpy/kernel']:.0f}"
        )
    print("float64 within the limits" if not missed else "MISSED\n  " + "\n  ".join(missed))
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
