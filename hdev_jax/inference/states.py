"""Loads with a hidden state: a hidden Markov model of on/off loads over what a vehicle's prediction leaves.

Each load is a two-state chain in continuous time, so rows may have any length: over a row of Δt it keeps its state
with the weight e^(−Δt/memory) and otherwise takes one by its share of time on. A row in which it switches holds some
share of its power. About the levels the residual is an autoregression of first order with Student-t innovations, whose
degrees of freedom are estimated and whose scale differs between standstill and motion. Parameters by
expectation-maximisation (Rabiner, Proc. IEEE 77, 1989; Hamilton, Econometrica 57, 1989; Lange, Little and Taylor, JASA
84, 1989), trips as separate sequences.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammaln

from hdev_jax.inference.chain import draw, smooth
from hdev_jax.inference.rows import padded_rows
from hdev_jax.physics.states import KNOTS_C, USUAL_C
from hdev_jax.segments import Segments, trip_slices

__all__ = [
    "Decoded", "StateRows", "Switching", "decode", "energy_draws", "errors_alone", "fit_switching", "rows_of",
    "shares_of",
]  # fmt: skip

LANES = 16  # trips run side by side
STANDSTILL_MPS = 0.1
FREEDOMS = (2.0, 3.0, 4.0, 6.0, 10.0, 20.0, 60.0)  # degrees of freedom of the errors
LEAST_SHARE, MOST_SHARE = 0.005, 0.995  # of time on: a state that is never taken has no dwell time
SHRINK_S = 300.0  # of time at a temperature, worth as much as the mean over all temperatures
FEW_ROWS = 100.0
SAMPLES, MEANS = 0.1, 0.9  # chance that a row in which a load switches holds a share of its power
MOST_ERROR = 0.2  # of a load's memory: errors that last longer are not told from its levels
LEAST_MEMORY_S = 30.0  # contactors and compressors are not switched faster; what is faster counts as an error
SWEEPS = 4  # of reweighted least squares for the levels


@dataclass(frozen=True)
class StateRows:
    """Rows of whole trips as the hidden Markov model takes them: what the vehicle's prediction leaves, as a power.
    `partly`: the chance that a row in which a load switches holds a share of its power and not all of it, as means over
    rows do and samples mostly do not."""

    residual_w: Float[np.ndarray, " row"]
    trip: Int[np.ndarray, " row"]
    duration_s: Float[np.ndarray, " row"]
    temp_c: Float[np.ndarray, " row"]
    standing: Int[np.ndarray, " row"]  # 1 at standstill, else 0
    partly: float = MEANS

    @property
    def has_temperature(self) -> bool:
        """Whether the shares may depend on the temperature: where it varies at all."""
        return float(np.ptp(self.temp_c)) > 0 if len(self.temp_c) else False

    def take(self, rows: np.ndarray | slice) -> "StateRows":
        """Rows by mask, index or slice."""
        columns = (self.residual_w, self.trip, self.duration_s, self.temp_c, self.standing)
        residual, trip, seconds, temp, standing = (x[rows] for x in columns)
        return StateRows(residual, trip, seconds, temp, standing, self.partly)

    def coarse(self, seconds: float) -> "StateRows":
        """Means over runs of rows of at least so many seconds in a trip; the rows themselves where they are long."""
        starts = []
        for _, s in trip_slices(self.trip):
            clock = np.floor(np.cumsum(self.duration_s[s]) / seconds - 1e-9)
            starts += [np.flatnonzero(np.r_[True, np.diff(clock) > 0]) + s.start]
        at = np.concatenate(starts)
        total = np.add.reduceat(self.duration_s, at)

        def mean(x: np.ndarray) -> np.ndarray:
            return np.add.reduceat(x * self.duration_s, at) / total

        standing = (mean(self.standing.astype(float)) > 0.5).astype(int)
        return StateRows(mean(self.residual_w), self.trip[at], total, mean(self.temp_c), standing)


def rows_of(segments: Segments, residual_w: Float[np.ndarray, " row"], *, samples: bool) -> StateRows:
    """The first rows of (padded) segments with their residual [W]; `samples`: measured at an instant, no means."""
    n = len(residual_w)
    temp = np.broadcast_to(np.asarray(segments.get("ambient_temp_c", USUAL_C), dtype=float), len(segments))[:n]
    standing = (np.asarray(segments.speed_mps)[:n] < STANDSTILL_MPS).astype(int)
    return StateRows(
        np.asarray(residual_w, dtype=float), np.asarray(segments.trip)[:n], np.asarray(segments.duration_s)[:n],
        np.array(temp), standing, SAMPLES if samples else MEANS,
    )  # fmt: skip


@dataclass(frozen=True)
class Switching:
    """Parameters of on/off loads: the power of each [W], what is left with all off [W], the scale of the errors'
    innovations in motion and at standstill [W], each load's share of time on at `KNOTS_C` and its memory [s]; the
    memory of the errors [s], 0 where they are independent, and the degrees of freedom of their innovations."""

    power_w: Float[np.ndarray, " load"]
    base_w: float
    scale_w: Float[np.ndarray, " kind"]
    share: Float[np.ndarray, "load knot"]
    memory_s: Float[np.ndarray, " load"]
    error_s: float = 0.0
    freedom: float = 4.0

    @property
    def on(self) -> Float[np.ndarray, "state load"]:
        """Which loads are on in each joint state."""
        return np.array(list(itertools.product((0.0, 1.0), repeat=len(self.power_w))))

    def plus(self, other: "Switching") -> "Switching":
        """These loads with those of another model; the other's base and scales."""
        return Switching(
            np.r_[self.power_w, other.power_w], other.base_w, other.scale_w, np.r_[self.share, other.share],
            np.r_[self.memory_s, other.memory_s], other.error_s, other.freedom,
        )  # fmt: skip

    def only(self, kept: Sequence[int]) -> "Switching":
        """Some of these loads."""
        at = list(kept)
        return replace(self, power_w=self.power_w[at], share=self.share[at], memory_s=self.memory_s[at])

    def turned(self) -> "Switching":
        """The same levels with on and off exchanged."""
        return replace(
            self, power_w=-self.power_w, base_w=self.base_w + float(np.sum(self.power_w)), share=1.0 - self.share
        )

    def expected(self, temp_c: Float[np.ndarray, " row"]) -> Float[np.ndarray, "row load"]:
        """Share of time on in each row, without measured power."""
        return np.stack([np.interp(temp_c, KNOTS_C, s) for s in self.share], axis=1)

    def predicted_w(self, on: Float[np.ndarray, "row load"]) -> Float[np.ndarray, " row"]:
        """Base and loads [W] for a share of time on in each row."""
        return self.base_w + on @ self.power_w


