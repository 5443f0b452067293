"""Speed of posteriors: `python benchmarks/posteriors.py [WHAT …] [--write]`; compiling apart, ratios in the same run.

recursive   a row more of one vehicle, and of 1,000 at once, with the prediction before and the coefficients after it
fleet       20 vehicles × 25,000 rows, hierarchical, linear-Gaussian: effective draws a second, first answer
kernel      20 × 1,000 rows, hierarchical, through the kernel's switch with Student-t noise: ours and NumPyro's NUTS,
            their speed and whether they have the same posterior once both have converged (over half an hour)
rows        the closed form in chunks, one piece again and again: one pass over 10 million rows, memory

All data are synthetic. Seconds are wall clock; where cores are shared, `cpu` (of this process) tells more. With --write
what was measured takes its place in docs/posteriors.md, with the command.
"""

import argparse
import os
import resource
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["main"]

DOC = Path(__file__).parents[1] / "docs" / "posteriors.md"
WHAT = ("recursive", "fleet", "kernel", "rows")
INTRO = """Time of the estimators of posteriors, on synthetic data. *Recursive*: one more row of a vehicle. *Fleet*: a
hierarchical linear-Gaussian model of 20 vehicles with 25,000 rows each. *Kernel*: a hierarchical model through the
kernel with Student-t noise, beside NumPyro's NUTS. *Rows*: the closed form over 10 million rows, in chunks."""
HEAD = ["| synthetic data | compiling [s] | measured | also measured | target |", "|---|---:|---:|---:|---:|"]
CONVERGED = 1.1  # R-hat above which draws say nothing of a speed or a mean
TABLE = (("road.c_rr", "1", 0.006, 0.0008), ("road.cda_m2", "m²", 5.6, 0.5))


class Clock:
    """Wall and CPU seconds of a call."""

    def __init__(self, call: Callable[[], Any]):
        wall, cpu = time.perf_counter(), time.process_time()
        self.result = call()
        self.wall, self.cpu = time.perf_counter() - wall, time.process_time() - cpu


def driving(rows: int, trips: int, seed: int, *, hills: float) -> Any:
    """Rows of 5 s on a road of random slopes up to `hills` either way (uphill only where it is negative)."""
    from hdev_jax.segments import Segments

    rng = np.random.default_rng(seed)
    n = rows * trips
    trip = np.repeat(np.arange(trips), rows)
    start, end = rng.uniform(4.0, 25.0, (2, n))
    end = start + 0.02 * (end - start)
    grade = rng.uniform(-hills, hills, n) if hills > 0 else rng.uniform(0.012, 0.03, n)
    channels = {"mass_kg": rng.uniform(18e3, 34e3, trips)[trip], "grade_rad": grade}
    return Segments(
        trip, trip, 5.0 * np.tile(np.arange(rows), trips), np.full(n, 5.0), 2.5 * (start + end), start, end, channels
    )


def fleet(vehicles: int, rows: int, *, hills: float, tails: bool) -> Any:
    """A truck, its table, a fleet's padded rows, the vehicle of each row and their true coefficients."""
    import jax.numpy as jnp

    from hdev_jax.inference import Coefficient, ParameterTable, padded
    from hdev_jax.physics import Driveline, Grouped, Machine, Vehicle
    from hdev_jax.physics.loads import Auxiliary
    from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling

    def truck(c_rr: Any, cda: Any) -> Vehicle:
        parts = (Inertia(np.asarray(1.0)), Grade(), Rolling(c_rr), Aero(cda), Auxiliary(np.asarray(0.0)))
        return Vehicle(parts, mass_kg=np.asarray(24e3), driveline=Driveline(np.asarray(0.91)),
                       machine=Machine(np.asarray(1.0), np.asarray(1.0)))  # fmt: skip

    rng = np.random.default_rng(7)
    s = driving(rows, vehicles, 1, hills=hills)
    truth = np.array([0.0066, 5.9]) + rng.standard_normal((vehicles, 2)) * np.array([0.0004, 0.3])
    true = truck(*(Grouped(jnp.asarray(truth[:, k]), "vehicle") for k in (0, 1)))
    y = np.asarray(true.predict(s, "battery_power_kw"))
    y = y + (np.hypot(2.0, 0.03 * y) * rng.standard_t(5, len(y)) if tails else 10.0 * rng.standard_normal(len(y)))
    table = ParameterTable(tuple(Coefficient(p, u, v, sd, sd, 0.0, np.inf) for p, u, v, sd in TABLE))
    return truck(np.asarray(0.006), np.asarray(5.6)), table, padded(s, y), np.asarray(s.vehicle), truth


