"""The planted study's sizes and errors: do intervals hold the planted size, is the error that of an oracle?"""

from typing import Any

from experiments.planted import scores as scores
from experiments.planted.scores import Group
from experiments.runner.tables import wilson
from hdev_jax.physics import LIBRARY

__all__ = ["CAPTION", "NEAR_ORACLE", "sized_rows"]

COVERED = (0.85, 0.95)  # of 90 % intervals, after selection
ORACLE = 0.90  # of the logs within NEAR_ORACLE of the error of an oracle that knows the cause
NEAR_ORACLE = 1.05
# of the noise, from which on an oracle's error is out of reach of a model that found nothing: √(1 + 0.5²) = 1.118
TELLING = 0.5
CAPTION = (
    "Planted effects: intervals of coefficients (n coefficients, of effects named by their own id) and test errors (n "
    "logs), over all logs with an effect to be named; target met: the share is in the target range"
)


def sized_rows(able: Group) -> list[dict[str, Any]]:
    """A row for each share, over all logs that are asked for names."""
    return [*_covered(able), *_near_oracle(able)]


def _share(name: str, hits: int, n: int, wanted: tuple[float, float] | None) -> dict[str, Any]:
    return {
        "name": name, "n": n, "share": hits / n, "interval_95": list(wilson(hits, n)),
        "wanted_range": list(wanted) if wanted else None, "met": wanted[0] <= hits / n <= wanted[1] if wanted else None,
    }  # fmt: skip


def _covered(able: Group) -> list[dict[str, Any]]:
    """Do intervals hold what they should, over all logs with an effect of the library and over each kind of log."""
    name = "90 % intervals that hold the planted coefficient"
    kinds = list(dict.fromkeys(t["entry"] for t, _ in able))
    rows = []
    for words, of in (("", kinds), *((f", logs that enter at the {k}", [k]) for k in kinds if len(kinds) > 1)):
        covered = [s["covered"] for t, r in able if _in_library(t) and t["entry"] in of for s in r["sizes"]]
        if covered:
            rows.append(_share(f"{name}{words}", sum(covered), len(covered), COVERED))
    return rows


def _near_oracle(able: Group) -> list[dict[str, Any]]:
    """Is the error after the diagnosis that of an oracle: size by size, and where finding nothing would not pass.

    The oracle of what the library holds in another form is the noise itself.
    """
    name = "test error within 5 % of that of a fit that knows the cause"
    near = [
        (t["size"], _in_library(t), r["test_rmse"]["after"] < NEAR_ORACLE * r["oracle_rmse"])
        for t, r in able if t["size"] and scores.nameable(t["effects"])
    ]  # fmt: skip
    rows = []
    for size in sorted({s for s, inside, _ in near if inside}):
        hits = [ok for s, inside, ok in near if inside and s == size]
        rows.append(_share(f"{name}, effect/noise {size:g}", sum(hits), len(hits), None))
    for words, inside in ((f"effect/noise {TELLING:g} and above", True), ("truths in another form", False)):
        hits = [ok for s, held, ok in near if held == inside and s >= TELLING]
        if hits:
            rows.append(_share(f"{name}, {words}", sum(hits), len(hits), (ORACLE, 1.0)))
    return rows


def _in_library(task: dict[str, Any]) -> bool:
    """Whether something was planted that the library holds as it is."""
    return bool(task["effects"]) and all(k in LIBRARY for k in task["effects"])
