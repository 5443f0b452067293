"""The planted study's table of rivals: ours and theirs on the same logs, credited by the same classes."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.planted import scores as scores
from experiments.planted.rivals import comparable
from experiments.planted.scores import Group
from experiments.runner.tables import readable

__all__ = ["LABELS", "outcome", "rival_rows"]

LABELS = {"ours": "hdev_jax", "ours_first": "hdev_jax, first name only", "stlsq": "STLSQ (PySINDy)",
          "lasso_cv": "LassoCV", "forward_bic": "forward BIC"}  # fmt: skip


def outcome(planted: Sequence[str], result: dict[str, Any], method: str) -> tuple[bool, bool]:
    """Whether a method named exactly what was planted, and whether it named anything else; `ours_first` is ours with
    the first name of each entry alone."""
    if method == "ours":
        return scores.exact(planted, result["named"]), scores.false(planted, result["named"])
    if method == "ours_first":
        named, right = [n["id"] for n in result["named"]], [{k} for k in scores.names(planted)]
    else:
        named, right = result["rivals"][method]["named"], scores.alike(planted, result)
    return scores.rival_exact(right, named), scores.rival_false(right, named)


def rival_rows(groups: Sequence[tuple[str, Group]], rivals: Sequence[str]) -> list[dict[str, Any]]:
    """A row for each setting and method; `lightgbm` names nothing."""
    rows = []
    for setting, every in groups:
        group = [(t, r) for t, r in every if r["rivals"] and comparable(t["effects"])]
        for method in ("ours", "ours_first", *rivals) if group else ():
            names = method != "lightgbm"
            hits = [outcome(t["effects"], r, method) for t, r in group] if names else []
            ours = method.startswith("ours")
            error = [
                (r["test_rmse"]["after"] if ours else r["rivals"][method]["test_rmse"]) / r["oracle_rmse"]
                for _, r in group
            ]
            took = [r["seconds"] if ours else r["rivals"][method]["seconds"] for _, r in group]
            rows.append({
                "name": f"{setting}: {LABELS.get(method, readable(method))}", "n": len(group),
                "exactly": float(np.mean([h for h, _ in hits])) if names else None,
                "false": float(np.mean([f for _, f in hits])) if names else None,
                "test_over_oracle": float(np.median(error)), "seconds": float(np.median(took)),
            })  # fmt: skip
    return rows
