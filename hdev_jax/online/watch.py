"""Is the declared model still right? A test of every effect of the library that one may read after every row.

A candidate is one form of an effect; its column c is what one typical size of it adds to a row. The Bayes factor

    E = (1 + I)^−½ · exp(½·S²/(1 + I)),   S = c⊥ᵀe/σ²,   I = c⊥ᵀc⊥/σ²

compares a size β ~ N(0, 1) with β = 0. Here e and c⊥ are whitened, and the declared coefficients and the trip's levels
are projected out of them. While the effect is absent, E is a martingale with mean 1, so the probability that it ever
exceeds 1/a is at most a (Ville 1939; normal mixture: Robbins, Ann. Math. Statist. 41, 1970; Ramdas et al., Statistical
Science 38, 2023). So one may look after every row and stop at any time. The mean of E over models of the noise and over
the forms of an effect has the same property. An alarm is an E above (number of effects)/alpha: the probability of any
false alarm, ever, is at most alpha.

**What is approximate:** σ and the correlation of errors are estimates of the model without the effect, so alarms wait
for `WATCH_ROWS` rows. Where the noise differs from trip to trip by a factor of two, E takes it for smaller than it is.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdev_jax.diagnosis.candidates.candidate import Candidate
from hdev_jax.diagnosis.candidates.facts import facts_of
from hdev_jax.diagnosis.candidates.plan import Plan, plan_of
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.inference import padded
from hdev_jax.online.form import Form
from hdev_jax.online.state import State, sample_row
from hdev_jax.online.sums import of_mean
from hdev_jax.physics import LIBRARY, Effect, Vehicle
from hdev_jax.segments import Segments

__all__ = ["WATCH_ROWS", "Alarm", "Watch", "evidence", "of_effects", "watched"]

WATCH_ROWS = 400.0  # that show the noise and its correlation, which E takes as known; also these count in it

TOGETHER = 256  # rows whose columns are computed at a time: one shape, so each program compiles once
SHIFT_S = 9 * 3600.0  # what a vehicle drives in a day: daily driving time of Regulation (EC) 561/2006


def evidence(state: State) -> tuple[Float[Array, " candidate"], Float[Array, " candidate"], Float[Array, " candidate"]]:
    """Logarithm of each candidate's E; its size in typical sizes, with the standard deviation."""
    form = state.form
    noise, variance = of_mean(form, state.variance), jnp.maximum(state.variance, 1e-300)
    x, r = state.sums.cross[:, :-1], state.sums.cross[:, -1]
    score = (r - jnp.einsum("mxc,mx->mc", x, state.mean)) / variance[:, None]
    off = jnp.einsum("mxc,mxy,myc->mc", x, state.covariance, x) / noise[:, None]
    counts = jnp.maximum(state.score, 1e-12) if form.robust else jnp.ones_like(variance)
    information = jnp.maximum(state.sums.square - off, 0.0) * (counts / variance)[:, None]
    each = 0.5 * score**2 / (1.0 + information) - 0.5 * jnp.log1p(information)
    w = state.weights[:, None]
    log_e = jax.scipy.special.logsumexp(each, axis=0, b=w)
    best = w * jnp.exp(each - log_e[None, :])
    size = score / (1.0 + information)
    mean = jnp.sum(best * size, axis=0)
    spread = jnp.sum(best * (1.0 / (1.0 + information) + (size - mean[None, :]) ** 2), axis=0)
    return log_e, mean, jnp.sqrt(spread)


def of_effects(form: Form, log_e: Float[Array, " candidate"]) -> Float[Array, " effect"]:
    """Logarithm of each effect's E, the mean over its forms."""
    mine = np.array([[c == e for c in form.candidates] for e in form.effects])
    shares = jnp.asarray(mine / mine.sum(axis=1, keepdims=True))
    return jax.scipy.special.logsumexp(jnp.broadcast_to(log_e, mine.shape), axis=1, b=shares)


