"""The total mass from the energy (or force) that a vehicle took: by trip on the fleet, by stop on measured buses.

c_rr and drag area are first learnt on other trips of the same vehicle, with the mass that the log claims; then every
trip (bus: every stretch between two changes of the number of passengers) has a posterior of its mass, whatever the log
claims. On the fleet against the truth; on ZTBus the slope against the passengers who were counted. The number of
passengers takes no part in a held-out mission's masses: they are of its forces, speeds and the map's slope alone.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import equinox as eqx
import numpy as np
from pydantic import Field

from experiments.paper1.halves import coefficient, paper_table
from experiments.runner.config import CONFIGS, Strict
from experiments.runner.data import MissingDataError, data_folder, fingerprint
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import write_tables
from hdev_jax.inference import Rows, cluster_rows, linear_fit, padded
from hdev_jax.inference.mass import loads, mass_posterior, with_sd
from hdev_jax.report.canvas import AFTER, GREY, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("../paper1/halves.py",)
ADAPTER = CONFIGS / "adapters" / "ztbus.toml"
BRAKES_ON_PA = 2e4  # above this the force at the wheels is not the motor's alone
SHORTEST_KM = 0.3  # a stretch between two stops


class Config(Strict):
    """The fleet's models and routes, and the buses' missions."""

    experiment: Literal["calibration.mass"]
    artefact: str
    caption: str
    models: list[str]
    routes: int = 60
    learnt_on: int = 20  # routes whose mass is taken as logged
    buses: list[str]
    missions: int = 3  # that c_rr and drag are learnt on; and as many that are held out
    rows: int = 0  # of each mission; 0: all
    within_percent: float = 3.0
    slope_kg: list[float]
    seed: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One for each model, one for each bus whose missions are there."""
    for name in config.models:
        yield {
            "kind": "fleet",
            "model": name,
            "routes": config.routes,
            "learnt_on": config.learnt_on,
            "seed": config.seed,
        }
    try:
        folder = data_folder("ztbus")
    except MissingDataError:
        return
    for bus in config.buses:
        files = [p for p in sorted(folder.glob(f"{bus}_*.csv*")) if ".grade." not in p.name]
        learn, held = files[: 2 * config.missions : 2], files[1 : 2 * config.missions : 2]
        yield {"kind": "ztbus", "model": bus, "learn": [p.name for p in learn], "held": [p.name for p in held],
               "rows": config.rows, "data": fingerprint([*learn, *held])}  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Masses, their sds, distances, and what they are held against."""
    return {"fleet": _fleet, "ztbus": _ztbus}[task["kind"]](task)


def _fleet(task: dict[str, Any]) -> dict[str, Any]:
    from hdev_jax.fleet import simulate

    settings = {"seed": task["seed"] + 1, "routes": task["routes"], "variants": [task["model"]]}
    vehicle = simulate(settings).vehicles[0]
    v, s, y = vehicle.variant, vehicle.segments, vehicle.energy_wh
    table = paper_table(v.c_rr, v.cda_m2).plus(
        coefficient("battery.auxiliary_w", "W", v.auxiliary_w, 1500.0, positive=False)
    )
    trip = np.asarray(s.trip)
    learn = trip < task["learnt_on"]
    clusters = cluster_rows(s.take(learn))
    rows = Rows(padded(s.take(learn), y[learn]), clusters.ids)
    known = linear_fit(vehicle.tabular, table, lambda: [rows], "energy_wh", clusters=clusters.count, robust=True)
    empty, full = v.mass_kg
    found = mass_posterior(
        table.insert(vehicle.tabular, known.values), with_sd(table, known.values, known.sd), s.take(~learn), y[~learn],
        "energy_wh", mass_kg=0.5 * (empty + full), sd_kg=0.5 * (full - empty), inflation=known.inflation,
    )  # fmt: skip

    def mean(x: np.ndarray) -> list[float]:
        return [float(np.mean(x[trip == t])) for t in np.unique(trip[~learn])]

    return {
        "mass": found.mass_kg.tolist(), "sd": found.sd_kg.tolist(), "km": found.km.tolist(),
        "against": mean(vehicle.truth["mass_kg"]), "logged": mean(np.asarray(s.channels["mass_kg"])),
    }  # fmt: skip


def _mission(name: str, rows: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Rows in motion without the service brake; force; the stretch that each row is of."""
    from hdev_jax.logs import read_log

    log = read_log([data_folder("ztbus") / name], ADAPTER)
    s, y = log.segments, np.asarray(log.target("traction_force_n"))
    stretch = loads(s)
    on = (np.asarray(s.speed_mps) > 1.0) & (np.nan_to_num(np.asarray(s.channels["brake_pressure_pa"])) <= BRAKES_ON_PA)
    kept = {k: x for k, x in s.channels.items() if k in ("grade_rad", "mass_kg", "passengers")}
    at = np.flatnonzero(on)[: rows or None]
    return eqx.tree_at(lambda q: q.channels, s, kept).take(at), y[at], stretch[at]


