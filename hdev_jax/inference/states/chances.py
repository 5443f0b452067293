"""What the chances of switching depend on: logistic regression of the moves of decoded loads.

A move from state i to j over a row has the chance A = keep·δ + (1 − keep)·p, p being the share of time on, whose
log-odds are those of the temperature plus a sum over `COVARIATES`. The expected log-likelihood of the decoded moves is
maximised: a step of expectation-maximisation, so the likelihood of the residual gains as much at least (Dempster, Laird
and Rubin, JRSS B 39, 1977).
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, stats

from hdev_jax.inference.states.decode import Decoded
from hdev_jax.inference.states.model import LEAST_MEMORY_S, MOST_MEMORY_S, Switching
from hdev_jax.inference.states.rows import StateRows
from hdev_jax.physics.states import COVARIATES, KNOTS_C

__all__ = ["chances", "contrasts", "what_it_depends_on"]

SHRINK = 0.5  # precision of a knot's log-odds about the mean of all: as of 5 minutes of a load with a minute's memory
STEPS = 3  # of the coefficients in a round of expectation-maximisation, which comes back to them
FURTHEST = 8.0  # log-odds beyond which a share is 0 or 1 in any log
KNOTS = len(KNOTS_C)
FIRST = 1 + KNOTS  # place of the first covariate, after the memory and the knots
PULL = np.pad(SHRINK * (np.eye(KNOTS) - 1.0 / KNOTS), ((1, 0), (1, 0)))  # of memory and knots


class _Chance(NamedTuple):
    """Of each row: chance of being on after it by the state before it (`on`); its derivatives by the logarithm of the
    memory (`by_memory`) and, the same from either state, by the row's log-odds (`by_odds`); theirs by the share of time
    on (`by_share`), the share's at a knot by its log-odds (`by_knot`); and theirs by the coefficients (`columns`)."""

    on: Float[np.ndarray, "row before"]
    by_memory: Float[np.ndarray, "row before"]
    by_odds: Float[np.ndarray, " row"]
    by_share: Float[np.ndarray, " row"]
    by_knot: Float[np.ndarray, " knot"]
    columns: Float[np.ndarray, "row covariate"]


class _Fitted(NamedTuple):
    theta: Float[np.ndarray, " k"]
    value: float


class _Moves:
    """The moves of one load: what they say of its memory, its log-odds at `KNOTS_C` and of the coefficients of some
    covariates."""

    def __init__(self, model: Switching, rows: StateRows, decoded: Decoded, load: int) -> None:
        self.seconds = np.where(np.r_[True, np.diff(rows.trip) != 0], np.inf, rows.duration_s)  # before a trip is none
        self.moved = decoded.moves[:, load]
        self.hats = np.stack([np.interp(rows.temp_c, KNOTS_C, e) for e in np.eye(KNOTS)], axis=1)
        self.beside = rows.beside
        share = np.clip(model.share[load], 1e-4, 1.0 - 1e-4)
        self.start = np.r_[np.log(model.memory_s[load]), np.log(share / (1.0 - share))]
        self.by = model.by[load]

    def _chance(self, theta: np.ndarray, columns: Sequence[int]) -> _Chance:
        x, over = self.beside[:, list(columns)], self.seconds / np.exp(theta[0])
        keep = np.exp(-over)[:, None]
        own = 1.0 / (1.0 + np.exp(-theta[1:FIRST]))
        share = self.hats @ own
        odds = share * np.exp(np.clip(x @ theta[FIRST:], -30.0, 30.0))
        p = (odds / (odds + 1.0 - share))[:, None]
        longer = np.where(np.isfinite(over), over, 0.0)[:, None] * keep * (np.array([0.0, 1.0]) - p)
        on = np.clip((1.0 - keep) * p + keep * np.array([0.0, 1.0]), 1e-9, 1.0 - 1e-9)
        by_odds = ((1.0 - keep) * p * (1.0 - p))[:, 0]
        return _Chance(on, longer, by_odds, 1.0 / (share * (1.0 - share)), own * (1.0 - own), x)

    def _scores(self, chance: _Chance) -> Float[np.ndarray, "row before"]:
        """Derivatives of each row's log-likelihood by its chances of being on."""
        return self.moved[:, :, 1] / chance.on - self.moved[:, :, 0] / (1.0 - chance.on)

    def _jacobian(self, chance: _Chance) -> Float[np.ndarray, "row before k"]:
        """Derivatives of the chances by all that is fitted."""
        knots = self.hats * chance.by_share[:, None] * chance.by_knot
        same = chance.by_odds[:, None] * np.hstack([knots, chance.columns])
        return np.concatenate([chance.by_memory[:, :, None], same[:, None, :].repeat(2, axis=1)], axis=2)

    def _gradient(self, chance: _Chance) -> Float[np.ndarray, " k"]:
        """Derivatives of the log-likelihood of all rows."""
        scores = self._scores(chance)
        weight = np.sum(scores, axis=1) * chance.by_odds
        knots = (weight * chance.by_share) @ self.hats * chance.by_knot
        return np.r_[np.sum(scores * chance.by_memory), knots, weight @ chance.columns]

    def fitted(self, columns: Sequence[int], steps: int = 100) -> _Fitted:
        """The values that suit the moves best, or better than the present ones after so many `steps`."""

        def cost(theta: np.ndarray) -> tuple[float, np.ndarray]:
            chance, pull = self._chance(theta, columns), PULL @ theta[:FIRST]
            total = np.sum(self.moved[:, :, 1] * np.log(chance.on) + self.moved[:, :, 0] * np.log1p(-chance.on))
            gradient = self._gradient(chance)
            gradient[:FIRST] -= pull
            return 0.5 * float(theta[:FIRST] @ pull) - float(total), -gradient

        memory = (np.log(LEAST_MEMORY_S), np.log(MOST_MEMORY_S))
        odds = [(-FURTHEST, FURTHEST)] * KNOTS + [(-2.0 * FURTHEST, 2.0 * FURTHEST)] * len(columns)
        found = optimize.minimize(
            cost, np.r_[self.start, self.by[list(columns)]], jac=True, method="L-BFGS-B", bounds=[memory, *odds],
            options={"maxiter": steps},
        )  # fmt: skip
        return _Fitted(np.asarray(found.x), -float(found.fun))

    def p_last(self, fitted: _Fitted, columns: Sequence[int], clusters: Int[np.ndarray, " row"]) -> float:
        """p of the last coefficient, with errors of whole clusters: the jackknife in one step, Student's t."""
        chance = self._chance(fitted.theta, columns)
        weight = self.moved.sum(axis=2) / (chance.on * (1.0 - chance.on))
        at = np.flatnonzero(np.r_[True, np.diff(clusters) != 0])
        if (n := len(at)) < 3:
            return 1.0
        jacobian = self._jacobian(chance)
        grams = np.stack([np.einsum("rb,rbj,rbk->jk", weight[a:b], jacobian[a:b], jacobian[a:b])
                          for a, b in pairwise([*at, len(clusters)])])  # fmt: skip
        total = grams.sum(axis=0)
        total += 1e-9 * np.trace(total) * np.eye(len(total))
        total[:FIRST, :FIRST] += PULL
        scores = np.add.reduceat(np.einsum("rb,rbk->rk", self._scores(chance), jacobian), at)
        moves = np.linalg.solve(total - (1.0 - 1e-6) * grams, scores[:, :, None])[:, -1, 0]
        error = float(np.sqrt((n - 1) / n * np.sum((moves - moves.mean()) ** 2)))
        naive = float(np.sqrt(np.linalg.inv(total)[-1, -1]))
        return 2.0 * float(stats.t.sf(abs(fitted.theta[-1]) / max(error, naive), n - 1))

    def put(self, model: Switching, load: int, fitted: _Fitted, columns: Sequence[int]) -> Switching:
        """The model with the load's chances of switching as fitted."""
        share, by, memory = model.share.copy(), model.by.copy(), model.memory_s.copy()
        share[load] = 1.0 / (1.0 + np.exp(-fitted.theta[1:FIRST]))
        by[load] = 0.0
        by[load, list(columns)] = fitted.theta[FIRST:]
        memory[load] = np.exp(fitted.theta[0])
        return replace(model, share=share, by=by, memory_s=memory)


