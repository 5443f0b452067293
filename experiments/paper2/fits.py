"""The models of paper 2's tables: each kind fitted on trip 1, by settings of a config, with the spread over starts."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.paper2.data import LEAST_ROWS
from experiments.paper2.diagnosed import Diagnosed
from experiments.paper2.models import corner_kw, penalised, structure
from hdev_jax.errors import InputError
from hdev_jax.learn import (
    Channels,
    Trip,
    fit_prediction,
    fit_simulation,
    prepared,
    starts,
    with_theta,
)
from hdev_jax.learn.baselines.classical import search_classical
from hdev_jax.learn.baselines.recurrent import train_recurrent
from hdev_jax.learn.sequences import energy_kwh, mean_squared

__all__ = ["KINDS", "Mean", "evaluated", "fitted", "recurrent", "step_seconds"]

DIVERGED_KW = 1e6  # far beyond any battery of a car
Model = Any


class Fit(NamedTuple):
    """Models from each start in the order of their loss on the training trip, and those losses.

    `converged` says of each whether the search for its minimum ended by itself; None where there is no such search.
    """

    models: list[Model]
    losses: list[float]
    converged: list[bool] | None = None


def _narx(s: dict[str, Any], trip: Trip, seed: int) -> Fit:
    """One-step fit from many starts; then, where `simulation`, the free run from its solutions."""
    shape = structure(s)
    model, loss = prepared(shape, trip), penalised(s)
    if shape.units:
        keys = jax.random.split(jax.random.key(seed), s["starts"])
        begin = starts(model, trip, keys=keys, steps=s["coarse_steps"], **loss)
    else:
        begin = jnp.zeros((1, shape.shape.size))
    fit = fit_prediction(model, trip, begin, max_steps=s["steps"], rtol=s["rtol"], **loss)
    if s["simulation"]:
        fit = fit_simulation(model, trip, fit.theta, max_steps=s["simulation_steps"], rtol=s["rtol"], **loss)
    order = np.argsort(np.nan_to_num(np.asarray(fit.loss), nan=np.inf))
    return Fit(
        [with_theta(model, fit.theta[k]) for k in order], [float(fit.loss[k]) for k in order],
        [bool(fit.converged[k]) for k in order],
    )  # fmt: skip


def recurrent(s: dict[str, Any], trip: Trip, seed: int, without: np.ndarray | None = None) -> Fit:
    """A network for each start, ordered by its error on the training trip, on the rows that are not left out of it."""
    keys = jax.random.split(jax.random.key(seed), s["starts"])
    models = train_recurrent(
        s["cell"], trip, keys=keys, source=Channels(tuple(s["inputs"])), units=s["units"], steps=s["steps"],
        length=s["length"], rate=s["rate"], decay=s["decay"], huber=corner_kw(s), without=without,
    )  # fmt: skip
    known = np.ones(len(trip), bool) if without is None else ~without
    loss = [mean_squared((m.predict(trip) - m.measured(trip))[known]) for m in models]
    order = np.argsort(loss)
    return Fit([models[k] for k in order], [loss[k] for k in order])


def _classical(s: dict[str, Any], trip: Trip, seed: int) -> Fit:
    model = search_classical(s["model"], trip, trials=s["trials"], seed=seed, source=Channels(tuple(s["inputs"])))
    return Fit([model], [model.score])


class Mean:
    """The mean of several models' predictions, and of their free runs."""

    def __init__(self, members: Sequence[Model]):
        self.members = members

    @staticmethod
    def of(models: Sequence[Model], trip: Trip) -> "Mean":
        """Of those whose free run stays finite on the training trip; of all where none does."""
        finite = [m for m in models if np.all(np.isfinite(m.simulate(trip)))] if len(models) > 1 else models
        return Mean(finite or models)

    @property
    def parameters(self) -> int:
        return sum(m.parameters for m in self.members)

    def predict(self, trip: Trip) -> np.ndarray:
        return np.mean([m.predict(trip) for m in self.members], axis=0)

    def simulate(self, trip: Trip) -> np.ndarray:
        return np.mean([m.simulate(trip) for m in self.members], axis=0)

    def measured(self, trip: Trip) -> np.ndarray:
        return self.members[0].measured(trip)