class Decoded(NamedTuple):
    """The states of rows: the share of each row that a load is on given all rows of the trip (`on`) and given the rows
    before alone (`ahead`), what the errors before say of a row's own [W] (`error_w`), the probability that a row begins
    and ends in the same joint state (`same`), and the log-likelihood."""

    on: Float[np.ndarray, "row load"]
    ahead: Float[np.ndarray, "row load"]
    error_w: Float[np.ndarray, " row"]
    same: Float[np.ndarray, "row state"]
    log_likelihood: float


class _Lanes(NamedTuple):
    """Where each row is: whole trips one after the other in a few lanes of about the same length."""

    lane: np.ndarray
    place: np.ndarray
    shape: tuple[int, int]
    starts: np.ndarray  # rows that begin a trip

    @classmethod
    def of(cls, trip: np.ndarray) -> "_Lanes":
        slices = [s for _, s in trip_slices(trip)]
        filled = np.zeros(min(LANES, len(slices)), dtype=int)
        lane, place = np.empty(len(trip), dtype=int), np.empty(len(trip), dtype=int)
        for s in sorted(slices, key=lambda s: s.start - s.stop):
            k = int(np.argmin(filled))
            lane[s], place[s] = k, filled[k] + np.arange(s.stop - s.start)
            filled[k] += s.stop - s.start
        return cls(lane, place, (padded_rows(int(filled.max())), len(filled)), np.array([s.start for s in slices]))

    def spread(self, values: np.ndarray, fill: Any) -> np.ndarray:
        out = np.empty((*self.shape, *values.shape[1:]))
        out[...] = fill
        out[self.place, self.lane] = values
        return out


