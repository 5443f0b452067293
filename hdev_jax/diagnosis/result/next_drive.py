"""What to measure next: the drive that separates two causes which this log cannot distinguish, by Fisher information.

The kernel's Jacobian on a simulated drive gives the information that each kilometre of it adds on each coefficient. A
drive separates a found effect from its rival when the found size, fitted together with the rival's, would be
`SEPARATED` standard errors from 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdev_jax.diagnosis.candidates.plan import columns
from hdev_jax.diagnosis.competition.state import State
from hdev_jax.inference import Fit, jacobian, padded
from hdev_jax.physics import Effect
from hdev_jax.problem import Problem
from hdev_jax.segments import WITHIN_ROWS, Segments
from hdev_jax.units import GRAVITY_MPS2

__all__ = ["DRIVES", "Advice", "advise"]

SEPARATED = 3.0
MOST_REPEATS = 50.0  # of a drive; more is not practical


@dataclass(frozen=True)
class Advice:
    """One drive that separates `effect` from `rival`: how much of it, and how well the log separates them now."""

    effect: str
    rival: str
    drive: str
    kilometres: float
    hours: float
    sd_now: float  # of the effect's size with the rival beside it, over the size
    sd_after: float


@dataclass(frozen=True)
class Part:
    """A stretch of a simulated drive: speeds in m/s between which it goes steadily, for so many seconds."""

    speeds: tuple[float, float]
    seconds: float
    grade: float = 0.0
    heading: float = 0.0
    load: float = 1.0
    temperature_c: float | None = None
    wind_mps: float | None = None


def _steps(**options: float) -> tuple[Part, ...]:
    return tuple(Part((v, v), 240.0, **options) for v in (6.0, 11.0, 16.0, 22.0))


def _town(**options: float) -> tuple[Part, ...]:
    stop = Part((0.0, 0.0), 20.0, **options)
    return tuple(
        p for a in (12.0, 25.0) for p in (Part((0.0, 14.0), a, **options), Part((14.0, 14.0), 30.0, **options),
                                          Part((14.0, 0.0), 0.7 * a, **options), stop)
    ) * 4  # fmt: skip


DRIVES: dict[str, tuple[Part, ...]] = {
    "standing still for half an hour with all consumers on": (Part((0.0, 0.0), 1800.0),),
    "standing still for half an hour on a cold and on a hot day": (
        Part((0.0, 0.0), 1800.0, temperature_c=-5.0), Part((0.0, 0.0), 1800.0, temperature_c=32.0),
    ),
    "four steady speeds on the flat": _steps(),
    "four steady speeds out and back in wind": (*_steps(wind_mps=8.0), *_steps(heading=np.pi, wind_mps=8.0)),
    "four steady speeds on a cold and on a hot day": (*_steps(temperature_c=-5.0), *_steps(temperature_c=32.0)),
    "four steady speeds loaded and empty": (*_steps(load=1.3), *_steps(load=0.7)),
    "a hill of 4 % up and down": (
        Part((14.0, 14.0), 360.0, grade=0.04), Part((14.0, 14.0), 360.0, grade=-0.04, heading=np.pi),
    ),
    "a hill of 4 % up and down, loaded and empty": tuple(
        Part((14.0, 14.0), 360.0, grade=g, load=m) for m in (1.3, 0.7) for g in (0.04, -0.04)
    ),
    "stop and go, gently and hard": _town(),
    "stop and go, loaded and empty": (*_town(load=1.3), *_town(load=0.7)),
    "coasting from 80 km/h": (Part((22.0, 8.0), 140.0), Part((8.0, 0.0), 80.0)) * 4,
}  # fmt: skip


def simulate(parts: Sequence[Part], problem: Problem) -> Segments:
    """The drive as rows of the log's usual length, its channels at their medians except for what the drive varies."""
    s = problem.segments
    step = float(np.median(np.asarray(s.duration_s)))
    v0, v1, which = [], [], []
    for k, p in enumerate(parts):
        n = max(2, round(p.seconds / step))
        edges = np.linspace(*p.speeds, n + 1)
        v0.append(edges[:-1])
        v1.append(edges[1:])
        which.append(np.full(n, k))
    start, end, at = np.concatenate(v0), np.concatenate(v1), np.concatenate(which)
    n, duration = len(at), np.full(len(at), step)
    median = {k: float(np.median(np.asarray(v, dtype=float))) for k, v in s.without(*WITHIN_ROWS).channels.items()}
    channels: dict[str, Any] = {k: np.full(n, m) for k, m in median.items()}

    def vary(name: str, values: list[float | None], usual: float) -> None:
        if name in channels:
            channels[name] = np.array([usual if x is None else x for x in values])[at]

    if "mass_kg" not in channels and problem.vehicle.entry == "road":  # the sheet's: a drive may change it all the same
        channels["mass_kg"] = np.full(n, float(np.mean(np.asarray(problem.vehicle.mass_kg))))
    mass = float(channels["mass_kg"][0]) if "mass_kg" in channels else 1.0
    vary("mass_kg", [p.load * mass for p in parts], mass)
    vary("grade_rad", [p.grade for p in parts], 0.0)
    vary("heading_rad", [p.heading for p in parts], 0.0)
    vary("wind_speed_mps", [p.wind_mps for p in parts], median.get("wind_speed_mps", 0.0))
    vary("wind_from_rad", [0.0 for _ in parts], 0.0)
    vary("ambient_temp_c", [p.temperature_c for p in parts], median.get("ambient_temp_c", 15.0))
    speed = 0.5 * (start + end)
    accel = (end - start) / duration
    grade = np.array([p.grade for p in parts])[at]
    load = np.array([p.load for p in parts])[at]
    # a usual vehicle's effort, in the units of the log's own: what a sensor at the wheel or the shaft would show
    effort = load * (accel + GRAVITY_MPS2 * (grade + 0.007)) + 1.2e-4 * speed**2
    effort = np.where(speed > 0, effort, 0.0)
    for name in ("traction_force_n", "motor_torque_nm"):
        if name in channels:
            own = np.asarray(s.channels[name], dtype=float)
            channels[name] = effort / 1.2 * float(np.quantile(np.abs(own), 0.98))
    if "motor_speed_radps" in channels:
        moving = np.asarray(s.speed_mps) > 2.0
        ratio = np.median(np.asarray(s.channels["motor_speed_radps"])[moving] / np.asarray(s.speed_mps)[moving])
        channels["motor_speed_radps"] = speed * float(ratio)
    if "accel_mps2" in channels:
        channels["accel_mps2"] = accel + GRAVITY_MPS2 * np.sin(grade)
    if "brake_pressure_pa" in channels:
        channels["brake_pressure_pa"] = np.where(accel < -1.0, 3e5, 0.0)
    return Segments(
        trip=np.zeros(n, dtype=int), vehicle=np.zeros(n, dtype=int), time_s=np.arange(n) * step, duration_s=duration,
        distance_m=speed * duration, speed_start_mps=start, speed_end_mps=end, channels=channels,
    )  # fmt: skip


