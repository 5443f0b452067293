"""What a change would cost on the trips as driven: `road.c_rr=-10%`, `mass_kg=+500`, `ambient_temp_c=-5`."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hdev_jax.energy.causes import ByCause, Change, by_cause
from hdev_jax.energy.fitted import Fitted
from hdev_jax.errors import InputError
from hdev_jax.inference.parameters import leaf_of
from hdev_jax.inference.sheet.schema import KEYS, Key, effect_key
from hdev_jax.logs.adapter import near
from hdev_jax.logs.limits import MAX_GRADE_RAD, MAX_SPEED_MPS
from hdev_jax.logs.log import KINEMATICS
from hdev_jax.physics import EfficiencyMap, Grouped, Vehicle
from hdev_jax.physics.loads import Auxiliary
from hdev_jax.problem import Problem
from hdev_jax.segments import NO_CAUSE, Segments

__all__ = ["Changed", "Step", "changed", "idle", "parse_changes"]

NOTHING = 1e-9  # of the energy: rounding

_FORM = re.compile(r"([^=\s]+)=([+-]?)(\d+(?:\.\d*)?(?:[eE][+-]?\d+)?|\.\d+)(%?)")
_CHANNELS = {  # ranges of channels, where a number beyond is in another unit or no weather
    "grade_rad": Key("number", "rad", -MAX_GRADE_RAD, MAX_GRADE_RAD),
    "ambient_temp_c": Key("number", "degC", -90.0, 60.0),  # the extremes on record: -89.2 and 56.7 °C (WMO)
    "wind_speed_mps": Key("number", "m/s", 0.0, MAX_SPEED_MPS),
    "soc": Key("number", "1", 0.0, 1.0),
}
_MEASURED = ("motor_torque_nm", "motor_speed_radps", "traction_force_n", "accel_mps2", "current_a", "brake_pressure_pa",
             *NO_CAUSE)  # fmt: skip


@dataclass(frozen=True)
class Step:
    """One change: `key`, a coefficient of the sheet or a channel of the log; `text` as it was written.

    The new value is `factor`·old + `plus`.
    """

    key: str
    text: str
    factor: float
    plus: float
    channel: bool


@dataclass(frozen=True)
class Changed:
    """Energy by cause and trip as it was driven (`before`), with the change (`after`), and the difference (`by`), which
    is taken draw by draw: what both have in common is certain."""

    before: ByCause
    after: ByCause
    by: ByCause


def parse_changes(problem: Problem, changes: Sequence[str]) -> list[Step]:
    """What `--set` asks for. A value with a sign is a change (`-10%`, `+500`), one without is the new value.

    **Raises:** `InputError`, one line, for what does not read, and for a key that is neither a coefficient in use nor a
    channel of the log, with the near names.
    """
    if not changes:
        raise InputError("--set: no change is given; road.c_rr=-10% or mass_kg=+500 are expected, each after a --set")
    held = {*KEYS} - {c.path for c in problem.table.rows} - {"mass_kg"}
    coefficients = [c.path for c in problem.table.rows]
    if problem.vehicle.entry == "road":
        coefficients += [p for p in ("mass_kg", "road.rotating_mass_factor") if p not in coefficients]
    if "battery.auxiliary_w" not in coefficients and problem.vehicle.has(Auxiliary.id):
        coefficients.append("battery.auxiliary_w")
    channels = [k for k in problem.segments.channels if k not in _MEASURED and ":" not in k]
    out = []
    for text in changes:
        found = _FORM.fullmatch(text.strip())
        if found is None:
            raise InputError(
                f"--set {text}: KEY=VALUE is expected, as in road.c_rr=-10%, mass_kg=+500 or battery.auxiliary_w=2000"
            )
        key, sign, digits, percent = found.groups()
        if key in KINEMATICS:
            raise InputError(f"--set {text}: the trips stay as driven; a coefficient or the weather can change")
        if key in _MEASURED:
            raise InputError(f"--set {text}: {key} follows from the drive; a coefficient or the weather can change")
        if key not in coefficients and key not in channels:
            why = "is not in use here" if key in held else "is no coefficient in use and no channel of the log"
            choices = tuple(dict.fromkeys([*coefficients, *channels]))
            raise InputError(f"--set {text}: {key} {why}{near(key, choices)}; accepted are {', '.join(choices)}")
        number = float(f"{sign}{digits}")
        if key in [s.key for s in out]:
            raise InputError(f"--set {text}: {key} is set twice; once is expected")
        channel = key in channels
        if not channel and isinstance(leaf_of(problem.vehicle, key), EfficiencyMap):
            raise InputError(f"--set {text}: the sheet has an efficiency map; one number is expected")
        if percent and not sign:
            raise InputError(f"--set {text}: a percentage is a change and has a sign, as in {key}=+{digits}%")
        factor, plus = (1.0 + number / 100.0, 0.0) if percent else (1.0, number) if sign else (0.0, number)
        step = Step(key, text.strip(), factor, plus, channel)
        _in_range(problem, step)
        out.append(step)
    return out


def _in_range(problem: Problem, step: Step) -> None:
    key = _CHANNELS.get(step.key, KEYS.get(step.key))
    if step.key.startswith("effects."):
        _, effect_id, name = step.key.split(".")
        effect = problem.sheet.library[effect_id]
        key = effect_key(effect, next(p for p in effect.parameters if p.name == name))
    if key is None:
        return
    old = problem.segments.channels[step.key] if step.channel else leaf_of(problem.vehicle, step.key)
    values = np.atleast_1d(np.asarray(old.values if isinstance(old, Grouped) else old, dtype=float))
    new = step.factor * values + step.plus
    if bad := [x for x in new if not key.holds(float(x))]:
        raise InputError(f"--set {step.text}: {step.key} would be {bad[0]:g}; {key.expected} is accepted")


def changed(fitted: Fitted, steps: Sequence[Step], *, seed: int = 0) -> Changed:
    """Energy by cause and trip before and after, at the same draws of the coefficients.

    A change in percent, or by an amount, is one of the coefficient whatever it is; a new value is certain.
    """

    change = _by(steps)
    thetas = fitted.draws(seed)
    before, after = by_cause(fitted, thetas), by_cause(fitted, thetas, change)
    return Changed(before, after, after.minus(before))


def idle(fitted: Fitted, steps: Sequence[Step]) -> list[Step]:
    """The changes of channels that, each by itself, leave the energy of every trip as it was."""
    estimate = fitted.draws(0)[:1]
    whole = by_cause(fitted, estimate).value
    small = NOTHING * max(float(np.max(np.abs(whole))), 1.0)
    alone = ((s, by_cause(fitted, estimate, _by([s])).value) for s in steps if s.channel)
    return [s for s, x in alone if float(np.max(np.abs(x - whole))) <= small]


def _by(steps: Sequence[Step]) -> Change:
    """The vehicle and the rows with these changes."""

    def change(car: Vehicle, rows: Segments) -> tuple[Vehicle, Segments]:
        for s in steps:
            if s.channel:
                rows = rows.with_channels(**{s.key: s.factor * rows.channels[s.key] + s.plus})
            else:
                car = eqx.tree_at(
                    lambda v, key=s.key: leaf_of(v, key), car, _moved(leaf_of(car, s.key), s),
                    is_leaf=lambda x: isinstance(x, Grouped),
                )  # fmt: skip
        return car, rows

    return change


def _moved(leaf: object, s: Step) -> object:
    if isinstance(leaf, Grouped):
        return Grouped(s.factor * leaf.values + s.plus, leaf.by)
    return s.factor * jnp.asarray(leaf, dtype=float) + s.plus