def _ztbus(task: dict[str, Any]) -> dict[str, Any]:
    from hdev_jax.physics import Driveline, Machine, Vehicle
    from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling

    table = paper_table((0.0080, 0.0016), (6.0, 1.0))  # as in paper1/table1.py
    car = Vehicle((Inertia(np.asarray(1.0)), Grade(), Rolling(np.asarray(0.008)), Aero(np.asarray(6.0))),
                  mass_kg=np.asarray(2e4), driveline=Driveline(np.asarray(1.0)),
                  machine=Machine(np.asarray(1.0), np.asarray(1.0)))  # fmt: skip
    pieces = []
    for k, name in enumerate(task["learn"]):
        s, y, _ = _mission(name, task["rows"])
        clusters = cluster_rows(s)
        pieces.append(Rows(padded(s.without("passengers"), y), clusters.ids + 1000 * k))
    _, ids = np.unique(np.concatenate([p.cluster for p in pieces]), return_inverse=True)
    cuts = np.split(ids, np.cumsum([p.fit.rows for p in pieces])[:-1])
    pieces = [Rows(p.fit, c) for p, c in zip(pieces, cuts, strict=True)]
    known = linear_fit(car, table, lambda: pieces, "traction_force_n", clusters=int(ids.max()) + 1, robust=True)
    out: dict[str, list[float]] = {"mass": [], "sd": [], "km": [], "against": []}
    for name in task["held"]:
        s, y, stretch = _mission(name, task["rows"])
        found = mass_posterior(
            table.insert(car, known.values), with_sd(table, known.values, known.sd), s.without("passengers"), y,
            "traction_force_n", mass_kg=23e3, sd_kg=6e3, group=stretch, inflation=known.inflation,
        )  # fmt: skip
        first = np.unique(stretch, return_index=True)[1]
        far = found.km >= SHORTEST_KM
        out["mass"] += found.mass_kg[far].tolist()
        out["sd"] += found.sd_kg[far].tolist()
        out["km"] += found.km[far].tolist()
        out["against"] += np.asarray(s.channels["passengers"])[first][far].tolist()
    return out | {"c_rr": [float(known.values[0])]}