def _moves(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, "row state state"]:
    """Chance of each joint state given the one before; a trip's first row has none before it."""
    keep = np.exp(-rows.duration_s[:, None] / model.memory_s)
    keep[starts] = 0.0
    share = model.expected(rows.temp_c)
    out = np.ones((len(rows.trip), 1, 1))
    for k in range(len(model.power_w)):
        p = np.stack([1.0 - share[:, k], share[:, k]], axis=1)
        own = (1.0 - keep[:, k, None, None]) * p[:, None, :] + keep[:, k, None, None] * np.eye(2)
        size = 2 * out.shape[1]
        out = np.einsum("rij,rkl->rikjl", out, own).reshape(len(out), size, size)
    return out


def _kept(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, " row"]:
    """How much of the error of the row before a row's error keeps; none of it in a trip's first row."""
    kept = np.exp(-rows.duration_s / max(model.error_s, 1e-9))
    kept[starts] = 0.0
    return kept


def _fits(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, "row state state"]:
    """Log-likelihood of each row's residual for each pair of states before and after it.

    Where they differ, the row is at the level after it, or holds any share of the difference alike: a density that is
    flat between the two levels.
    """
    levels, kept = model.base_w + model.on @ model.power_w, _kept(model, rows, starts)
    scale = model.scale_w[rows.standing][:, None, None]
    before = np.r_[0.0, rows.residual_w[:-1]][:, None] - levels  # error of the row before, by the state before
    x = (rows.residual_w[:, None] - kept[:, None] * before)[:, :, None]
    first = _is_first(rows, starts)
    low, high = (np.where(first, levels, f(levels[:, None], levels)) for f in (np.minimum, np.maximum))
    off = np.maximum(np.maximum(low - x, x - high), 0.0)
    flat = 1.0 + (high - low) / scale * np.exp(_log_t(0.0, model.freedom))
    partly = _log_t(off / scale, model.freedom) - np.log(scale * flat)
    whole = _log_t((x - levels) / scale, model.freedom) - np.log(scale)
    return np.logaddexp(np.log(rows.partly) + partly, np.log1p(-rows.partly) + whole)


def _log_t(x: Any, freedom: float) -> Any:
    """Logarithm of Student's density."""
    norm = gammaln(0.5 * (freedom + 1.0)) - gammaln(0.5 * freedom) - 0.5 * np.log(freedom * np.pi)
    return norm - 0.5 * (freedom + 1.0) * np.log1p(np.square(x) / freedom)


def _is_first(rows: StateRows, starts: np.ndarray) -> np.ndarray:
    """Whether a row is the first of its trip, against pairs of states: it begins in the state that it ends in."""
    first = np.zeros(len(rows.trip), dtype=bool)
    first[starts] = True
    return first[:, None, None]


def _on_in(model: Switching, rows: StateRows, starts: np.ndarray) -> Float[np.ndarray, "row state state load"]:
    """The share of each row that each load is on, for each pair of states before and after it: as measured, where a row
    may hold a share and the step is larger than the error, else half of it."""
    levels, kept = model.base_w + model.on @ model.power_w, _kept(model, rows, starts)
    scale = model.scale_w[rows.standing][:, None, None]
    before = np.r_[0.0, rows.residual_w[:-1]][:, None] - levels
    x = (rows.residual_w[:, None] - kept[:, None] * before)[:, :, None]
    step = levels[None, :] - levels[:, None]
    way = np.clip((x - levels[:, None]) / np.where(step == 0, 1.0, step), 0.0, 1.0)
    sure = step**2 / (step**2 + 12.0 * scale**2)  # variance of a uniform share over that with the error's
    way = np.where(_is_first(rows, starts), 1.0, 0.5 + sure * (way - 0.5))[..., None]
    return (1.0 - way) * model.on[:, None, :] + way * model.on[None, :, :]


def _posed(model: Switching, rows: StateRows) -> tuple[_Lanes, np.ndarray, np.ndarray]:
    lanes = _Lanes.of(rows.trip)
    moves = lanes.spread(_moves(model, rows, lanes.starts), np.eye(len(model.on)))
    return lanes, moves, lanes.spread(_fits(model, rows, lanes.starts), 0.0)