def chances(model: Switching, rows: StateRows, decoded: Decoded) -> Switching:
    """The model with the chances of switching that suit the decoded moves best, of the loads whose chances depend on
    covariates; those are as they were for the others."""
    for k in np.flatnonzero(np.any(model.by, axis=1)).tolist():
        moves, columns = _Moves(model, rows, decoded, k), np.flatnonzero(model.by[k]).tolist()
        model = moves.put(model, k, moves.fitted(columns, STEPS), columns)
    return model


def what_it_depends_on(
    model: Switching, rows: StateRows, decoded: Decoded, clusters: Int[np.ndarray, " row"], *, cost: float, level: float
) -> Switching:
    """The model with more covariates that its chances of switching depend on, added one at a time, the best first.

    **Arguments:** `clusters`, which rows have errors in common; `cost`, what each coefficient has to gain in
    log-likelihood; `level` of its p-value over all covariates and loads that are tried.
    """
    able = [c for c in range(len(COVARIATES)) if np.ptp(rows.beside[:, c]) > 0]
    for k in range(len(model.power_w)):
        moves, chosen = _Moves(model, rows, decoded, k), np.flatnonzero(model.by[k]).tolist()
        best, before = moves.fitted(chosen), len(chosen)
        while left := [c for c in able if c not in chosen]:
            tried = {c: moves.fitted([*chosen, c]) for c in left}
            c = max(tried, key=lambda c: tried[c].value)
            p = moves.p_last(tried[c], [*chosen, c], clusters) * len(able) * len(model.power_w)
            if tried[c].value - best.value < cost or p > level:
                break
            best, chosen = tried[c], [*chosen, c]
        if len(chosen) > before:
            model = moves.put(model, k, best, chosen)
    return model


def contrasts(model: Switching, rows: StateRows, load: int) -> list[dict[str, Any]]:
    """What a load's share of time on depends on beside the temperature: the expected share over the rows' time where
    that is as high, and as low, as in any of the rows."""
    out = []
    for c in np.flatnonzero(model.by[load]):
        extremes = float(np.max(rows.beside[:, c])), float(np.min(rows.beside[:, c]))
        shares = []
        for x in extremes:
            beside = rows.beside.copy()
            beside[:, c] = x
            shares.append(
                float(np.average(model.expected(replace(rows, others=beside))[:, load], weights=rows.duration_s))
            )
        what = COVARIATES[c]
        out.append({
            "by": what.name, "log_odds": float(model.by[load, c]),
            "high": what.high, "share_high": shares[0], "low": what.low, "share_low": shares[1],
        })  # fmt: skip
    return out
