"""The loop end to end on one log: from a sheet to what it misses, with the error before and after."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.diagnosis.look import Found, Search, Verdict
from hdev_jax.diagnosis.memory import from_plain, to_plain
from hdev_jax.diagnosis.metrics import metrics, sum_weight
from hdev_jax.diagnosis.select import search
from hdev_jax.diagnosis.split import Split
from hdev_jax.diagnosis.unexplained import Remainder, Rows, remainder
from hdev_jax.errors import InputError
from hdev_jax.inference import Calibration, Fit, ParameterTable, calibrate, cluster_rows, padded
from hdev_jax.inference.sheet import Sheet, choose_entry, traction_force_from_torque
from hdev_jax.logs import Log
from hdev_jax.physics import Effect, Vehicle
from hdev_jax.physics.across import distance_since_start
from hdev_jax.physics.vehicle import Target
from hdev_jax.segments import Segments

__all__ = ["UNITS", "Diagnosis", "Problem", "baseline_block", "diagnose", "prepare"]

UNITS = {"energy_wh": "Wh", "battery_power_kw": "kW", "motor_torque_nm": "Nm", "traction_force_n": "N"}
MOST_SHADOWS = 2
FAR = 2.0  # tabular standard deviations beyond which a coefficient has moved suspiciously far
Tell = Callable[[str], None]
Checkpoint = Callable[[str, Callable[[], Any]], Any]


@dataclass(frozen=True)
class Problem:
    """A log, a sheet and a target brought together."""

    log: Log
    sheet: Sheet
    target: Target
    segments: Segments  # without what the target would leak
    measured: np.ndarray
    vehicle: Vehicle
    table: ParameterTable
    notes: tuple[str, ...]

    @property
    def unit(self) -> str:
        """Unit of the target."""
        return UNITS[self.target]

    def rows(self, trips: Sequence[int]) -> np.ndarray:
        """Mask of these trips' rows."""
        return np.isin(self.segments.trip, trips)

    def weight(self) -> np.ndarray:
        """What each row weighs in a sum."""
        return sum_weight(self.target, np.asarray(self.segments.duration_s), np.asarray(self.segments.distance_m))


@dataclass(frozen=True)
class Diagnosis:
    """What came out: `summary` is diagnosis.json, `before` and `after` the two vehicles, the columns for figures."""

    problem: Problem
    split: Split
    summary: dict[str, Any]
    before: Vehicle
    after: Vehicle
    fit: Calibration
    predicted_before: np.ndarray
    predicted_after: np.ndarray
    found: dict[str, dict[str, tuple[float, float, str]]]


def prepare(log: Log, sheet: Sheet, target: str | None = None, *, need_measured: bool = True) -> Problem:
    """The vehicle of a sheet for this log and target, with the chain entered where the log measures it.

    Raises `InputError` where the log does not measure the target, or the sheet lacks what is in use.
    """
    derived = target == "traction_force_n" and target not in log.targets and log.segments.has("motor_torque_nm")
    name: Any = target or log.default_target
    if derived:
        measured = np.asarray(traction_force_from_torque(log.segments, sheet))
    else:
        measured = log.target(name) if need_measured else np.zeros(len(log))
    segments = log.segments
    if name == "traction_force_n":
        segments = segments.without("traction_force_n", "motor_torque_nm")
    elif name == "motor_torque_nm":
        segments = segments.without("motor_torque_nm")
    built = sheet.build(segments, choose_entry(segments, name), name, vehicle_names=log.vehicle_names)
    notes = list(built.notes)
    if derived:
        notes.append("traction_force_n is not logged: it is motor torque · ratio / wheel radius · η^sign(torque)")
    if not segments.has("grade_rad") and built.vehicle.entry == "road":
        notes.append("the log has no slope: the declared model takes the road as flat")
    return Problem(log, sheet, name, segments, measured, built.vehicle, built.table, tuple(notes))


