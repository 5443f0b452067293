"""Paper 1 assumes that energy is linear in c_rr and C_d·A (section 2.2). Where it is not, and what that costs.

Each side of the efficiency's switch is a line; a segment whose energy at the wheels changes sign between two values of
the coefficients is none. On planted logs of one truck: how many segments change sign between the tables and the truth;
how far one linearisation at the tables is from the answer of a posterior that is linearised where it ends (the map's
and the closed form's); and how far both are where the efficiency is not known either, in which energy is no line.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field

from experiments.paper1.halves import coefficient, paper_table
from experiments.runner.config import Strict
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import write_tables
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import Rows, cluster_rows, linear_fit, padded, predict
from hdev_jax.report.canvas import AFTER, BEFORE, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("../paper1/halves.py",)
NEAR_ZERO = 0.1  # of the median segment's energy
TABLE = ((0.0060, 0.0008), (5.6, 0.5))


class Config(Strict):
    """How far the truth is from the tables, in their sds, and how many logs of each."""

    experiment: Literal["calibration.linearity"]
    artefact: str
    caption: str
    distances: list[float]
    logs: int = 6
    trips: int = 8
    noise_level: float = 0.02
    seed: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """A log each, with the efficiency known and free."""
    for distance in config.distances:
        for k in range(config.logs):
            for free in (False, True):
                yield {"distance": distance, "log": k, "free": free, "trips": config.trips,
                       "noise_level": config.noise_level, "seed": config.seed}  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Energy errors by row and in total of one linearisation, and of as many as it takes, against the truth."""
    import tempfile

    from hdev_jax.inference.sheet import read_sheet
    from hdev_jax.logs import read_log
    from hdev_jax.problem import prepare

    made = synthetic_log(seed=1000 * task["seed"] + task["log"], trips=task["trips"], noise="white",
                         noise_level=task["noise_level"])  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        files = made.write(folder, truth=False)
        problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    car, s = problem.vehicle, problem.segments
    table = paper_table(*TABLE)
    if task["free"]:
        table = table.plus(coefficient("driveline.efficiency", "1", 0.91, 0.03))
    value = np.array([c.value for c in table.free])
    sd = np.array([c.sd for c in table.free], dtype=float)
    rng = np.random.default_rng([task["seed"], task["log"], int(10 * task["distance"])])
    turn = rng.standard_normal(len(value))
    truth = value + task["distance"] * sd * turn / np.linalg.norm(turn)
    rows = padded(s, problem.measured)

    def energy(theta: np.ndarray) -> np.ndarray:
        return np.asarray(predict(table.insert(car, theta), rows.segments, problem.target))[: rows.rows]

    clean, before = energy(truth), energy(value)
    noise = made.noise_rms * rng.standard_normal(len(clean))
    rows = padded(s, clean + noise)
    piece = Rows(rows, cluster_rows(s).ids)
    once = linear_fit(car, table, lambda: [piece], problem.target, passes=1, noise=made.noise_rms)
    often = linear_fit(car, table, lambda: [piece], problem.target, noise=made.noise_rms)
    out: dict[str, Any] = {"changes_sign": float(np.mean(np.sign(clean) != np.sign(before))), "passes": often.passes,
                           "noise": made.noise_rms}  # fmt: skip
    # segments whose energy is small beside the others': those that may change sign
    flat = np.abs(clean) < NEAR_ZERO * np.median(np.abs(clean))
    out["near_zero"] = float(np.mean(flat))
    for name, fit in (("once", once), ("often", often)):
        error = energy(fit.values) - clean
        out[f"near_{name}"] = float(np.sqrt(np.mean(error[flat] ** 2))) if flat.any() else 0.0
        out[f"rmse_{name}"] = float(np.sqrt(np.mean(error**2)))
        out[f"pe_{name}"] = 100.0 * float(np.sum(error) / np.sum(clean))
        out[f"off_{name}"] = float(np.max(np.abs(fit.values - truth) / fit.sd))
    return out


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Medians over logs, by distance and by whether the efficiency is free."""
    rows, lines = [], []
    for free in (False, True):
        for distance in config.distances:
            found = [r for t, r in results if t["distance"] == distance and t["free"] == free]
            mine = {k: float(np.median(np.abs([r[k] for r in found]))) for k in found[0]}
            name = f"efficiency {'free' if free else 'known'}, {distance:g} sds"
            rows.append({"name": name, "paper": None, "ours": mine})
            line = {"efficiency": "free" if free else "known", "true minus table value [prior sd]": distance}
            ways = (("once", "one linearisation"), ("often", "iterated"))
            line |= {f"RMSE, {word} [Wh]": mine[f"rmse_{way}"] for way, word in ways}
            line |= {f"|PE|, {word} [%]": mine[f"pe_{way}"] for way, word in ways}
            line |= {f"largest error of a coefficient, {word} [posterior sd]": mine[f"off_{way}"] for way, word in ways}
            line |= {f"RMSE near 0, {word} [Wh]": mine[f"near_{way}"] for way, word in ways}
            line |= {"rows that change sign": mine["changes_sign"], "rows near 0": mine["near_zero"]}
            lines.append(line | {"noise [Wh]": mine["noise"], "logs": len(found), "passes": mine["passes"]})
    write_tables(run, "linearity", lines, config.caption)
    _figure(run, config, rows)
    return {"artefact": config.artefact, "data": "synthetic", "synthetic": True, "rows": rows,
            "better_than_paper": 0, "of": 0, "logs": len(results), "findings": _findings(rows)}  # fmt: skip


def _findings(rows: list[dict[str, Any]]) -> list[str]:
    """What one linearisation costs, by whether the efficiency is free."""
    said = []
    for what in ("known", "free"):
        once, often = ([r["ours"][k] for r in rows if what in r["name"]] for k in ("rmse_once", "rmse_often"))
        said.append(f"With a {what} efficiency, one linearisation at the table values has an "
                    f"RMSE of {min(once):.3f} to {max(once):.3f} Wh a row, iterating {min(often):.3f} to "
                    f"{max(often):.3f} Wh (medians of logs)")  # fmt: skip
    return said


@styled
def _figure(run: Run, config: Config, rows: list[dict[str, Any]]) -> None:
    fig = figure(8.0, 3.0)
    for k, what in enumerate(("known", "free")):
        ax = fig.add_subplot(1, 2, k + 1)
        mine = [r["ours"] for r in rows if what in r["name"]]
        for key, colour, label in (("rmse_once", BEFORE, "one linearisation"), ("rmse_often", AFTER, "iterated")):
            ax.plot(config.distances, [m[key] for m in mine], "o-", color=colour, label=label)
        ax.set_xlabel("true minus table value [prior sd]")
        ax.set_ylabel("RMSE of the energy of a row [Wh]")
        ax.set_ylim(0, None)
        ax.set_title(f"Efficiency {what}, synthetic")
        ax.legend()
        tidy(ax)
    save_figure(run, fig, "linearity")