def watched(state: State, counts: Bool[Array, ""], row: Float[Array, ""]) -> State:
    """The state with what this row, the `row`-th, changed in what is watched."""
    form = state.form
    if not form.candidates:
        return state
    log_e, _, _ = evidence(state)
    lower = counts & (log_e <= state.lowest)
    certain = of_effects(form, log_e) > np.log(len(form.effects) / form.alpha)
    new = (
        jnp.where(lower, log_e, state.lowest), jnp.where(lower, row, state.lowest_at),
        jnp.where(counts & certain & (state.alarm_at == 0), row, state.alarm_at),
    )  # fmt: skip
    return eqx.tree_at(lambda s: (s.lowest, s.lowest_at, s.alarm_at), state, new)


@dataclass(frozen=True)
class Alarm:
    """An effect that the declared model lacks: the one that explains most of the model's error.

    **Fields:**

    - `effect`: its id. `name`, `unit`, `size`, `sd`: its parameter with the estimate. `shapes`: of the form that
      explains most.
    - `since_row`: the row (from 1) since which it shows. `certain_row`: the row at which some effect was certain.
    - `log_e`: logarithm of its e-value.
    - `wh_per_day`: its energy in a day with `SHIFT_S` of driving.
    - `instead`: effects that explain about as much.
    """

    effect: str
    name: str
    unit: str
    size: float
    sd: float
    shapes: tuple[tuple[str, float], ...]
    since_row: int
    certain_row: int
    log_e: float
    wh_per_day: float
    instead: tuple[str, ...]

    def line(self) -> str:
        """The alarm in one line."""
        at = "".join(f", {k} = {v:.4g}" for k, v in self.shapes)
        error = f" ± {self.sd:.2g}" if np.isfinite(self.sd) else ""
        other = f"; or {', '.join(self.instead)}" if self.instead else ""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return (
            f"{self.effect}: {self.name} = {self.size:.4g}{error}{unit}{at}; since row {self.since_row}, certain "
            f"at row {self.certain_row}; {self.wh_per_day / 1e3:+.3g} kWh in {SHIFT_S / 3600:g} h of driving{other}"
        )


