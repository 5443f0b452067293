"""Which of the settings that were tried on trip 1 is best, and whether the tables' models are those."""

from collections.abc import Mapping
from typing import Any

from experiments.paper2.models import Settings
from experiments.runner.config import typed
from experiments.runner.tables import write_tables
from hdev_jax.errors import InputError
from hdev_jax.rundir import Run

__all__ = ["chosen_keys", "collect"]

RULES = {"least": "the start with the lowest training loss", "ensemble": "the mean prediction of all starts"}
CHOSEN = ("units", "rate", "ridge_slope", "outputs")  # numbers that may be at the edge of the grid


def chosen_keys(model: Settings, keys: Mapping[str, Any]) -> dict[str, Any]:
    """What a structure and its loss are made of, in the settings of `model` with `keys` in their place.

    **Raises:** `InputError` where a key is none of theirs, or a value of the wrong type.
    """
    where = f"what is tried, {', '.join(keys)}"
    settings = typed(Settings, {**model.model_dump(mode="json"), **keys}, where)
    if odd := [k for k in keys if k not in settings.choices]:
        raise InputError(f"{where}: key {odd[0]} is not chosen here; keys are {', '.join(settings.choices)}")
    return settings.chosen()


def collect(config: Any, results: Any, run: Run) -> dict[str, Any]:
    """In the order tried, with the best of each group, and whether the tables' model is that.

    A setting is judged by the mean over its starts: the start of least loss is one draw, and scatters. Then, in the
    best setting, the rule that makes one model of several starts is judged: the start of least loss on the rows that
    it was fitted on, or the mean of all starts' predictions.
    """
    found = {(task["group"], task["name"]): (task, result) for task, result in results}
    rows, lines, missed, edges = [], [], [], []
    for key, group in config.picked.items():
        model, own = config.models[group.model], {n: found[key, n] for n in group.tried if (key, n) in found}
        best = min(own, key=lambda n: own[n][1]["mean_mse"]) if own else ""
        for name, (task, result) in own.items():
            is_best, is_used = name == best, task["settings"] == chosen_keys(model, {})
            rows.append({"name": f"{key}: {name}", "paper": None, "ours": {**result, "best": is_best, "used": is_used}})
            line = {"model": key, "tried": name, "starts": result["starts"], "mean MSE": result["mean_mse"]}
            line |= {"parameters": result["parameters"], "best": is_best, "in the tables": is_used}
            line |= {"blocks": result["blocks_mse"], "edge": result["edge_mse"]}
            if result["starts"] > 1:
                line |= {"start with lowest loss": result["least_mse"], "ensemble": result["ensemble_mse"]}
            lines.append(line)
            if not (is_best and group.decides):
                continue
            edges += [f"{key}: {what}" for what in _at_the_edge(name, {n: t["settings"] for n, (t, _) in own.items()})]
            rule = min(RULES, key=lambda r: result[f"{r}_mse"])
            if not is_used:
                missed.append(f"{group.model} of the tables is not the best on trip 1, which is {name}")
            if result["starts"] > 1 and model.rule != rule:
                missed.append(
                    f"the tables are meant to have what is better on held-out rows of trip 1, for {group.model} "
                    f"{RULES[rule]}; they have {RULES[model.rule]}"
                )
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False, "rows": rows,
        "better_than_paper": 0, "of": 0, "logs": 1, "missed": missed,
        "notes": [
            "The paper chose its orders on its test trips; here they are chosen on held-out rows of trip 1, and no "
            "other trip is used",
            "The best setting has the lowest mean MSE over its starts",
            "Unless stated otherwise, the ridge is 1e-3 and the loss is Huber's with its corner at 0.4 kW; orders are "
            "tried with NARXP's units and ridge",
            *_recurrent_notes(config),
            *([f"Chosen values at the edge of their grid: {'; '.join(edges)}"] if edges else []),
            "Networks and NARX are chosen from these grids, the classical models by Optuna on trip 1",
        ],
    }  # fmt: skip


def _at_the_edge(best: str, tried: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Numbers of the best setting that are the least or the largest of those tried."""
    out = []
    for key in CHOSEN:
        values = {s[key] for s in tried.values() if key in s}
        if len(values) > 1 and (own := tried[best][key]) in (min(values), max(values)):
            out.append(f"{key} {own:g} ({'smallest' if own == min(values) else 'largest'})")
    return out


def _recurrent_notes(config: Any) -> list[str]:
    """How recurrent networks are judged, where there are any."""
    own = [g.model for g in config.picked.values() if config.models[g.model].kind == "recurrent"]
    if not own:
        return []
    by_model = {n: config.models[n].steps for n in own}
    steps = " and ".join(f"{count} steps ({n})" for n, count in by_model.items())
    if len(set(by_model.values())) == 1:
        steps = f"{config.models[own[0]].steps} steps"
    return [
        f"{' and '.join(own)} are validated on blocks of time only, with {config.recurrent_starts} starts of "
        f"{config.recurrent_steps} steps; for the tables they are trained for {steps}"
    ]
