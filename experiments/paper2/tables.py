"""Tables of paper 2: the paper's number, ours, their ratio, and all starts beside the one that is the model."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.runner.compare import tally
from experiments.runner.tables import readable, write_tables
from hdev_jax.errors import InputError
from hdev_jax.rundir import Run

__all__ = ["OF_SOME", "collect"]

DIVERGED_KW2 = 1e6  # an error above this is of a run that left the numbers
OF_SOME = ("change_percent", "step_ms")  # numbers that not every row has
PREDICTION = ("NARXP", "NNP")  # the P of their names: one step ahead in whatever table they stand (tables VIII and IX)


def collect(config: Any, results: Any, run: Run) -> dict[str, Any]:
    """The rows of one artefact, and its table: a line for each model and number of `config.show`."""
    found = {task["name"]: result for task, result in results if not task.get("timed")}
    seconds = {task["name"]: result["step_seconds"] for task, result in results if task.get("timed")}
    rows, lines, first = [], [], config.show[0]
    for name in config.order:
        if name not in found:
            rows.append({"name": name, "paper": config.paper.get(name), "ours": None, "reason": "not run"})
            continue
        way = "free" if config.free_run and name not in PREDICTION else "step"
        paper, spread = config.paper.get(name), _spread(config, found[name], way)
        ours = _ours(config, found[name], config.models[name], way)
        if "change_percent" in config.show and rows and rows[0]["ours"]:
            ours["change_percent"] = 100.0 * (ours[first] / rows[0]["ours"][first] - 1.0)
        if name in seconds:
            ours["step_ms"] = 1e3 * seconds[name]
        if first == "test_mean" and spread[first]["starts"] > 1:
            ours["spread"] = spread["test_mean"]
        rows.append({"name": name, "paper": paper, "ours": ours})
        if odd := [key for key in config.show if key not in ours and key not in (paper or {}) and key not in OF_SOME]:
            raise InputError(f"config, key show: no number {odd[0]!r}; there are {', '.join(ours)}")
        lines += [_line(name, key, paper or {}, ours, spread.get(key, {})) for key in config.show]
    write_tables(run, config.artefact.rpartition("/")[2], lines, config.caption)
    compared = [r for r in rows if r["ours"] and r["paper"] and first in r["paper"]]
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False, "rows": rows,
        **tally(rows, first), "notes": [*config.notes, *_described(config, found)], "logs": 1 + len(config.test),
        "missed": [
            f"{r['name']}: {readable(first)} {r['ours'][first]:.4g}, the paper's {r['paper'][first]:.4g}"
            for r in compared if abs(r["ours"][first]) > abs(r["paper"][first])
        ],
    }  # fmt: skip


def _ours(config: Any, result: Mapping[str, Any], settings: Any, own: str) -> dict[str, Any]:
    """The paper's keys, from the configuration `own` that the row is of, and the other one beside it.

    Energies are in kWh, errors of energy in %: `signed_energy_error` with their sign, `energy_error` without, as the
    paper has them.
    """
    trips = result["trips"]
    out: dict[str, Any] = {f"trip{t}": trips[t][f"{own}_mse"] for t in trips}
    out["test_mean"] = float(np.mean([trips[t][f"{own}_mse"] for t in config.test]))
    for way in ("step", "free"):
        out[f"{way}_test_mean"] = float(np.mean([trips[t][f"{way}_mse"] for t in config.test]))
        out[f"{way}_worst_energy_percent"] = max((abs(trips[t][f"{way}_pe"]) for t in config.test), default=0.0)
    for t, m in trips.items():
        out[f"fit_trip{t}"] = m[f"{own}_fit"]
        for kind in ("", "_positive", "_negative"):
            out[f"energy{kind}_trip{t}"] = m[f"{own}_energy{kind}"]
            out[f"measured{kind}_trip{t}"] = m[f"energy{kind}"]
            out[f"signed_energy_error{kind}_trip{t}"] = m[f"{own}_pe{kind}"]
            out[f"energy_error{kind}_trip{t}"] = abs(m[f"{own}_pe{kind}"])
            out[f"signed_energy_error_in_free_run{kind}_trip{t}"] = m[f"free_pe{kind}"]
    out |= {"free_run": own == "free", "parameters": result["parameters"], "rule": settings.rule}
    if result["settings_found"]:
        out["settings_found"] = result["settings_found"]
    return out


def _spread(config: Any, result: Mapping[str, Any], way: str) -> dict[str, dict[str, Any]]:
    """MSE of every start, in the order of the loss on the training trip, and of their mean; by trip and over tests."""
    key = f"{way}_mse"
    every = {f"trip{t}": (np.asarray(m[key]), result["ensemble"][t][key]) for t, m in result["starts"].items()}
    tests = [every[f"trip{t}"] for t in config.test]
    every["test_mean"] = (np.mean([e for e, _ in tests], axis=0), float(np.mean([m for _, m in tests])))
    return {name: _starts(mse, mean) for name, (mse, mean) in every.items()}


def _starts(mse: np.ndarray, mean: float) -> dict[str, Any]:
    return {
        "chosen": float(mse[0]), "least": float(mse.min()), "median": float(np.median(mse)), "most": float(mse.max()),
        "ensemble": mean, "starts": len(mse), "every": mse.tolist(),
    }  # fmt: skip


def _line(
    name: str, key: str, paper: Mapping[str, float], ours: Mapping[str, Any], spread: Mapping[str, Any]
) -> dict[str, Any]:
    several = spread if spread.get("starts", 0) > 1 else {}
    theirs, own = paper.get(key), ours.get(key)
    return {
        "model": name, "quantity": readable(key), "paper": _digits(theirs), "ours": _digits(own),
        "ratio": own / theirs if theirs and own is not None else None,
        "median": _digits(several.get("median")),
        "range over starts": f"{_digits(several['least'])} to {_digits(several['most'])}" if several else None,
        "ensemble": _digits(several.get("ensemble")),
    }  # fmt: skip


def _digits(x: Any) -> str | None:
    if isinstance(x, float):
        return "diverges" if abs(x) > DIVERGED_KW2 else f"{x:.4g}"
    return None if x is None else str(x)


def _words(x: Any) -> str | None:
    return (", ".join(x) or "none") if isinstance(x, list) else _digits(x)


def _described(config: Any, found: Mapping[str, Any]) -> Sequence[str]:
    """What the columns and rows are, where the table does not say."""
    several = [n for n in found if len(found[n]["losses"]) > 1]
    starts = {n: f"{n} ({len(found[n]['losses'])} starts)" for n in several}
    rules = {
        "least": "the random start with the lowest training loss on trip 1, which is not always the lowest MSE",
        "ensemble": "the mean of all starts' predictions",
    }  # fmt: skip
    said = [
        f"column ours of {', '.join(starts[n] for n in names)}: {words}"
        for rule, words in rules.items()
        if (names := [n for n in several if config.models[n].rule == rule])
    ]
    if several:
        said.append("median and range: over all random starts, for each number separately")
        said.append("ensemble: error of the mean prediction of all starts")
    for n in found:
        if found[n]["converged"] and not all(found[n]["converged"]):
            ended, steps = found[n]["converged"], config.models[n]
            most = f"{steps.simulation_steps} steps in free run" if steps.simulation else f"{steps.steps} steps"
            ours = "" if steps.rule == "ensemble" else f", ours {'among them' if ended[0] else 'not among them'}"
            said.append(f"{n}: {sum(ended)} of {len(ended)} starts converged{ours}; the others stopped after {most}")
    if config.free_run and (ahead := [n for n in found if n in PREDICTION]):
        said.append(f"{', '.join(ahead)}: predicted one step ahead, as in the paper's table; all others in free run")
    for n in found:
        if settings := found[n]["settings_found"]:
            best = ", ".join(f"{k.replace('_', ' ')} {_words(x)}" for k, x in settings.items())
            searched = f"the best of {config.models[n].trials} settings (Optuna, on held-out rows of trip 1)"
            said.append(
                f"{readable(n)}: {searched if config.models[n].kind == 'classical' else 'found on trip 1'}: {best}"
            )
    if "change_percent" in config.show and config.order[0] in found:
        said.append(f"change [%]: of the test mean, relative to {config.order[0]}")
    return [*said, *(f"{readable(n)}: {config.models[n].why}" for n in found if config.models[n].why)]
