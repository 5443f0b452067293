"""What a fit has left beside its sheet: `predictive.json`, the coefficients' covariance and the noise."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hdev_jax.errors import InputError
from hdev_jax.inference import Spread
from hdev_jax.problem import Problem
from hdev_jax.targets import TARGETS
from hdev_jax.textfiles import digest
from hdev_jax.verbs.result import PREDICTIVE

__all__ = ["beside_sheet", "covariance_of"]


def beside_sheet(sheet: Path) -> dict[str, Any]:
    """The file beside a fitted sheet; `stale` alone where the sheet was changed since.

    Raises `InputError` where the file is there and cannot be used.
    """
    path = sheet.parent / PREDICTIVE
    try:
        found = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as e:
        raise InputError(f"{path}: does not read as JSON: {e}; fit the sheet again, or delete the file") from e
    try:
        same = found["sheet_sha256"] == digest(sheet)
        names, matrix = found["covariance"]["names"], np.asarray(found["covariance"]["matrix"], dtype=float)
        spread = {k: float(v) for k, v in found["spread"].items()}
        right = (
            found["target"] in TARGETS
            and matrix.size == len(names) ** 2
            and np.all(np.isfinite(matrix))
            and {f.name for f in fields(Spread)} == set(spread)
            and np.all(np.isfinite(list(spread.values())))
            and min(spread["scale"], spread["freedom"], spread["total_freedom"], spread["row_s"]) > 0
        )
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise InputError(f"{path}: {type(e).__name__}: {e}; fit the sheet again, or delete the file") from e
    if not right:
        raise InputError(
            f"{path}: covariance or spread is not as hdev writes it; fit the sheet again, or delete the file"
        )
    return found if same else {"target": found["target"], "stale": True}


def covariance_of(problem: Problem, known: Mapping[str, Any]) -> Float[np.ndarray, "free free"]:
    """The coefficients' covariance, in the table's order; from their sds alone where there is no other."""
    free = problem.table.free
    names = known.get("covariance", {}).get("names", [])
    covariance = np.diag([(c.sd or 0.0) ** 2 for c in free]).reshape(len(free), len(free))
    there = [k for k, c in enumerate(free) if c.name in names]
    if there:
        at = [names.index(free[k].name) for k in there]
        matrix = np.asarray(known["covariance"]["matrix"], dtype=float).reshape(len(names), len(names))
        covariance[np.ix_(there, there)] = matrix[np.ix_(at, at)]
    return covariance
