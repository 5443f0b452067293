"""What a log leaves open, in words: directions that only the table knows, tables that it contradicts, rows alone."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hdev_jax.inference.design import LinearFit
from hdev_jax.inference.linear import Statistics, least_squares

__all__ = ["OUTLIER", "caveats"]

WEAK_INFORMATION = 0.25  # what the log says of a direction, over what the table says of it: less is as good as nothing
NOTHING = 1e-4  # of the best determined direction of columns of one size: less is one column twice
TAKES_PART = 0.3  # of a direction of length 1, from which on a coefficient is named
CONTRADICTS = 3.0  # standard deviations of table and log together
OUTLIER = 10.0  # times the noise of all other rows
FEW_ROWS = 10


def caveats(fit: LinearFit) -> list[str]:
    """Sentences on what the fit's numbers do not say by themselves; none where the log determines every coefficient.

    One set of coefficients. Of several groups, `caveats` of each are prefixed with its number.
    """
    if fit.at.ndim == 1:
        return _of_one(fit.table_names, fit, fit.statistics, fit.at, np.asarray(fit.prior.mean))
    found = []
    for g in range(len(fit.at)):
        one = Statistics(*(leaf[g] for leaf in _leaves(fit.statistics)))
        said = _of_one(fit.table_names, fit, one, fit.at[g], np.asarray(fit.prior.mean[g]))
        found += [f"group {g}: {line}" for line in said]
    return found


def _leaves(s: Statistics) -> tuple:
    return s.gram, s.moment, s.square, s.rows, s.driving, s.largest


def _undetermined(gram: Float[np.ndarray, "k k"]) -> set[int]:
    """Coefficients that take part in a direction that the log does not determine, whatever the tables say."""
    d = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(d, d))
    empty = {k for k in range(len(d)) if gram[k, k] <= 0}
    null = vectors[:, values < NOTHING * max(float(values[-1]), 1e-300)]
    return empty | {k for v in null.T for k in range(len(d)) if abs(v[k]) > TAKES_PART}


def _of_one(
    names: Sequence[str], fit: LinearFit, data: Statistics, at: Float[np.ndarray, " k"], table: Float[np.ndarray, " k"]
) -> list[str]:
    rows = float(data.rows) * fit.inflation
    if rows <= 0:
        return ["there are no rows: every coefficient comes from the table"]
    out = []
    if rows < FEW_ROWS:
        out.append(f"{rows:.0f} rows: the noise is mostly its prior, not measured")
    if float(data.driving) <= 0:
        out.append("every row gives energy back: this log does not identify the cost of driving")
    gram = np.asarray(data.gram)
    sd = fit.tabular_sd / fit.scale
    noise = float(np.mean(np.asarray(fit.posterior.sigma)))
    values, vectors = np.linalg.eigh(gram * np.outer(sd, sd) / noise**2)
    undetermined = _undetermined(gram)
    for value, v in zip(values, vectors.T, strict=True):
        members = [k for k in range(len(v)) if abs(v[k]) > TAKES_PART]
        if value >= WEAK_INFORMATION:
            continue
        which = " and ".join(names[k] for k in members)
        if not undetermined & set(members):
            out.append(f"{which}: the table is far more certain than this log, so the value comes from the table")
        elif len(members) == 1:
            out.append(f"{names[members[0]]} is not identified by this log: its value comes from the table")
        else:
            out.append(f"this log cannot separate {which}: how they share their effect comes from the table")
    out = list(dict.fromkeys(out))  # two directions of the same members are one sentence
    step, covariance, _ = least_squares(data)
    determined = [k for k in range(len(step)) if k not in undetermined]
    for k in determined:
        spread = float(np.sqrt(sd[k] ** 2 + np.asarray(covariance)[k, k]))
        if abs(float(step[k]) - table[k]) > CONTRADICTS * spread and fit.table.free[k].sd is not None:
            says = at[k] + fit.scale[k] * float(step[k])
            own = at[k] + fit.scale[k] * table[k]
            out.append(
                f"{names[k]}: the log says {says:.4g} and the table {own:.4g} ± {fit.tabular_sd[k]:.2g}: one of them "
                "is wrong, or something is missing in the model"
            )
    others = max(float(data.square) - float(data.largest), 0.0) / max(float(data.rows) - 1.0, 1.0)
    if rows > FEW_ROWS and float(data.largest) > OUTLIER**2 * others:
        times = float(jnp.sqrt(data.largest / max(others, 1e-300)))
        out.append(f"one row is off by {min(times, 1e6):.3g} times the noise of all others: check it, or use student_t")
    return out
