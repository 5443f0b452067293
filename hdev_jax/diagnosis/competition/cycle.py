"""A load that switches on and off in every trip, with a phase of its own in each: the phases are searched first.

A cycle whose phase is free in each trip has no column before the phases are known, so it is searched in the spectrum,
which does not depend on phases; then its period, its duty and the phase of each trip are chosen by generalised least
squares. It is named where it is one cycle: the same size in every trip, and a load that is either on or off. Other
cycles stay unexplained.
"""

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.competition.refit import joined
from hdev_jax.diagnosis.competition.state import Found, State, Verdict
from hdev_jax.diagnosis.gates.gates import RESAMPLES
from hdev_jax.diagnosis.gates.rejection import Kind, Rejection
from hdev_jax.diagnosis.noise.noise import estimate_noise
from hdev_jax.diagnosis.noise.spectrum import Clocked, strongest_period
from hdev_jax.diagnosis.scores.evidence import Score
from hdev_jax.diagnosis.settings import Settings
from hdev_jax.diagnosis.training import Training
from hdev_jax.physics import Effect
from hdev_jax.physics.loads import PeriodicLoad
from hdev_jax.targets import TARGETS, as_watts

__all__ = ["add_cycle", "barred"]

ID = PeriodicLoad.id
PERIODS, PHASES, DUTIES = 21, 9, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
ROUNDS = 3  # of choosing period, duty and phases in turn


@dataclass(frozen=True)
class _Wave:
    period_s: float
    duty: float
    phase: Float[np.ndarray, " trip"]


