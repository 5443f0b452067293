"""Vehicles that differ from the others of their type: in which coefficient, since when, and at what cost."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.settings import FleetSettings
from hdev_jax.many.evidence import by_type
from hdev_jax.many.pooling import pooled, shrunk, without_each

__all__ = ["Change", "Weeks", "change_point", "changes", "equations", "levels", "pooled_coefficients"]

Record = Mapping[str, Any]
DAY_S, WEEK_S = 86_400.0, 604_800.0
DRAWS = 999, 19_999  # permutations: for all, and for those that the first do not decide
UNDECIDED = 0.02  # p-value of the first permutations below which more are drawn
LEAST_OTHERS = 5  # vehicles of the type with trips in a week, for the type's own course there
LEAST_TOLD = 1e-4  # of a coefficient's information: with less beside the others, no step of it is reported
CLOSE = 1.92  # log-likelihood of the best split less that of another which is as good: half of χ²₁ at 95 %


def pooled_coefficients(records: Sequence[Record], settings: FleetSettings) -> list[dict[str, Any]]:
    """Each declared coefficient by type: `mean`, `sd`, `between` vehicles, and each vehicle's estimate, shrunk to it.

    Estimates are taken without the sheet's prior for that coefficient; else the prior would count once per vehicle.
    """
    out = []
    for kind, each in by_type(records).items():
        for name in _names(each):
            there, value, sd = _alone(each, name)
            if len(there) < 2:
                continue
            pool = pooled(value, sd)
            near, near_sd = shrunk(value, sd, pool)
            first = each[0]["coefficients"].get(name, {})
            out.append({
                "type": kind, "name": name, "unit": there[0]["coefficients"][name]["unit"], "mean": pool.mean,
                "sd": pool.error, "between": pool.between, "p_alike": pool.p_alike, "vehicles": pool.n,
                "prior_value": first.get("prior_value"), "prior_sd": first.get("prior_sd"),
                "by_vehicle": {r["name"]: {"alone": float(a), "alone_sd": float(b), "pooled": float(x), "pooled_sd":
                                           float(y)}
                               for r, a, b, x, y in zip(there, value, sd, near, near_sd, strict=True)},
            })  # fmt: skip
    return out


def _names(each: Sequence[Record]) -> list[str]:
    return list(dict.fromkeys(n for r in each for n in r["coefficients"]))


def _alone(each: Sequence[Record], name: str) -> tuple[list[Record], np.ndarray, np.ndarray]:
    there = [r for r in each if (r["coefficients"].get(name) or {}).get("alone_sd")]
    value = np.array([r["coefficients"][name]["alone"] for r in there], dtype=float)
    return there, value, np.array([r["coefficients"][name]["alone_sd"] for r in there], dtype=float)


def levels(records: Sequence[Record], settings: FleetSettings) -> list[dict[str, Any]]:
    """Each vehicle's coefficients against what the others of its type predict: `difference`, `sd`, `p`, `q` over all
    vehicles × coefficients, `kwh_per_day`."""
    out = []
    for kind, each in by_type(records).items():
        for name in _names(each):
            there, value, sd = _alone(each, name)
            if len(there) < max(settings.least_vehicles, 3):
                continue
            for r, a, e, p in zip(there, *without_each(value, sd), strict=True):
                cost = _per_day(r["course"], name, float(a), 0)
                out.append({
                    "vehicle": r["name"], "type": kind, "kind": "level", "coefficient": name,
                    "unit": r["coefficients"][name]["unit"], "difference": float(a), "sd": float(e), "p": float(p),
                    "percent": _percent(a, value), "since": None, "since_low": None, "since_high": None,
                    "kwh_per_day": cost,
                })  # fmt: skip
    return _adjusted(out, settings)


def changes(records: Sequence[Record], settings: FleetSettings, seed: int) -> list[dict[str, Any]]:
    """Steps in time of each vehicle's coefficients: as `levels`, with the trip and the date of the step.

    The date is `since`, in seconds since 1970, None without a date; a range of trips says where a step fits as well.

    What all vehicles of a type do alike in a week (a season) is removed first, where there are enough of them. Vehicles
    that changed are then left out of that common course, and all are tested again. Where several coefficients of a
    vehicle changed, only the one that explains most is kept, as it shows in the others too; `q` is of the vehicle.
    """
    first = {e["vehicle"] for e in _changes(records, settings, seed, frozenset()) if e["found"]}
    return _changes(records, settings, seed, frozenset(first))


def _changes(
    records: Sequence[Record], settings: FleetSettings, seed: int, without: frozenset[str]
) -> list[dict[str, Any]]:
    """As `changes`, with the vehicles `without` no part of what is common."""
    out = []
    for kind, each in by_type(records).items():
        alike: dict[tuple[str, ...], list[Record]] = {}
        for r in each:
            if r["course"]["coefficients"] is not None:
                alike.setdefault(tuple(r["course"]["coefficients"]["names"]), []).append(r)
        for some in alike.values():
            common = Weeks(some, without)
            for k, r in enumerate(some):
                if len(r["course"]["trip"]) < settings.least_trips:
                    continue
                for name, found in _of_vehicle(r, *common.of(k), settings, seed):
                    course, value = r["course"], r["coefficients"][name]
                    when = course["started_s"]
                    out.append({
                        "vehicle": r["name"], "type": kind, "kind": "change", "coefficient": name,
                        "unit": value["unit"], "difference": found.size, "sd": found.sd, "p": found.p,
                        "percent": _percent(found.size, np.array([value["value"]])), "gain": found.gain,
                        "since_trip": course["trip"][found.at], "since": when[found.at],
                        "since_low": when[found.low], "since_high": when[found.high],
                        "kwh_per_day": _per_day(course, name, found.size, found.at),
                    })  # fmt: skip
    # one hypothesis a vehicle, as a step of one coefficient shows in the others
    by_vehicle: dict[str, list[dict[str, Any]]] = {}
    for e in out:
        by_vehicle.setdefault(e["vehicle"], []).append(e)
    first = [max(v, key=lambda e: (-e["p"], e["gain"])) for v in by_vehicle.values()]
    tried = [min(1.0, e["p"] * len(by_vehicle[e["vehicle"]])) for e in first]
    for e, q in zip(first, stats.false_discovery_control(tried) if tried else (), strict=True):
        for other in by_vehicle[e["vehicle"]]:
            other |= {"q": float(q), "found": other is e and bool(q <= settings.fdr)}
    return out


def _of_vehicle(
    r: Record, gram: np.ndarray, score: np.ndarray, settings: FleetSettings, seed: int
) -> Iterator[tuple[str, "Change"]]:
    told = r["course"]["coefficients"]
    for j, name in enumerate(told["names"]):
        if told["declared"][j] and name in r["coefficients"]:
            rng = np.random.default_rng([seed, *r["name"].encode(), *name.encode()])
            found = change_point(gram, score, j, rng, side=settings.least_side)
            if found is not None:
                yield name, found


@dataclass(frozen=True)
class Change:
    """A step: before which trip it is (`at`; as likely from `low` to `high`), its `size` with `sd`, `gain` in
    log-likelihood, `p` by permutation of the trips."""

    at: int
    low: int
    high: int
    size: float
    sd: float
    gain: float
    p: float


def change_point(
    gram: Float[np.ndarray, "trip k k"], score: Float[np.ndarray, "trip k"], j: int, rng: np.random.Generator, *,
    side: int,
) -> Change | None:  # fmt: skip
    """The likeliest step of coefficient `j`, with `side` or more trips on either side; None where no trip tells of it.

    From each trip's normal equations: with a column more, J_j on the trips from s on, beside all k. Its score is
    U = Σ_{t≥s} g_tj − a'H⁻¹Σg_t, its information V = Σ_{t≥s} G_tjj − a'H⁻¹a, with H = ΣG_t and a = Σ_{t≥s} G_t·j; the
    gain at its best split, ½U²/V, is compared with that of the trips in random order. The error of its size is from how
    trips differ (a sandwich).
    """
    n = len(score)
    scale = np.sqrt(np.maximum(np.einsum("tii->i", gram), 1e-300))
    gram, score = gram / np.outer(scale, scale), score / scale
    whole, total = gram.sum(axis=0), score.sum(axis=0)
    bread = np.linalg.pinv(whole, rcond=1e-10, hermitian=True)
    column, own = gram[:, :, j], score[:, j]

    def gains(order: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        after = np.cumsum(column[order][:, ::-1], axis=1)[:, ::-1][:, side : n - side + 1]
        u = np.cumsum(own[order][:, ::-1], axis=1)[:, ::-1][:, side : n - side + 1] - after @ (bread @ total)
        v = after[..., j] - np.einsum("wsi,ik,wsk->ws", after, bread, after)
        told = v > LEAST_TOLD * whole[j, j]
        return np.where(told, 0.5 * u**2 / np.where(told, v, 1.0), 0.0), u, v

    first, u, v = (x[0] for x in gains(np.arange(n)[None]))
    best = int(np.argmax(first))
    top = float(first[best])
    if top <= 0.0:
        return None
    p = 1.0
    for draws in DRAWS:
        more = 0
        for start in range(0, draws, 1000):
            order = rng.permuted(np.tile(np.arange(n), (min(1000, draws - start), 1)), axis=1)
            more += int(np.sum(np.max(gains(order)[0], axis=1) >= top * (1 - 1e-12)))
        p = (more + 1.0) / (draws + 1.0)
        if p > UNDECIDED:
            break
    at, size = best + side, float(u[best] / v[best])
    # what is left of each trip's score when the step and the other coefficients are fitted
    late = (np.arange(n) >= at).astype(float)
    a = column[at:].sum(axis=0)
    moved = bread @ (total - a * size)
    left = score - gram @ moved - (late * size)[:, None] * column
    each = late * left[:, j] - left @ (bread @ a)
    over = max(float(np.sum(each**2)) / float(v[best]), 1.0)  # trips that differ by more than their rows: as that often
    as_good = np.flatnonzero(first > top - CLOSE * over)
    sd = float(np.sqrt(over / v[best]))
    return Change(
        at, int(as_good[0]) + side, int(as_good[-1]) + side, size / scale[j], sd / scale[j], top / over, p
    )  # fmt: skip


class Weeks:
    """Normal equations by trip of vehicles with the same coefficients, and what they have in common week by week."""

    def __init__(self, each: Sequence[Record], without: frozenset[str] = frozenset()):
        self.counts: list[bool] = [r["name"] not in without for r in each]
        self.own: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = [
            (*equations(r["course"]), *_weeks(r["course"])) for r in each
        ]
        self.sums: dict[float, tuple[np.ndarray, np.ndarray, int]] = {}
        for gram, score, _, week in (o for o, counts in zip(self.own, self.counts, strict=True) if counts):
            for w in np.unique(week[np.isfinite(week)]).tolist():
                g, b, n = self.sums.get(w, (0.0, 0.0, 0))
                self.sums[w] = g + gram[week == w].sum(axis=0), b + score[week == w].sum(axis=0), n + 1

    def of(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Of a vehicle, less what the others have in common in each trip's week."""
        gram, score, _, week = self.own[k]
        score = score.copy()
        for w in np.unique(week[np.isfinite(week)]).tolist():
            mine = week == w
            g, b, n = self.sums.get(w, (np.zeros(gram.shape[1:]), np.zeros(score.shape[1:]), 0))
            others = g, b
            if self.counts[k]:
                others, n = (g - gram[mine].sum(axis=0), b - score[mine].sum(axis=0)), n - 1
            if n >= LEAST_OTHERS:
                # drawn towards none by as much as one vehicle tells: a week of few trips is not taken for a season
                common = np.linalg.lstsq(others[0] * (1.0 + 1.0 / n), others[1], rcond=1e-10)[0]
                score[mine] -= gram[mine] @ common
        return gram, score


