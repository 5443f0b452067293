"""Tables of paper 2: the paper's number, ours, their ratio; trips, free run beside one step, spread over starts."""

from typing import Any

import numpy as np

from experiments.tables import write_tables
from hdev_jax.rundir import Run

__all__ = ["collect"]


def collect(config: Any, results: Any, run: Run) -> dict[str, Any]:
    """`metrics.json` and tables of one artefact."""
    found = {task["name"]: result for task, result in results}
    rows, lines, starts = [], [], []
    for name in config.order:
        paper = config.paper.get(name)
        if name not in found:
            rows.append({"name": name, "paper": paper, "ours": None, "reason": config.reasons.get(name, "not run")})
            lines += [_line(name, key, paper, None) for key in config.show]
            continue
        ours = _ours(config, found[name])
        if paper is not None and (both := [k for k in paper if k in ours and paper[k]]):
            ours["ratio"] = {k: ours[k] / paper[k] for k in both}
        rows.append({"name": name, "paper": paper, "ours": ours})
        lines += [_line(name, key, paper, ours) for key in config.show]
        if len(found[name]["spread"]) > 1:
            starts.append(_starts(name, found[name]))
    artefact = config.artefact.rpartition("/")[2]
    write_tables(run, artefact, lines, config.caption)
    if starts:
        write_tables(run, f"{artefact}_starts", starts, "Spread over starts, mean MSE of the test trips [kW²]")
    if config.notes:
        run.path("notes.txt").write_text("\n".join(config.notes) + "\n")
    first = config.show[0]
    compared = [r for r in rows if r["ours"] and r["paper"] and first in r["paper"] and first in r["ours"]]
    return {
        "artefact": config.artefact, "data": "kia_niro", "synthetic": False, "rows": rows,
        "better_than_paper": sum(abs(r["ours"][first]) <= abs(r["paper"][first]) for r in compared),
        "of": len(compared), "notes": config.notes, "logs": 1 + len(config.test), "skipped": [], "missed": [],
    }  # fmt: skip


def _ours(config: Any, result: dict[str, Any]) -> dict[str, Any]:
    """The paper's keys, from the configuration that the table is of, and the other one beside it."""
    trips = result["trips"]
    own = "free" if config.free_run else "step"
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
            out[f"pe{kind}_trip{t}"] = m[f"{own}_pe{kind}"]
            out[f"free_pe{kind}_trip{t}"] = m[f"free_pe{kind}"]
    out |= {
        "free_run": config.free_run, "parameters": result["parameters"],
        "step_ms": 1e3 * result["step_seconds"], "fit_seconds": result["fit_seconds"],
    }  # fmt: skip
    if len(result["spread"]) > 1:
        out["spread"] = _starts("", result)
    if result["settings_found"]:
        out["settings_found"] = result["settings_found"]
    return out


def _line(name: str, key: str, paper: dict[str, float] | None, ours: dict[str, Any] | None) -> dict[str, Any]:
    theirs = None if paper is None else paper.get(key)
    own = None if ours is None else ours.get(key)
    return {
        "model": name, "number": key, "paper": _digits(theirs), "ours": _digits(own),
        "ratio": own / theirs if theirs and own is not None else None,
        "free run": _digits(ours["free_test_mean"]) if ours and key == "test_mean" else None,
        "parameters": ours["parameters"] if ours else None,
    }  # fmt: skip


def _digits(x: Any) -> str | None:
    return None if x is None else f"{x:.4g}" if isinstance(x, float) else str(x)


def _starts(name: str, result: dict[str, Any]) -> dict[str, Any]:
    """The chosen start beside all of them: the luckiest is not the result."""
    spread = np.asarray(result["spread"])
    row = {
        "chosen": float(spread[0]), "least": float(spread.min()), "median": float(np.median(spread)),
        "most": float(spread.max()), "starts": len(spread),
    }  # fmt: skip
    return {"model": name, **{k: _digits(v) for k, v in row.items()}} if name else row
