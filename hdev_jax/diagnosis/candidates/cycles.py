"""A load that switches on and off in every trip, out of step from trip to trip: its phases are sought, not its size.

A cycle whose phase is free in each trip has no column of its own before the phases are known, so it is looked for in
the spectrum, where phases do not count; then its period, its duty and the phase of each trip are chosen by whitened
rows. It is named where it is one cycle: the same size in every trip, and a load that is either on or off. What swings
otherwise stays unexplained.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import special, stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.refit import joined
from hdev_jax.diagnosis.noise.model import estimate_noise
from hdev_jax.diagnosis.noise.spectrum import Clocked, strongest_period
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.scores.look import Found, Loop, Search, Verdict, barred
from hdev_jax.diagnosis.scores.ranking import LEFT_OUT, STABLE
from hdev_jax.physics.loads import PeriodicLoad
from hdev_jax.units import J_PER_WH

__all__ = ["add_cycle"]

ID = PeriodicLoad.id
PERIODS, PHASES, DUTIES = 21, 9, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
ROUNDS = 3  # of choosing period, duty and phases in turn
UNLIKE = 1e-3  # p from which on a cycle is not the same in every trip, or no square wave
SPREAD = 0.3  # of its size over trips, beyond which it is not the same in every trip
OTHER = 0.1  # of the square wave's gain that other waves of the same period may add
WITHIN = 1.5  # of the shortest and the longest period, so that a fit may move
COST = 3.0  # of each of its numbers, in log-likelihood
LEAST_SHARE = 0.02  # of the residual's variance
RESAMPLES = 100
NEAR = 5  # periods, and duties, about the best that are asked again without some of the trips


@dataclass(frozen=True)
class _Wave:
    period_s: float
    duty: float
    phase: Float[np.ndarray, " trip"]


@dataclass(frozen=True)
class _Rows(Clocked):
    """Training rows and their whitened residual; the level of a trip is a constant load [W]."""

    white: Float[np.ndarray, " row"]

    @property
    def place(self) -> Int[np.ndarray, " row"]:
        """Place of each row's trip among the trips."""
        return np.concatenate([np.full(s.stop - s.start, k) for k, s in enumerate(self.slices)])

    def met(self, loads: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row k"]:
        """Loads [W] as whitened rows of the target meet them."""
        return self.whitened(loads * self.worth[:, None])

    def load(self, wave: _Wave, phase: Float[np.ndarray, " trip"] | None = None) -> Float[np.ndarray, " row"]:
        """The cycle of 1 W on every row, by the effect's own equation."""
        at = (wave.phase if phase is None else phase)[self.place]
        effect = PeriodicLoad(power_w=1.0, period_s=wave.period_s, duty=wave.duty, phase=jnp.asarray(at))
        return np.asarray(effect.on(self.clock_s - 0.5 * self.duration_s, self.duration_s))


def add_cycle(problem: Loop, state: Search) -> tuple[Search | None, Verdict | None]:
    """The state with a periodic load added and refitted, or a verdict on why it is not; neither where it cannot be."""
    if (why := barred(problem, state, PeriodicLoad)) is not None:
        return None, Verdict(ID, None, 1.0, why) if why else None
    residual = problem.measured - state.fit.predicted
    rows = _rows(problem, residual, residual)
    hit = strongest_period(residual, rows)
    if hit is None:
        return None, Verdict(ID, None, 1.0, "the residual is too short for a spectrum")
    q = min(1.0, hit.p * len(problem.effects))
    if q > problem.fdr:
        return None, Verdict(ID, None, q, f"no cycle stands out of the spectrum of the noise (q = {q:.2g})")
    period = next(p for p in PeriodicLoad.parameters if p.name == "period_s")
    if not WITHIN * period.lower < hit.period_s < period.upper / WITHIN:
        return None, Verdict(ID, None, q, f"a cycle of {hit.period_s:.3g} s, which no load is switched in")
    wave, square = _fitted(rows, hit.period_s)
    # the noise is quieter, and phases are sharper, without the cycle
    load = rows.worth * rows.load(wave) * _common(rows, square[:, None])[1]
    left = residual - load  # the mean of the cycle may have been taken for a constant load
    rows = _rows(problem, residual, left - rows.worth * (rows.worth @ left) / (rows.worth @ rows.worth))
    wave, square = _fitted(rows, wave.period_s)
    gains, sizes, sd = _by_trip(rows, square)
    if why := _unlike(rows, wave, square, gains, sizes, sd):
        return None, Verdict(ID, float(np.sum(gains)), q, why)
    beta = np.array([np.sum(sizes / sd**2) / np.sum(1.0 / sd**2)])
    shapes = (("period_s", wave.period_s), ("duty", wave.duty))
    ids = [int(problem.trip[s.start]) for s in rows.slices]
    phases = tuple((f"phase[{t}]", float(p)) for t, p in zip(ids, wave.phase, strict=True))
    c = Candidate(PeriodicLoad, ("power_w",), (None,), (*shapes, *phases), "size", ())
    gain, freedoms = float(np.sum(gains)), len(wave.phase) + 3
    share = float(np.mean((rows.worth * beta[0]) ** 2 * wave.duty * (1 - wave.duty)) / np.mean(residual**2))
    if gain < COST * freedoms or share < LEAST_SHARE:
        return None, Verdict(ID, gain, q, f"a cycle of {wave.period_s:.0f} s that explains too little for its numbers")
    again = _profile(rows, wave)
    left_out, stability = again.left_out_gain(), again.stability(COST * freedoms, problem.rng.spawn(1)[0])
    if left_out <= LEFT_OUT:
        return None, Verdict(ID, gain, q, f"a cycle of {wave.period_s:.0f} s that trips left out do not bear out")
    if stability < STABLE:
        return None, Verdict(ID, gain, q, f"chosen in only {100 * stability:.0f} % of resampled sets of trips")
    score = Score(c, beta, gain, hit.p, hit.p, left_out, 1.0)
    new = joined(problem, state, score, rows.noise) or joined(problem, state, score)
    if new is None:
        return None, Verdict(ID, gain, q, "in the joint refit it is out of range or not told from nothing")
    found = Found(ID, score, q, stability, (), gain)
    return replace(new, found=[*state.found, found]), None


def _rows(problem: Loop, residual: np.ndarray, left: np.ndarray) -> _Rows:
    """The residual whitened by the noise of what is left of it."""
    levels = problem.clusters.kind == "trip"
    noise = estimate_noise(left, problem.trip, problem.seconds, levels=levels)
    start = np.asarray(problem.rows.segments.time_s)[: problem.rows.rows]
    worth = problem.seconds / J_PER_WH if problem.target == "energy_wh" else np.full(len(start), 1e-3)
    clocked = Clocked(start + 0.5 * problem.seconds, problem.seconds, problem.trip, worth, noise)
    return _Rows(**vars(clocked), white=clocked.whitened(residual[:, None])[:, 0])


def _by_trip(rows: _Rows, column: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gain in log-likelihood, size and its standard error of one whitened column in each trip."""
    square = np.array([column[s] @ column[s] for s in rows.slices]) + 1e-300
    cross = np.array([column[s] @ rows.white[s] for s in rows.slices])
    return 0.5 * cross**2 / square, cross / square, 1.0 / np.sqrt(square)


def _common(rows: _Rows, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and size of each column alone, the size being the same in every trip."""
    square, cross = np.sum(columns**2, axis=0) + 1e-300, columns.T @ rows.white
    return 0.5 * np.where(cross > 0, cross, 0.0) ** 2 / square, cross / square


def _fitted(rows: _Rows, period_s: float) -> tuple[_Wave, np.ndarray]:
    """Period, duty and the phase of each trip by whitened rows, from the spectrum's period; and the wave's column."""
    longest = max(float(np.sum(rows.duration_s[s])) for s in rows.slices)
    wave = _fundamental(rows, period_s, 0.6 * period_s / longest)
    for k in range(ROUNDS):
        trials = [replace(wave, duty=d) for d in _near(np.array(DUTIES), wave.duty, k)]
        wave = _best(rows, trials)
        step = 0.1 / 2**k
        shifts = np.linspace(-step, step, PHASES)
        columns = rows.met(np.stack([rows.load(wave, wave.phase + x) for x in shifts], axis=1))
        square = np.stack([np.sum(columns[s] ** 2, axis=0) for s in rows.slices]) + 1e-300
        cross = np.stack([columns[s].T @ rows.white[s] for s in rows.slices])
        wave = replace(wave, phase=wave.phase + shifts[np.argmax(np.where(cross > 0, cross**2 / square, 0.0), axis=1)])
        width = 0.2 * wave.period_s / longest / 2**k
        middle = np.array([np.mean(rows.clock_s[s]) for s in rows.slices])
        trials = [
            # about the middle of each trip, so that a longer period does not move its phase
            replace(wave, period_s=t, phase=wave.phase + middle / wave.period_s - middle / t)
            for t in wave.period_s * (1 + width * np.linspace(-1, 1, PHASES))
        ]
        wave = _best(rows, trials)
    wave = replace(wave, phase=(wave.phase + 0.5) % 1.0 - 0.5)
    return wave, rows.met(rows.load(wave)[:, None])[:, 0]


def _near(grid: np.ndarray, at: float, k: int) -> np.ndarray:
    """The whole grid at first, then ever finer about where the duty stands."""
    step = 0.1 / 2**k
    return grid if k == 0 else np.clip(at + step * np.linspace(-1, 1, 5), 0.05, 0.95)


def _best(rows: _Rows, trials: list[_Wave]) -> _Wave:
    columns = rows.met(np.stack([rows.load(w) for w in trials], axis=1))
    return trials[int(np.argmax(_common(rows, columns)[0]))]


def _fundamental(rows: _Rows, period_s: float, width: float) -> _Wave:
    """The period near the spectrum's whose cosine and sine, free in each trip, gain most; phases from those."""
    middle = rows.clock_s
    best: tuple[float, float, np.ndarray] | None = None
    for period in period_s * (1 + width * np.linspace(-1, 1, PERIODS)):
        angle = 2 * np.pi * middle / period
        columns = rows.met(np.stack([np.cos(angle), np.sin(angle)], axis=1))
        gain, phases = 0.0, []
        for s in rows.slices:
            x = np.linalg.lstsq(columns[s], rows.white[s], rcond=None)[0]
            gain += 0.5 * float(rows.white[s] @ columns[s] @ x)
            phases.append(np.arctan2(-x[1], x[0]) / (2 * np.pi))
        if best is None or gain > best[0]:
            best = gain, float(period), np.array(phases)
    assert best is not None
    return _Wave(best[1], 0.5, best[2])


def _differ(sizes: np.ndarray, precision: np.ndarray, times: np.ndarray) -> bool:
    """Whether sizes differ between trips, each counted so many times, by more than chance and by much of themselves."""
    weight = precision * times
    mean = float(np.sum(weight * sizes) / np.sum(weight))
    chi2, freedom = float(np.sum(weight * (sizes - mean) ** 2)), float(np.sum(times)) - 1
    if freedom < 1 or stats.chi2.sf(chi2, freedom) >= UNLIKE:
        return False
    between = max(chi2 - freedom, 0.0) / (np.sum(weight) - np.sum(weight * precision) / np.sum(weight))
    return bool(np.sqrt(between) > SPREAD * mean)


def _unlike(
    rows: _Rows, wave: _Wave, square: np.ndarray, gains: np.ndarray, sizes: np.ndarray, sd: np.ndarray
) -> str | None:
    """Why it is not one load that is switched in every trip, or None."""
    if _differ(sizes, 1.0 / sd**2, np.ones(len(sizes))):
        return f"a cycle of {wave.period_s:.0f} s, but not of the same size in every trip"
    angle = 2 * np.pi * (rows.clock_s / wave.period_s + wave.phase[rows.place])
    others = np.stack([f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin)], axis=1)
    both = np.column_stack([square, rows.met(others)])
    x = np.linalg.lstsq(both, rows.white, rcond=None)[0]
    alone = 0.5 * float(square @ rows.white) ** 2 / float(square @ square)
    more = 0.5 * float(rows.white @ both @ x) - alone
    if stats.chi2.sf(2 * more, others.shape[1]) < UNLIKE and more > OTHER * alone:
        return f"a cycle of {wave.period_s:.0f} s, but not a load that is either on or off"
    return None


@dataclass(frozen=True)
class _Profile:
    """What whitened rows of each trip say of waves near the best one, at phases `step` apart about the trip's own."""

    cross: Float[np.ndarray, "wave trip phase"]  # of the wave's column of 1 W with the residual
    square: Float[np.ndarray, "wave trip phase"]
    step: float

    @cached_property
    def own(self) -> tuple[Float[np.ndarray, "wave trip"], Float[np.ndarray, "wave trip"]]:
        """`cross` and `square` at the phase that suits each trip best."""
        gain = np.where(self.cross > 0, self.cross, 0.0) ** 2 / self.square
        at = np.argmax(gain, axis=2)[..., None]
        return np.take_along_axis(self.cross, at, 2)[..., 0], np.take_along_axis(self.square, at, 2)[..., 0]

    def _chosen(self, weight: Float[np.ndarray, " trip"]) -> tuple[int, float, float]:
        """The best wave of trips that count so many times, its gain and its size."""
        cross, square = (x @ weight for x in self.own)
        gain = 0.5 * np.maximum(cross, 0.0) ** 2 / (square + 1e-300)
        k = int(np.argmax(gain))
        return k, float(gain[k]), float(cross[k] / (square[k] + 1e-300))

    def left_out_gain(self) -> float:
        """Gain in log-likelihood over trips left out in turn: wave and size are the others', and the phase is unknown.

        Phases far from the trip's own add next to nothing and are left out of the mean: a little less than it is.
        """
        total, trips = 0.0, self.cross.shape[1]
        for t in range(trips):
            k, _, size = self._chosen((np.arange(trips) != t).astype(float))
            each = size * self.cross[k, t] - 0.5 * size**2 * self.square[k, t]
            total += float(special.logsumexp(each) + np.log(self.step))
        return total

    def stability(self, cost: float, rng: np.random.Generator) -> float:
        """Share of resampled sets of trips in which a cycle is chosen again: of one size, and worth its numbers."""
        trips, hits = self.cross.shape[1], 0
        for _ in range(RESAMPLES):
            weight = np.bincount(rng.integers(0, trips, trips), minlength=trips).astype(float)
            k, gain, _ = self._chosen(weight)
            cross, square = (x[k] for x in self.own)
            hits += gain > cost and not _differ(cross / square, square, weight)
        return hits / RESAMPLES


def _profile(rows: _Rows, wave: _Wave) -> _Profile:
    """The waves near one: periods that its trips can just tell apart, duties, and phases of each trip."""
    longest = max(float(np.sum(rows.duration_s[s])) for s in rows.slices)
    periods = wave.period_s * (1 + 0.2 * wave.period_s / longest * np.linspace(-1, 1, NEAR))
    duties = np.unique(np.clip(wave.duty + 0.1 * np.linspace(-1, 1, NEAR), 0.05, 0.95))
    shifts, step = np.linspace(-0.1, 0.1, PHASES, retstep=True)
    middle = np.array([np.mean(rows.clock_s[s]) for s in rows.slices])
    out = []
    for period, duty in product(periods, duties):
        near = _Wave(float(period), float(duty), wave.phase + middle / wave.period_s - middle / period)
        columns = rows.met(np.stack([rows.load(near, near.phase + x) for x in shifts], axis=1))
        out.append([(columns[s].T @ rows.white[s], np.sum(columns[s] ** 2, axis=0) + 1e-300) for s in rows.slices])
    both = np.array(out)  # [wave, trip, cross or square, phase]
    return _Profile(both[:, :, 0], both[:, :, 1], float(step))
