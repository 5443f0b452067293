"""Scores of candidates from normal equations by cluster: no refit, no second look at the rows.

Everything is whitened (`whiten.py`), so a cluster's rows enter only through its Gram matrix of Jacobian, candidate
columns and residual. Gains, clustered tests, left-out gains, resampling and sign placebos are algebra on these.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from hdev_jax.diagnosis.candidates import Candidate
from hdev_jax.diagnosis.significance import least_clusters, wald
from hdev_jax.segments import trip_slices

__all__ = ["ABSORBED", "Evidence", "Score"]

AT_ONCE = 2_000_000  # numbers of the matrices of candidates that are scored together: 16 MB
ABSORBED = 3e-3  # share of a column left after projecting the Jacobian off, below which the log cannot show it


@dataclass(frozen=True)
class Score:
    """What a log says of one candidate beside what the vehicle has.

    `gain` in log-likelihood on training rows, `p_model` from it (χ²), `p_cluster` from a Wald test with jackknifed
    clusters (F), `left_out_gain` in log-likelihood over clusters left out in turn, `left` the share of its columns
    that the Jacobian does not hold. `plain`: told by rows that weigh the same (`Evidence.plain_score`).
    """

    candidate: Candidate
    beta: Float[np.ndarray, " k"]
    gain: float
    p_model: float
    p_cluster: float
    left_out_gain: float
    left: float
    plain: bool = False

    @property
    def p(self) -> float:
        """Both tests have to agree; twice that, since whitened and plain rows are both looked at."""
        return min(1.0, 2.0 * max(self.p_model, self.p_cluster))


def _solved(a: Float[np.ndarray, "*way n n"], b: Float[np.ndarray, "*way n"]) -> Float[np.ndarray, "*way n"]:
    """Solutions of normal equations in units of each column's own length."""
    d = np.sqrt(np.maximum(np.einsum("...ii->...i", a), 1e-300))
    return np.linalg.solve(a / (d[..., :, None] * d[..., None, :]), (b / d)[..., None])[..., 0] / d


