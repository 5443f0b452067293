"""Scores from Gram matrices against the same numbers from the rows themselves."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.scores import normal_equations
from hdev_jax.diagnosis.scores.evidence import Evidence
from hdev_jax.diagnosis.scores.passes import LEVELS, Sums
from hdev_jax.diagnosis.scores.scores import best_of
from hdev_jax.diagnosis.scores.significance import (
    clusters_needed,
    clusters_to_tell,
    effective_number,
    ruled_out,
    wald,
)
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.inference import Clusters
from hdev_jax.physics import LIBRARY
from hdev_jax.segments import trip_slices

BASE, CANDIDATES = 2, 3
PRIOR_SD, MOVED = np.array([0.5, 2.0]), np.array([0.3, -1.0])


def candidate(*at: int) -> Candidate:
    """A candidate with these columns; which effect it is plays no part."""
    n = len(at)
    return Candidate(LIBRARY["auxiliary_power"], ("power_w",) * n, (None,) * n, (), "size", at)


class Rows:
    """Whitened rows of a few trips, with a level of their own and a part that follows the first candidate."""

    def __init__(self, trips: int = 9, rows: int = 30, *, level: float = 0.8, seed: int = 0, effect: float = 0.15):
        rng = np.random.default_rng(seed)
        self.ids = np.repeat(np.arange(trips), rows)
        n = trips * rows
        self.jacobian, self.columns = rng.normal(size=(n, BASE)), rng.normal(size=(n, CANDIDATES))
        self.columns[:, 1] += 0.7 * self.jacobian[:, 0]  # partly absorbed by the coefficients
        self.level = rng.uniform(0.5, 1.5, n)
        noise = rng.normal(size=n) + level * rng.normal(size=trips)[self.ids] * self.level
        self.residual = effect * self.columns[:, 0] + noise
        self.clusters = Clusters(self.ids, trips, "trip")
        self.level_sd = level

    @property
    def white(self) -> np.ndarray:
        return np.c_[self.jacobian, self.columns, self.residual, self.level]

    def evidence(self, **prior) -> Evidence:
        white, trips = self.white, [s for _, s in trip_slices(self.ids)]
        sums = Sums(white.shape[1] - 1, self.clusters.count, len(trips))
        sums.add(white[:, :-1], self.clusters.ids)
        sums.add_levels(white[:, :-1], white[:, -1], self.clusters.ids, trips)
        return sums.evidence(BASE, level_sd=self.level_sd, **{"moved": MOVED, "prior_sd": PRIOR_SD, **prior})

    def variances(self) -> list[float]:
        return [x * self.level_sd**2 for x in (LEVELS if self.level_sd > 0 else LEVELS[:1])]

    def gls(
        self, at: tuple[int, ...], variance: float, keep: np.ndarray | None = None
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Generalised least squares on rows with the prior: log-likelihood up to a constant, coefficients, and half
        the sum of squares of each cluster (as the covariance of its rows weighs them)."""
        x = np.c_[self.jacobian, self.columns[:, list(at)]]
        wx, wr, log_determinant = x.copy(), self.residual.copy(), 0.0
        for g in range(self.clusters.count):  # clusters do not mix
            at_g = self.ids == g
            covariance = np.eye(at_g.sum()) + variance * np.outer(self.level[at_g], self.level[at_g])
            root = np.linalg.inv(np.linalg.cholesky(covariance))
            wx[at_g], wr[at_g] = root @ x[at_g], root @ self.residual[at_g]
            log_determinant += np.linalg.slogdet(covariance)[1]
        use = np.ones(len(x), bool) if keep is None else keep
        # the prior as more rows: coefficient + moved ~ N(0, sd²)
        more_x = np.c_[np.diag(1 / PRIOR_SD), np.zeros((BASE, len(at)))]
        stacked, right = np.r_[wx[use], more_x], np.r_[wr[use], -MOVED / PRIOR_SD]
        beta = np.linalg.lstsq(stacked, right, rcond=None)[0]
        fit = -0.5 * np.sum((right - stacked @ beta) ** 2) - 0.5 * log_determinant
        each = np.array([0.5 * np.sum((wr - wx @ beta)[self.ids == g] ** 2) for g in range(self.clusters.count)])
        return float(fit), beta, each