def diagnose(
    problem: Problem,
    split: Split,
    library: Mapping[str, type[Effect]],
    *,
    fdr: float = 0.05,
    seed: int = 0,
    tell: Tell = lambda _: None,
    checkpoint: Checkpoint = lambda _, compute: compute(),
) -> Diagnosis:
    """Steps 1 to 6 of the loop. Test trips are looked at once, when everything has been chosen.

    **Arguments:** `library`, the candidates by id; `fdr`, the level of false discoveries over all of them; `seed` of
    placebos, resampling and the flexible learner; `checkpoint(name, compute)` keeps plain values of each stage.

    **Returns:** a `Diagnosis`; its `summary` keeps contract §4.
    """
    if problem.target != "energy_wh" and not np.all(np.isfinite(problem.measured)):
        raise InputError("the target holds values that are no numbers; see the ledger of `hdev check`")
    train = problem.rows(split.train)
    rows = padded(problem.segments.take(train), problem.measured[train])
    real = problem.segments.take(train)
    gears = int(np.max(np.asarray(real.channels["gear"]))) if real.has("gear") else 1

    def remember(step: int, compute: Callable[[], Search]) -> Search:
        plain = checkpoint(f"step-{step}", lambda: to_plain(compute()))
        return from_plain(plain, problem.vehicle, library, gears)

    if problem.target in ("traction_force_n", "motor_torque_nm"):  # a power sensor's fault is none of theirs
        library = {k: c for k, c in library.items() if k != "power_gain"}
    state = search(
        problem.vehicle, problem.table, rows, problem.target, list(library.values()),
        fdr=fdr, seed=seed, tell=tell, remember=remember,
    )  # fmt: skip
    tell("error before and after on test trips")
    for round_ in range(MOST_SHADOWS + 1):
        steps = _path(problem, state, rows)
        predicted = [_predict(problem, fit.vehicle) for fit in steps]
        plain = checkpoint(
            f"remainder-{round_}",
            lambda p=predicted: _remainder(problem, split, p[-1], p[0], seed, tell).__dict__,
        )
        left = Remainder(**plain)
        shadow = _shadow(problem, state, predicted, train, left)
        if shadow is None or round_ == MOST_SHADOWS:
            break
        tell(f"taking {shadow} out: what is left is larger than what it explains")
        state = _without(problem, state, shadow, rows)
    base = steps[0]
    summary = _summary(problem, split, state, steps, predicted, left)
    found = {
        e["id"]: {k: (p["value"], p["sd"], p["unit"]) for k, p in e["parameters"].items()} for e in summary["effects"]
    }
    return Diagnosis(
        problem, split, summary, base.vehicle, steps[-1].vehicle, steps[-1], predicted[0], predicted[-1], found
    )


def _shadow(
    problem: Problem, state: Search, predicted: list[np.ndarray], train: np.ndarray, left: Remainder
) -> str | None:
    """A found effect that reads no channel and explains less than the structure that is left: the mean of a cause
    that the library does not hold is a constant load, but naming it so would be wrong."""
    if not left.significant:
        return None
    mse = [float(np.mean((problem.measured - p)[train] ** 2)) for p in predicted]
    for k, f in reversed(list(enumerate(state.found))):
        effect = f.score.candidate.effect
        reads_nothing = effect.id == "power_gain" or (effect.stage == "battery" and not effect.needs)
        if reads_nothing and max(mse[k] - mse[k + 1], 0.0) < left.rms**2:
            return f.id
    return None


def _without(problem: Problem, state: Search, effect_id: str, rows: Fit) -> Search:
    """The state with one effect taken out again and the rest refitted."""
    table, vehicle = state.table.minus(effect_id), state.fit.vehicle.minus(effect_id)
    clusters = cluster_rows(rows.segments.take(np.arange(rows.rows)))
    fit = calibrate(vehicle, table, rows, problem.target, clusters)
    gone = next(f for f in state.found if f.id == effect_id)
    why = "the mean of something larger that is left unexplained, not a cause of its own"
    verdicts = [Verdict(effect_id, gone.score.gain, gone.q_value, why), *state.verdicts]
    found = [f for f in state.found if f.id != effect_id]
    return replace(state, vehicle=fit.vehicle, table=table, fit=fit, found=found, verdicts=verdicts)


def _predict(problem: Problem, vehicle: Vehicle) -> np.ndarray:
    """The target's column on every row of the log."""
    rows = padded(problem.segments, problem.measured)
    return np.asarray(_column(vehicle, rows.segments, problem.target))[: rows.rows]


@eqx.filter_jit
def _column(vehicle: Vehicle, segments: Segments, target: Target) -> jax.Array:
    return vehicle.predict(segments, target)