def advise(
    problem: Problem, state: State, rows: Fit, pairs: Sequence[tuple[str, type[Effect]]], *, best: int = 2
) -> list[Advice]:
    """The best drives for each pair of a found effect and a rival that the log cannot distinguish from it.

    **Arguments:** `pairs` of a found effect's id and the rival's class; `best`, how many drives for each pair.
    **Returns:** advice, the shortest first; one with an empty `drive` for a pair that no drive here separates.
    """
    rivals = {rival.id: rival for _, rival in pairs}
    # of a long log one rival's columns at a time; drives are short
    logged = {k: _information(problem, state, rows, [rival])[k] for k, rival in rivals.items()}
    pairs = [(found, rival) for found, rival in pairs if logged[rival.id] and len(_places(state, found)[0])]
    if not pairs:
        return []
    drives = {name: simulate(parts, problem) for name, parts in DRIVES.items()}
    every = [*rivals.values()]
    driven = {k: _information(problem, state, padded(d, np.zeros(len(d))), every) for k, d in drives.items()}
    out = []
    for found, rival in pairs:
        at, size = _places(state, found)
        # of the rival's forms, the one that is hardest to separate from the found effect
        forms = [information + _prior(state) for information in logged[rival.id]]
        which = max(range(len(forms)), key=lambda k: _relative_sd(forms[k], size, at))
        now = _relative_sd(forms[which], size, at)
        options = []
        for name, drive in drives.items():
            if which >= len(driven[name][rival.id]):
                continue
            extra = driven[name][rival.id][which]
            repeats = _repeats(forms[which], extra, size, at)
            if repeats is not None:
                kilometres = repeats * float(np.sum(drive.distance_m)) / 1e3
                hours = repeats * float(np.sum(drive.duration_s)) / 3600
                after = _relative_sd(forms[which] + repeats * extra, size, at)
                options.append(Advice(found, rival.id, name, kilometres, hours, min(now, 1e6), after))
        nothing = Advice(found, rival.id, "", 0.0, 0.0, min(now, 1e6), 1e6)
        out += sorted(options, key=lambda a: a.hours)[:best] or [nothing]
    return out


