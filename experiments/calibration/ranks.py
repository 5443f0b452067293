"""Simulation-based calibration: worlds drawn from the prior, and where the truth ranks among draws of the posterior.

Ranks of a posterior that is the model's are uniform (Talts et al. 2018, arXiv:1804.06788). Three posteriors through the
kernel: the closed form and a fleet's draws on statistics, on rows that drive (there the kernel is linear in c_rr and
C_d·A, but for the few vehicles of a fleet that lie beyond five of the tables' sds); NUTS on rows that brake too, with
the efficiency unknown and Student t noise that grows with energy.
"""

import tempfile
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import Field
from scipy import stats

from experiments.paper1.halves import coefficient, paper_table
from experiments.runner.config import Strict
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import write_tables
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import Coefficient, Rows, linear_fit, padded, predict
from hdev_jax.inference.design import GROUP, tabular
from hdev_jax.inference.linear import LEAST_ROWS
from hdev_jax.inference.parameters import ParameterTable, insert_by
from hdev_jax.inference.posterior.draws import Draws
from hdev_jax.inference.posterior.hierarchy import fleet_draws
from hdev_jax.inference.posterior.models import DF_RATE, DF_SHAPE, GROWTH, POOL_FREEDOM, Model
from hdev_jax.inference.posterior.nuts import compiled, coordinates
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.problem import Problem, prepare
from hdev_jax.report.canvas import AFTER, GREY, figure, tidy
from hdev_jax.rundir import Run
from hdev_jax.segments import Segments

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("../paper1/halves.py",)
C_RR, CDA, EFFICIENCY = (0.0060, 0.0008), (5.6, 0.5), (0.91, 0.02)
NOISE_WH = 20.0  # believed of a row: about what the two coefficients' sds come to
SHORT = {"road.c_rr": "c_rr", "road.cda_m2": "C_d·A", "driveline.efficiency": "efficiency"}
DRAWS, APART = 19, 50  # ranks 0 … 19; draws of a chain are so many apart
LEAST_P = 0.01  # of all histograms together

Kind = Literal["closed form", "fleet on statistics", "NUTS"]
World = dict[str, float]


class Config(Strict):
    """How many worlds of each posterior, in blocks; rows of a vehicle, and vehicles of a fleet."""

    experiment: Literal["calibration.ranks"]
    artefact: str
    caption: str
    worlds: dict[Kind, int]
    block: int = Field(50, ge=1)
    rows: int = Field(40, ge=8)
    vehicles: int = Field(5, ge=2)
    warm_up: int = Field(300, ge=50)
    seed: int = Field(0, ge=0)


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """Blocks of worlds; each world has its own seed."""
    for kind, count in config.worlds.items():
        for first in range(0, count, config.block):
            yield {
                "kind": kind, "first": first, "count": min(config.block, count - first), "rows": config.rows,
                "vehicles": config.vehicles, "warm_up": config.warm_up, "seed": config.seed,
            }  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, list[int]]:
    """Ranks of the truth by name, a number for each world."""
    makers = {"closed form": _closed, "fleet on statistics": _fleet, "NUTS": _nuts}
    at = list(makers).index(task["kind"])
    out: dict[str, list[int]] = {}
    for k in range(task["first"], task["first"] + task["count"]):
        rng = np.random.default_rng([task["seed"], at, k])
        truth, draws = makers[task["kind"]](task, rng, jax.random.key(int(rng.integers(2**63))))
        for name, value in truth.items():
            column = np.asarray(draws[name])
            if not np.all(np.isfinite(column)):
                raise FloatingPointError(f"{task['kind']}, world {k}: draws of {name} are not finite")
            out.setdefault(name, []).append(int(np.sum(column < value)))
    return out


@cache
def _log() -> Problem:
    """One synthetic log: its rows are what the worlds are driven on."""
    with tempfile.TemporaryDirectory() as folder:
        files = synthetic_log(seed=1, trips=8, noise="white", noise_level=0.02).write(folder, truth=False)
        return prepare(read_log([files["log"]]), read_sheet(files["sheet"]))


def _rows(rng: np.random.Generator, table: ParameterTable, count: int, *, driving: bool) -> Segments:
    """So many rows of the log; of those alone whose energy leaves the battery for any likely coefficients."""
    p = _log()
    value, sd = tabular(table)
    fit = padded(p.segments, np.zeros(len(p.segments)))
    least = np.asarray(predict(table.insert(p.vehicle, value - 5.0 * sd), fit.segments, p.target))[: fit.rows]
    able = np.flatnonzero(least > 0) if driving else np.arange(fit.rows)
    return p.segments.take(np.sort(rng.choice(able, count, replace=False)))


