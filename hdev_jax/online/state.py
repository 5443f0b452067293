"""The state of one vehicle that is followed row by row: what is known of its coefficients and of its noise.

The rows are kept as sums of their squares and products (information form), once for each of a few models of the noise.
The sums hold no estimate of the noise, so noise and correlation can be estimated anew after every row.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdev_jax.errors import InputError
from hdev_jax.inference.calibrate import tabular
from hdev_jax.inference.sheet import Sheet, build, choose_entry
from hdev_jax.learn.gears.gears import Surrogate
from hdev_jax.online.form import LASTING_S, MEMORIES, Form
from hdev_jax.online.gears import gears_of, untold
from hdev_jax.physics import Vehicle
from hdev_jax.segments import Segments
from hdev_jax.targets import TARGETS, TargetName

__all__ = ["Now", "State", "Sums", "sample_row", "stacked", "start"]

SAMPLE = {"mass_kg": 20e3, "voltage_v": 600.0, "soc": 0.5, "gear": 1.0, "air_density_kgpm3": 1.225}


class Sums(eqx.Module):
    """Sums over whitened rows, each by its weight, of every member: with z = [x | r], and c what candidates would add.

    `gram` Σzzᵀ, `cross` Σzcᵀ, `square` Σc².
    """

    gram: Float[Array, "*car member z z"]
    cross: Float[Array, "*car member z candidate"]
    square: Float[Array, "*car member candidate"]

    def plus(self, z: Float[Array, "member z"], c: Float[Array, "member candidate"], weight: Any) -> "Sums":
        """With one row more."""
        return Sums(
            self.gram + weight * z[:, :, None] * z[:, None, :], self.cross + weight * z[:, :, None] * c[:, None, :],
            self.square + weight * c**2,
        )  # fmt: skip

    def moved(self, along: Float[Array, "member z a"], room: Float[Array, "member a"]) -> "Sums":
        """What the rows say of coefficients that have moved since, by N(0, σ²/room) along each of these directions.

        G − GU(R + UᵀGU)⁻¹UᵀG: the likelihood of the rows with the move integrated out.
        """
        gram, cross = self.gram @ along, jnp.swapaxes(along, 1, 2) @ self.cross
        inside = jnp.swapaxes(along, 1, 2) @ gram + jax.vmap(jnp.diag)(room)
        both = jnp.concatenate([jnp.swapaxes(gram, 1, 2), cross], axis=2)
        less = jnp.linalg.solve(inside, both)
        z = self.gram.shape[-1]
        return Sums(
            self.gram - gram @ less[:, :, :z], self.cross - gram @ less[:, :, z:],
            self.square - jnp.sum(cross * less[:, :, z:], axis=1),
        )  # fmt: skip

    def scaled(self, scale: Any) -> "Sums":
        """With each coefficient's column multiplied, `scale` `[member z]`."""
        return Sums(scale[:, :, None] * self.gram * scale[:, None, :], scale[:, :, None] * self.cross, self.square)