def recursive() -> list[list[str]]:
    """Microseconds a row, one vehicle and 1,000."""
    import jax

    from hdev_jax.inference import Prior, Statistics, follow

    rng = np.random.default_rng(0)
    prior = Prior.of_table([0.0, 0.0], [1.0, 1.0], 0.5)
    x, r = rng.standard_normal((20_000, 2)), rng.standard_normal(20_000)
    one = jax.jit(lambda x, r: follow(prior, Statistics.zero(2), x, r, forgetting=0.999))
    many = jax.jit(jax.vmap(one))
    out = []
    for name, run, a, b, rows, limit in (
        ("one vehicle", one, x, r, 20_000, 50.0),
        ("1,000 vehicles by vmap", many, np.tile(x[:200], (1000, 1, 1)), np.tile(r[:200], (1000, 1)), 200_000, 1.0),
    ):
        first = Clock(lambda run=run, a=a, b=b: jax.block_until_ready(run(a, b)))
        times = [Clock(lambda run=run, a=a, b=b: jax.block_until_ready(run(a, b))) for _ in range(7)]
        wall, cpu = (1e6 * float(np.median([getattr(t, k) for t in times])) / rows for k in ("wall", "cpu"))
        out.append([f"recursive update, {name}", f"{first.wall:.1f}", f"{wall:.3g} µs a row", f"{cpu:.3g} µs cpu",
                    f"under {limit:g} µs"])  # fmt: skip
    return out


def linear_fleet() -> list[list[str]]:
    """The hierarchical linear-Gaussian posterior of 500,000 rows."""
    import jax

    from hdev_jax.inference import Rows, linear_fit
    from hdev_jax.inference.posterior.hierarchy import fleet_draws

    car, table, rows, vehicle, _ = fleet(20, 25_000, hills=-1.0, tails=False)
    piece = Rows(rows, vehicle, vehicle)
    first = Clock(lambda: linear_fit(car, table, lambda: [piece], "battery_power_kw", groups=20))
    again = Clock(lambda: linear_fit(car, table, lambda: [piece], "battery_power_kw", groups=20))
    drawn = Clock(lambda: fleet_draws(first.result, key=jax.random.key(0), chains=4, draws=2500))
    made = [
        Clock(lambda k=k: fleet_draws(first.result, key=jax.random.key(k), chains=4, draws=2500)) for k in (1, 2, 3)
    ]
    wall = float(np.median([t.wall for t in made]))
    q = made[0].result.quality()
    return [
        ["one pass and its check, 500,000 rows", f"{first.wall - again.wall:.1f}", f"{again.wall:.2f} s",
         f"{again.cpu:.2f} s cpu", "–"],
        ["first answer, reading and compiling included", "–", f"{first.wall + drawn.wall:.1f} s",
         f"{first.cpu + drawn.cpu:.1f} s cpu", "10 s"],
        ["effective draws per second (bulk ESS, smallest over all quantities)", "0", f"{q['ess_bulk'] / wall:,.0f} /s",
         f"R-hat {q['r_hat']:.3f}", "5,000 /s"],
        ["the same, of bulk and tail ESS", "0", f"{q['ess'] / wall:,.0f} /s", f"{q['draws']:.0f} draws", "5,000 /s"],
    ]  # fmt: skip


def through_kernel(vehicles: int, rows_each: int, draws: int, plain_draws: int) -> list[list[str]]:
    """Ours and NumPyro's NUTS on the same model and rows, and whether they agree where both have converged."""
    import arviz
    import jax

    from hdev_jax.inference import Rows, linear_fit
    from hdev_jax.inference.posterior.models import Model
    from hdev_jax.inference.posterior.nuts import compiled, coordinates, numpyro_nuts

    car, table, rows, vehicle, _ = fleet(vehicles, rows_each, hills=0.03, tails=True)
    piece = Rows(rows, vehicle, vehicle)
    begun = Clock(lambda: linear_fit(car, table, lambda: [piece], "battery_power_kw", groups=vehicles, robust=True))
    sigma = float(np.median(np.asarray(begun.result.posterior.sigma)))
    model = Model.of(car, table, rows, "battery_power_kw", noise=sigma, group=vehicle, groups=vehicles)
    placed = Clock(lambda: coordinates(model, begun.result.values, noise=sigma))
    run = compiled(model, chains=2, draws=draws, warm_up=300)
    first = Clock(lambda: run(model, placed.result, jax.random.key(0)))
    ours = Clock(lambda: run(model, placed.result, jax.random.key(1)))
    plain = Clock(
        lambda: numpyro_nuts(model, key=jax.random.key(2), chains=2, draws=plain_draws, warm_up=2 * plain_draws)
    )
    a, b = ours.result.quality(), plain.result.quality()
    apart = []
    for name in ("mean", "spread", "theta", "variance", "growth", "df"):
        each = [d.values[name].reshape(*d.values[name].shape[:2], -1).transpose(2, 0, 1)
                for d in (ours.result, plain.result)]  # fmt: skip
        for x, y in zip(*each, strict=True):
            error = np.sqrt(sum(np.var(q) / float(arviz.ess(q)) for q in (x, y)))
            apart.append(abs(float(x.mean() - y.mean())) / error)
    speed = [a["ess_bulk"] / ours.cpu, b["ess_bulk"] / plain.cpu]
    most = 2 * 3 * plain_draws / plain.cpu  # of two chains, were each step of theirs, warm-up and all, a draw by itself
    size = f"{vehicles} × {rows_each:,} rows"
    return [
        [f"ours, through the kernel, {size}", f"{placed.wall + first.wall - ours.wall:.0f}",
         f"{a['ess_bulk'] / ours.wall:.3g} /s", f"{speed[0]:.3g} /s cpu, R-hat {a['r_hat']:.3f}", "–"],
        [f"NumPyro's NUTS, {size} (compiling included)", "–", f"{b['ess_bulk'] / plain.wall:.3g} /s",
         f"{speed[1]:.3g} /s cpu, R-hat {b['r_hat']:.3f}", "–"],
        ["speed, ours over NumPyro's, if each step of NumPyro (warm-up too) were an independent draw", "–",
         f"{speed[0] / most:.3g}",
         "lower bound", "10"],
        *([] if b["r_hat"] > CONVERGED else [
            [f"speed, ours over NumPyro's, {size}", "–", f"{speed[0] / speed[1]:.3g}", "by CPU time", "10"],
            ["largest difference of the two posterior means", "–", f"{max(apart):.2g} Monte-Carlo sds",
             f"of {len(apart)} quantities", "about 3"],
        ]),
    ]  # fmt: skip


