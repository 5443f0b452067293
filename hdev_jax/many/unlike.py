"""Which vehicles differ from their like, by what, since when, and what that costs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from hdev_jax.diagnosis.settings import FleetSettings
from hdev_jax.many.evidence import by_type
from hdev_jax.many.pooling import pooled, shrunk, without_each

__all__ = ["Change", "change_point", "changes", "levels", "pooled_coefficients"]

Record = Mapping[str, Any]
DAY_S, WEEK_S = 86_400.0, 604_800.0
DRAWS = 999, 19_999  # permutations: for all, and for those that the first do not decide
UNDECIDED = 0.02  # p-value of the first permutations below which more are drawn
LEAST_OTHERS = 5  # vehicles of the type with trips in a week, for the type's own course there
CLOSE = 1.92  # log-likelihood of the best split less that of another which is as good: half of χ²₁ at 95 %


def pooled_coefficients(records: Sequence[Record], settings: FleetSettings) -> list[dict[str, Any]]:
    """Each declared coefficient by type: `mean`, `sd`, `between` vehicles, and each vehicle's own drawn towards it.

    Estimates are taken without the sheet's table for that coefficient, so that the table is not counted once a vehicle.
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
    """Each vehicle's coefficients, trip by trip, against one step: as `levels`, with the trip and the date (`since`, in
    seconds since 1970, None without a date) and the range of trips where a step fits as well.

    What all vehicles of a type do alike in a week (a season) is taken off first, where there are enough of them. Where
    several coefficients of a vehicle changed, the one that explains most is kept, as it shows in the others too.
    """
    out = []
    for kind, each in by_type(records).items():
        for name in _names(each):
            common = _Weeks(each, name)
            for k, r in enumerate(each):
                told = r["course"]["coefficients"].get(name)
                if told is None or len(r["course"]["trip"]) < settings.least_trips:
                    continue
                estimate, weight, used = common.of(k)
                if used.sum() < settings.least_trips:
                    continue
                rng = np.random.default_rng([seed, *r["name"].encode(), *name.encode()])
                found = change_point(estimate, weight, rng, side=settings.least_side)
                at = np.flatnonzero(used)
                course, value = r["course"], r["coefficients"][name]
                out.append({
                    "vehicle": r["name"], "type": kind, "kind": "change", "coefficient": name, "unit": value["unit"],
                    "difference": found.size, "sd": found.sd, "p": found.p, "percent": _percent(found.size,
                    np.array([value["value"]])), "gain": found.gain,
                    "since_trip": course["trip"][at[found.at]],
                    "since": course["started_s"][at[found.at]],
                    "since_low": course["started_s"][at[found.low]], "since_high": course["started_s"][at[found.high]],
                    "kwh_per_day": _per_day(course, name, found.size, int(at[found.at])),
                })  # fmt: skip
    out = _adjusted(out, settings)
    best: dict[str, dict[str, Any]] = {}
    for e in out:
        if e["found"] and (e["vehicle"] not in best or e["gain"] > best[e["vehicle"]]["gain"]):
            best[e["vehicle"]] = e
    for e in out:
        e["also"] = e["found"] and best[e["vehicle"]] is not e
        e["found"] = e["found"] and not e["also"]
    return out


class Change:
    """A step: before which place it is (`at`; as likely from `low` to `high`), its `size` with `sd`, `gain` in
    log-likelihood, `p` by permutation of the trips."""

    def __init__(self, at: int, low: int, high: int, size: float, sd: float, gain: float, p: float):
        self.at, self.low, self.high = at, low, high
        self.size, self.sd, self.gain, self.p = size, sd, gain, p