@pytest.mark.parametrize("level", [0.0, 0.8])
@pytest.mark.parametrize("at", [(0,), (1,), (0, 2)])
def test_gain_is_that_of_generalised_least_squares(at, level):
    """On the rows, with dense covariances and the best variance of the levels for each model."""
    rows = Rows(level=level)
    evidence = rows.evidence()
    with_, beta, _ = max((rows.gls(at, v) for v in rows.variances()), key=lambda f: f[0])
    without = max(rows.gls((), v)[0] for v in rows.variances())
    gain, found = evidence.gain(evidence.totals(), at)
    assert gain == pytest.approx(with_ - without, rel=1e-6, abs=1e-8)
    np.testing.assert_allclose(found, beta[BASE:], rtol=1e-6)
    before = evidence.base_likelihood(evidence.totals())
    assert evidence.gain(evidence.totals(), at, before)[0] == gain


@pytest.mark.parametrize("room", [1, 700, 10**6])
def test_ways_are_scored_in_as_many_parts_as_memory_asks_for(room, monkeypatch):
    """Also where not even one of them has room: no part is empty."""
    rows, ways = Rows(), [candidate(0), candidate(1), candidate(0, 2)]
    alone = [rows.evidence().score(c) for c in ways]
    monkeypatch.setattr(normal_equations, "AT_ONCE", room)
    evidence = rows.evidence()
    for own, together in zip(alone, evidence.scores(ways), strict=True):
        np.testing.assert_allclose(together.beta, own.beta, rtol=1e-9)
        assert together.gain == pytest.approx(own.gain, rel=1e-9)
    np.testing.assert_allclose(
        evidence.gains(evidence.totals(), [c.columns for c in ways]), [x.gain for x in alone], rtol=1e-9
    )


@pytest.mark.parametrize("level", [0.0, 0.8])
@pytest.mark.parametrize("at", [(0,), (0, 2)])
def test_the_jackknife_leaves_clusters_out(at, level):
    """Explicit refits without each cluster in turn: what each left-out cluster loses, and the clustered test."""
    rows = Rows(level=level)
    score = rows.evidence().score(candidate(*at))
    v = max(rows.variances(), key=lambda v: rows.gls(at, v)[0])
    g, k = rows.clusters.count, len(at)
    beta = rows.gls(at, v)[1][BASE:]
    left_out, better = [], 0.0
    for cluster in range(g):
        keep = rows.ids != cluster
        _, x, loss = rows.gls(at, v, keep)
        left_out.append(x[BASE:])
        better += rows.gls((), v, keep)[2][cluster] - loss[cluster]
    spread = np.array(left_out) - beta
    covariance = (g - 1) / g * spread.T @ spread
    f = beta @ np.linalg.solve(covariance, beta) * (g - k) / (k * (g - 1))
    np.testing.assert_allclose(score.beta, beta, rtol=1e-6)
    assert score.p_cluster == pytest.approx(stats.f.sf(f, k, g - k), rel=1e-5)
    assert score.left_out_gain == pytest.approx(better, rel=1e-5, abs=1e-7)
    assert score.p_model == pytest.approx(stats.chi2.sf(2 * score.gain, k), rel=1e-6)


@pytest.mark.parametrize("level", [0.0, 0.8])
@pytest.mark.parametrize("own", [(0,), (0, 2)])
def test_what_another_column_takes_over_is_what_a_fit_beside_it_gives_up(own, level):
    """Coefficients of a fit with so much of the other column taken off the residual."""
    rows = Rows(level=level)
    per_unit = rows.evidence().traded(own, 1)
    before = rows.evidence().estimate(candidate(*own))[0]
    rows.residual = rows.residual - 0.05 * rows.columns[:, 1]
    np.testing.assert_allclose(rows.evidence().estimate(candidate(*own))[0], before + 0.05 * per_unit, atol=1e-9)
    assert np.all(np.abs(per_unit) > 1e-3)


