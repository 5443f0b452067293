"""How a prediction of energy scores: by row, by trip, by the coefficients against the truth."""

from typing import Any

import numpy as np

from experiments.pinn.data import Data

__all__ = ["QUANTILES", "TAUGHT", "pooled", "scores"]

USES = {"test": 2, "unseen": 3}
TAUGHT = "test, vehicles trained on"
QUANTILES = (5, 25, 50, 75, 95)


def scores(
    data: Data,
    use: np.ndarray,
    energy_wh: np.ndarray,
    *,
    only: int | None = None,
    c_rr: np.ndarray | None = None,
    cda_m2: np.ndarray | None = None,
    sd_wh: np.ndarray | None = None,
) -> dict[str, Any]:
    """Of each use (`test`, `unseen`): sums that add up over vehicles, errors of trips, coefficients by vehicle. Where
    some vehicles have no training row, also of the test rows of those that have (`TAUGHT`).

    **Arguments:** columns of all rows of `data` [row], or of its vehicle `only`; `use` of these rows.
    """
    members = data.vehicles if only is None else (data.vehicles[only],)
    y = np.concatenate([m.energy_wh for m in members])
    route = np.concatenate([m.routes for m in members])
    out: dict[str, Any] = {}
    taught = np.concatenate([np.full(len(m.use), np.any(m.use == 0)) for m in members])
    parts = {name: use == number for name, number in USES.items()}
    if np.any(parts["test"] & ~taught):
        parts[TAUGHT] = parts["test"] & taught
    for name, at in parts.items():
        if not at.any():
            continue
        error = energy_wh[at] - y[at]
        trips, of = np.unique(route[at], return_inverse=True)
        whole, off = np.bincount(of, y[at]), np.bincount(of, error)
        out[name] = {
            "rows": int(at.sum()), "squares": float(np.sum(error**2)), "error_wh": float(error.sum()),
            "energy_wh": float(y[at].sum()), "trips": len(trips),
            "trip_pe": [float(x) for x in np.round(100 * off / np.where(np.abs(whole) > 1.0, whole, np.nan), 4)
                        if np.isfinite(x)],
        }  # fmt: skip
        if sd_wh is not None and np.all(np.isfinite(sd_wh[at])):
            out[name]["share_inside_90"] = float(np.mean(np.abs(error) < 1.645 * sd_wh[at]))
        if c_rr is not None and cda_m2 is not None:
            out[name]["coefficients"] = _coefficients(members, at, c_rr, cda_m2)
    return out


def _coefficients(members: Any, at: np.ndarray, c_rr: np.ndarray, cda_m2: np.ndarray) -> dict[str, Any]:
    """By vehicle: quantiles of the prediction and of the truth, the median of the error relative to the truth."""
    out, first = {}, 0
    for m in members:
        rows = np.flatnonzero(at[first : first + len(m.energy_wh)])
        moving = rows[np.asarray(m.segments.distance_m)[rows] > 0]
        if len(moving):
            entry: dict[str, Any] = {}
            for name, said, true in (("c_rr", c_rr, m.c_rr), ("cda_m2", cda_m2, m.cda_m2)):
                x = said[first + moving]
                entry[name] = [float(q) for q in np.percentile(x, QUANTILES)]
                if true is not None:
                    t = true[moving]
                    entry[f"{name}_true"] = [float(q) for q in np.percentile(t, QUANTILES)]
                    entry[f"{name}_error"] = float(abs(np.median(x / t) - 1))
            out[m.id] = entry
        first += len(m.energy_wh)
    return out


def pooled(found: list[dict[str, Any]]) -> dict[str, float]:
    """RMSE [Wh], PE of all trips together [%], median |PE| of a trip [%], of scores that add up."""
    rows, energy = sum(f["rows"] for f in found), sum(f["energy_wh"] for f in found)
    trips = np.array([x for f in found for x in f["trip_pe"]])
    out = {
        "rmse_wh": float(np.sqrt(sum(f["squares"] for f in found) / rows)),
        "pe_percent": 100 * sum(f["error_wh"] for f in found) / energy,
        "trip_pe_median": float(np.median(np.abs(trips))), "trip_pe_mean": float(np.mean(trips)),
        "rows": rows, "trips": sum(f["trips"] for f in found),
    }  # fmt: skip
    inside = [(f["share_inside_90"], f["rows"]) for f in found if "share_inside_90" in f]
    if inside:
        out["share_inside_90"] = float(np.average([a for a, _ in inside], weights=[b for _, b in inside]))
    for name in ("c_rr", "cda_m2"):
        errors = [c[f"{name}_error"] for f in found for c in f.get("coefficients", {}).values() if f"{name}_error" in c]
        if errors:
            out[f"{name}_error_percent"] = 100 * float(np.median(errors))
            out[f"{name}_error_worst"] = 100 * float(np.max(errors))
    return out