def equations(course: Mapping[str, Any]) -> tuple[Float[np.ndarray, "trip k k"], Float[np.ndarray, "trip k"]]:
    """JᵀJ and Jᵀr of each trip."""
    told = course["coefficients"]
    k = len(told["names"])
    upper = np.triu_indices(k)
    gram = np.zeros((len(told["gram"]), k, k))
    gram[:, upper[0], upper[1]] = gram[:, upper[1], upper[0]] = np.asarray(told["gram"], dtype=float)
    return gram, np.asarray(told["score"], dtype=float)


def _weeks(course: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    when = np.array([np.nan if s is None else s for s in course["started_s"]], dtype=float)
    return when, np.floor(when / WEEK_S)


def _percent(difference: float, of: np.ndarray) -> float | None:
    whole = float(np.mean(of))
    return 100.0 * float(difference) / whole if whole else None


def _per_day(course: Mapping[str, Any], name: str, difference: float, first: int) -> float | None:
    """What a difference costs from the trip `first` on [kWh a day]; None where trips have no date."""
    told = course["coefficients"]
    when = [s for s in course["started_s"][first:] if s is not None]
    if (
        told is None
        or told["kwh_per_unit"] is None
        or name not in told["names"]
        or len(when) < len(course["started_s"]) - first
        or len(when) < 2
    ):
        return None
    days = max((max(when) - min(when)) / DAY_S, 1.0)
    return difference * float(np.sum(np.asarray(told["kwh_per_unit"])[first:, told["names"].index(name)])) / days


def _adjusted(out: list[dict[str, Any]], settings: FleetSettings) -> list[dict[str, Any]]:
    if out:
        for e, q in zip(out, stats.false_discovery_control([e["p"] for e in out]), strict=True):
            e["q"], e["found"] = float(q), bool(q <= settings.fdr)
    return out
