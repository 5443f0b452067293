"""What the vehicles of a type show together: effects that no single log decides, and how many finds may be false."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.settings import FleetSettings
from hdev_jax.many.pooling import cauchy, pooled
from hdev_jax.many.scan import FOUND
from hdev_jax.physics import LIBRARY

__all__ = ["by_type", "effects_of_types", "families", "heavier"]

Record = Mapping[str, Any]


def by_type(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Vehicles that are done, by type."""
    out: dict[str, list[Record]] = {}
    for r in records:
        if r["status"] == "done":
            out.setdefault(r["type"], []).append(r)
    return dict(sorted(out.items()))


def effects_of_types(records: Sequence[Record], settings: FleetSettings) -> list[dict[str, Any]]:
    """Every effect in every type with enough vehicles: its pooled size where it is clearest, with its p-value.

    The forms of an effect (shapes on a grid) are one hypothesis: their p-values are combined (`cauchy`). Adjusted over
    types × effects by Benjamini and Yekutieli, as effects resemble each other. A vehicle whose own diagnosis named the
    effect counts with the size found there.

    **Returns:** `type`, `id`, `size` with its `unit`, `shapes`, `value`, `sd`, `between` (sd over vehicles),
    `vehicles`, `named_in` (by their own diagnoses), `p`, `q`, `found`.
    """
    out = []
    for kind, each in by_type(records).items():
        if len(each) < settings.least_vehicles:
            continue
        for id_ in sorted({s["id"] for r in each for s in r["scan"].values()}):
            if (best := _effect(each, id_, settings)) is not None:
                out.append({"type": kind, **best})
    if out:
        q = stats.false_discovery_control([e["p"] for e in out], method="by")
        for e, adjusted in zip(out, q, strict=True):
            e["q"], e["found"] = float(adjusted), bool(adjusted <= settings.fdr)
    return sorted(out, key=lambda e: (e["q"], e["type"], e["id"]))


def _effect(each: Sequence[Record], id_: str, settings: FleetSettings) -> dict[str, Any] | None:
    forms = sorted({k for r in each for k, s in r["scan"].items() if s["id"] == id_ and not k.endswith(f" {FOUND}")})
    tried = []
    for form in forms:
        name = form.split(" ")[0]
        # what a vehicle's own diagnosis named stands in that vehicle for every form of the same size
        shown = [r["scan"].get(f"{name} {FOUND}") or r["scan"].get(form) for r in each]
        there = [s for s in shown if s is not None]
        if len(there) < settings.least_vehicles:
            continue
        # an error from few trips is known to few degrees of freedom: as wide as Student's t
        sd = np.array([s["sd"] * heavier(s["clusters"]) for s in there])
        pool = pooled(np.array([s["value"] for s in there]), sd)
        tried.append((pool.p(), form, pool))
    if not tried:
        return None
    _, form, pool = min(tried, key=lambda x: x[0])
    size, _, shapes = form.partition(" ")
    parameter = next(x for x in LIBRARY[id_].parameters if x.name == size.rpartition(".")[2])
    return {
        "id": id_, "size": parameter.name, "unit": parameter.unit, "shapes": shapes, "value": pool.mean,
        "sd": pool.error, "between": pool.between, "vehicles": pool.n,
        "named_in": sum(any(e["id"] == id_ for e in r["effects"]) for r in each),
        "p": cauchy(np.array([x[0] for x in tried])),
    }  # fmt: skip


def heavier(clusters: float) -> float:
    """Standard deviation over standard error, of an error known from so many clusters (Student's t)."""
    freedom = max(clusters - 1.0, 3.0)
    return float(np.sqrt(freedom / (freedom - 2.0)))


def families(records: Sequence[Record], fdr: float) -> float:
    """The highest adjusted p-value, within a vehicle, of an effect that counts in the fleet.

    Vehicles are families of hypotheses, selected by Benjamini and Hochberg on their best p-value, and each is tested at
    `fdr` times the share that was selected: so the expected share of false finds, averaged over the vehicles with any,
    is at most `fdr` (Benjamini and Bogomolov, JRSS B 76, 2014).
    """
    best = [min((e["q_value"] for e in r["effects"]), default=1.0) for r in records if r["status"] == "done"]
    if not best:
        return 0.0
    chosen = int(np.sum(stats.false_discovery_control(best) <= fdr))
    return fdr * chosen / len(best)