def change_point(
    estimate: Float[np.ndarray, " trip"], weight: Float[np.ndarray, " trip"], rng: np.random.Generator, *, side: int
) -> Change:
    """The likeliest step of estimates with weights (1/variance, up to a factor), with `side` or more on either side.

    Two means against one, normal with a variance that is estimated: gain ½n·ln(RSS₀/RSS₁) at its best split, against
    the same of trips in random order.
    """
    n = len(estimate)
    gain = _gains(estimate[None], weight[None], side)[0]
    best = int(np.argmax(gain))
    top = float(gain[best])
    p = 1.0
    for draws in DRAWS:
        more = 0
        for start in range(0, draws, 1000):
            order = rng.permuted(np.tile(np.arange(n), (min(1000, draws - start), 1)), axis=1)
            more += int(np.sum(np.max(_gains(estimate[order], weight[order], side), axis=1) >= top * (1 - 1e-12)))
        p = (more + 1.0) / (draws + 1.0)
        if p > UNDECIDED:
            break
    as_good = np.flatnonzero(gain > top - CLOSE)
    at = best + side
    before, after = slice(0, at), slice(at, n)
    a, b = weight[before].sum(), weight[after].sum()
    m0, m1 = (weight[before] @ estimate[before]) / a, (weight[after] @ estimate[after]) / b
    rss = weight[before] @ (estimate[before] - m0) ** 2 + weight[after] @ (estimate[after] - m1) ** 2
    sd = float(np.sqrt(rss / max(n - 2, 1) * (1 / a + 1 / b)))
    return Change(at, int(as_good[0]) + side, int(as_good[-1]) + side, float(m1 - m0), sd, top, p)


def _gains(y: Float[np.ndarray, "way trip"], w: Float[np.ndarray, "way trip"], side: int) -> np.ndarray:
    """Gain of a step at every place with `side` or more trips on either side."""
    n = y.shape[1]
    a, b = np.cumsum(w, axis=1), np.cumsum(w * y, axis=1)
    whole, total = a[:, -1:], b[:, -1:]
    rss0 = np.sum(w * y * y, axis=1, keepdims=True) - total**2 / whole
    a, b = a[:, side - 1 : n - side], b[:, side - 1 : n - side]
    taken = b**2 / a + (total - b) ** 2 / (whole - a) - total**2 / whole
    return -0.5 * n * np.log1p(-np.clip(taken / np.maximum(rss0, 1e-300), 0.0, 1.0 - 1e-12))


class _Weeks:
    """Estimates of a coefficient by trip of the vehicles of a type, and what they have in common week by week."""

    def __init__(self, each: Sequence[Record], name: str):
        self.own = []
        for r in each:
            told = r["course"]["coefficients"].get(name)
            a = np.array(told["information"] if told else [], dtype=float)
            b = np.array(told["score"] if told else [], dtype=float)
            when = np.array([np.nan if s is None else s for s in r["course"]["started_s"]], dtype=float)
            self.own.append((a, b, np.floor(when[: len(a)] / WEEK_S)))
        self.sums: dict[float, np.ndarray] = {}
        for a, b, week in self.own:
            for w in np.unique(week[np.isfinite(week)]).tolist():
                at = week == w
                here = self.sums.setdefault(w, np.zeros(3))
                here += [a[at].sum(), b[at].sum(), 1.0]

    def of(self, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Estimates and weights of a vehicle's trips that tell anything, and which those are."""
        a, b, week = self.own[k]
        used = a > 1e-9 * max(float(np.max(a, initial=0.0)), 1e-300)
        y = b[used] / a[used]
        w = week[used]
        for x in np.unique(w[np.isfinite(w)]).tolist():
            mine = week == x
            info, score, vehicles = self.sums[x] - [a[mine].sum(), b[mine].sum(), 1.0]
            if vehicles >= LEAST_OTHERS and info > 0:
                y[w == x] -= score / info
        return y, a[used], used


def _percent(difference: float, of: np.ndarray) -> float | None:
    whole = float(np.mean(of))
    return 100.0 * float(difference) / whole if whole else None


def _per_day(course: Mapping[str, Any], name: str, difference: float, first: int) -> float | None:
    """What a difference costs from the trip `first` on [kWh a day]; None where trips have no date."""
    told = course["coefficients"].get(name)
    when = [s for s in course["started_s"][first:] if s is not None]
    if told is None or told["kwh_per_unit"] is None or len(when) < len(course["started_s"]) - first or len(when) < 2:
        return None
    days = max((max(when) - min(when)) / DAY_S, 1.0)
    return difference * float(np.sum(told["kwh_per_unit"][first:])) / days


def _adjusted(out: list[dict[str, Any]], settings: FleetSettings) -> list[dict[str, Any]]:
    if out:
        for e, q in zip(out, stats.false_discovery_control([e["p"] for e in out]), strict=True):
            e["q"], e["found"] = float(q), bool(q <= settings.fdr)
    return out