def decode(model: Switching, rows: StateRows) -> Decoded:
    """The states of rows by filter and smoother."""
    lanes, moves, fits = _posed(model, rows)
    found = smooth(moves, fits)
    at = lanes.place, lanes.lane
    pairs = np.asarray(found.pairs)[at]
    on = np.einsum("rij,rijk->rk", pairs, _on_in(model, rows, lanes.starts))
    same = np.einsum("rii->ri", pairs).copy()
    same[lanes.starts] = pairs[lanes.starts].sum(axis=1)  # nothing comes before
    filtered, ahead = (np.asarray(x)[at] @ model.on for x in (found.filtered, found.ahead))
    # half of a row in which it may switch is spent in the state before
    before = np.r_[filtered[:1], filtered[:-1]]
    before[lanes.starts] = ahead[lanes.starts]
    error = np.r_[0.0, (rows.residual_w - model.predicted_w(filtered))[:-1]] * _kept(model, rows, lanes.starts)
    return Decoded(on, 0.5 * (before + ahead), error, same, float(np.sum(np.asarray(found.log_likelihood))))


def energy_draws(
    model: Switching, rows: StateRows, *, key: jax.Array, draws: int
) -> Float[np.ndarray, "draw load trip"]:
    """Energy of each load in each trip [Wh] over draws of the state sequence from its posterior."""
    lanes, moves, fits = _posed(model, rows)
    filtered, where = smooth(moves, fits).filtered, _on_in(model, rows, lanes.starts)
    which, at = [s for _, s in trip_slices(rows.trip)], np.arange(len(rows.trip))
    hours = rows.duration_s / 3600.0
    out = np.empty((draws, len(model.power_w), len(which)))
    for k, one in enumerate(jax.random.split(key, draws)):
        after = np.asarray(draw(filtered, moves, fits, key=one))[lanes.place, lanes.lane]
        before = np.r_[after[:1], after[:-1]]
        before[lanes.starts] = after[lanes.starts]
        energy = where[at, before, after] * hours[:, None] * model.power_w
        out[k] = np.stack([energy[s].sum(axis=0) for s in which], axis=1)
    return out


def fit_switching(
    model: Switching, rows: StateRows, rounds: int, *, coloured: bool = True
) -> tuple[Switching, Decoded]:
    """Parameters by so many rounds of expectation-maximisation from `model`, and the states in the last round;
    `coloured`: the errors have a memory."""
    decoded = decode(model, rows)
    for _ in range(rounds):
        model = _updated(model, rows, decoded, coloured)
        decoded = decode(model, rows)
    return model, decoded


def _updated(model: Switching, rows: StateRows, decoded: Decoded, coloured: bool) -> Switching:
    """The parameters that suit these states. Levels and errors are of the rows that begin and end in the same state:
    in the others the share of time on is not known."""
    starts = np.array([s.start for _, s in trip_slices(rows.trip)])
    before, same = np.r_[0.0, rows.residual_w[:-1]], decoded.same
    kept = _kept(model, rows, starts)
    y, z = rows.residual_w - kept * before, np.column_stack([np.ones(len(model.on)), model.on])
    beta, scale = np.r_[model.base_w, model.power_w], model.scale_w[rows.standing][:, None]
    for _ in range(SWEEPS):
        off = y[:, None] - (1.0 - kept)[:, None] * (z @ beta)
        weight = same * (model.freedom + 1.0) / (model.freedom + (off / scale) ** 2) / scale**2
        gram = (z.T * ((1.0 - kept) ** 2 @ weight)) @ z
        gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
        beta = np.linalg.solve(gram, z.T @ (((1.0 - kept) * y) @ weight))
    share = np.stack([shares_of(rows, decoded.on[:, k]) for k in range(len(model.power_w))])
    new = replace(model, power_w=beta[1:], base_w=float(beta[0]), share=share)
    new = replace(new, memory_s=_memories(new, rows, decoded.on))
    error, last = (x[:, None] - z @ beta for x in (rows.residual_w, before))
    if coloured:
        weight[starts] = 0.0
        share_kept = float(np.sum(weight * error * last) / (np.sum(weight * last**2) + 1e-12))
        memory = -float(np.median(rows.duration_s)) / np.log(share_kept) if 0.01 < share_kept < 1.0 else 0.0
        new = replace(new, error_s=min(memory, MOST_ERROR * float(np.min(new.memory_s))))
    innovation = error - _kept(new, rows, starts)[:, None] * last
    return _with_errors(new, innovation, same, rows.standing)


