"""The parameters that suit rows, by expectation-maximisation."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hdev_jax.inference.states.chances import chances
from hdev_jax.inference.states.decode import Decoded, decode
from hdev_jax.inference.states.model import LEAST_MEMORY_S, MOST_MEMORY_S, Switching, kept_errors, log_t, scales
from hdev_jax.inference.states.rows import StateRows
from hdev_jax.physics.states import KNOTS_C
from hdev_jax.segments import trip_slices

__all__ = ["errors_alone", "fit_switching", "rise", "shares_of"]

FREEDOMS = (2.0, 3.0, 4.0, 6.0, 10.0, 20.0, 60.0)  # degrees of freedom of the errors
LEAST_SHARE, MOST_SHARE = 0.005, 0.995  # of time on: a state that is never taken has no dwell time
SHRINK_S = 300.0  # of time at a temperature, worth as much as the mean over all temperatures
WANDERS = 0.9999  # share that errors keep from row to row, at most: a random walk
FEW_ROWS = 100.0  # of the errors of all rows, mixed with those at standstill and in motion
MOST_ERROR = 0.2  # of a load's memory: errors that last longer are not told from its levels
FEW_STEPS = 4.0  # rows that errors may last in any case: of long rows a load's memory has not many more
SWEEPS = 4  # of reweighted least squares for the levels


def fit_switching(
    model: Switching, rows: StateRows, rounds: int, *, coloured: bool = True
) -> tuple[Switching, Decoded]:
    """Parameters by at most so many rounds of expectation-maximisation from `model`, and the states by them;
    `coloured`: the errors have a memory. It ends where a round gains nothing: errors and chances are not maximised
    jointly, and about the maximum a round may lose a little."""
    decoded = decode(model, rows)
    for _ in range(rounds):
        new = _updated(model, rows, decoded, coloured)
        again = decode(new, rows)
        if not again.log_likelihood > decoded.log_likelihood:
            break
        model, decoded = new, again
    return model, decoded


def _updated(model: Switching, rows: StateRows, decoded: Decoded, coloured: bool) -> Switching:
    """The parameters that suit these states. Levels and errors are of the rows that begin and end in the same state:
    in the others the share of time on is not known."""
    starts = np.array([s.start for _, s in trip_slices(rows.trip)])
    before, same = np.r_[0.0, rows.residual_w[:-1]], decoded.same
    kept = kept_errors(model, rows, starts)
    y, z = rows.residual_w - kept * before, np.column_stack([np.ones(len(model.on)), model.on])
    beta, scale = np.r_[model.base_w, model.power_w], scales(model, rows, starts)[:, None]
    for _ in range(SWEEPS):
        off = y[:, None] - (1.0 - kept)[:, None] * (z @ beta)
        weight = same * (model.freedom + 1.0) / (model.freedom + (off / scale) ** 2) / scale**2
        gram = (z.T * ((1.0 - kept) ** 2 @ weight)) @ z
        gram += 1e-9 * np.trace(gram) * np.eye(len(gram))
        beta = np.linalg.solve(gram, z.T @ (((1.0 - kept) * y) @ weight))
    new = replace(model, power_w=beta[1:], base_w=float(beta[0]))
    if np.any(model.by):
        new = chances(new, rows, decoded)
    alike = ~np.any(model.by, axis=1)  # by moments, where there are no covariates: faster
    share = np.stack([shares_of(rows, decoded.on[:, k]) for k in range(len(model.power_w))])
    new = replace(new, share=np.where(alike[:, None], share, new.share))
    new = replace(new, memory_s=np.where(alike, _memories(new, rows, decoded.on), new.memory_s))
    error, last = (x[:, None] - z @ beta for x in (rows.residual_w, before))
    if coloured:
        weight[starts] = 0.0
        alike_w = last * (rows.wide / np.r_[1.0, rows.wide[:-1]])[:, None]
        share_kept = float(np.sum(weight * error * alike_w) / (np.sum(weight * alike_w**2) + 1e-12))
        memory = _memory_of(share_kept, rows)
        most = max(MOST_ERROR * float(np.min(new.memory_s)), FEW_STEPS * float(np.median(rows.forgets_s)))
        new = replace(new, error_s=min(memory, most))
    innovation = error - kept_errors(new, rows, starts)[:, None] * last
    inner = same.copy()
    if len(starts) < len(inner):
        inner[starts] = 0.0  # a first row's error is no innovation
    return _with_errors(new, innovation / rows.wide[:, None], inner, rows.standing)


def _memory_of(kept: float, rows: StateRows) -> float:
    """Memory [s] of errors that keep such a share from row to row; 0 where they keep none."""
    return -float(np.median(rows.forgets_s)) / np.log(min(kept, WANDERS)) if kept > 0.01 else 0.0


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
        fits = float(np.sum(weight[some] * (log_t(innovation[some] / each, freedom) - np.log(each))))
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
    inside, own = np.diff(rows.trip) == 0, error / rows.wide
    kept = float(np.sum((own[1:] * own[:-1])[inside]) / (np.sum((own[:-1] ** 2)[inside]) + 1e-12))
    memory = _memory_of(kept, rows)
    model = Switching(
        np.zeros(1), middle, np.full(2, float(np.std(own)) + 1e-9), np.full((1, len(KNOTS_C)), 0.5),
        np.full(1, MOST_MEMORY_S), memory,
    )  # fmt: skip
    innovation = error - np.r_[0.0, error[:-1]] * kept_errors(model, rows, starts)
    model = _with_errors(model, (innovation / rows.wide)[:, None], np.ones((len(error), 1)), rows.standing)
    return decode(model, rows).log_likelihood, memory


def rise(model: Switching, rows: StateRows, on: Float[np.ndarray, " row"]) -> tuple[float, float]:
    """How much the power rises from begin to end of a stay at the upper level, as a share of it, and its standard
    error: generalised least squares with the errors' memory and Student's weights. A saw-tooth is decoded as two
    levels too, but rises."""
    starts = np.array([s.start for _, s in trip_slices(rows.trip)])
    begins = np.r_[True, np.diff((on > 0.5).astype(int)) != 0]
    begins[starts] = True
    stay, until = np.cumsum(begins) - 1, np.cumsum(rows.duration_s)
    seconds = np.bincount(stay, rows.duration_s)
    through = (until - 0.5 * rows.duration_s - (until - rows.duration_s)[begins][stay]) / seconds[stay]
    kept, scale = kept_errors(model, rows, starts)[:, None], scales(model, rows, starts)[:, None]
    x = np.column_stack([np.ones(len(on)), on, np.where(on > 0.5, through - 0.5, 0.0), rows.residual_w])
    x = (x - kept * np.r_[np.zeros((1, 4)), x[:-1]]) / scale
    x, y, weight = x[:, :3], x[:, 3], np.ones(len(on))
    for _ in range(SWEEPS):
        inverse = np.linalg.pinv((x.T * weight) @ x)
        size = inverse @ (x.T @ (weight * y))
        weight = (model.freedom + 1.0) / (model.freedom + (y - x @ size) ** 2)
    return float(size[2] / size[1]), float(np.sqrt(inverse[2, 2]) / abs(size[1]))


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
    share = model.expected(rows)
    expected = np.sum(2.0 * share * (1.0 - share) * rows.duration_s[:, None], axis=0)
    inside = np.diff(rows.trip) == 0
    switches = np.sum(np.abs(np.diff(on, axis=0))[inside], axis=0)
    return np.clip(expected / np.maximum(switches, 1.0), LEAST_MEMORY_S, MOST_MEMORY_S)
