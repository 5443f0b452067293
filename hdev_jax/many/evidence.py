"""Effects that the vehicles of a type show together though no single log decides, with control of false discoveries."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from hdev_jax.diagnosis.settings import SETTINGS, FleetSettings
from hdev_jax.many.pooling import cauchy, pooled
from hdev_jax.many.scan import FOUND
from hdev_jax.physics import LIBRARY, Effect

__all__ = ["Again", "beside", "by_type", "effects_of_types", "families", "heavier"]

Record = Mapping[str, Any]
# scans by vehicle, of these vehicles beside these effects (values and sds by parameter)
Again = Callable[[Sequence[Record], Mapping[str, Mapping[str, list[float]]]], Mapping[str, Mapping[str, Any]]]
WIDE = 3.0  # sd over size of an effect of the type in a vehicle's model: the vehicle's log decides


def by_type(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Vehicles that are done, by type."""
    out: dict[str, list[Record]] = {}
    for r in records:
        if r["status"] == "done":
            out.setdefault(r["type"], []).append(r)
    return dict(sorted(out.items()))


def effects_of_types(
    records: Sequence[Record], settings: FleetSettings, again: Again | None = None,
    library: Mapping[str, type[Effect]] = LIBRARY,
) -> list[dict[str, Any]]:  # fmt: skip
    """Every effect in every type with enough vehicles: its pooled size where it is clearest, with its p-value.

    The forms of an effect (shapes on a grid) are one hypothesis: their p-values are combined (`cauchy`). They are
    adjusted over types × effects by Benjamini and Yekutieli, as effects resemble each other. A vehicle whose own
    diagnosis named the effect counts with the size found there.

    One missing effect can make others look significant. So where a type shows more than one, the clearest goes into the
    models of its vehicles, `again` scans them anew, and so on until no other is left.

    **Arguments:** `again(records, effect by vehicle)`: returns scans by vehicle's name, with the vehicle's own effects
    and these in its model. `library`: the effects that were searched, a user's own among them.

    **Returns:** `type`, `id`, `size` with its `unit`, `shapes`, `value`, `sd`, `between` (sd over vehicles),
    `vehicles`, `named_in` (by their own diagnoses), `p`, `q`, `found`.
    """
    groups = {k: v for k, v in by_type(records).items() if len(v) >= settings.least_vehicles}
    scans = {k: {r["name"]: dict(r["scan"]) for r in v} for k, v in groups.items()}
    shown: dict[str, dict[str, dict[str, Any]]] = {k: {} for k in groups}
    out = _tested(groups, scans, shown, settings, library)
    for _ in range(settings.most_effects if again is not None else 0):
        new = {k: [e for e in out if e["type"] == k and e["found"] and e["id"] not in shown[k]] for k in groups}
        todo = {k: v for k, v in new.items() if len(v) > 1}
        if not todo or again is None:
            break
        for kind, found in todo.items():
            best = min(found, key=lambda e: e["p"])
            shown[kind][best["id"]] = best
            for name, scan in again(groups[kind], {e["id"]: beside(e, library) for e in shown[kind].values()}).items():
                own = {k: s for k, s in scans[kind][name].items() if k.endswith(f" {FOUND}")}
                scans[kind][name] = {**scan, **own}
        out = _tested(groups, scans, shown, settings, library)
    return sorted(out, key=lambda e: (not e["found"], e["q"], e["type"], e["id"]))


def beside(effect: Mapping[str, Any], library: Mapping[str, type[Effect]] = LIBRARY) -> dict[str, list[float]]:
    """An effect of a type as a vehicle's sheet has it: its size to be fitted anew, shapes and all else known."""
    own = library[effect["id"]]
    shapes = dict(x.split("=") for x in effect["shapes"].split())
    out: dict[str, list[float]] = {}
    for p in own.parameters:
        if p.name in shapes:
            out[p.name] = [float(shapes[p.name]), 0.0]
        elif p.name == effect["size"] and effect["kind"] == "size":
            out[p.name] = [float(p.null) + effect["value"], WIDE * abs(effect["value"]) + effect["sd"]]
        elif np.isfinite(p.null):
            out[p.name] = [float(p.null), 0.0]
    return out


