"""Scores of candidates from normal equations by cluster: no refit, no second look at the rows.

Gains, clustered tests, left-out gains, resampling and sign placebos are algebra on `NormalEquations`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy import special, stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.scores.normal_equations import NormalEquations, solved
from hdev_jax.diagnosis.scores.significance import least_clusters, wald

__all__ = ["Evidence", "Score"]


@dataclass(frozen=True)
class Score:
    """The tests of one candidate beside the effects that the vehicle has.

    `gain` in log-likelihood on training rows, `p_model` from it (χ²), `p_cluster` from a Wald test with jackknifed
    clusters (F), `left_out_gain` in log-likelihood over clusters left out in turn, `left` the share of its columns
    that the Jacobian does not hold. `plain`: by ordinary least squares (`Evidence.plain_score`).
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
        """Both tests have to agree."""
        return max(self.p_model, self.p_cluster)


@dataclass(frozen=True)
class Evidence(NormalEquations):
    """Normal equations with the tests of candidates: what each would explain, and whether chance could have."""

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
        for places, at in self._alike([c.columns for c in candidates], max(g, len(self.home))):
            likelihood, x = self._fit(totals, at)
            suits = np.argmax(likelihood, axis=0)
            for v in np.unique(suits).tolist():
                here = np.flatnonzero(suits == v)
                beta, gain = x[v, here, self.base :], likelihood[v, here] - before
                blocks = self._blocks(at[here], v)
                full = self._jackknife(blocks)
                left_out = missed - np.sum(self._loss(full, blocks), axis=0) - self.cost[v]
                p_model = stats.chi2.sf(2 * np.maximum(gain, 0.0), at.shape[-1])
                p_cluster = wald(beta, full[..., self.base :], self._freedom([candidates[k] for k in places[here]]))
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
        spread = self._jackknife(self._blocks(at, v))[:, self.base :] - beta
        return beta, np.sqrt((g - 1) / g * np.sum(spread**2, axis=0))

    def bearing(self, candidate: Candidate) -> Float[np.ndarray, " k"]:
        """How many clusters each of a candidate's coefficients rests on: (Σγ)²/Σγ², γ each cluster's share of its
        variance w'X'Xw (Carter, Schnepel and Steigerwald, Review of Economics and Statistics 99, 2017; rows of a
        cluster taken as independent). What two trips show is known by two, however many others there are.
        """
        return 1.0 / np.maximum(np.sum(self._shares(candidate) ** 2, axis=1), 1e-300)

    def rests_on(self, candidate: Candidate) -> float:
        """How many clusters a candidate's coefficients rest on together, as `bearing` of each."""
        return 1.0 / max(float(np.sum(np.mean(self._shares(candidate), axis=0) ** 2)), 1e-300)

    def _freedom(self, candidates: Sequence[Candidate], *, every: bool = False) -> Float[np.ndarray, " way"]:
        """Degrees of freedom of the Wald test of each: those of the clusters that it rests on, where it compares trips
        with one another, or for `every` one; else of all clusters, for rows inside each of them show the effect."""
        k = np.array([len(c.columns) for c in candidates])
        some = [self.rests_on(c) if every or c.effect.between_trips else np.inf for c in candidates]
        return np.clip(some, k + 1, self.count) - k

    def _shares(self, candidate: Candidate) -> Float[np.ndarray, "k cluster"]:
        """The share that each cluster has in the variance of each coefficient."""
        at, totals = self.base + np.asarray(candidate.columns), self.totals()
        v = int(np.argmax(self._fit(totals, at)[0]))
        index = self._with_base(at)
        normal = self._normal(totals[v], at)[0]
        weights = np.stack([solved(normal, e) for e in np.eye(len(index))[self.base :]])
        variance = np.einsum("ki,gij,kj->kg", weights, self.by_cluster(v, index), weights)
        variance = np.maximum(variance, 0.0)  # rounding of what the levels take off
        return variance / np.maximum(np.sum(variance, axis=1, keepdims=True), 1e-300)

    def traded(self, own: Sequence[int], other: int) -> Float[np.ndarray, " k"]:
        """What a unit of another column adds to the coefficients of a candidate's own."""
        at, totals = self.base + np.asarray(own, dtype=int), self.totals()
        v = int(np.argmax(self._fit(totals, at)[0]))
        return -solved(self._normal(totals[v], at)[0], totals[v][self._with_base(at), self.base + other])[self.base :]

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
        for places, at in self._alike([c.columns for c in candidates], max(g, len(self.home))):
            likelihood, x = self._fit(totals, at)
            blocks, beta = self._blocks(at, 0), x[0, :, self.base :]
            gain, full = self._plain_gain(blocks, beta)
            better = self._base_loss(0)[:, None] - self._loss(full, blocks)
            t = np.mean(better, axis=0) / (np.std(better, axis=0) + 1e-300) * np.sqrt(g)
            # as much of it as clusters keep that are left out of the fit
            whole = np.max(likelihood, axis=0) - self.base_likelihood(totals)
            kept = np.sum(better, axis=0) / np.maximum(whole, 1e-300)
            left_out = np.where(t > 1.0, gain * np.minimum(kept, 1.0), 0.0)
            p = wald(beta, full[..., self.base :], self._freedom([candidates[i] for i in places], every=True))
            for i, j in enumerate(places):
                out[int(j)] = Score(
                    candidates[j], beta[i], float(gain[i]), float(p[i]), float(p[i]), float(left_out[i]),
                    self.left(candidates[j].columns), plain=True,
                )  # fmt: skip
        return [out[k] for k in range(len(candidates))]

    def plain_gain(self, columns: Sequence[int]) -> float:
        """The gain of `plain_score` alone, for resampling."""
        at = self.base + np.asarray(columns, dtype=int)
        beta = self._fit(self.totals()[:1], at)[1][0, self.base :]
        return float(self._plain_gain(self._blocks(at, 0), beta)[0])

    def _plain_gain(self, blocks: np.ndarray, beta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gains of ways by `_blocks` and coefficients [*way k], and all coefficients with each cluster left out."""
        full, k, g = self._jackknife(blocks), beta.shape[-1], self.count
        p = wald(beta, full[..., self.base :])
        if g < least_clusters(k):
            return np.zeros_like(p), full
        # the likelihood ratio that an F of this size stands for; p can underflow, its logarithm here is bounded
        statistic = np.minimum(special.fdtri(k, g - k, 1.0 - np.maximum(p, 1e-60)), 1e12) * k / (g - k)
        return 0.5 * g * np.log1p(statistic), full

    def beside(self, other: Sequence[int], own: Sequence[int]) -> float:
        """p of a candidate's columns against zero when another's are in, with jackknifed clusters."""
        at = self.base + np.array([*other, *(k for k in own if k not in other)], dtype=int)
        if len(at) == len(other):
            return 1.0
        likelihood, x = self._fit(self.totals(), at)
        v, skip = int(np.argmax(likelihood)), self.base + len(other)
        return float(wald(x[v, skip:], self._jackknife(self._blocks(at, v))[:, skip:]))

    def weighted(self, columns: Sequence[int], weight: Float[np.ndarray, " cluster"]) -> "Evidence":
        """The same evidence with candidates' columns multiplied by a number in each cluster: 0 takes them out of it."""
        grams, levels, at = self.grams.copy(), self.levels.copy(), self.base + np.asarray(columns)
        grams[:, :, at] *= weight[:, None, None]
        grams[:, at, :] *= weight[:, None, None]
        levels[:, at] *= weight[self.home][:, None]
        return replace(self, grams=grams, levels=levels)

    def within(self, on: Float[np.ndarray, " cluster"]) -> "Evidence":
        """The same evidence of candidates that act in the clusters `on` alone."""
        return self.weighted(range(self.grams.shape[-1] - 1 - self.base), on)

    def left_out_gain_of_mode(self, on: Float[np.ndarray, " cluster"]) -> float:
        """Gain in log-likelihood, over clusters left out in turn, of one column that acts in the clusters `on` alone.

        Whether a cluster that is left out has it is not known: it is as likely as among the others.
        """
        at = np.array([self.base])
        x, blocks = self._jackknife(self.within(on)._blocks(at, 0)), self._blocks(at, 0)
        share = np.clip((np.sum(on) - on) / (len(on) - 1), 1e-9, 1.0 - 1e-9)
        with_it, without = (self._loss(x * np.r_[np.ones(self.base), k], blocks) for k in (1.0, 0.0))
        either = np.logaddexp(np.log(share) - with_it, np.log1p(-share) - without)
        return float(np.sum(self._base_loss(0) + either))

    def sign_placebos(self, s: Score, rng: np.random.Generator, draws: int) -> Float[np.ndarray, " draw"]:
        """Gains of the same columns with each cluster's sign drawn at random: what no consistent effect would give."""
        small, (candidate,) = self.only([s.candidate])
        out = np.zeros(draws)
        # what lives in k clusters meets itself, up to its sign, in one draw of 2^(k−1): that is no placebo
        energy = np.einsum("gii->g", small.by_cluster(0, self.base + np.arange(len(candidate.columns))))
        for i in range(draws):
            sign = rng.choice([-1.0, 1.0], size=self.count)
            if abs(sign @ energy) > 0.98 * energy.sum():
                continue
            columns = candidate.columns
            other = small.weighted(columns, sign)
            out[i] = other.plain_gain(columns) if s.plain else other.gain(other.totals(), columns)[0]
        return out

    def only(self, candidates: Sequence[Candidate]) -> tuple["Evidence", list[Candidate]]:
        """Evidence of some candidates alone, and these with their columns' places in it."""
        places = list(dict.fromkeys(k for c in candidates for k in c.columns))
        index = np.r_[np.arange(self.base), self.base + np.array(places, dtype=int), self.grams.shape[-1] - 1]
        grams, levels = self.grams[:, index[:, None], index[None, :]], self.levels[:, index]
        at = {k: i for i, k in enumerate(places)}
        moved = [replace(c, columns=tuple(at[k] for k in c.columns)) for c in candidates]
        return replace(self, grams=grams, levels=levels), moved