def _path(problem: Problem, state: Search, rows: Fit) -> list[Calibration]:
    """The declared model, then with each effect in the order found, each fitted to all training rows."""
    real = rows.segments.take(np.arange(rows.rows))
    clusters = cluster_rows(real)
    fits = [calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)]
    for k in range(1, len(state.found)):
        later = [f.id for f in state.found[k:]]
        table = state.table
        for id_ in later:
            table = table.minus(id_)
        vehicle = state.fit.vehicle.minus(*later)
        values = state.trail.get(",".join(f.id for f in state.found[:k]))
        if values is not None:  # fitted when it was found
            fits.append(replace(fits[0], vehicle=table.insert(vehicle, jnp.asarray(values)), table=table))
        else:
            fits.append(calibrate(vehicle, table, rows, problem.target, clusters))
    return [*fits, state.fit] if state.found else fits


def _features(problem: Problem, predicted: np.ndarray, declared: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """What a flexible learner may use: every channel, motion, time and place in the trip, and the models' own words."""
    s = problem.segments
    columns: dict[str, np.ndarray] = {
        "speed_mps": np.asarray(s.speed_mps),
        "acceleration": np.asarray(s.accel_mps2),
        "time_s": np.asarray(s.time_s),
        "distance_since_start_m": np.asarray(distance_since_start(jax.tree.map(jnp.asarray, s))),
        "duration_s": np.asarray(s.duration_s),
        "predicted": predicted,
        "declared": declared,
        **{k: np.asarray(v, dtype=float) for k, v in s.channels.items()},
    }
    names = [k for k, v in columns.items() if np.ptp(v) > 0]
    return np.stack([columns[k] for k in names], axis=1), names


def _remainder(
    problem: Problem, split: Split, predicted: np.ndarray, declared: np.ndarray, seed: int, tell: Tell
) -> Remainder:
    features, names = _features(problem, predicted, declared)

    def side(trips: Sequence[int]) -> Rows:
        at = problem.rows(trips)
        segments = problem.segments.take(at)
        residual = (problem.measured - predicted)[at]
        return Rows(
            features[at], residual, cluster_rows(segments), np.asarray(segments.trip), np.asarray(segments.duration_s)
        )

    trip_names = problem.log.trip_names
    return remainder(side(split.train), side(split.test), names, problem.unit, trip_names, seed=seed, tell=tell)


def baseline_block(fit: Calibration, absorbs: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """The contract's `baseline.parameters`: value, sd, the table's, how far it moved, what it may have absorbed."""
    block = {}
    for c, value, sd, z in zip(fit.table.free, fit.values, fit.sd, fit.prior_z(), strict=True):
        prior = {} if c.sd is None else {"prior_value": c.value, "prior_sd": c.sd, "prior_z": float(z)}
        block[c.name] = {
            "value": float(value), "sd": float(sd), "unit": c.unit, **prior, "absorbs": list(absorbs.get(c.name, ())),
        }  # fmt: skip
    return block


def _effect_block(f: Found, fit: Calibration, before: float, after: float) -> dict[str, Any]:
    c = f.score.candidate
    prefix = f"effects.{f.id}."
    parameters = {
        row.name.removeprefix(prefix): {"value": float(v), "sd": float(s), "unit": row.unit}
        for row, v, s in zip(fit.table.free, fit.values, fit.sd, strict=True)
        if row.path.startswith(prefix)
    }
    chosen = {p.name: p for p in c.effect.parameters if p.kind == "choice"}
    for name, value in c.shapes:
        if name in chosen:
            parameters[name] = {"value": float(value), "sd": 0.0, "unit": chosen[name].unit}
    return {
        "id": f.id,
        "stage": c.effect.stage,
        "verdict": "one_of_class" if f.twins else "found",
        "parameters": parameters,
        "equation": c.effect.equation,
        "separated_by": c.effect.separated_by,
        "q_value": f.q_value,
        "stability": f.stability,
        "test_rmse_before": before,
        "test_rmse_after": after,
        "indistinguishable_from": list(f.twins),
    }


def _summary(
    problem: Problem,
    split: Split,
    state: Search,
    steps: list[Calibration],
    predicted: list[np.ndarray],
    left: Remainder,
) -> dict[str, Any]:
    weight, y = problem.weight(), problem.measured
    train, test = problem.rows(split.train), problem.rows(split.test)

    def block(p: np.ndarray) -> dict[str, Any]:
        at = {problem.log.trip_names[i]: problem.rows([i]) for i in split.test}
        return {
            "train": metrics(y[train], p[train], weight[train]),
            "test": metrics(y[test], p[test], weight[test]),
            "test_by_trip": {k: metrics(y[m], p[m], weight[m]) for k, m in at.items()},
        }

    rmse = [metrics(y[test], p[test], weight[test])["rmse"] for p in predicted]
    effects = [{**_effect_block(f, steps[-1], rmse[k], rmse[k + 1]), "order": k + 1} for k, f in enumerate(state.found)]
    verdict = {
        (False, False): "nothing_missing",
        (True, False): "effects_found",
        (False, True): "unexplained_structure",
        (True, True): "effects_found_and_unexplained_structure",
    }[bool(effects), left.significant]
    clusters = cluster_rows(problem.segments.take(train))
    candidates = [{"id": v.id, "score": v.score, "q_value": v.q_value, "why_not": v.why_not} for v in state.verdicts]
    considered = {c["id"] for c in candidates}
    for e in state.fit.vehicle.effects:  # in the vehicle: nothing to turn down, but considered all the same
        if e.parameters and e.id not in considered:
            f = next((f for f in state.found if f.id == e.id), None)
            here = (f.gain, f.q_value, "found") if f else (None, 1.0, "declared in the sheet")
            candidates.append(dict(zip(("id", "score", "q_value", "why_not"), (e.id, *here), strict=True)))
    return {
        "schema": "hdev-diagnosis/1",
        "target": problem.target,
        "split": {
            "train_trips": split.names(split.train),
            "test_trips": split.names(split.test),
            "unused_trips": split.names(split.unused),
        },
        "before": block(predicted[0]),
        "after": block(predicted[-1]),
        "baseline": {"parameters": baseline_block(steps[0], state.absorbs)},
        "effects": effects,
        "candidates": candidates,
        "unexplained": {
            "significant": left.significant,
            "share_of_test_variance": left.share,
            "noise_floor_rmse": left.noise_floor_rmse,
            "depends_on": list(left.depends_on),
            "signature": left.signature,
        },
        "verdict": verdict,
        "parameters_fitted": _fitted(state),
        "clusters": {"kind": clusters.kind, "count": clusters.count},
        "subsets": _subsets(problem, test, predicted[0], predicted[-1]),
        "notes": [*problem.notes, *_warnings(steps, state)],
    }


def _fitted(state: Search) -> int:
    """Every fitted or grid-chosen number: free coefficients, and choices among more than one value."""
    choices = sum(
        len(p.grid) != 1
        for f in state.found
        for p in f.score.candidate.effect.parameters
        if p.kind == "choice" and any(p.name == n for n, _ in f.score.candidate.shapes)
    )
    return len(state.table.free) + choices


def _subsets(problem: Problem, test: np.ndarray, before: np.ndarray, after: np.ndarray) -> dict[str, Any]:
    """Errors on parts of the test rows that mean something of their own."""
    s, weight = problem.segments, problem.weight()
    moving = np.asarray(s.speed_mps) > 2.0
    parts = {"standing still": np.asarray(s.speed_mps) < 0.1, "above 2 m/s": moving}
    if s.has("brake_pressure_pa") or s.has("brake_pedal_pct"):
        brake = np.asarray(s.get("brake_pressure_pa", s.get("brake_pedal_pct", 0.0)))
        off = brake < 0.005 * np.max(np.abs(brake))
        parts["above 2 m/s, friction brake off"] = moving & off
    y = problem.measured
    return {
        name: {k: metrics(y[m], p[m], weight[m]) for k, p in (("before", before), ("after", after))}
        for name, rows in parts.items()
        if (m := rows & test).sum() > 50
    }


def _warnings(steps: list[Calibration], state: Search) -> list[str]:
    out = []
    for fit, when in ((steps[0], "declared model"), (steps[-1], "model with the effects")):
        if not fit.converged:
            out.append(f"the fit of the {when} stopped early: {fit.message}")
    for name, p in baseline_block(steps[0], state.absorbs).items():
        if abs(p.get("prior_z", 0.0)) > FAR:
            held = f"; on this log it cannot be told from {', '.join(p['absorbs'])}" if p["absorbs"] else ""
            out.append(f"{name} moved {p['prior_z']:+.1f} tabular sd to fit the declared model{held}")
    return out