@dataclass(frozen=True)
class Watch:
    """The effects of the library that one vehicle's channels allow, and what each would add to a row.

    Not watched are effects that act across rows, that have a search of their own, or that have one number for each
    gear. `left_out` gives the reason by id.
    """

    form: Form
    plan: Plan
    chosen: tuple[int, ...]
    scales: Float[np.ndarray, " candidate"]
    left_out: Mapping[str, str]

    @staticmethod
    def of(state: State, library: Mapping[str, type[Effect]] = LIBRARY) -> "Watch":
        """The effects that this state's vehicle lacks and its channels allow: `start(candidates=watch.candidates)`."""
        return Watch.beside(state.vehicle, state.form, library)

    @staticmethod
    def beside(vehicle: Vehicle, form: Form, library: Mapping[str, type[Effect]] = LIBRARY) -> "Watch":
        """As `of`, from a vehicle and a form."""
        why = {k: "acts across rows" for k, c in library.items() if c.acts_across_rows(form.channels)}
        why |= {k: "has a search of its own" for k, c in library.items() if c.searched}
        why |= {k: "has a number for each group" for k, c in library.items() if any(p.by for p in c.parameters)}
        by_trip = [k for k, c in library.items() if any(p.name == "at_trip" for p in c.parameters)]
        why |= dict.fromkeys(by_trip, "compares trips with those before them")
        own = [c for k, c in library.items() if k not in why and not vehicle.has(k)]
        sample = sample_row(form.channels)
        plan = plan_of(vehicle, own, facts_of(sample), form.target)
        places = {p: c for c in plan.candidates for p in c.columns}
        chosen = tuple(sorted(places))
        scales = np.array([_scale(places[p], p) for p in chosen])
        return Watch(form, plan, chosen, scales, why | dict(plan.left_out))

    @property
    def candidates(self) -> tuple[str, ...]:
        """The effect of each candidate."""
        return tuple(self._candidate(p).id for p in self.chosen)

    def _candidate(self, place: int) -> Candidate:
        return next(c for c in self.plan.candidates if place in c.columns)

    def columns(self, rows: Float[Any, "row column"]) -> Float[np.ndarray, "row candidate"]:
        """What a typical size of each candidate adds to each row [target's unit]; 0 where a channel is missing."""
        rows = np.asarray(rows, dtype=float)
        parts = [self._columns(rows[k : k + TOGETHER]) for k in range(0, len(rows), TOGETHER)]
        return np.concatenate(parts) if parts else np.zeros((0, len(self.chosen)))

    def _columns(self, rows: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row candidate"]:
        by = {c: rows[:, i] for i, c in enumerate(self.form.columns)}
        usable = by["duration_s"] > 0
        n = len(rows)
        segments = Segments(
            trip=np.zeros(n, dtype=np.int32), vehicle=np.zeros(n, dtype=np.int32), time_s=by["time_s"],
            duration_s=np.where(usable, by["duration_s"], 1.0), distance_m=self._distance(by),
            speed_start_mps=by["speed_start_mps"], speed_end_mps=by["speed_end_mps"],
            channels={c: by[c] for c in self.form.channels},
        )  # fmt: skip
        fit = padded(segments, np.zeros(n), TOGETHER)
        out = np.zeros((len(fit.weight), len(self.chosen)))
        self.plan.write(out, fit.segments, self.chosen)
        return out[:n] * self.scales

    @staticmethod
    def _distance(by: Mapping[str, np.ndarray]) -> np.ndarray:
        made = 0.5 * (by["speed_start_mps"] + by["speed_end_mps"]) * by["duration_s"]
        return np.where(np.isfinite(by["distance_m"]), by["distance_m"], made)

    def alarm(self, state: State) -> Alarm | None:
        """The effect that the model lacks, once it has been certain that one is missing; None until then.

        Of the effects that have been certain it is the one with the most evidence now. Whether a second effect is
        missing shows only once this one is in the sheet: `hdev diagnose` adds it and looks again.
        """
        found = np.asarray(state.alarm_at)
        if not found.any():
            return None
        log_e, size, sd = (np.asarray(x) for x in evidence(state))
        every = np.asarray(of_effects(state.form, jnp.asarray(log_e)))
        first = int(np.argmax(np.where(found > 0, every, -np.inf)))
        effect, near = state.form.effects[first], every > every[first] - SETTINGS.ahead
        mine = np.flatnonzero(np.array(state.form.candidates) == effect)
        best = int(mine[np.argmax(log_e[mine])])
        candidate = self._candidate(self.chosen[best])
        name = candidate.sizes[candidate.columns.index(self.chosen[best])]
        value, error = float(size[best] * self.scales[best]), float(sd[best] * self.scales[best])
        if candidate.kind == "limit":  # its column is the whole difference: the size is where the switch is
            value, error = dict(candidate.shapes)[name], float("nan")
        days = max(float(state.driven_s), 1.0) / SHIFT_S
        return Alarm(
            effect, name, candidate.parameter(name).unit, value, error,
            tuple((n, v) for n, v in candidate.shapes if n != name), int(np.asarray(state.lowest_at)[best]) + 1,
            int(found[found > 0].min()), float(every[first]),
            float(size[best] * np.asarray(state.cost_wh)[best]) / days,
            tuple(e for k, e in enumerate(state.form.effects) if near[k] and k != first),
        )  # fmt: skip


def _scale(candidate: Candidate, place: int) -> float:
    """A typical size of this column's parameter; a limit's column is the whole difference already."""
    if candidate.kind == "limit":
        return 1.0
    return abs(candidate.parameter(candidate.sizes[candidate.columns.index(place)]).scale)