def _world(rng: np.random.Generator, table: ParameterTable, *, conjugate: bool) -> tuple[np.ndarray, float]:
    """Coefficients within their support and the noise's variance, from the prior."""
    value, sd = tabular(table)
    shape = 0.5 * LEAST_ROWS
    variance = float(stats.invgamma.rvs(shape, scale=(shape - 1.0) * NOISE_WH**2, random_state=rng))
    wide = np.sqrt(variance) / NOISE_WH if conjugate else 1.0
    lower, upper = (np.array([getattr(c, side) for c in table.free]) for side in ("lower", "upper"))
    while True:
        theta = value + wide * sd * rng.standard_normal(len(value))
        if np.all((theta > lower) & (theta < upper)):
            return theta, variance


def _predicted(table: ParameterTable, theta: np.ndarray, fit: Any) -> np.ndarray:
    p = _log()
    return np.asarray(predict(table.insert(p.vehicle, theta), fit.segments, p.target))[: fit.rows]


def _named(table: ParameterTable, values: Any) -> World:
    return dict(zip((_short(c) for c in table.free), np.asarray(values), strict=True))


def _short(c: Coefficient) -> str:
    return SHORT.get(c.path, c.path)


def _alone(s: Segments) -> np.ndarray:
    """One cluster: rows are independent."""
    return np.zeros(len(s), dtype=int)


def _closed(task: dict[str, Any], rng: np.random.Generator, key: Any) -> tuple[World, dict[str, Any]]:
    """Normal-inverse-gamma: the table is as wide as the noise is."""
    p, table = _log(), paper_table(C_RR, CDA)
    s = _rows(rng, table, task["rows"], driving=True)
    theta, variance = _world(rng, table, conjugate=True)
    y = _predicted(table, theta, padded(s, np.zeros(len(s)))) + np.sqrt(variance) * rng.standard_normal(len(s))
    fit = linear_fit(p.vehicle, table, lambda: [Rows(padded(s, y), _alone(s))], p.target, noise=NOISE_WH)
    draws, sigma = fit.draws(key, DRAWS)
    return {**_named(table, theta), "noise": np.sqrt(variance)}, {**_named(table, draws.T), "noise": sigma}


def _fleet(task: dict[str, Any], rng: np.random.Generator, key: Any) -> tuple[World, dict[str, Any]]:
    """Vehicles drawn around a fleet's mean: mean, spread, the first vehicle, the noise."""
    p, table, groups = _log(), paper_table(C_RR, CDA), task["vehicles"]
    _, sd = tabular(table)
    s = _rows(rng, table, groups * task["rows"], driving=True)
    own = np.repeat(np.arange(groups), task["rows"])
    mean, variance = _world(rng, table, conjugate=False)
    spread = sd * np.abs(stats.t.rvs(POOL_FREEDOM, size=len(sd), random_state=rng))
    theta = mean + spread * rng.standard_normal((groups, len(sd)))
    fit = padded(s.with_channels(**{GROUP: own.astype(float)}), np.zeros(len(s)))
    car = insert_by(p.vehicle, table.structure, jnp.asarray(theta), GROUP)
    clean = np.asarray(car.predict(fit.segments, p.target))[: fit.rows]
    y = clean + np.sqrt(variance) * rng.standard_normal(len(s))
    piece = Rows(padded(s, y), own, own)
    line = linear_fit(p.vehicle, table, lambda: [piece], p.target, groups=groups, noise=NOISE_WH)
    draws = fleet_draws(line, key=key, chains=1, draws=DRAWS * APART)
    truth: World = {"noise": np.sqrt(variance)}
    found: dict[str, Any] = {"noise": np.sqrt(_thin(draws, "variance"))}
    for k, c in enumerate(table.free):
        for name, true in (("mean", mean), ("spread", spread)):
            truth[f"{name} of {_short(c)}"], found[f"{name} of {_short(c)}"] = true[k], _thin(draws, name)[:, k]
        truth[f"{_short(c)} of one vehicle"], found[f"{_short(c)} of one vehicle"] = (
            theta[0, k],
            _thin(draws, "theta")[:, 0, k],
        )
    return truth, found


def _nuts(task: dict[str, Any], rng: np.random.Generator, key: Any) -> tuple[World, dict[str, Any]]:
    """Through the whole kernel: rows that brake, an unknown efficiency, heavy tails, noise that grows with energy."""
    p = _log()
    table = paper_table(C_RR, CDA).plus(coefficient("driveline.efficiency", "1", *EFFICIENCY))
    s = _rows(rng, table, task["rows"], driving=False)
    theta, variance = _world(rng, table, conjugate=False)
    fit = padded(s, np.zeros(len(s)))
    growth = float(np.abs(GROWTH * rng.standard_normal()))
    df = float(rng.gamma(DF_SHAPE, 1.0 / DF_RATE))
    size = np.abs(_predicted(table, tabular(table)[0], fit))
    scale = np.sqrt(variance + (growth * size) ** 2)
    y = _predicted(table, theta, fit) + scale * rng.standard_t(df, len(s))
    fit = padded(s, y)
    at = linear_fit(p.vehicle, table, lambda: [Rows(fit, _alone(s))], p.target, noise=NOISE_WH, robust=True).values
    model = Model.of(p.vehicle, table, fit, p.target, noise=NOISE_WH, size=size)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        sampler = _sampler(model, task["warm_up"])
        draws = sampler(model, coordinates(model, at), key)
    truth = {**_named(table, theta), "noise": np.sqrt(variance), "growth": growth, "df": df}
    found = {**_named(table, _thin(draws, "theta").T), "noise": np.sqrt(_thin(draws, "variance"))}
    return truth, found | {name: _thin(draws, name) for name in ("growth", "df")}