@pytest.mark.parametrize("level", [0.0, 0.8])
@pytest.mark.parametrize("at", [(0,), (0, 2)])
def test_draws_of_clusters_are_scored_as_each_alone(level, at):
    evidence = Rows(level=level).evidence()
    weights = np.random.default_rng(1).multinomial(9, np.full(9, 1 / 9), size=5).astype(float)
    alone = [evidence.gain(evidence.totals(w), at)[0] for w in weights]
    assert np.ptp(alone) > 0.1
    np.testing.assert_allclose(evidence.gains_of_draws(weights, at), alone, rtol=1e-9)


def test_what_is_left_of_a_column():
    """1 − R² of a column on the Jacobian; nothing where it lies in it, all where there is no Jacobian."""
    rows = Rows(level=0.0)
    rows.columns[:, 2] = rows.jacobian @ np.array([2.0, -1.0])
    evidence = rows.evidence()
    for k in range(CANDIDATES):
        c = rows.columns[:, k]
        rest = c - rows.jacobian @ np.linalg.lstsq(rows.jacobian, c, rcond=None)[0]
        assert evidence.left((k,)) == pytest.approx(rest @ rest / (c @ c), rel=1e-8, abs=1e-10)
    assert evidence.left((0, 2)) == pytest.approx(0.0, abs=1e-10)  # the smallest of its columns


def test_absorbed_columns_gain_nothing():
    """A column in the span of the Jacobian gains what the prior holds back, and nothing under a wide one."""
    rows = Rows(level=0.0)
    rows.columns[:, 2] = rows.jacobian[:, 0]
    wide = rows.evidence(moved=np.zeros(BASE), prior_sd=np.full(BASE, 1e6))
    assert wide.gain(wide.totals(), (2,))[0] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("level", [0.0, 0.8])
def test_what_tests_are_of(level):
    """Columns as rows hold them with the Jacobian's projected off, the prior being more rows of it."""
    rows = Rows(level=level, effect=0.0)
    v = max(rows.variances(), key=lambda v: rows.gls((), v)[0])
    white = np.c_[rows.jacobian, rows.columns]
    for g in range(rows.clusters.count):
        at = rows.ids == g
        covariance = np.eye(at.sum()) + v * np.outer(rows.level[at], rows.level[at])
        white[at] = np.linalg.inv(np.linalg.cholesky(covariance)) @ white[at]
    base = np.r_[white[:, :BASE], np.diag(1 / PRIOR_SD)]
    own = np.r_[white[:, BASE:], np.zeros((BASE, CANDIDATES))]
    rest = own - base @ np.linalg.lstsq(base, own, rcond=None)[0]
    np.testing.assert_allclose(rows.evidence().projected(np.array([2, 0])), (rest.T @ rest)[np.ix_([2, 0], [2, 0])])