def many_rows(rows: int) -> list[list[str]]:
    """One pass over many chunks; they are one piece again and again, so that reading is not timed."""
    import jax

    from hdev_jax.inference import Rows, linear_fit

    car, table, one, _, _ = fleet(20, 3277, hills=-1.0, tails=False)
    count = -(-rows // one.rows)
    piece = Rows(one, np.zeros(one.rows, dtype=int))

    def read(n: int) -> Iterator[Rows]:
        for _ in range(n):
            yield piece

    jax.block_until_ready(linear_fit(car, table, lambda: read(1), "battery_power_kw", passes=1).statistics)
    took = [
        Clock(lambda n=n: linear_fit(car, table, lambda: read(n), "battery_power_kw", passes=1))
        for n in (count // 10, count)
    ]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    ratio = took[1].cpu / took[0].cpu * (count // 10) / count
    return [
        [
            f"one pass, {count * one.rows:,} rows in chunks",
            "–",
            f"{took[1].wall:.1f} s",
            f"{took[1].cpu:.1f} s cpu",
            "–",
        ],
        ["time per row over that of a tenth of the rows", "–", f"{ratio:.2f}", "by CPU time", "–"],
        ["peak memory", "–", f"{peak:.2f} GB", "", "4 GB"],
    ]


def _kept() -> dict[str, list[str]]:
    """The page's sections by name, as earlier commands left them."""
    sections: dict[str, list[str]] = {}
    for line in DOC.read_text(encoding="utf-8").splitlines() if DOC.exists() else []:
        if line.startswith("## "):
            sections[line.removeprefix("## ")] = [line]
        elif sections:
            sections[next(reversed(sections))].append(line)
    return {name: ["\n".join(lines).rstrip(), ""] for name, lines in sections.items()}


def main(argv: list[str] | None = None) -> int:
    """Measure, print, and with `--write` keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=[], choices=[*WHAT, []], help="all, where none is named")
    parser.add_argument("--rows", type=int, default=10_000_000)
    parser.add_argument("--draws", type=int, default=2000, help="of each chain, ours")
    parser.add_argument(
        "--plain-draws", type=int, default=500, help="of each chain, NumPyro's, after twice as many to warm up"
    )
    parser.add_argument("--write", action="store_true", help="keep the table in docs/posteriors.md")
    options = parser.parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    calls = {
        "recursive": recursive, "fleet": linear_fleet, "rows": lambda: many_rows(options.rows),
        "kernel": lambda: through_kernel(20, 1000, options.draws, options.plain_draws),
    }  # fmt: skip
    sections = _kept()
    print("\n".join(HEAD), flush=True)
    for name in options.what or WHAT:
        table, load = [*HEAD], os.getloadavg()[0]
        for row in calls[name]():
            table.append(f"| {' | '.join(row)} |")
            print(table[-1], flush=True)
        made = [f"Made by `python benchmarks/posteriors.py {shlex.join(sys.argv[1:])}`: {cores} cores, float64;",
                f"load average before the run {load:.1f}."]  # fmt: skip
        sections[name] = [f"## {name}", "", *made, "", *table, ""]
    if options.write:
        lines = ["# Posteriors: speed", "", INTRO, "", *(line for name in WHAT for line in sections.get(name, []))]
        DOC.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
