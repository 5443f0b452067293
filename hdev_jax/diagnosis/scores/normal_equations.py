"""Normal equations by cluster of [Jacobian | candidates | residual], with random intercepts of trips: the algebra.

Everything is whitened (`noise.whiten`), so a cluster's rows enter only through its Gram matrix. Fits, refits without
each cluster in turn, what candidates gain and what they share with the Jacobian need no second look at the rows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["NormalEquations", "solved"]

AT_ONCE = 2_000_000  # numbers of the matrices of candidates that are scored together: 16 MB


def solved(a: Float[np.ndarray, "*way n n"], b: Float[np.ndarray, "*way n"]) -> Float[np.ndarray, "*way n"]:
    """Solutions of normal equations in units of each column's own length."""
    d = np.sqrt(np.maximum(np.einsum("...ii->...i", a), 1e-300))
    return np.linalg.solve(a / (d[..., :, None] * d[..., None, :]), (b / d)[..., None])[..., 0] / d


@dataclass(frozen=True)
class NormalEquations:
    """Gram matrices by cluster of [Jacobian | candidates | residual], and the prior on the Jacobian's part.

    Trips may have random intercepts: `levels` is what an intercept of 1 of each trip meets in these columns, `squares`
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

    def by_cluster(self, v: int, at: Int[np.ndarray, "*way n"]) -> Float[np.ndarray, "cluster *way n n"]:
        """Gram matrices of the columns `at` with random intercepts of the v-th variance taken out."""
        out = self.grams[:, at[..., :, None], at[..., None, :]]
        if self.variances[v]:
            levels = self.levels[:, at]
            shrunk = levels * self._shrink(v).reshape(-1, *(1,) * at.ndim)
            starts = np.flatnonzero(np.r_[True, np.diff(self.home) != 0])  # a cluster's trips follow one another
            out[self.home[starts]] -= np.add.reduceat(shrunk[..., :, None] * levels[..., None, :], starts, axis=0)
        return out

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
        """Log-likelihood up to a constant [*draw variance *way] and coefficients, for each variance."""
        a, b = self._normal(gram, at)
        alone = (-0.5 * gram[..., -1, -1] - self.cost)[(..., *(None,) * (at.ndim - 1))]
        if not a.shape[-1]:
            return alone, b
        x = solved(a, b)
        return alone + 0.5 * np.einsum("...i,...i->...", b, x), x

    def base_likelihood(self, gram: np.ndarray) -> float:
        """Log-likelihood of the base alone at its best variance, `gram` from `totals`."""
        return float(np.max(self._fit(gram, np.empty(0, int))[0]))

    def gain(self, gram: np.ndarray, at: Sequence[int], before: float | None = None) -> tuple[float, np.ndarray]:
        """Gain in log-likelihood of candidate columns (places from 0) over the base, and their coefficients."""
        likelihood, x = self._fit(gram, self.base + np.asarray(at, dtype=int))
        v = int(np.argmax(likelihood))
        return float(likelihood[v]) - (self.base_likelihood(gram) if before is None else before), x[v, self.base :]

    def gains_of_draws(
        self, weights: Float[np.ndarray, "draw cluster"], at: Sequence[int]
    ) -> Float[np.ndarray, " draw"]:
        """Gain of candidate columns over the base, as `gain`, in each draw, which counts each cluster so many times."""
        grams = np.stack([self.totals(w) for w in weights])
        with_it, without = (
            np.max(self._fit(grams, x)[0], axis=1)
            for x in (self.base + np.asarray(at, dtype=int), np.empty(0, dtype=int))
        )
        return with_it - without

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
            for part in np.array_split(places, min(len(places), -(-len(places) * size // AT_ONCE))):
                yield part, self.base + np.array([ways[i] for i in part], dtype=int)

    @cached_property
    def _spans(self) -> tuple[Float[np.ndarray, " column"], Float[np.ndarray, "base column"]]:
        """`span` of every candidate column."""
        gram = self.totals()[0]
        square, cross = np.diag(gram)[self.base : -1], gram[: self.base, self.base : -1]
        d = np.sqrt(np.maximum(np.diag(gram)[: self.base], 1e-300))
        there = np.isfinite(square) & np.all(np.isfinite(cross), axis=0)
        c = np.where(there, cross, 0.0) / d[:, None]
        x = np.linalg.lstsq(gram[: self.base, : self.base] / np.outer(d, d), c, rcond=1e-10)[0]
        return 1.0 - np.sum(c * x, axis=0) / np.maximum(np.where(there, square, 1.0), 1e-300), x

    def span(self, at: int) -> tuple[float, Float[np.ndarray, " base"]]:
        """Share of a candidate column that is left after projecting the base columns off, and the weights of those,
        each of which counts with its length one."""
        share, weights = self._spans
        return float(share[at]), weights[:, at]

    def left(self, at: Sequence[int]) -> float:
        """Smallest share of the candidate columns that is left after projecting the base columns off."""
        return float(np.min(self._spans[0][list(at)])) if self.base else 1.0

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

    def misfit(self) -> float:
        """What the residual costs as it is, in log-likelihood, at the levels' best variance."""
        return float(np.min(0.5 * self.totals()[:, -1, -1] + self.cost))

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """The base columns' own Gauss-Newton step, and the covariance of where it leads.

        Standard errors are from clusters left out in turn, and no smaller than the working model's: an estimate
        that rests on a single cluster does not change without the others. Correlations are the working model's.
        """
        none, totals = np.empty(0, int), self.totals()
        likelihood, x = self._fit(totals, none)
        v, g = int(np.argmax(likelihood)), self.count
        normal = self._normal(totals, none)[0][v]
        d = np.sqrt(np.diag(normal))
        model = np.linalg.pinv(normal / np.outer(d, d), rcond=1e-12) / np.outer(d, d)
        own = np.sqrt(np.diag(model))
        left_out = self._jackknife(self._blocks(none, v))
        error = np.maximum(own, np.sqrt((g - 1) / g * np.sum((left_out - x[v]) ** 2, axis=0)))
        scale = np.divide(error, own, out=np.ones_like(own), where=own > 0)
        return x[v], model * np.outer(scale, scale)

    def _blocks(self, at: np.ndarray, v: int) -> Float[np.ndarray, "cluster *way m m"]:
        """`by_cluster` of the base columns, those at `at` [*way k] and the residual."""
        last = np.full((*at.shape[:-1], 1), self.grams.shape[-1] - 1)
        return self.by_cluster(v, np.concatenate([self._with_base(at), last], axis=-1))

    def _jackknife(self, blocks: np.ndarray) -> Float[np.ndarray, "cluster *way n"]:
        """Coefficients of the columns of `_blocks` with each cluster left out in turn."""
        a, b = self._normal(blocks.sum(axis=0) - blocks, np.arange(self.base, blocks.shape[-1] - 1))
        return solved(a, b) if a.shape[-1] else b

    @staticmethod
    def _loss(x: np.ndarray, blocks: np.ndarray) -> Float[np.ndarray, "cluster *way"]:
        """Half the sum of squares of each cluster of `_blocks` under its own left-out coefficients [cluster *way n]."""
        fitted = np.matmul(blocks[..., :-1, :-1], x[..., None])[..., 0] - 2.0 * blocks[..., :-1, -1]
        return 0.5 * (blocks[..., -1, -1] + np.einsum("...i,...i->...", x, fitted))

    def _base_loss(self, v: int) -> Float[np.ndarray, " cluster"]:
        """`_loss` of the base alone, the same for every candidate."""
        if v not in self._missed:
            blocks = self._blocks(np.empty(0, int), v)
            self._missed[v] = self._loss(self._jackknife(blocks), blocks)
        return self._missed[v]

    def moved(self, step: Float[np.ndarray, " base"]) -> "NormalEquations":
        """The same from where the base columns' coefficients are after this step, by their columns as they are."""
        to = np.r_[step, np.zeros(self.grams.shape[-1] - self.base)]
        grams, levels = self.grams.copy(), self.levels.copy()
        grams[:, :, -1] -= self.grams @ to
        grams[:, -1, :] = grams[:, :, -1]
        grams[:, -1, -1] = self.grams[:, -1, -1] - 2.0 * (self.grams @ to)[:, -1] + to @ (self.grams @ to).T
        levels[:, -1] -= self.levels @ to
        return replace(self, grams=grams, levels=levels, pull=self.pull + self.precision * step)

    def holding(self, held: Bool[np.ndarray, " base"]) -> "NormalEquations":
        """The same with some of the base columns' coefficients held where they are."""
        kept = np.r_[~held, np.ones(self.grams.shape[-1] - self.base, dtype=bool)]
        return replace(
            self, grams=self.grams[:, kept][:, :, kept], levels=self.levels[:, kept], base=int(np.sum(~held)),
            precision=self.precision[~held], pull=self.pull[~held],
        )  # fmt: skip

    def freed(self, at: Sequence[int], values: Float[np.ndarray, " k"] | None = None) -> "NormalEquations":
        """The same without some of the base columns, which come first among the candidates' instead; with `values`,
        what they stand for is put back into the residual: the equations of a model that lacks them."""
        d = self.grams.shape[-1]
        kept = np.array([k for k in range(self.base) if k not in {*at}], dtype=int)
        order = np.r_[kept, np.asarray(at, dtype=int), np.arange(self.base, d)].astype(int)
        grams, levels = self.grams, self.levels
        if values is not None:
            back = np.zeros(d)
            back[list(at)] = values
            more, own = grams @ back, grams[:, -1, -1]
            grams, levels = grams.copy(), levels.copy()
            grams[:, :, -1] += more
            grams[:, -1, :] = grams[:, :, -1]
            grams[:, -1, -1] = own + 2.0 * more[:, -1] + more @ back
            levels[:, -1] += levels @ back
        return replace(
            self, grams=grams[:, order[:, None], order[None, :]], levels=levels[:, order], base=len(kept),
            precision=self.precision[kept], pull=self.pull[kept],
        )  # fmt: skip