def _repeats(information: np.ndarray, extra: np.ndarray, size: np.ndarray, at: np.ndarray) -> float | None:
    """How many times the drive has to be driven, at least once; None where even `MOST_REPEATS` are not enough."""

    def separated(times: float) -> bool:
        return _relative_sd(information + times * extra, size, at) <= 1.0 / SEPARATED

    if separated(1.0):
        return 1.0
    if not separated(MOST_REPEATS):
        return None
    low, high = 1.0, MOST_REPEATS
    for _ in range(20):
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if separated(middle) else (middle, high)
    return float(np.ceil(high))


def _places(state: State, found: str) -> tuple[np.ndarray, np.ndarray]:
    """Where the found effect's sizes are among the free coefficients, and what they are."""
    sizes = next(f.score.candidate.sizes for f in state.found if f.id == found)
    paths = {f"effects.{found}.{n}" for n in sizes}
    at = np.array([k for k, c in enumerate(state.fit.table.free) if c.path in paths], dtype=int)
    return at, np.asarray(state.fit.values)[at]


def _information(
    problem: Problem, state: State, rows: Fit, rivals: Sequence[type[Effect]]
) -> dict[str, list[np.ndarray]]:
    """Fisher information of these rows on [free coefficients, rival's size], for each form of each rival."""
    fit = state.fit
    jac = jacobian(fit.vehicle, fit.table, rows.segments, problem.target)[: rows.rows]
    candidates, matrix, _ = columns(fit.vehicle, rivals, rows.segments, rows.rows, problem.target)
    out: dict[str, list[np.ndarray]] = {rival.id: [] for rival in rivals}
    for c in candidates:
        if len(c.columns) == 1 and c.kind == "size":
            both = np.concatenate([jac, matrix[:, [c.columns[0]]]], axis=1)
            out[c.id].append(both.T @ both / (fit.sigma**2 * fit.inflation))
    return out


def _prior(state: State) -> np.ndarray:
    """What the sheet's tables say of the coefficients, and nothing of the rival."""
    precision = [0.0 if c.sd is None else 1.0 / c.sd**2 for c in state.fit.table.free]
    return np.diag([*precision, 0.0])


def _relative_sd(information: np.ndarray, size: np.ndarray, at: np.ndarray) -> float:
    """Standard error over value of the found effect's best known size, everything else fitted with it."""
    d = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(d, d) + 1e-9 * np.eye(len(d))
    with np.errstate(over="ignore"):  # of a size on which the rows hold no information: infinite
        variance = np.diag(np.linalg.inv(scaled))[at] / d[at] ** 2
    sd = np.sqrt(np.maximum(variance, 0.0))
    return float(np.min(np.divide(sd, np.abs(size), out=np.full(len(sd), np.inf), where=size != 0)))