@dataclass(frozen=True)
class Evidence:
    """Gram matrices by cluster of [Jacobian | candidates | residual], and the prior on the Jacobian's part.

    Trips may have levels of their own: `levels` is what a level of 1 of each trip meets in the same columns, `squares`
    its own square, `home` the cluster of the trip, `variances` those that are tried. Each model takes the variance
    that suits it: a candidate that explains the levels is not held against a variance that still contains them, which
    would let no statistic exceed the number of trips.
    """

    grams: Float[np.ndarray, "cluster d d"]
    levels: Float[np.ndarray, "trip d"]
    squares: Float[np.ndarray, " trip"]
    home: Int[np.ndarray, " trip"]
    variances: Float[np.ndarray, " variance"]
    base: int
    precision: Float[np.ndarray, " base"]
    pull: Float[np.ndarray, " base"]
    _kept: dict[int, np.ndarray] = field(init=False, repr=False, compare=False, default_factory=dict)
    _missed: dict[int, np.ndarray] = field(init=False, repr=False, compare=False, default_factory=dict)

    @property
    def count(self) -> int:
        """Number of clusters."""
        return self.grams.shape[0]

    @cached_property
    def cost(self) -> Float[np.ndarray, " variance"]:
        """Half the log-determinant that each variance of the levels costs."""
        return 0.5 * np.sum(np.log1p(self.variances[:, None] * self.squares), axis=1)

    def _shrink(self, v: int) -> np.ndarray:
        return self.variances[v] / (1.0 + self.variances[v] * self.squares)

    def by_cluster(self, v: int) -> Float[np.ndarray, "cluster d d"]:
        """Gram matrices with levels of the v-th variance taken out."""
        if not self.variances[v]:
            return self.grams
        if v not in self._kept:
            out, shrink = self.grams.copy(), self._shrink(v)
            for g, part in trip_slices(self.home):
                out[g] -= (self.levels[part] * shrink[part, None]).T @ self.levels[part]
            self._kept.clear()  # one variance at a time: each is as large as all Gram matrices
            self._kept[v] = out
        return self._kept[v]

    @cached_property
    def _total(self) -> np.ndarray:
        return self.totals(np.ones(self.count))

    def totals(self, weight: Float[np.ndarray, " cluster"] | None = None) -> Float[np.ndarray, "variance d d"]:
        """One Gram matrix for each variance, each cluster counted so many times."""
        if weight is None:
            return self._total
        plain = np.tensordot(weight, self.grams, axes=1)
        by_trip = weight[self.home][:, None] * self.levels
        every = range(len(self.variances))
        return np.stack([plain - (by_trip * self._shrink(v)[:, None]).T @ self.levels for v in every])

    def _with_base(self, at: np.ndarray) -> np.ndarray:
        """Places of the base columns before those at `at` [*way k]."""
        base = np.broadcast_to(np.arange(self.base), (*at.shape[:-1], self.base))
        return np.concatenate([base, at], axis=-1).astype(int)

    def _normal(self, gram: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrices [*gram *way n n] and right-hand sides for the base columns and those at `at` [*way k]."""
        index = self._with_base(at)
        a = gram[..., index[..., :, None], index[..., None, :]]
        b = gram[..., index, -1]
        diagonal = np.arange(self.base)
        a[..., diagonal, diagonal] += self.precision
        b[..., : self.base] -= self.pull
        every = np.arange(index.shape[-1])
        a[..., every, every] *= 1.0 + 1e-10
        a[..., every, every] += 1e-300
        return a, b

    def _fit(self, gram: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log-likelihood up to a constant [variance *way] and coefficients, for each variance."""
        a, b = self._normal(gram, at)
        alone = (-0.5 * gram[..., -1, -1] - self.cost).reshape(-1, *(1,) * (at.ndim - 1))
        if not a.shape[-1]:
            return alone, b
        x = _solved(a, b)
        return alone + 0.5 * np.einsum("...i,...i->...", b, x), x

    def base_likelihood(self, gram: np.ndarray) -> float:
        """Log-likelihood of the base alone at its best variance, `gram` from `totals`."""
        return float(np.max(self._fit(gram, np.empty(0, int))[0]))

    def gain(self, gram: np.ndarray, at: Sequence[int], before: float | None = None) -> tuple[float, np.ndarray]:
        """Gain in log-likelihood of candidate columns (places from 0) over the base, and their coefficients."""
        likelihood, x = self._fit(gram, self.base + np.asarray(at, dtype=int))
        v = int(np.argmax(likelihood))
        return float(likelihood[v]) - (self.base_likelihood(gram) if before is None else before), x[v, self.base :]

    def gains(self, gram: np.ndarray, ways: Sequence[Sequence[int]]) -> Float[np.ndarray, " way"]:
        """Gains of many ways to have an effect, each by its columns, as `gain` of each."""
        out, before = np.empty(len(ways)), self.base_likelihood(gram)
        for places, at in self._alike(ways, len(self.variances)):
            out[places] = np.max(self._fit(gram, at)[0], axis=0) - before
        return out

    def _alike(self, ways: Sequence[Sequence[int]], cells: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Places among the ways and columns [way k] of those that have equally many, no more at a time than memory
        holds of `cells` matrices for each."""
        count = np.array([len(w) for w in ways], dtype=int)
        for k in np.unique(count):
            places, size = np.flatnonzero(count == k), cells * (self.base + int(k) + 1) ** 2
            for part in np.array_split(places, -(-len(places) * size // AT_ONCE)):
                yield part, self.base + np.array([ways[i] for i in part], dtype=int)

    @cached_property
    def _lefts(self) -> Float[np.ndarray, " column"]:
        """Share of each candidate column that is left after projecting the base columns off."""
        gram = self.totals()[0]
        square, cross = np.diag(gram)[self.base : -1], gram[: self.base, self.base : -1]
        d = np.sqrt(np.maximum(np.diag(gram)[: self.base], 1e-300))
        there = np.isfinite(square) & np.all(np.isfinite(cross), axis=0)
        c = np.where(there, cross, 0.0) / d[:, None]
        x = np.linalg.lstsq(gram[: self.base, : self.base] / np.outer(d, d), c, rcond=1e-10)[0]
        return 1.0 - np.sum(c * x, axis=0) / np.maximum(np.where(there, square, 1.0), 1e-300)

    def left(self, at: Sequence[int]) -> float:
        """Smallest share of the candidate columns that is left after projecting the base columns off."""
        return float(np.min(self._lefts[list(at)])) if self.base else 1.0

    def span(self, gram: np.ndarray, at: int) -> tuple[float, Float[np.ndarray, " base"]]:
        """Share of a column that is left after projecting the base columns off, and the weights of those, each of
        which counts with its length one."""
        gram, j = gram[0], self.base + at
        a = gram[: self.base, : self.base]
        d = np.sqrt(np.maximum(np.diag(a), 1e-300))
        c = gram[: self.base, j] / d
        x = np.linalg.lstsq(a / np.outer(d, d), c, rcond=1e-10)[0]
        return 1.0 - float(c @ x) / max(gram[j, j], 1e-300), x

    def projected(self, at: Int[np.ndarray, " k"]) -> Float[np.ndarray, "left left"]:
        """Gram matrix of columns with the base columns taken off, as far as their prior lets those move.

        Tests are of these: columns that all hold a large constant look alike, what is left of them need not. Columns
        that nothing is left of are not in it.
        """
        none, totals = np.empty(0, int), self.totals()
        v = int(np.argmax(self._fit(totals, none)[0]))
        normal, at = self._normal(totals[v], none)[0], self.base + at
        d = np.sqrt(np.diag(normal))
        own, cross = totals[v][np.ix_(at, at)], totals[v][: self.base, at] / d[:, None]
        out = own - cross.T @ np.linalg.pinv(normal / np.outer(d, d), hermitian=True) @ cross
        there = np.diag(out) > 1e-9 * np.diag(own)
        return out[np.ix_(there, there)]

    def score(self, candidate: Candidate) -> Score:
        """All tests of one candidate."""
        return self.scores([candidate])[0]

    def scores(self, candidates: Sequence[Candidate]) -> list[Score]:
        """All tests of each candidate."""
        totals, g = self.totals(), self.count
        base, _ = self._fit(totals, np.empty(0, int))
        own = int(np.argmax(base))  # the base at the variance that suits the base
        before, missed = float(base[own]), float(np.sum(self._base_loss(own))) + self.cost[own]
        out: dict[int, Score] = {}
        for places, at in self._alike([c.columns for c in candidates], g):
            likelihood, x = self._fit(totals, at)
            suits = np.argmax(likelihood, axis=0)
            for v in np.unique(suits).tolist():
                here = np.flatnonzero(suits == v)
                beta, gain = x[v, here, self.base :], likelihood[v, here] - before
                full = self._jackknife(at[here], v)
                left_out = missed - np.sum(self._loss(full, self._with_base(at[here]), v), axis=0) - self.cost[v]
                p_model = stats.chi2.sf(2 * np.maximum(gain, 0.0), at.shape[-1])
                p_cluster = wald(beta, full[..., self.base :])
                for i, k in enumerate(places[here]):
                    out[int(k)] = Score(
                        candidates[k], beta[i], float(gain[i]), float(p_model[i]), float(p_cluster[i]),
                        float(left_out[i]), self.left(candidates[k].columns),
                    )  # fmt: skip
        return [out[k] for k in range(len(candidates))]

    def estimate(self, candidate: Candidate) -> tuple[np.ndarray, np.ndarray]:
        """A candidate's coefficients and their standard errors from clusters left out in turn."""
        at = self.base + np.asarray(candidate.columns)
        likelihood, x = self._fit(self.totals(), at)
        v = int(np.argmax(likelihood))
        beta, g = x[v, self.base :], self.count
        spread = self._jackknife(at, v)[:, self.base :] - beta
        return beta, np.sqrt((g - 1) / g * np.sum(spread**2, axis=0))

    def misfit(self) -> float:
        """What the residual costs as it is, in log-likelihood, at the levels' best variance."""
        return float(np.min(0.5 * self.totals()[:, -1, -1] + self.cost))

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """The base columns' own Gauss-Newton step, and the covariance of where it leads.

        Standard errors are from clusters left out in turn, and no smaller than the working model's: what a single
        cluster tells, the others leave as it is. Correlations are the working model's.
        """
        none, totals = np.empty(0, int), self.totals()
        likelihood, x = self._fit(totals, none)
        v, g = int(np.argmax(likelihood)), self.count
        normal = self._normal(totals, none)[0][v]
        d = np.sqrt(np.diag(normal))
        model = np.linalg.pinv(normal / np.outer(d, d), rcond=1e-12) / np.outer(d, d)
        own = np.sqrt(np.diag(model))
        error = np.maximum(own, np.sqrt((g - 1) / g * np.sum((self._jackknife(none, v) - x[v]) ** 2, axis=0)))
        scale = np.divide(error, own, out=np.ones_like(own), where=own > 0)
        return x[v], model * np.outer(scale, scale)

    def plain_score(self, candidate: Candidate) -> Score:
        """A candidate's tests where rows are as they were measured and only clusters count as independent."""
        return self.plain_scores([candidate])[0]

    def plain_scores(self, candidates: Sequence[Candidate]) -> list[Score]:
        """Tests of each candidate where rows are as they were measured and only clusters count as independent.

        Weights that suit the noise inside trips may drown what differs between them (a temperature that moves slowly
        and is measured late). The gain is the likelihood ratio of as many observations as there are clusters.
        """
        totals, g = self.totals(), self.count
        out: dict[int, Score] = {}
        for places, at in self._alike([c.columns for c in candidates], g):
            k = at.shape[-1]
            likelihood, x = self._fit(totals, at)
            full, beta = self._jackknife(at, 0), x[0, :, self.base :]
            p = wald(beta, full[..., self.base :])
            # the likelihood ratio that an F of this size stands for; p can underflow, its logarithm here is bounded
            statistic = np.zeros(len(places))
            if g >= least_clusters(k):
                statistic = np.minimum(stats.f.isf(np.maximum(p, 1e-60), k, g - k), 1e12) * k / (g - k)
            better = self._base_loss(0)[:, None] - self._loss(full, self._with_base(at), 0)
            t = np.mean(better, axis=0) / (np.std(better, axis=0) + 1e-300) * np.sqrt(g)
            gain = 0.5 * g * np.log1p(statistic)
            # as much of it as clusters keep that are left out of the fit
            whole = np.max(likelihood, axis=0) - self.base_likelihood(totals)
            kept = np.sum(better, axis=0) / np.maximum(whole, 1e-300)
            left_out = np.where(t > 1.0, gain * np.minimum(kept, 1.0), 0.0)
            for i, j in enumerate(places):
                out[int(j)] = Score(
                    candidates[j], beta[i], float(gain[i]), float(p[i]), float(p[i]), float(left_out[i]),
                    self.left(candidates[j].columns), plain=True,
                )  # fmt: skip
        return [out[k] for k in range(len(candidates))]

    def beside(self, other: Sequence[int], own: Sequence[int]) -> float:
        """p of a candidate's columns against zero when another's are in, with jackknifed clusters."""
        at = self.base + np.array([*other, *(k for k in own if k not in other)], dtype=int)
        if len(at) == len(other):
            return 1.0
        _, x = self._fit(self.totals(), at)
        skip = self.base + len(other)
        return float(wald(x[0, skip:], self._jackknife(at, 0)[:, skip:]))

    def flipped(self, candidate: Candidate, sign: Float[np.ndarray, " cluster"]) -> "Evidence":
        """The same evidence with the candidate's columns given a sign in each cluster."""
        at = self.base + np.asarray(candidate.columns)
        grams, levels = self.grams.copy(), self.levels.copy()
        inner = grams[:, at[:, None], at[None, :]]
        grams[:, :, at] *= sign[:, None, None]
        grams[:, at, :] *= sign[:, None, None]
        grams[:, at[:, None], at[None, :]] = inner
        levels[:, at] *= sign[self.home][:, None]
        return replace(self, grams=grams, levels=levels)

    def present(self, at: Sequence[int], values: Float[np.ndarray, " k"]) -> float:
        """p of base columns against being taken out: their values against zero with jackknifed clusters."""
        likelihood, x = self._fit(self.totals(), np.empty(0, int))
        v = int(np.argmax(likelihood))
        index = np.asarray(at)
        return float(wald(x[v, index] + values, self._jackknife(np.empty(0, int), v)[:, index] + values))

    def _jackknife(self, at: np.ndarray, v: int) -> Float[np.ndarray, "cluster *way n"]:
        """Coefficients of base and `at` columns [*way k] with each cluster left out in turn."""
        index = np.concatenate([self._with_base(at), np.full((*at.shape[:-1], 1), self.grams.shape[-1] - 1)], axis=-1)
        grams = self.by_cluster(v)[:, index[..., :, None], index[..., None, :]]
        a, b = self._normal(grams.sum(axis=0) - grams, np.arange(self.base, index.shape[-1] - 1))
        return _solved(a, b) if a.shape[-1] else b

    def _loss(self, x: np.ndarray, index: np.ndarray, v: int) -> Float[np.ndarray, "cluster *way"]:
        """Half the sum of squares of each cluster under its own left-out coefficients of columns `index` [*way n]."""
        grams = self.by_cluster(v)
        inner, cross = grams[:, index[..., :, None], index[..., None, :]], grams[:, index, -1]
        own = grams[:, -1, -1].reshape(-1, *(1,) * (index.ndim - 1))
        fitted = np.matmul(inner, x[..., None])[..., 0] - 2.0 * cross
        return 0.5 * (own + np.einsum("...i,...i->...", x, fitted))

    def _base_loss(self, v: int) -> Float[np.ndarray, " cluster"]:
        """`_loss` of the base alone, the same for every candidate."""
        if v not in self._missed:
            self._missed[v] = self._loss(self._jackknife(np.empty(0, int), v), np.arange(self.base), v)
        return self._missed[v]

    def sign_placebos(self, s: Score, rng: np.random.Generator, draws: int) -> Float[np.ndarray, " draw"]:
        """Gains of the same columns with each cluster's sign drawn at random: what no consistent effect would give."""
        small, candidate = self.only(s.candidate)
        out = np.zeros(draws)
        # what lives in k clusters meets itself, up to its sign, in one draw of 2^(k−1): that is no placebo
        energy = np.einsum("gii->g", small.by_cluster(0)[:, self.base : -1, self.base : -1])
        for i in range(draws):
            sign = rng.choice([-1.0, 1.0], size=self.count)
            if abs(sign @ energy) > 0.98 * energy.sum():
                continue
            other = small.flipped(candidate, sign)
            out[i] = other.plain_score(candidate).gain if s.plain else other.gain(other.totals(), candidate.columns)[0]
        return out

    def moved(self, step: Float[np.ndarray, " base"]) -> "Evidence":
        """The evidence from where the base columns' coefficients are after this step, by their columns as they are."""
        to = np.r_[step, np.zeros(self.grams.shape[-1] - self.base)]
        grams, levels = self.grams.copy(), self.levels.copy()
        grams[:, :, -1] -= self.grams @ to
        grams[:, -1, :] = grams[:, :, -1]
        grams[:, -1, -1] = self.grams[:, -1, -1] - 2.0 * (self.grams @ to)[:, -1] + to @ (self.grams @ to).T
        levels[:, -1] -= self.levels @ to
        return replace(self, grams=grams, levels=levels, pull=self.pull + self.precision * step)

    def holding(self, held: Bool[np.ndarray, " base"]) -> "Evidence":
        """The same evidence with some of the base columns' coefficients held where they are."""
        kept = np.r_[~held, np.ones(self.grams.shape[-1] - self.base, dtype=bool)]
        return replace(
            self, grams=self.grams[:, kept][:, :, kept], levels=self.levels[:, kept], base=int(np.sum(~held)),
            precision=self.precision[~held], pull=self.pull[~held],
        )  # fmt: skip

    def only(self, candidate: Candidate) -> tuple["Evidence", Candidate]:
        """Evidence of one candidate alone, and the candidate with its columns' places in it."""
        index = np.r_[np.arange(self.base), self.base + np.asarray(candidate.columns), self.grams.shape[-1] - 1]
        grams, levels = self.grams[:, index[:, None], index[None, :]], self.levels[:, index]
        small = replace(self, grams=grams, levels=levels)
        return small, replace(candidate, columns=tuple(range(len(candidate.columns))))
