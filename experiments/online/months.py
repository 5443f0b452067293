"""Months of driving with nothing planted: how many vehicles have an alarm?

One task is one drive of a month, with as many vehicles on it as noises are drawn, all watched at once for every effect
of the library. An alarm of any of them is false.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field

from experiments.online.study import Noise, rows_of, watching
from experiments.runner.config import Strict
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import wilson, write_tables
from hdev_jax.fleet import synthetic_log
from hdev_jax.fleet.noise import noise_of_one
from hdev_jax.online import State, update
from hdev_jax.report.canvas import AFTER, BEFORE, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("study.py",)


class Config(Strict):
    """Drives of a month for each noise, and vehicles on each."""

    experiment: Literal["online.months"]
    artefact: str
    caption: str
    seed: int = Field(0, ge=0)
    noises: list[Noise]
    drives: int = Field(ge=1)  # of each noise
    vehicles: int = Field(ge=1)  # on each drive
    trips: int = Field(ge=3)
    rows_per_trip: int = Field(ge=60)  # of 100 m
    ar_coefficient: float = 0.85
    at_most: float = 0.01  # share of the vehicles with an alarm


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """A drive each."""
    for k in range(config.drives):
        for n, noise in enumerate(config.noises):
            seed = config.seed + k * len(config.noises) + n
            yield {"noise": noise, "seed": seed, "trips": config.trips, "vehicles": config.vehicles,
                   "rows_per_trip": config.rows_per_trip, "ar_coefficient": config.ar_coefficient}  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """The rows, and at which of them each vehicle had an alarm (0: none)."""
    made = synthetic_log(seed=task["seed"], trips=task["trips"], rows_per_trip=task["rows_per_trip"])
    state, watch = watching(made)
    rows = rows_of(state, made.frame)
    lengths = made.frame.groupby("trip_id", sort=False).size().to_numpy()
    rng = np.random.default_rng([task["seed"], 5])
    noise = [noise_of_one(rng, lengths, task["noise"], task["ar_coefficient"]) for _ in range(task["vehicles"])]
    measured = made.truth["noise_free"].to_numpy() + made.noise_rms * np.stack(noise)
    alarms = _alarm_rows(state, rows, measured, watch.columns(rows))
    return {"rows": len(rows), "alarm_at": np.asarray(alarms).max(axis=-1).tolist()}


@eqx.filter_jit
def _alarm_rows(state: State, rows: Any, measured: Any, columns: Any) -> Any:
    at = state.form.columns.index("measured")

    def step(s: State, x: Any) -> tuple[State, None]:
        row, y, column = x
        return update(s, row.at[at].set(y), column)[0], None

    def of_one(y: Any) -> Any:
        return jax.lax.scan(step, state, (jnp.asarray(rows), y, jnp.asarray(columns)))[0].alarm_at

    return jax.vmap(of_one)(jnp.asarray(measured))


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """A line for each noise and one for all; a figure of the alarms over the rows."""
    lines = [_line(noise, [r for t, r in results if t["noise"] == noise]) for noise in config.noises]
    total = _line("all", [r for _, r in results])
    write_tables(run, "months", [*lines, total], config.caption)
    _figure(run, config, results)
    said = f"{total['with_alarm']} of {total['vehicle_months']} have an alarm, target {config.at_most:.0%}"
    missed = [said] if total["with_alarm"] > config.at_most * total["vehicle_months"] else []  # a noise has too few
    many = total["vehicle_months"] // total["drives"]
    shared = f"but {many} vehicles share each of {total['drives']} drives and differ only in noise"
    had = f"False alarms: {total['with_alarm']} in {total['vehicle_months']} vehicle-months"
    how_sure = f"95 % interval {total['interval_95']} if they were independent; {shared}"
    findings = [f"{had} of {total['km_a_month']:.0f} km ({how_sure})"]
    rows = [{"name": x["name"], "paper": None, "ours": x} for x in (*lines, total)]
    return {"artefact": config.artefact, "data": "synthetic logs", "synthetic": True, "rows": rows,
            "better_than_paper": 0, "of": 0, "missed": missed, "findings": findings}  # fmt: skip


def _line(name: str, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    alarms = np.concatenate([r["alarm_at"] for r in results])
    low, high = wilson(int(np.sum(alarms > 0)), len(alarms))
    return {
        "name": name, "drives": len(results), "vehicle_months": len(alarms),
        "km_a_month": sum(r["rows"] for r in results) / len(results) / 10.0,
        "with_alarm": int(np.sum(alarms > 0)), "interval_95": f"{100 * low:.1f} to {100 * high:.1f} %",
    }  # fmt: skip


@styled
def _figure(run: Run, config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> None:
    """Vehicles with an alarm by the distance driven, all noises together, with Wilson's 95 % interval."""
    fig = figure(6.0, 3.2)
    ax = fig.add_subplot()
    alarms = np.concatenate([r["alarm_at"] for _, r in results])
    had = np.sort(alarms[alarms > 0])
    at = [0.0, *(had / 10.0), max(r["rows"] for _, r in results) / 10.0]
    counts = [*range(len(had) + 1), len(had)]
    low, high = np.transpose([wilson(k, len(alarms)) for k in counts])
    ax.fill_between(
        at,
        100 * low,
        100 * high,
        step="post",
        color=AFTER,
        alpha=0.2,
        lw=0,
        label="95 % interval",
    )
    ax.step(at, 100 * np.array(counts) / len(alarms), where="post", color=AFTER, label=f"{len(alarms)} vehicles")
    ax.axhline(100.0 * config.at_most, color=BEFORE, ls="--", lw=1, label=f"target: at most {config.at_most:.0%}")
    ax.set(xlabel="driven [km]", ylabel="vehicles with an alarm [%]", ylim=(0, None), xlim=(0, at[-1]))
    ax.set_title("Synthetic vehicles with nothing planted")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=3)
    tidy(ax)
    save_figure(run, fig, "watch_months")