def test_ways_are_counted_by_what_the_declared_coefficients_leave_of_them():
    """Ten ways that share a large constant are one before a declared constant is projected off, and ten after."""
    rng = np.random.default_rng(0)
    n = 4000
    z = rng.normal(size=(n, 10))
    sums = Sums(12, 8, 0)
    sums.add(np.c_[np.ones(n), 1.0 + 0.1 * z, rng.normal(size=n)], np.repeat(np.arange(8), n // 8))
    ways = [candidate(k) for k in range(10)]
    for prior_sd, expected in ((1e3, 10.0), (1e-6, 1.64)):  # a coefficient that its table holds fast takes nothing off
        evidence = sums.evidence(1, moved=np.zeros(1), prior_sd=np.array([prior_sd]))
        counted = best_of(evidence, evidence, ways, np.zeros(10, bool), SETTINGS)[1]["auxiliary_power"]
        assert counted == pytest.approx(expected, abs=0.1)


def test_two_looks_are_two_tests():
    """A column that hardly changes inside a trip is tried by ordinary least squares too."""
    evidence, ways = Rows().evidence(), [candidate(0), candidate(2)]
    quick, slow = np.zeros(CANDIDATES, bool), np.ones(CANDIDATES, bool)
    _, once = best_of(evidence, evidence, ways, quick, SETTINGS)
    _, twice = best_of(evidence, evidence, ways, slow, SETTINGS)
    assert twice["auxiliary_power"] == 2.0 * once["auxiliary_power"]


def test_what_lies_in_the_jacobian_is_no_way_of_its_own():
    rows = Rows(level=0.0)
    rows.columns[:, 2] = rows.jacobian @ np.array([2.0, -1.0])
    free = {"moved": np.zeros(BASE), "prior_sd": np.full(BASE, 1e9)}
    assert rows.evidence(**free).projected(np.array([0, 2])).shape == (1, 1)
    assert effective_number(rows.evidence(**free).projected(np.array([2]))) == 1.0


def test_weights_count_clusters():
    """Resampling by weights is the same as gathering the drawn clusters again."""
    rows = Rows(level=0.0)
    weight = np.array([2.0, 0, 1, 1, 3, 0, 1, 1, 0])
    drawn = np.repeat(np.arange(9), weight.astype(int))
    again = Rows(level=0.0)
    at = np.concatenate([np.flatnonzero(rows.ids == g) for g in drawn])
    for name in ("jacobian", "columns", "residual", "level"):
        setattr(again, name, getattr(rows, name)[at])
    again.ids = np.repeat(np.arange(len(drawn)), 30)
    again.clusters = Clusters(again.ids, len(drawn), "trip")
    evidence, other = rows.evidence(), again.evidence()
    np.testing.assert_allclose(
        evidence.gain(evidence.totals(weight), (0,))[0], other.gain(other.totals(), (0,))[0], rtol=1e-9
    )


@pytest.mark.parametrize("values", [(-1.0, 1.0), (0.0, 1.0)])
def test_columns_are_weighted_by_cluster(values):
    """Gram matrices of weighted columns are those of rows whose columns were; one sign for all is no change."""
    rows = Rows()
    sign = np.random.default_rng(1).choice(values, 9)
    flipped = rows.evidence().weighted((0, 2), sign)
    rows.columns[:, [0, 2]] *= sign[rows.ids][:, None]
    every = np.arange(BASE + CANDIDATES + 1)
    for v in range(len(LEVELS)):
        there, flip = (e.by_cluster(v, every) for e in (rows.evidence(), flipped))
        np.testing.assert_allclose(flip, there, rtol=1e-9, atol=1e-9)
    evidence = rows.evidence()
    for one in (-1.0, 1.0):
        same = evidence.weighted((0,), np.full(9, one))
        assert same.gain(same.totals(), (0,))[0] == pytest.approx(evidence.gain(evidence.totals(), (0,))[0])


def test_sign_placebos_of_a_consistent_effect():
    """Hardly any gains what the effect itself does; without an effect about half do."""
    found = Rows(effect=0.4).evidence()
    score = found.score(candidate(0))
    gains = found.sign_placebos(score, np.random.default_rng(0), 60)
    # one draw in 2⁸ gives nine clusters one sign, which is the effect itself
    assert np.max(gains) <= score.gain * (1 + 1e-9)
    assert np.quantile(gains, 0.9) < 0.6 * score.gain
    ranks = []
    for seed in range(8):
        nothing = Rows(effect=0.0, seed=seed).evidence()
        s = nothing.score(candidate(0))
        ranks.append(np.mean(nothing.sign_placebos(s, np.random.default_rng(seed), 30) < s.gain))
    # uniform ranks of eight logs: their mean has a standard error of 0.1
    assert abs(np.mean(ranks) - 0.5) < 0.3


def test_one_candidate_alone():
    rows = Rows()
    evidence = rows.evidence()
    small, (alone,) = evidence.only([candidate(2, 0)])
    assert alone.columns == (0, 1)
    one, other = evidence.gain(evidence.totals(), (2, 0)), small.gain(small.totals(), alone.columns)
    assert one[0] == pytest.approx(other[0])
    np.testing.assert_allclose(one[1], other[1])


def test_some_candidates_alone_share_their_columns():
    evidence = Rows().evidence()
    small, (one, two) = evidence.only([candidate(2, 0), candidate(0)])
    assert (one.columns, two.columns) == ((0, 1), (1,))
    for own, there in ((one, candidate(2, 0)), (two, candidate(0))):
        assert small.score(own).gain == pytest.approx(evidence.score(there).gain)
        assert small.score(own).p_cluster == pytest.approx(evidence.score(there).p_cluster)
    none, left = evidence.only([])
    assert not left
    assert none.base_likelihood(none.totals()) == pytest.approx(evidence.base_likelihood(evidence.totals()))


def test_trips_of_a_cluster_have_levels_of_their_own():
    """Nine trips in four clusters: each cluster's rows less what the intercepts of its trips take, trip by trip."""
    rows = Rows()
    home = np.array([0, 0, 0, 1, 2, 2, 3, 3, 3])
    ids, trips = home[rows.ids], [s for _, s in trip_slices(rows.ids)]
    white = rows.white
    sums = Sums(white.shape[1] - 1, 4, len(trips))
    sums.add(white[:, :-1], ids)
    sums.add_levels(white[:, :-1], white[:, -1], ids, trips)
    evidence = sums.evidence(BASE, level_sd=0.8, moved=MOVED, prior_sd=PRIOR_SD)
    at = np.array([3, 0, 5])
    for v, variance in enumerate(evidence.variances):
        expected = np.zeros((4, 3, 3))
        for t, s in enumerate(trips):
            x, one = white[s][:, at], white[s][:, -1:]
            covariance = np.eye(len(x)) + variance * one @ one.T
            expected[home[t]] += x.T @ np.linalg.solve(covariance, x)
        np.testing.assert_allclose(evidence.by_cluster(v, at), expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            evidence.by_cluster(v, np.array([at, at[::-1]]))[:, 0], expected, rtol=1e-9, atol=1e-9
        )


def test_plain_rows_count_clusters_alone():
    """The rows' variance scales the prior, nothing else: p does not change with it when there is hardly any prior."""
    rows = Rows(level=0.0)
    every = np.c_[rows.jacobian, rows.columns, rows.residual]
    wide = {"moved": np.zeros(BASE), "prior_sd": np.full(BASE, 1e6)}
    sums = Sums(every.shape[1], rows.clusters.count, 0)
    sums.add(every, rows.clusters.ids)
    one, other = (sums.evidence(BASE, variance=v, **wide).plain_score(candidate(0)) for v in (1.0, 50.0))
    assert one.plain
    assert one.p_cluster == pytest.approx(other.p_cluster, rel=1e-5)
    np.testing.assert_allclose(one.beta, other.beta, rtol=1e-6)
    g, evidence = rows.clusters.count, sums.evidence(BASE, **wide)
    f = stats.f.isf(one.p_cluster, 1, min(evidence.rests_on(candidate(0)), g) - 1)
    # the likelihood ratio of g observations whose F is this
    assert one.gain == pytest.approx(0.5 * g * np.log1p(f / (g - 1)), rel=1e-6)


@pytest.mark.parametrize("effect", [0.15, 0.6])
def test_the_left_out_gain_of_plain_rows_is_of_clusters_left_out(effect):
    """Its gain times the share that explicit refits without each cluster in turn keep of what one fit to all gains."""
    rows = Rows(level=0.0, effect=effect)
    score = rows.evidence().plain_score(candidate(0))
    better = 0.0
    for cluster in range(rows.clusters.count):
        keep = rows.ids != cluster
        better += rows.gls((), 0.0, keep)[2][cluster] - rows.gls((0,), 0.0, keep)[2][cluster]
    kept = better / (rows.gls((0,), 0.0)[0] - rows.gls((), 0.0)[0])
    assert 0.0 < kept < 1.0
    assert score.left_out_gain == pytest.approx(score.gain * kept, rel=1e-6)


@pytest.mark.parametrize("level", [0.0, 0.8])
@pytest.mark.parametrize("at", [(0,), (1,), (1, 0)])
def test_freed_equations_are_those_of_a_model_that_lacks_the_columns(at, level):
    """Built anew from rows: the columns among the candidates, their part back in the residual, no prior on them."""
    rows, put_back = Rows(level=level), np.array([0.4, -0.2])[: len(at)]
    freed = rows.evidence().freed(at, put_back)
    lacking = Rows(level=level)
    kept = [k for k in range(BASE) if k not in at]
    own = rows.jacobian[:, list(at)]
    lacking.jacobian, lacking.columns = rows.jacobian[:, kept], np.c_[own, rows.columns]
    lacking.residual = rows.residual + own @ put_back
    white, trips = lacking.white, [s for _, s in trip_slices(rows.ids)]
    sums = Sums(white.shape[1] - 1, rows.clusters.count, len(trips))
    sums.add(white[:, :-1], rows.ids)
    sums.add_levels(white[:, :-1], white[:, -1], rows.ids, trips)
    expected = sums.evidence(len(kept), moved=MOVED[kept], prior_sd=PRIOR_SD[kept], level_sd=level)
    for name in ("grams", "levels", "squares", "precision", "pull"):
        np.testing.assert_allclose(getattr(freed, name), getattr(expected, name), rtol=1e-9, atol=1e-9)
    ways = [candidate(*range(len(at))), candidate(len(at)), candidate(0, len(at) + 2)]
    for one, other in zip(freed.scores(ways), expected.scores(ways), strict=True):
        np.testing.assert_allclose(one.beta, other.beta, rtol=1e-7)
        assert one.gain == pytest.approx(other.gain, rel=1e-7)
        assert one.left_out_gain == pytest.approx(other.left_out_gain, rel=1e-6)
        assert one.p_cluster == pytest.approx(other.p_cluster, rel=1e-5)


def test_a_column_that_is_freed_gives_back_the_fit_that_it_was_part_of():
    """With hardly any prior, a freed size is where it stood plus the step that the whole fit would take."""
    rows, wide = Rows(level=0.0), {"moved": np.zeros(BASE), "prior_sd": np.full(BASE, 1e6)}
    evidence, stood = rows.evidence(**wide), 0.4
    step, covariance = evidence.step()
    score = evidence.freed((1,), np.array([stood])).score(candidate(0))
    assert score.beta[0] == pytest.approx(stood + step[1], rel=1e-6)
    assert covariance[1, 1] > 0


def test_one_column_beside_another():
    """The partial test of least squares with both in, clusters left out in turn; of itself nothing is left to ask."""
    rows = Rows(level=0.0)
    rows.columns[:, 2] += 0.6 * rows.columns[:, 0]
    evidence = rows.evidence()
    x = np.c_[rows.jacobian, rows.columns[:, [2, 0]]]
    prior = np.diag([*(1 / PRIOR_SD**2), 0.0, 0.0])

    def fitted(keep: np.ndarray) -> np.ndarray:
        right = x[keep].T @ rows.residual[keep] - np.r_[MOVED / PRIOR_SD**2, 0.0, 0.0]
        return np.linalg.solve(x[keep].T @ x[keep] + prior, right)[-1:]

    g = rows.clusters.count
    spread = np.array([fitted(rows.ids != k) for k in range(g)])
    t = fitted(rows.ids >= 0)[0] ** 2 / ((g - 1) / g * np.sum((spread - fitted(rows.ids >= 0)) ** 2))
    assert evidence.beside((2,), (0,)) == pytest.approx(stats.f.sf(t, 1, g - 1), rel=1e-6)
    assert evidence.beside((0,), (0,)) == 1.0


def test_evidence_from_elsewhere_and_with_some_held():
    """Against the rows themselves."""
    rng = np.random.default_rng(0)
    ids, x, y = np.repeat(np.arange(8), 50), rng.normal(size=(400, 3)), rng.normal(size=400)
    level, at, sd = rng.normal(size=400), np.array([0.5, -2.0, 0.0]), np.array([1.0, 2.0, 3.0])
    slices = [slice(50 * k, 50 * k + 50) for k in range(8)]

    def evidence(x, y, moved, sd):
        sums = Sums(x.shape[1] + 1, 8, 8)
        sums.add(np.c_[x, y], ids)
        sums.add_levels(np.c_[x, y], level, ids, slices)
        return sums.evidence(x.shape[1], moved=moved, prior_sd=sd, level_sd=0.7)

    base = evidence(x, y, np.array([0.1, 0.2, 0.3]), sd)
    there = evidence(x, y - x @ at, np.array([0.1, 0.2, 0.3]) + at, sd)
    for name in ("grams", "levels", "pull"):
        np.testing.assert_allclose(getattr(base.moved(at), name), getattr(there, name), rtol=1e-9, atol=1e-9)
    held = np.array([False, True, False])
    fewer = evidence(x[:, ~held], y, np.array([0.1, 0.3]), sd[~held])
    for got, expected in zip(base.holding(held).step(), fewer.step(), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_what_one_cluster_tells_is_no_better_known_than_its_rows_allow():
    """The jackknife sees no spread where all clusters but one are silent about a column."""
    rng = np.random.default_rng(0)
    ids = np.repeat(np.arange(8), 50)
    column = np.where(ids == 3, rng.normal(size=400), 1e-9 * rng.normal(size=400))
    sums = Sums(2, 8, 8)
    sums.add(np.c_[column, 2.0 * column + rng.normal(size=400)], ids)
    _, covariance = sums.evidence(1, moved=np.zeros(1), prior_sd=np.array([1e3])).step()
    assert covariance[0, 0] >= 0.98 / np.sum(column**2)


# --- tests and their correction --------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [1, 2])
def test_wald_holds_its_level(k):
    """Means of nine independent clusters with no effect: jackknifed Hotelling p-values are uniform.

    For a mean the jackknife is exact, so the only error is that of 400 draws: 0.025 at a level of one half.
    """
    rng = np.random.default_rng(0)
    p = []
    for _ in range(400):
        x = rng.normal(size=(9, k)) @ (np.eye(k) + 0.5)
        p.append(wald(x.mean(axis=0), np.stack([np.delete(x, i, axis=0).mean(axis=0) for i in range(9)])))
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_wald_of_few_clusters_says_nothing():
    assert wald(np.ones(2), np.ones((3, 2))) == 1.0


@pytest.mark.parametrize("bearing", [1, 2, 5, 9])
def test_a_size_rests_on_the_clusters_that_show_it(bearing):
    rows = Rows(rows=400, level=0.0)
    rows.columns[rows.ids >= bearing, 0] = 0.0
    evidence = rows.evidence()
    assert evidence.bearing(candidate(0)) == pytest.approx([bearing], rel=0.03)
    assert np.all(evidence.bearing(candidate(0, 2)) == pytest.approx([bearing, 9.0], rel=0.05))


@pytest.mark.parametrize("bearing", [2, 4, 9])
def test_trips_that_are_compared_count_as_the_fewer_of_them(bearing):
    """A change from a trip on is known by the trips that show it; what rows inside each trip show, by all clusters."""
    rows = Rows(rows=400, level=0.0)
    rows.columns[rows.ids >= bearing, 0] = 0.0
    evidence = rows.evidence()
    within = evidence.score(candidate(0))
    between = evidence.score(replace(candidate(0), effect=LIBRARY["step_change"]))
    f = stats.f.isf(within.p_cluster, 1, 8)
    expected = stats.f.sf(f, 1, max(evidence.rests_on(candidate(0)), 2.0) - 1.0)
    assert between.p_cluster == pytest.approx(expected, rel=1e-6)
    assert (between.p_cluster > 2.0 * within.p_cluster) is (bearing < 9)


def test_clusters_that_a_size_rests_on_are_those_of_its_variance():
    """Each cluster's share of the variance of least squares, from the rows themselves."""
    rows = Rows(level=0.0)
    rows.columns *= rows.ids[:, None] + 1.0
    x = np.c_[rows.jacobian, rows.columns[:, [0, 2]]]
    normal = x.T @ x + np.diag([*(1 / PRIOR_SD**2), 0.0, 0.0])
    weights = np.linalg.inv(normal)[BASE:] @ x.T
    share = np.stack([np.sum(weights[:, rows.ids == g] ** 2, axis=1) for g in range(rows.clusters.count)])
    expected = np.sum(share, axis=0) ** 2 / np.sum(share**2, axis=0)
    np.testing.assert_allclose(rows.evidence().bearing(candidate(0, 2)), expected, rtol=1e-8)
    assert np.all(expected < 0.8 * rows.clusters.count)


@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("p", [0.2, 0.01])
def test_as_many_clusters_as_are_needed_and_no_more(k, p):
    n = clusters_needed(p, k, 9, 1e-3)
    assert n is not None
    assert n > 9
    statistic = stats.f.isf(p, k, 9 - k)

    def at(m: int) -> float:
        return float(stats.f.sf(statistic * m / 9, k, m - k))

    assert at(n) <= 1e-3 < at(n - 1)


def test_what_nothing_hints_at_is_out_of_reach():
    assert clusters_needed(0.9, 1, 9, 1e-3) is None
    assert clusters_needed(0.01, 2, 3, 1e-3) is None


def test_ways_that_are_alike_are_one_test():
    rng = np.random.default_rng(0)
    apart = rng.normal(size=(4000, 6))
    alike = apart[:, :1] + 0.01 * rng.normal(size=(4000, 6))
    assert effective_number(apart.T @ apart) == pytest.approx(6.0, abs=0.1)
    assert effective_number(alike.T @ alike) == pytest.approx(1.0, abs=0.1)
    assert effective_number((half := np.c_[apart, apart]).T @ half) == pytest.approx(6.0, abs=0.1)
    assert effective_number(np.ones((1, 1))) == 1.0


def correlations(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Of the rows of two matrices."""
    x, y = (a - a.mean(axis=1, keepdims=True) for a in (x, y))
    return np.sum(x * y, axis=1) / np.sqrt(np.sum(x**2, axis=1) * np.sum(y**2, axis=1))


def test_enough_clusters_tell_half_of_what_they_differ_by():
    """By simulation: as many as are said find it in about half of the logs (the median F), far fewer do not."""
    n = clusters_to_tell(0.5, 1, 1e-3)
    assert n is not None
    rng = np.random.default_rng(0)

    def found(count: int) -> float:
        x, e = rng.standard_normal((2, 4000, count))
        r = correlations(x, x + e)
        return float(np.mean(stats.f.sf(r**2 / (1 - r**2) * (count - 2), 1, count - 2) <= 1e-3))

    assert found(n) == pytest.approx(0.5, abs=0.1)
    assert found(n // 2) < 0.25
    assert clusters_to_tell(0.5, 1, 1e-6) > n
    assert clusters_to_tell(1e-6, 1, 1e-3) is None


def test_what_would_show_by_now_is_ruled_out():
    """By simulation: of logs in which it holds half of what trips differ by, one in twenty says that it does not."""
    rng, count, n = np.random.default_rng(1), 8, 800
    x, e = rng.standard_normal((2, n, count))
    r = correlations(x, x + e)
    p = stats.f.sf(r**2 / (1 - r**2) * (count - 2), 1, count - 2)
    out = float(np.mean([ruled_out(0.5, float(v), 1, count) for v in p]))
    assert 0.02 < out < 0.09
    assert ruled_out(0.5, 0.5, 1, 40)
    assert not ruled_out(0.5, 0.5, 1, 6)
    assert not ruled_out(0.5, 0.9, 2, 3)


@pytest.mark.parametrize("k", [1, 3])
def test_few_clusters_that_matter_make_as_few_false_finds(k):
    """Sizes that six of 24 clusters show are tested at 5 degrees of freedom: a level of 5 % is one."""
    rng, p = np.random.default_rng(k), []
    for _ in range(2000):
        sizes = rng.normal(size=(6, k))
        mean = sizes.mean(axis=0)
        spread = np.linalg.cholesky(np.atleast_2d(np.cov(sizes.T)) / 6.0) * np.sqrt(24.0 / 23.0)
        left_out = mean + np.concatenate([spread.T, -spread.T, np.zeros((24 - 2 * k, k))]) / np.sqrt(2.0)
        p.append(float(wald(mean, left_out, np.asarray(6.0 - k))))
    assert np.mean(np.array(p) < 0.05) == pytest.approx(0.05, abs=0.012)


@pytest.mark.parametrize("rests_on", [4.0, 9.0])
def test_a_size_that_rests_on_few_clusters_needs_more(rests_on):
    p, level = 0.01, 1e-3
    n = clusters_needed(p, 1, 9, level, rests_on)
    assert n is not None
    share = rests_on / 9
    statistic = stats.f.isf(p, 1, rests_on - 1)
    assert (
        stats.f.sf(statistic * n / 9, 1, share * n - 1)
        <= level
        < stats.f.sf(statistic * (n - 1) / 9, 1, share * (n - 1) - 1)
    )
    assert (n == clusters_needed(p, 1, 9, level)) == (rests_on == 9.0)