_samplers: dict[int, Any] = {}


def _sampler(model: Model, warm_up: int) -> Any:
    """One program for all worlds: their models are of one shape."""
    if warm_up not in _samplers:
        _samplers[warm_up] = compiled(model, chains=1, draws=DRAWS * APART, warm_up=warm_up)
    return _samplers[warm_up]


def _thin(draws: Draws, name: str) -> np.ndarray:
    return draws.flat(name)[APART - 1 :: APART]


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """p of uniform ranks by posterior and coefficient, of their histogram, mean and spread; passed where none of all is
    beyond chance.
    """
    ranks: dict[tuple[str, str], list[int]] = {}
    for task, result in results:
        for name, values in result.items():
            ranks.setdefault((task["kind"], name), []).extend(values)
    rows, lines = [], []
    for (kind, name), values in ranks.items():
        counts = np.bincount(values, minlength=DRAWS + 1)
        away = np.array(values) - 0.5 * DRAWS
        ps = {"p": float(stats.chisquare(counts).pvalue), "p_mean": _p_of(away, 1), "p_spread": _p_of(away, 2)}
        middle = np.mean(np.abs(away) < 0.45 * (DRAWS + 1))
        ours = {"worlds": len(values), **ps, "in_middle_90": float(middle), "mean_rank": float(np.mean(values))}
        rows.append({"name": f"{kind}, {name}", "paper": None, "ours": ours})
        lines.append({"posterior": kind, "coefficient": name, "data sets": len(values), "p, χ² of ranks": ps["p"],
                      "p, mean rank": ps["p_mean"], "p, spread of ranks": ps["p_spread"],
                      "share of ranks in the middle 90 %": middle, "mean rank": np.mean(values)})  # fmt: skip
    tests = [r["ours"][k] for r in rows for k in ("p", "p_mean", "p_spread")]
    least, passed = min(tests), min(tests) * len(tests) > LEAST_P
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    _figure(run, config, ranks)
    return {
        "artefact": config.artefact, "data": "synthetic", "synthetic": True, "rows": rows,
        "better_than_paper": 0, "of": 0, "logs": sum(len(next(iter(result.values()))) for _, result in results),
        "missed": [] if passed else [f"ranks that are not uniform: p {least:.2g} among {len(tests)} tests"],
        "findings": [
            f"{'Passed' if passed else 'Not passed'}: the smallest of {len(tests)} p-values is {least:.2g}; after "
            f"Bonferroni's correction, one below {LEAST_P / len(tests):.1g} is significant at {100 * LEAST_P:.0f} %",
        ],
        "notes": [
            f"{DRAWS} draws for each data set, {APART} apart in a chain: ranks run from 0 to {DRAWS}",
            "Here the prior of the noise, and each row's energy to which the growing part of the noise is "
            "proportional, are fixed in advance; in use, hdev estimates both from the same rows",
        ],
    }  # fmt: skip


def _p_of(away: np.ndarray, power: int) -> float:
    """p of the mean of ranks' distances from the middle, or of their squares, where all ranks are as likely."""
    every = (np.arange(DRAWS + 1) - 0.5 * DRAWS) ** power
    z = (np.mean(away**power) - np.mean(every)) / (np.std(every) / np.sqrt(len(away)))
    return float(2.0 * stats.norm.sf(abs(z)))


@styled
def _figure(run: Run, config: Config, ranks: dict[tuple[str, str], list[int]]) -> None:
    """A histogram each, with the band that 99 % of counts fall into where ranks are uniform."""
    across = 4
    down = -(-len(ranks) // across)
    fig = figure(9.0, 1.9 * down + 0.4)
    for k, ((kind, name), values) in enumerate(ranks.items()):
        ax = fig.add_subplot(down, across, k + 1)
        low, high = stats.binom.ppf([0.005, 0.995], len(values), 1.0 / (DRAWS + 1))
        ax.hist(values, bins=np.arange(DRAWS + 2) - 0.5, color=AFTER)
        ax.axhspan(low, high, color=GREY, alpha=0.25)
        ax.set_title(f"{kind}\n{name}", fontsize=7)
        if k // across == down - 1 or k + across >= len(ranks):
            ax.set_xlabel("rank of the truth")
        tidy(ax)
    save_figure(run, fig, config.artefact.rpartition("/")[2])
