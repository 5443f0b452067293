"""Tables II and III and figures 4-8 of paper 2: the trips themselves, from the public files."""

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from experiments.paper2.data import MPH, TripName, kia_fingerprint, kia_trips
from experiments.paper2.drawings import signals_figure, speeds_figure
from experiments.runner.config import Strict
from experiments.runner.tables import readable, write_tables
from hdev_jax.learn.sequences import energy_kwh
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("data.py",)
MILE_M = 1609.344  # the international mile (1959)


class Config(Strict):
    """`table`: statistics by trip beside the paper's; `figure`: "speeds" (figure 4) or "signals" of `trip` (5-8)."""

    experiment: Literal["paper2.trips"]
    artefact: str
    caption: str
    figure: Literal["", "speeds", "signals"] = ""
    trip: TripName = "1"
    paper: dict[str, dict[str, float]] = Field(default_factory=dict)
    reasons: dict[str, str] = Field(default_factory=dict)
    rows: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each trip."""
    for trip in ("1", "2", "3", "4"):
        yield {"trip": trip, "rows": config.rows, "data": kia_fingerprint()}


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Duration, distance, speeds, accelerations, jerk, power and energy of one trip; quartiles of speed."""
    trip = kia_trips(task["rows"] or None)[task["trip"]]
    speed, dt = trip.inputs["speed_mps"], trip.dt_s
    accel = trip.inputs["accel_mps2"]  # the accelerometer: its extremes are the paper's
    jerk = np.diff(accel) / dt
    power = np.asarray(trip.target)
    return {
        "duration_min": len(trip) * dt / 60.0,
        "average_speed_mph": float(speed.mean() / MPH),
        "distance_miles": float(speed.sum() * dt / MILE_M),
        "max_acceleration_mps2": float(accel.max()), "max_deceleration_mps2": float(accel.min()),
        "max_jerk_mps3": float(jerk.max()), "min_jerk_mps3": float(jerk.min()),
        "max_power_kw": float(power.max()), "min_power_kw": float(power.min()),
        "energy_kwh": energy_kwh(power, dt)[0],
        "speed_quartiles_mph": [float(q / MPH) for q in np.quantile(speed, [0.0, 0.25, 0.5, 0.75, 1.0])],
    }  # fmt: skip


def collect(config: Config, results: Any, run: Run) -> dict[str, Any]:
    """Rows by quantity, keys by trip."""
    found = {task["trip"]: result for task, result in results}
    rows, lines = [], []
    measured = [k for k in found["1"] if k in config.paper]
    for name in [*measured, *config.reasons]:
        paper = config.paper.get(name)
        if name in config.reasons:
            rows.append({"name": name, "paper": paper, "ours": None, "reason": config.reasons[name]})
            beside = _beside({}, paper or {})
            lines.append({"quantity": readable(name), **beside, "why no value": config.reasons[name]})
            continue
        ours = {f"trip{t}": found[t][name] for t in found}
        rows.append({"name": name, "paper": paper, "ours": ours})
        lines.append({"quantity": readable(name), **_beside(ours, paper or {})})
    if config.figure == "speeds":
        speeds_figure(run, {t: kia_trips(config.rows or None)[t] for t in found})
        rows = [{"name": f"trip{t}", "paper": None, "ours": {"speed_quartiles_mph": r["speed_quartiles_mph"]}}
                for t, r in found.items()]  # fmt: skip
        words = ("minimum", "lower quartile", "median", "upper quartile", "maximum")
        lines = [{"trip": t, **dict(zip(words, r["speed_quartiles_mph"], strict=True))} for t, r in found.items()]
    elif config.figure == "signals":
        signals_figure(run, kia_trips(config.rows or None)[config.trip])
        own = found[config.trip]
        rows = [{"name": f"trip{config.trip}", "paper": None, "ours": own}]
        lines = [{"quantity": readable(k), "value": x} for k, x in own.items() if k != "speed_quartiles_mph"]
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False, "rows": rows,
        "better_than_paper": 0, "of": 0, "logs": 1 if config.figure == "signals" else len(found),
    }  # fmt: skip


def _beside(ours: Mapping[str, float], paper: Mapping[str, float]) -> dict[str, Any]:
    """By trip: the paper's number, then ours."""
    shown = lambda x: "–" if x is None else f"{x:.3g}"  # noqa: E731
    return {
        t.replace("trip", "trip "): f"{shown(paper.get(t))} → {shown(ours.get(t))}"
        for t in dict.fromkeys([*paper, *ours])
    }