class _Persistence:
    """ŷ(k) = y(k−1); in free run, the first value for ever."""

    parameters = 0

    def predict(self, trip: Trip) -> np.ndarray:
        return np.asarray(trip.target)[:-1]

    def simulate(self, trip: Trip) -> np.ndarray:
        return np.full(len(trip) - 1, trip.target[0])

    def measured(self, trip: Trip) -> np.ndarray:
        return np.asarray(trip.target)[1:]


def _diagnosed(s: dict[str, Any], trip: Trip, seed: int) -> Fit:
    """The declared car with what a diagnosis of the training trip adds."""
    model = Diagnosed.of(trip, seed)
    return Fit([model], [mean_squared(model.predict(trip) - model.measured(trip))])


def _persistence(s: dict[str, Any], trip: Trip, seed: int) -> Fit:
    return Fit([_Persistence()], [0.0])


KINDS: dict[str, Callable[[dict[str, Any], Trip, int], Fit]] = {
    "narx": _narx,
    "recurrent": recurrent,
    "classical": _classical,
    "diagnosed": _diagnosed,
    "persistence": _persistence,
}


def fitted(settings: dict[str, Any], trip: Trip, seed: int) -> Fit:
    """Fit a model of these settings. Raises `InputError` for a kind that there is not, and for a trip of few rows."""
    if len(trip) < LEAST_ROWS:
        raise InputError(f"trip {trip.name}: {len(trip)} rows, at least {LEAST_ROWS} are needed; raise rows, or 0: all")
    if settings["kind"] not in KINDS:
        raise InputError(f"model kind {settings['kind']!r}: one of {', '.join(KINDS)} is expected")
    return KINDS[settings["kind"]](settings, trip, seed)


def evaluated(model: Model, trip: Trip) -> dict[str, float]:
    """Errors, fit and energies of one trip, one step ahead (`step_`) and in free run (`free_`).

    A run that leaves the numbers has the error that `DIVERGED_KW` gives, for what is kept is finite.
    """
    measured = model.measured(trip)
    total, positive, negative = energy_kwh(measured, trip.dt_s)
    out = {"n": len(measured), "energy": total, "energy_positive": positive, "energy_negative": negative}
    for name, y in (("step", model.predict(trip)), ("free", model.simulate(trip))):
        y = np.clip(np.nan_to_num(y, nan=DIVERGED_KW), -DIVERGED_KW, DIVERGED_KW)
        error = y - measured
        sums = energy_kwh(y, trip.dt_s)
        out |= {
            f"{name}_mse": mean_squared(error),
            f"{name}_fit": 100.0 * (1.0 - float(np.sqrt(np.mean(error**2)) / np.std(measured))),
            f"{name}_energy": sums[0], f"{name}_energy_positive": sums[1], f"{name}_energy_negative": sums[2],
        }  # fmt: skip
        for kind, ours, theirs in zip(("", "_positive", "_negative"), sums, (total, positive, negative), strict=True):
            out[f"{name}_pe{kind}"] = 100.0 * (ours - theirs) / theirs if theirs else 0.0
    return out


def step_seconds(settings: dict[str, Any], trip: Trip, repeats: int = 5) -> float:
    """Wall time of a free run over a trip, by row [s]; the fastest of `repeats`, compiled before.

    Of a NARX with all parameters at zero: the time does not depend on their values. Raises `InputError` for a model
    that is no NARX.
    """
    if settings["kind"] != "narx":
        raise InputError(f"model kind {settings['kind']!r}: time is measured of a NARX alone")
    model = prepared(structure(settings), trip)
    model.simulate(trip)
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        model.simulate(trip)
        taken.append(time.perf_counter() - started)
    return min(taken) / len(trip)