@dataclass(frozen=True)
class _Rows(Clocked):
    """Training rows and their whitened residual; the intercept of a trip is a constant load [W]."""

    white: Float[np.ndarray, " row"]

    @property
    def place(self) -> Int[np.ndarray, " row"]:
        """Place of each row's trip among the trips."""
        return np.concatenate([np.full(s.stop - s.start, k) for k, s in enumerate(self.slices)])

    def met(self, loads: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row k"]:
        """Whitened columns of loads [W], in the target's unit."""
        return self.whitened(loads * self.worth[:, None])

    def load(self, wave: _Wave, phase: Float[np.ndarray, " trip"] | None = None) -> Float[np.ndarray, " row"]:
        """The cycle of 1 W on every row, by the effect's own equation."""
        at = (wave.phase if phase is None else phase)[self.place]
        effect = PeriodicLoad(power_w=1.0, period_s=wave.period_s, duty=wave.duty, phase=jnp.asarray(at))
        return np.asarray(effect.on(self.clock_s - 0.5 * self.duration_s, self.duration_s))


def barred(training: Training, state: State, effect: type[Effect]) -> Verdict | None:
    """The verdict on an effect with a search of its own where that is not run now; None where it is."""
    if not TARGETS[training.target].of_battery:
        why = Rejection(Kind.UNAVAILABLE, {"reason": f"cannot act on the target {training.target}"})
        return Verdict(effect.id, None, 1.0, why)
    if effect.id in state.barred:
        return Verdict(effect.id, None, 1.0, state.removed[effect.id])
    return None


def add_cycle(training: Training, state: State, rng: np.random.Generator) -> tuple[State | None, Verdict | None]:
    """The state with a periodic load added and refitted, or a verdict on why it is not."""
    if state.fit.vehicle.has(ID) or ID not in training.library:
        return None, None
    if (verdict := barred(training, state, PeriodicLoad)) is not None:
        return None, verdict
    settings = training.settings

    def no(kind: Kind, detail: str, gain: float | None = None, q: float = 1.0) -> tuple[None, Verdict]:
        return None, Verdict(ID, gain, q, Rejection(kind, {"detail": detail}))

    residual = training.residual(state.fit)
    rows = _rows(training, residual, residual)
    hit = strongest_period(residual, rows)
    if hit is None:
        return no(Kind.TOO_FEW_CLUSTERS, "the residual is too short for a spectrum")
    q = min(1.0, hit.p * len(training.library))
    if q > settings.fdr:
        why = f"no cycle is significant in the spectrum (FDR-adjusted p = {q:.2g})"
        return no(Kind.NOT_SIGNIFICANT, why, q=q)
    period = next(p for p in PeriodicLoad.parameters if p.name == "period_s")
    wave, square = _fitted(rows, hit.period_s)
    if not period.lower < wave.period_s < period.upper:
        return no(Kind.IMPLAUSIBLE, f"a cycle of {wave.period_s:.3g} s, outside the range of switched loads", q=q)
    # the noise is quieter, and phases are sharper, without the cycle
    load = rows.worth * rows.load(wave) * _common(rows, square[:, None])[1]
    left = residual - load  # the mean of the cycle may have been taken for a constant load
    rows = _rows(training, residual, left - rows.worth * (rows.worth @ left) / (rows.worth @ rows.worth))
    wave, square = _fitted(rows, wave.period_s)
    gains, sizes, sd = _by_trip(rows, square)
    gain, freedoms = float(np.sum(gains)), len(wave.phase) + 3
    cycle = f"a cycle of {wave.period_s:.0f} s"
    if why := _unlike(rows, wave, square, gains, sizes, sd, settings):
        return no(Kind.IMPLAUSIBLE, f"{cycle}, but {why}", gain, q)
    beta = np.array([np.sum(sizes / sd**2) / np.sum(1.0 / sd**2)])
    share = float(np.mean((rows.worth * beta[0]) ** 2 * wave.duty * (1 - wave.duty)) / np.mean(residual**2))
    if gain < settings.size_cost * freedoms or share < settings.least_share:
        return no(Kind.OUTSCORED, f"{cycle} that explains too little for its number of coefficients", gain, q)
    left_out = _left_out_gain(rows, square, settings)
    drawn = rng.integers(0, len(gains), (RESAMPLES, len(gains)))
    stability = float(np.mean(np.sum(gains[drawn], axis=1) > settings.size_cost * freedoms))
    if left_out <= settings.ahead:
        return no(Kind.NOT_CONFIRMED, f"{cycle}, not confirmed by cross-validation over trips", gain, q)
    if stability < settings.stable:
        return no(Kind.UNSTABLE, f"{cycle}, chosen in only {100 * stability:.0f} % of resampled sets of trips", gain, q)
    ids = [int(training.trip[s.start]) for s in rows.slices]
    phases = tuple((f"phase[{t}]", float(p)) for t, p in zip(ids, wave.phase, strict=True))
    shapes = (("period_s", wave.period_s), ("duty", wave.duty))
    c = Candidate(PeriodicLoad, ("power_w",), (None,), (*shapes, *phases), "size", ())
    score = Score(c, beta, gain, hit.p, hit.p, left_out, 1.0)
    fit = joined(training, state, score, rows.noise) or joined(training, state, score)
    if fit is None:
        return None, Verdict(ID, gain, q, Rejection(Kind.REFIT))
    found = Found(ID, score, q, stability, (), gain)
    return replace(state, fit=fit, found=(*state.found, found)), None


def _rows(training: Training, residual: np.ndarray, left: np.ndarray) -> _Rows:
    """The residual whitened by the noise of what is left of it."""
    levels = training.clusters.kind == "trip"
    noise = estimate_noise(left, training.trip, training.seconds, levels=levels)
    start = np.asarray(training.rows.segments.time_s)[: training.rows.rows]
    worth = 1.0 / as_watts(training.target, np.ones(len(start)), training.seconds)
    clocked = Clocked(start + 0.5 * training.seconds, training.seconds, training.trip, worth, noise)
    return _Rows(**vars(clocked), white=clocked.whitened(residual[:, None])[:, 0])


def _by_trip(rows: _Rows, column: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gain in log-likelihood, size and its standard error of one whitened column in each trip."""
    square = np.array([column[s] @ column[s] for s in rows.slices]) + 1e-300
    cross = np.array([column[s] @ rows.white[s] for s in rows.slices])
    return 0.5 * cross**2 / square, cross / square, 1.0 / np.sqrt(square)


def _left_out_gain(rows: _Rows, column: np.ndarray, settings: Settings) -> float:
    """Gain in log-likelihood over trips left out in turn: the size is the others', the phase of each costs its own."""
    square = np.array([column[s] @ column[s] for s in rows.slices])
    cross = np.array([column[s] @ rows.white[s] for s in rows.slices])
    others = (np.sum(cross) - cross) / (np.sum(square) - square + 1e-300)
    return float(np.sum(others * cross - 0.5 * others**2 * square - settings.size_cost))


def _common(rows: _Rows, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and size of each column alone, the size being the same in every trip."""
    square, cross = np.sum(columns**2, axis=0) + 1e-300, columns.T @ rows.white
    return 0.5 * np.where(cross > 0, cross, 0.0) ** 2 / square, cross / square


def _fitted(rows: _Rows, period_s: float) -> tuple[_Wave, np.ndarray]:
    """Period, duty and phases by generalised least squares, from the spectrum's period; and the wave's column."""
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
    """The whole grid at first, then ever finer about the present duty."""
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


def _differ(sizes: np.ndarray, precision: np.ndarray, times: np.ndarray, settings: Settings) -> bool:
    """Whether sizes differ between trips, each counted so many times, by more than chance and by much of themselves."""
    weight = precision * times
    mean = float(np.sum(weight * sizes) / np.sum(weight))
    chi2, freedom = float(np.sum(weight * (sizes - mean) ** 2)), float(np.sum(times)) - 1
    if freedom < 1 or stats.chi2.sf(chi2, freedom) >= settings.level:
        return False
    between = max(chi2 - freedom, 0.0) / (np.sum(weight) - np.sum(weight * precision) / np.sum(weight))
    return bool(np.sqrt(between) > settings.alike_spread * mean)


def _unlike(
    rows: _Rows,
    wave: _Wave,
    square: np.ndarray,
    gains: np.ndarray,
    sizes: np.ndarray,
    sd: np.ndarray,
    settings: Settings,
) -> str | None:
    """Why it is not one load that is switched in every trip, or None."""
    if _differ(sizes, 1.0 / sd**2, np.ones(len(sizes)), settings):
        return "not of the same size in every trip"
    angle = 2 * np.pi * (rows.clock_s / wave.period_s + wave.phase[rows.place])
    others = np.stack([f(k * angle) for k in (1, 2, 3) for f in (np.cos, np.sin)], axis=1)
    both = np.column_stack([square, rows.met(others)])
    x = np.linalg.lstsq(both, rows.white, rcond=None)[0]
    alone = 0.5 * float(square @ rows.white) ** 2 / float(square @ square)
    more = 0.5 * float(rows.white @ both @ x) - alone
    if stats.chi2.sf(2 * more, others.shape[1]) < settings.level and more > settings.other_waves * alone:
        return "not a load that is either on or off"
    return None
