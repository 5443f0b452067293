"""Tables and figure 5 of the gear study: accuracies beside their bound, confusion, speed, the cost of a wrong gear."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.runner.compare import tally
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import write_tables
from hdev_jax.learn.gears.classifiers import LEAST_ROWS
from hdev_jax.rundir import Run

__all__ = ["collect", "equation_1", "macro_f1"]

WORST_PERCENT = 1.0  # of a vehicle's energy, that the surrogate's gear may add
POINTS = {"unseen_routes": 0.02, "unseen_variants": 0.06}
POOLED, WITH_MEMORY = 0.90, 0.98
GROUPS = {"all": "", "2 to 4 speeds": "_2_to_4_speeds", "12 speeds": "_12_speeds"}


def equation_1(confusion: np.ndarray) -> float:
    """Accuracy by the paper's equation 1 as it is printed: Σ TP over Σ (TP + TN + FP + FN).

    The four counts of a class add up to all rows, so that this is the accuracy over the number of classes.
    """
    right, every = np.trace(confusion), confusion.sum()
    told, true = confusion.sum(axis=0), confusion.sum(axis=1)
    hits = np.diag(confusion)
    counts = hits + (every - told - true + hits) + (told - hits) + (true - hits)
    return float(right / counts.sum())


def macro_f1(confusion: np.ndarray) -> float:
    """Mean over the gears that occur of the harmonic mean of precision and recall."""
    true, told, hits = confusion.sum(axis=1), confusion.sum(axis=0), np.diag(confusion)
    here = true > 0
    return float(np.mean(2 * hits[here] / (true + told)[here]))


def collect(config: Any, results: Any, run: Run) -> dict[str, Any]:
    """All tables, the figure, and the rows of the metrics."""
    bound: dict[str, Any] = {}
    found: dict[str, Any] = {}
    counts: list[int] = []
    for task, result in results:
        if task.get("bound"):
            bound, counts = result["bounds"], result["rows"]
        else:
            name = f"{task['kind']}/{task['set']}" + ("+previous_gear" if task["previous"] else "")
            found[name] = result
    rows: list[dict[str, Any]] = []
    for name, result in found.items():
        of_rows = {} if name.endswith("+previous_gear") else bound  # what holds for single rows
        rows.append({"name": name, "paper": config.paper.get(name), "ours": _ours(result, of_rows, result["scores"])})
        if "memory" in result:
            how = "+chain" if name.endswith("+previous_gear") else "+filter"
            rows.append({"name": f"{name}{how}", "paper": None, "ours": _memory(result["memory"], bound)})
    short = config.artefact.rpartition("/")[2]
    write_tables(run, short, [_line(r) for r in rows], config.caption)
    if lines := [*_beside_bound(config, found, bound)]:
        write_tables(
            run, f"{short}_bounds", lines, f"{_named(f'{config.figure}/{config.sets[-1]}')} beside the reference [%]"
        )
    write_tables(run, f"{short}_speed", [*_speed(found)], "Time of a prediction, on a machine that also did other work")
    write_tables(run, f"{short}_energy", [*_energy(found)], _ENERGY)
    shown = found.get(f"{config.figure}/{config.sets[-1]}") or next(iter(found.values()))
    write_tables(
        run,
        f"{short}_confusion",
        [*_confusion(shown)],
        "Rows of unseen routes by true gear (down) and predicted gear (across)",
    )
    _figure(run, short, shown)
    return {
        "artefact": config.artefact, "data": f"synthetic fleet, seed {config.seed}, {config.routes} routes",
        "synthetic": True, "rows": rows, "bound": bound, **tally(rows, "accuracy_unseen_routes", more_is_better=True),
        "missed": [*_missed(config, found, bound)],
        "notes": [
            "rows of training, of unseen routes and of unseen variants "
            f"({', '.join(config.held_variants)}): {', '.join(map(str, counts))}; single-speed vehicles are left out",
            "reference: accuracy of a classifier that knows the two possible gears in the hysteresis band and every "
            "deciding input without noise; outside the band the gear is certain. The best possible (Bayes) accuracy "
            "from one row is at least this; a filter, which uses earlier rows, may exceed it",
            "equation 1, as printed in the paper, divides by the true negatives of every class too: it is the accuracy "
            "over the number of classes (12), at most 1/12; the paper's 'over 90 %' is the usual accuracy",
            "inputs: 'paper' has speed, requested torque and mass, which do not tell gearboxes apart, so that one "
            "speed may mean different gears; 'sheet' adds motor speed by gear, power over rated power and the "
            "number of gears; 'relative' also adds the slope, and predicts the distance from the gear of rated motor "
            "speed",
            "filter: a hidden Markov filter over the row-by-row probabilities; previous gear known: the measured "
            "previous gear is an input; previous gear predicted: the same classifier, with its own last prediction as "
            "the previous gear",
            f"searches: Optuna, {config.trials} trials, {config.folds} folds of whole routes, on at most "
            f"{config.search_rows} rows; score: mean of accuracy and balanced accuracy",
            "balanced: each probability is divided by the gear's share of the training rows before the likeliest gear "
            "is taken; shares below a limit chosen in the search are raised to that limit. Gears with fewer than "
            f"{LEAST_ROWS} scored rows are left out, of the reference too; the reference divides by the shares of "
            "the scored rows, which no classifier knows",
        ],
    }  # fmt: skip


def _beside_bound(config: Any, found: Mapping[str, Any], bound: Mapping[str, float]) -> Any:
    """Each group and split of the chosen model, row by row and with the previous gear."""
    name = f"{config.figure}/{config.sets[-1]}"
    if name not in found or not bound:
        return
    memory = found.get(f"{name}+previous_gear", {}).get("scores", {})
    for split in POINTS:
        for group, end in GROUPS.items():
            line: dict[str, Any] = {"rows of": f"{split.replace('_', ' ')}, {group}"}
            for kind in ("accuracy", "balanced"):
                key = f"{kind}_{split}{end}"
                if key in bound:
                    own = found[name]["scores"][key]
                    line |= {kind: f"{100 * own:.1f}", f"{kind}, reference": f"{100 * bound[key]:.1f}"}
                    line[f"{kind}, points below it"] = f"{100 * (bound[key] - own):.1f}"
                    line[f"{kind}, previous gear known"] = f"{100 * memory[key]:.1f}" if key in memory else None
            yield {**line, "rows of rare gears": bound.get(f"rare_rows_{split}{end}")}


_ENERGY = (
    "Energy with a predicted gear (synthetic): difference from that with the true gear, and errors against the "
    "measured energy"
)
_GEARS = {"true": "true", "hard": "likeliest gear", "soft": "gear probabilities", "none": "always the highest gear"}
_KINDS = {"catboost": "CatBoost", "lightgbm": "LightGBM", "xgboost": "XGBoost", "knn": "kNN", "svm": "SVM",
          "decision_tree": "decision tree", "random_forest": "random forest", "mlp": "network"}  # fmt: skip


def _named(row: str) -> str:
    """A classifier, its inputs and its memory in words: `catboost/relative+filter`."""
    kind, _, rest = row.partition("/")
    inputs, *memory = rest.split("+")
    how = {(): "", ("filter",): ", filter", ("previous_gear",): ", previous gear known",
           ("previous_gear", "chain"): ", previous gear predicted"}[tuple(memory)]  # fmt: skip
    return f"{_KINDS.get(kind, kind)}, {inputs} inputs{how}"


def _ours(result: Mapping[str, Any], bound: Mapping[str, float], scores: Mapping[str, float]) -> dict[str, Any]:
    confusion = np.asarray(result["confusion"])
    return {
        **scores, "balanced": scores["balanced_unseen_routes"], "bound": bound.get("accuracy_unseen_routes"),
        "bound_balanced": bound.get("balanced_unseen_routes"), "macro_f1": macro_f1(confusion),
        "equation_1": equation_1(confusion), "fit_seconds": result["fit_seconds"], **result["speed"],
        "settings": result["settings"], "memory": False,
    }  # fmt: skip


def _memory(scores: Mapping[str, float], bound: Mapping[str, float]) -> dict[str, Any]:
    return {**scores, "balanced": scores["balanced_unseen_routes"], "bound": None, "memory": True}


def _line(row: Mapping[str, Any]) -> dict[str, Any]:
    o = row["ours"]
    percent = lambda k: None if o.get(k) is None else f"{100 * o[k]:.1f}"  # noqa: E731
    return {
        "model": _named(row["name"]),
        "paper": f"{100 * row['paper']['accuracy_unseen_routes']:.0f}" if row["paper"] else None,
        "unseen routes": percent("accuracy_unseen_routes"), "reference": percent("bound"),
        "unseen types of vehicle": percent("accuracy_unseen_variants"),
        "balanced, unseen routes": percent("balanced_unseen_routes"),
        "balanced, reference": percent("bound_balanced"),
        "balanced, unseen types": percent("balanced_unseen_variants"),
        "12 speeds": percent("accuracy_unseen_routes_12_speeds"),
        "12 speeds, balanced": percent("balanced_unseen_routes_12_speeds"),
        "2-4 speeds": percent("accuracy_unseen_routes_2_to_4_speeds"), "macro F1": percent("macro_f1"),
        "equation 1": percent("equation_1"),
    }  # fmt: skip


def _speed(found: Mapping[str, Any]) -> Any:
    for name, r in found.items():
        s = r["speed"]
        yield {
            "model": _named(name), "library, s per million rows": s["library_s_per_million"],
            "in JAX, s per million rows": s.get("kernel_s_per_million"),
            "library, one row [µs]": s["library_us_one_row"], "in JAX, one row [µs]": s.get("kernel_us_one_row"),
            "largest difference in probability": s.get("kernel_difference"),
        }  # fmt: skip


def _energy(found: Mapping[str, Any]) -> Any:
    for name, r in found.items():
        cars = r["energy"]
        for way in ("true", "hard", "soft", "none"):
            added = {k: c["added_percent"][way] for k, c in cars.items()} if way != "true" else {}
            worst = max(added, key=lambda k: abs(added[k])) if added else None
            yield {
                "model": _named(name), "gear": _GEARS[way],
                "difference, worst vehicle [%]": added[worst] if worst else None,
                "worst vehicle": worst.replace("_", " ") if worst else None,
                "mean absolute difference [%]": float(np.mean(np.abs([*added.values()]))) if added else None,
                "RMSE [Wh]": float(np.mean([c["rmse_wh"][way] for c in cars.values()])),
                "trip error [%]": float(np.mean([c["trip_percent"][way] for c in cars.values()])),
                "s per million rows": r["speed"].get("kernel_s_per_million", r["speed"]["library_s_per_million"])
                if way in ("hard", "soft") else None,
            }  # fmt: skip


def _confusion(result: Mapping[str, Any]) -> Any:
    table = np.asarray(result["confusion"])
    for k, counts in enumerate(table):
        yield {"gear": str(k + 1), **{str(g + 1): int(n) for g, n in enumerate(counts)}}


def _missed(config: Any, found: Mapping[str, Any], bound: Mapping[str, float]) -> Any:
    """Where the chosen model misses its target, each with its number."""
    name = f"{config.figure}/{config.sets[-1]}"
    if name not in found:
        return
    r = found[name]
    for end in GROUPS.values():
        for split, points in POINTS.items():
            for kind in ("accuracy", "balanced"):
                key = f"{kind}_{split}{end}"
                if key in bound and r["scores"][key] < bound[key] - points:
                    own = f"{_key(key)} {100 * r['scores'][key]:.1f} %"
                    yield f"{_named(name)}: {own}, reference {100 * bound[key]:.1f} %"
    if r["scores"]["accuracy_unseen_routes"] < min(POOLED, bound["accuracy_unseen_routes"]):
        yield f"{_named(name)}: pooled {100 * r['scores']['accuracy_unseen_routes']:.1f} %, target 90 %"
    with_memory = {f"{name}+filter": r["memory"]}
    if (other := f"{name}+previous_gear") in found:
        with_memory |= {other: found[other]["scores"], f"{other}+chain": found[other]["memory"]}
    best = max(with_memory, key=lambda k: with_memory[k]["accuracy_unseen_routes"])
    for key in (
        f"{kind}_{split}{end}" for kind in ("accuracy", "balanced") for split in POINTS for end in GROUPS.values()
    ):
        if with_memory[best].get(key, 1.0) < WITH_MEMORY:
            yield f"{_named(best)}: {_key(key)} {100 * with_memory[best][key]:.1f} %, target 98 %"
    for way in ("hard", "soft"):
        for car, c in r["energy"].items():
            if abs(c["added_percent"][way]) >= WORST_PERCENT:
                adds = f"{c['added_percent'][way]:.2f} % to the energy of {car.replace('_', ' ')}"
                yield f"{_named(name)}: {_GEARS[way]} adds {adds}"


def _key(key: str) -> str:
    return key.replace("_", " ").replace("variants", "types")


@styled
def _figure(run: Run, name: str, result: Mapping[str, Any]) -> None:
    """A route of a gearbox of most gears: true gear, row by row and with the filter; and the confusion."""
    import matplotlib.pyplot as plt

    sample = result["sample"]
    fig, (top, below) = plt.subplots(2, 1, figsize=(7, 6.4), gridspec_kw={"height_ratios": [1, 1.35]})
    at = 0.1 * np.arange(len(sample["gear"]))
    top.step(at, sample["gear"], where="mid", label="simulation (truth)", lw=2.0)
    top.step(at, sample["told"], where="mid", label="predicted, row by row", lw=1.0)
    if "filter" in sample:
        top.step(at, sample["filter"], where="mid", label="predicted, with memory (filter)", lw=1.0, ls="--")
    top.set(xlabel="distance along the route [km]", ylabel="gear", title="An unseen route, synthetic fleet")
    top.legend()
    table = np.asarray(result["confusion"], dtype=float)
    share = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    image = below.imshow(share, vmin=0, vmax=1, cmap="Blues", origin="lower", aspect="auto")
    ticks = range(len(table))
    below.set(xlabel="predicted gear", ylabel="true gear", xticks=ticks, yticks=ticks)
    below.set_xticklabels([str(k + 1) for k in ticks])
    below.set_yticklabels([str(k + 1) for k in ticks])
    fig.colorbar(image, ax=below, label="share of the true gear's rows, unseen routes")
    fig.tight_layout()
    save_figure(run, fig, name)
    plt.close(fig)