def _tested(
    groups: Mapping[str, Sequence[Record]], scans: Mapping[str, Mapping[str, Any]],
    shown: Mapping[str, Mapping[str, dict[str, Any]]], settings: FleetSettings, library: Mapping[str, type[Effect]],
) -> list[dict[str, Any]]:  # fmt: skip
    """Every effect of every type; those that are `shown` already as they were."""
    out = []
    for kind, each in groups.items():
        out += list(shown[kind].values())
        for id_ in sorted({s["id"] for scan in scans[kind].values() for s in scan.values()} - set(shown[kind])):
            if (best := _effect([scans[kind][r["name"]] for r in each], library[id_], settings)) is not None:
                named = sum(any(e["id"] == id_ for e in r["effects"]) for r in each)
                out.append({"type": kind, **best, "named_in": named})
    if out:
        q = stats.false_discovery_control([e["p"] for e in out], method="by")
        for e, adjusted in zip(out, q, strict=True):
            e["q"], e["found"] = float(adjusted), bool(adjusted <= settings.fdr and e["plausible"])
    return out


def _effect(scans: Sequence[Mapping[str, Any]], effect: type[Effect], settings: FleetSettings) -> dict[str, Any] | None:
    id_ = effect.id
    forms = sorted({k for scan in scans for k, s in scan.items() if s["id"] == id_ and not k.endswith(f" {FOUND}")})
    if not forms:  # every vehicle names it by itself
        forms = sorted({k.split(" ")[0] for scan in scans for k, s in scan.items() if s["id"] == id_})
    tried = []
    for form in forms:
        name = form.split(" ")[0]
        # what a vehicle's own diagnosis named stands in that vehicle for every form of the same size
        known = [scan.get(f"{name} {FOUND}") or scan.get(form) for scan in scans]
        there = [s for s in known if s is not None and s["clusters"] >= settings.least_clusters]
        if len(there) < settings.least_vehicles:
            continue
        # an error from few trips is known to few degrees of freedom: as wide as Student's t
        sd = np.array([s["sd"] * heavier(s["clusters"]) for s in there])
        pool = pooled(np.array([s["value"] for s in there]), sd)
        tried.append((pool.p(), form, pool, there[0]["kind"]))
    if not tried:
        return None
    _, form, pool, kind = min(tried, key=lambda x: x[0])
    size, _, shapes = form.partition(" ")
    parameter = next(x for x in effect.parameters if x.name == size.rpartition(".")[2])
    if kind == "size":
        inside = parameter.lower <= float(parameter.null) + pool.mean <= parameter.upper
        plausible = inside and abs(pool.mean) >= parameter.least
    else:
        plausible = SETTINGS.switch_low <= pool.mean <= 1.0 / SETTINGS.switch_low
    return {
        "id": id_, "kind": kind, "size": parameter.name, "unit": parameter.unit if kind == "size" else "1",
        "shapes": shapes, "value": pool.mean, "sd": pool.error, "between": pool.between, "vehicles": pool.n,
        "plausible": bool(plausible), "p": cauchy(np.array([x[0] for x in tried])),
    }  # fmt: skip


def heavier(clusters: float) -> float:
    """Standard deviation over standard error, of an error known from so many clusters (Student's t)."""
    freedom = max(clusters - 1.0, 3.0)
    return float(np.sqrt(freedom / (freedom - 2.0)))


def families(records: Sequence[Record], fdr: float) -> float:
    """The highest adjusted p-value, within a vehicle, of an effect that counts in the fleet.

    Each vehicle is a family of hypotheses. Families are selected by Benjamini and Hochberg on their smallest p-value,
    and each is tested at `fdr` times the share of families selected. So the expected share of false discoveries,
    averaged over the selected vehicles, is at most `fdr` (Benjamini and Bogomolov, JRSS B 76, 2014).
    """
    best = [min((e["q_value"] for e in r["effects"]), default=1.0) for r in records if r["status"] == "done"]
    if not best:
        return 0.0
    chosen = int(np.sum(stats.false_discovery_control(best) <= fdr))
    return fdr * chosen / len(best)