class State(eqx.Module):
    """What is known after the rows so far. Several vehicles (`stacked`) add a leading axis to every array.

    Estimates are steps from the tabular values, in units of their standard deviations. The levels of the trip follow
    them (in kW and 100 N, or in the target's unit).

    **Fields of the vehicle:** `vehicle`: at its tabular values. `gears`: the trees that tell the gear where rows lack
    it. `centre`, `scale` `[k]`: tabular value and sd of each free coefficient. `drift`: sd [scale] of each estimate's
    drift in an hour. `noise`: of a row, where it is declared.

    **For each member, a model of the noise:** `sums` over rows; `mean` and `covariance` of the posterior; `variance`
    of a whitened row; `wide`: the variance per row of a total; `score`: mean square of a weighted error over its
    scale; `evidence`: log-likelihood.

    **Of the noise in common:** `growth`: moments of squared errors and of the target's size. `worth`: the number of
    rows with the usual noise that carry as much information as all rows so far.

    **Of the rows:** `before`, `candidate`: the last row that was used, [x | r] and c. `since`: how many rows ago that
    was. `last`: the last valid value of each column. `counts`: as `Form.counts`. `totals`: number of rows, squares of
    the target, squares of the levels' columns. `level_squares`: of finished trips. `driven_s`: duration of all rows.

    **Of the watched effects:** `cost_wh`: energy of one unit of each candidate so far. `lowest`: its smallest log
    e-value, at row `lowest_at`. `alarm_at`: the row at which each effect was first certain (0: not yet).
    """

    form: Form = eqx.field(static=True)
    vehicle: Vehicle
    centre: Float[Array, "*car k"]
    scale: Float[Array, "*car k"]
    drift: Float[Array, "*car size"]
    noise: Float[Array, "*car"]
    sums: Sums
    mean: Float[Array, "*car member size"]
    covariance: Float[Array, "*car member size size"]
    variance: Float[Array, "*car member"]
    wide: Float[Array, "*car member"]
    score: Float[Array, "*car member"]
    growth: Float[Array, "*car moment"]
    worth: Float[Array, "*car"]
    evidence: Float[Array, "*car member"]
    before: Float[Array, "*car z"]
    candidate: Float[Array, "*car candidate"]
    since: Float[Array, "*car"]
    last: Float[Array, "*car column"]
    counts: Float[Array, "*car count"]
    totals: Float[Array, "*car total"]
    level_squares: Float[Array, "*car level"]
    driven_s: Float[Array, "*car"]
    cost_wh: Float[Array, "*car candidate"]
    lowest: Float[Array, "*car candidate"]
    lowest_at: Float[Array, "*car candidate"]
    alarm_at: Float[Array, "*car effect"]
    gears: Surrogate | None = None

    @property
    def weights(self) -> Float[Array, " member"]:
        """Probability of each model of the noise `[member]`."""
        odds = jnp.exp(self.evidence - jnp.max(self.evidence))
        return odds / jnp.sum(odds)

    @property
    def steps(self) -> tuple[Float[Array, " size"], Float[Array, "size size"]]:
        """Mean `[size]` and covariance `[size, size]` of the steps from `centre`, over all models of the noise."""
        w = self.weights
        mean = w @ self.mean
        off = self.mean - mean[None, :]
        spread = self.covariance + off[:, :, None] * off[:, None, :]
        return mean, jnp.einsum("m,mij->ij", w, spread)

    @property
    def values(self) -> Float[Array, " k"]:
        """Posterior means of the coefficients `[k]`, in their units."""
        return self.centre + self.scale * self.steps[0][: len(self.form.names)]

    @property
    def sd(self) -> Float[Array, " k"]:
        """Posterior standard deviations of the coefficients `[k]`, in their units."""
        k = len(self.form.names)
        return self.scale * jnp.sqrt(jnp.diagonal(self.steps[1])[:k])

    @property
    def sigma(self) -> Float[Array, ""]:
        """Noise of a row, its correlated part included, in the target's unit."""
        rho = jnp.asarray(self.form.memories)
        return jnp.sqrt(self.weights @ (self.variance / (1.0 - rho**2)))

    @property
    def memory(self) -> Float[Array, ""]:
        """Correlation of a row's error with that of the row before."""
        return self.weights @ jnp.asarray(self.form.memories)

    def counted(self) -> dict[str, int]:
        """How the rows were used, by the names of `Form.counts`; zeros are left out."""
        found = zip(self.form.counts, np.asarray(self.counts), strict=True)
        return {name: int(n) for name, n in found if n}


class Now(eqx.Module):
    """What is known at one row: its prediction from the rows before, and the estimates after it.

    **Fields:**

    - `predicted`, `lower`, `upper`: prediction from the rows before, with its interval, in the target's unit.
    - `model`: the prediction without the correction by the error of the row before.
    - `energy_wh`: energy of the row where the target is at the battery, else its mechanical work.
    - `values`, `sd` `[k]`: the coefficients after the row, in their units.
    - `sigma`, `memory`: as in `State`. `weight`: of the row in the fit, from 0 (not used) to 1.
    - `alarm`: not 0 once it is certain that the sheet lacks an effect.

    For a row that cannot be used the numbers are NaN. The first row has no interval.
    """

    predicted: Float[Array, "*row"]
    lower: Float[Array, "*row"]
    upper: Float[Array, "*row"]
    model: Float[Array, "*row"]
    energy_wh: Float[Array, "*row"]
    values: Float[Array, "*row k"]
    sd: Float[Array, "*row k"]
    sigma: Float[Array, "*row"]
    memory: Float[Array, "*row"]
    weight: Float[Array, "*row"]
    alarm: Float[Array, "*row"]

    def row(self, i: int) -> "Now":
        """The i-th row."""
        return jax.tree.map(lambda x: x[i], self)


def sample_row(channels: Iterable[str]) -> Segments:
    """One plausible row with these channels; it shows which targets and effects such rows allow."""
    return Segments.from_arrays(
        duration_s=1.0, speed_start_mps=10.0, speed_end_mps=10.0, **{c: SAMPLE.get(c, 0.0) for c in channels}
    )