def _with_errors(
    model: Switching,
    innovation: Float[np.ndarray, "row state"],
    weight: Float[np.ndarray, "row state"],
    kind: np.ndarray,
) -> Switching:
    """The model with the scales that suit innovations [W] of these weights, and the degrees of freedom that suit them
    best of the present ones and their neighbours."""
    best: tuple[float, float, np.ndarray] | None = None
    some = slice(None, None, max(1, len(innovation) // 50_000))
    at = FREEDOMS.index(model.freedom)
    for freedom in FREEDOMS[max(at - 1, 0) : at + 2]:
        scale = _scales(innovation[some], weight[some], kind[some], freedom, model.scale_w)
        each = scale[kind[some]][:, None]
        fits = float(np.sum(weight[some] * (_log_t(innovation[some] / each, freedom) - np.log(each))))
        if best is None or fits > best[0]:
            best = fits, freedom, scale
    assert best is not None
    return replace(model, freedom=best[1], scale_w=best[2])


def _scales(off: np.ndarray, weight: np.ndarray, kind: np.ndarray, freedom: float, start: np.ndarray) -> np.ndarray:
    """Scale of Student's errors in motion and at standstill, of few rows mixed with that of all."""
    scale = float(np.mean(start)) + 1e-9
    for _ in range(SWEEPS):
        square = weight * (freedom + 1.0) / (freedom + (off / scale) ** 2) * off**2
        scale = float(np.sqrt(np.sum(square) / np.sum(weight))) + 1e-9
    few = FEW_ROWS * scale**2
    return np.sqrt([(np.sum(square[kind == k]) + few) / (np.sum(weight[kind == k]) + FEW_ROWS) for k in (0, 1)])


def errors_alone(rows: StateRows) -> tuple[float, float]:
    """Log-likelihood of rows without any load, about their median, and the memory of their errors [s]."""
    middle = float(np.median(rows.residual_w))
    error = rows.residual_w - middle
    starts = np.array([s.start for _, s in trip_slices(rows.trip)])
    inside = np.diff(rows.trip) == 0
    kept = float(np.sum((error[1:] * error[:-1])[inside]) / (np.sum((error[:-1] ** 2)[inside]) + 1e-12))
    memory = -float(np.median(rows.duration_s)) / np.log(kept) if 0.01 < kept < 1.0 else 0.0
    model = Switching(
        np.zeros(1), middle, np.full(2, float(np.std(error)) + 1e-9), np.full((1, len(KNOTS_C)), 0.5),
        np.full(1, 7200.0), memory,
    )  # fmt: skip
    innovation = error - np.r_[0.0, error[:-1]] * _kept(model, rows, starts)
    model = _with_errors(model, innovation[:, None], np.ones((len(error), 1)), rows.standing)
    return decode(model, rows).log_likelihood, memory


def shares_of(rows: StateRows, on: Float[np.ndarray, " row"]) -> Float[np.ndarray, " knot"]:
    """Share of time on at each of `KNOTS_C`, shrunk to the mean where there is little time at that temperature."""
    weight = rows.duration_s
    mean = float(np.sum(weight * on) / np.sum(weight))
    if not rows.has_temperature:
        return np.full(len(KNOTS_C), np.clip(mean, LEAST_SHARE, MOST_SHARE))
    hats = np.stack([np.interp(rows.temp_c, KNOTS_C, e) for e in np.eye(len(KNOTS_C))], axis=1)
    gram = (hats * weight[:, None]).T @ hats + SHRINK_S * np.eye(len(KNOTS_C))
    found = np.linalg.solve(gram, (hats * weight[:, None]).T @ on + SHRINK_S * mean)
    return np.clip(found, LEAST_SHARE, MOST_SHARE)


def _memories(model: Switching, rows: StateRows, on: np.ndarray) -> np.ndarray:
    """The memory that makes as many switches as there are: they come at a rate of 2·share·(1 − share)/memory."""
    share = model.expected(rows.temp_c)
    expected = np.sum(2.0 * share * (1.0 - share) * rows.duration_s[:, None], axis=0)
    inside = np.diff(rows.trip) == 0
    switches = np.sum(np.abs(np.diff(on, axis=0))[inside], axis=0)
    return np.clip(expected / np.maximum(switches, 1.0), LEAST_MEMORY_S, 7200.0)