def _line(passengers: np.ndarray, mass: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Empty mass and slope with their sds: weighted by each stretch's sd and what is left besides (two passes)."""
    x, besides = np.stack([np.ones(len(mass)), passengers], axis=1), 0.0
    for _ in range(3):
        w = 1.0 / (sd**2 + besides**2)
        inverse = np.linalg.inv((x * w[:, None]).T @ x)
        line = inverse @ ((x * w[:, None]).T @ mass)
        besides = float(np.sqrt(max(np.mean((mass - x @ line) ** 2 - sd**2), 0.0)))
    return line, np.sqrt(np.diag(inverse))


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Fleet: errors from 10 km on. Buses: a line through the stretches of held-out missions."""
    rows, lines, missed, every, drawn = [], [], [], [], []
    for task, r in results:
        mass, sd, km, against = (np.array(r[k]) for k in ("mass", "sd", "km", "against"))
        if task["kind"] == "fleet":
            far = km >= 10.0 if np.any(km >= 10.0) else km > 0
            error = 100.0 * (mass / against - 1.0)[far]
            logged = 100.0 * (np.array(r["logged"]) / against - 1.0)[far]
            inside = 100.0 * float(np.mean(np.abs(mass - against)[far] < 1.645 * sd[far]))
            ours = {"trips": int(far.sum()), "median_error_percent": float(np.median(np.abs(error))),
                    "logged_error_percent": float(np.median(np.abs(logged))), "inside_90": inside}  # fmt: skip
            every += np.abs(error).tolist()
            lines.append({"data": f"model {task['model']}, synthetic", **ours})
        else:
            line, spread = _line(against, mass, sd)
            ours = {"stretches": len(mass), "empty_kg": float(line[0]), "kg_per_passenger": float(line[1]),
                    "sd": float(spread[1]), "c_rr": r["c_rr"][0]}  # fmt: skip
            low, high = config.slope_kg
            if not low <= line[1] <= high:
                missed.append(f"{task['model']}: {line[1]:.0f} kg a passenger, target {low:g} to {high:g}")
            lines.append({"data": f"{task['model']}, measured, held-out missions", **ours})
            drawn.append((task["model"], against, mass, line))
        rows.append({"name": task["model"], "paper": None, "ours": ours})
    if every and np.median(every) > config.within_percent:
        missed.append(f"fleet: {np.median(every):.1f} % in the median, target {config.within_percent:g}")
    write_tables(run, "mass", lines, config.caption)
    _figure(run, results, drawn)
    said = [f"Fleet: median error {np.median(every):.2f} % over {len(every)} trips"] if every else []
    shares = [line["inside_90"] for line in lines if "inside_90" in line]
    if shares:
        low = "; they ignore effects that the sheet lacks and that differ by trip" if min(shares) < 85.0 else ""
        said.append(
            f"90 % intervals cover the true mass in {min(shares):.0f} to {max(shares):.0f} % of the trips of a "
            f"model{low}"
        )
    return {
        "artefact": config.artefact, "data": "synthetic fleet; ztbus where the row says measured", "synthetic": True,
        "rows": rows, "better_than_paper": 0, "of": 0, "missed": missed, "findings": said,
    }  # fmt: skip


@styled
def _figure(run: Run, results: Any, drawn: Any) -> None:
    fig = figure(9.0, 3.4)
    ax = fig.add_subplot(1, 2, 1)
    fleet = [r for t, r in results if t["kind"] == "fleet"]
    for r in fleet:
        ax.errorbar(np.array(r["against"]) / 1e3, np.array(r["mass"]) / 1e3, 1.645 * np.array(r["sd"]) / 1e3, fmt="o",
                    markersize=3, linewidth=0.7, color=AFTER, alpha=0.6)  # fmt: skip
    ends = (
        [min(min(r["against"]) for r in fleet) / 1e3, max(max(r["against"]) for r in fleet) / 1e3] if fleet else [0, 1]
    )
    ax.plot(ends, ends, color=GREY, label="equal")
    ax.set_xlabel("true mass [t]")
    ax.set_ylabel("estimated mass, 90 % interval [t]")
    ax.legend()
    ax.set_title("By trip, synthetic fleet")
    tidy(ax)
    ax = fig.add_subplot(1, 2, 2)
    for name, passengers, mass, line in drawn:
        dots = ax.plot(passengers, mass / 1e3, ".", markersize=3, alpha=0.5, label=f"{name}: {line[1]:.0f} kg each")
        reach = np.array([0.0, np.max(passengers)])
        ax.plot(reach, (line[0] + line[1] * reach) / 1e3, color=dots[0].get_color())
    ax.set_xlabel("passengers counted")
    ax.set_ylabel("estimated mass [t]")
    ax.set_title("By stop, measured (ZTBus), held out")
    if drawn:
        ax.legend()
    tidy(ax)
    save_figure(run, fig, "mass")