def start(
    sheet: Sheet,
    channels: Iterable[str] = (),
    target: TargetName = "energy_wh",
    *,
    by_trip: Iterable[str] = ("mass_kg",),
    drift: Mapping[str, float] | None = None,
    levels: bool = True,
    memories: Iterable[float] = MEMORIES,
    lasting_s: Iterable[float] = LASTING_S,
    robust: bool = True,
    noise: float | None = None,
    level: float = 0.9,
    candidates: Iterable[str] = (),
    alpha: float = 0.01,
    gears: Surrogate | None = None,
) -> tuple[State, list[str]]:
    """The state before the first row, from the sheet's tabular priors.

    **Arguments:**

    - `channels`: those that rows will have (`grade_rad`, `mass_kg`, …). `target`: what is measured.
    - `by_trip`: paths of the coefficients that are estimated anew in each trip.
    - `drift`: by path, the sd of a coefficient's drift in an hour of driving, in its unit; by default none.
    - `levels`: neighbouring rows of a trip share errors, by a load and a force whose sizes are learned from the trips.
    - `memories`: correlations of a row's error with that of the row before. `lasting_s`: times for which levels last.
      All are tried, and weighed by their likelihood.
    - `robust`: errors follow a Student t with 4 degrees of freedom, else a normal distribution.
    - `noise`: of a row [target's unit], where it is known. `level`: probability inside intervals.
    - `candidates`: the effect of each watched candidate (`Watch.candidates`). `alpha`: the probability that any effect
      is ever named although none is missing.
    - `gears`: a classifier of the gear, needed where the efficiency is a map over several gears and rows have no gear;
      by default the trees of the sheet's `driveline.gear_model`.

    **Returns:** the state, and notes on parts of the sheet that are not used.

    **Raises:** `InputError` where the sheet lacks something that is needed or has nothing to estimate, or where JAX
    computes in single precision: rounding errors would add up from row to row.
    """
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            'estimates row by row need double precision: call jax.config.update("jax_enable_x64", True) first'
        )
    sample = sample_row(channels).without(*TARGETS[target].follows)
    built = build(sheet, sample, choose_entry(sample, target, sheet), target)
    across = [e.id for e in built.vehicle.effects if e.acts_across_rows(sample.channels)]
    table, vehicle = built.table, built.vehicle
    notes = [n for n in built.notes if "efficiency map" not in n or "gear" in n]
    if not untold(sheet, sample, vehicle):
        gears = None
    elif gears is None:
        gears = gears_of(sheet)
    if gears is not None:
        notes = [n for n in notes if "no column 'gear'" not in n]
        notes.append(
            "the rows have no column 'gear': each is predicted over all gears, by the probabilities of the gear trees"
        )
    for effect_id in across:
        table, vehicle = table.minus(effect_id), vehicle.minus(effect_id)
        notes.append(f"effect {effect_id} of the sheet is skipped: it acts across rows, which come one by one here")
    if not table.free:
        raise InputError(f"sheet {sheet.path}: nothing to estimate; give a coefficient in use a value with an sd")
    wander = dict(drift or {})
    if unknown := sorted(set(wander) - {c.path for c in table.free}):
        free = ", ".join(c.path for c in table.free)
        raise InputError(f"drift: {unknown[0]} is no coefficient that is estimated; accepted: {free}")
    form = Form.of(
        table, tuple(sample.channels), target, by_trip=tuple(by_trip), levels=levels, memories=tuple(memories),
        lasting_s=tuple(lasting_s), robust=robust, drifts=any(wander.values()),
        known_noise=noise is not None, level=level,
        candidates=tuple(candidates), alpha=alpha,
    )  # fmt: skip
    centre, scale = tabular(table)
    m, size, k = len(form.members), form.size, len(form.names)
    last = np.full(len(form.columns), np.nan)
    for name, value in {"grade_rad": 0.0, "mass_kg": float(np.asarray(vehicle.mass_kg))}.items():
        if name in form.channels and (name != "mass_kg" or value > 0):
            last[form.columns.index(name)] = value  # until the first value comes
    real = lambda x: jnp.asarray(np.asarray(x, dtype=float))  # noqa: E731
    c, zero = len(form.candidates), real(0.0)
    return State(
        form=form, vehicle=vehicle, centre=real(centre), scale=real(scale),
        drift=real(np.r_[[wander.get(c.path, 0.0) for c in table.free] / scale, np.zeros(size - k)]),
        noise=real(0.0 if noise is None else noise),
        sums=Sums(jnp.zeros((m, size + 1, size + 1)), jnp.zeros((m, size + 1, c)), jnp.zeros((m, c))),
        mean=jnp.zeros((m, size)), covariance=real(np.tile(np.diag(np.r_[np.ones(k), np.zeros(size - k)]), (m, 1, 1))),
        variance=real(np.full(m, 0.0 if noise is None else noise**2)), wide=jnp.zeros(m), score=jnp.zeros(m),
        growth=jnp.zeros(5), worth=zero,
        evidence=jnp.zeros(m), before=jnp.zeros(size + 1), candidate=jnp.zeros(c), since=real(np.inf), last=real(last),
        counts=jnp.zeros(len(form.counts)), totals=jnp.zeros(2 + size - k), level_squares=jnp.zeros(size - k),
        driven_s=zero, cost_wh=jnp.zeros(c), lowest=jnp.zeros(c), lowest_at=jnp.zeros(c),
        alarm_at=jnp.zeros(len(form.effects)), gears=gears,
    ), notes  # fmt: skip


def stacked(states: Iterable[State]) -> State:
    """The states of several vehicles as one, for `jax.vmap(update)`. Raises `ValueError` where their forms differ."""
    every = list(states)
    if any(s.form != every[0].form for s in every):
        raise ValueError("states of one form are expected: the same columns, target and coefficients")
    return jax.tree.map(lambda *x: jnp.stack(x), *every)
