"""What a log shows of each instrument, in one line each."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hdev_jax.logs.instruments.slope import Slope
from hdev_jax.logs.instruments.steps import step_of

__all__ = ["Instrument", "instruments_of"]

_SHOWN = {  # unit that people read, and the factor to it
    "altitude_m": ("altitude", "m", 1.0),
    "grade_rad": ("slope", "%", 100.0),
    "speed_mps": ("speed", "km/h", 3.6),
    "motor_torque_nm": ("torque", "Nm", 1.0),
    "traction_force_n": ("traction force", "N", 1.0),
    "battery_power_w": ("battery power", "W", 1.0),
}
_STEPPED = ("speed_mps", "motor_torque_nm", "traction_force_n", "battery_power_w")


@dataclass(frozen=True)
class Instrument:
    """A channel's instrument: `noise` and `step` in the channel's unit (0: none seen), what else there is to say."""

    channel: str
    noise: float
    step: float
    more: str = ""

    def line(self) -> str:
        """`altitude: noise 3.1 m, step 1 m; slope smoothed over 180 m, its error 0.6 %`."""
        name, unit, factor = _SHOWN[self.channel]
        parts = [f"{what} {x * factor:.2g} {unit}" for what, x in (("noise", self.noise), ("step", self.step)) if x > 0]
        return f"{name}: {', '.join(parts) or 'no noise that matters'}{self.more}"


def instruments_of(columns: Mapping[str, np.ndarray], slope: tuple[str, Slope] | None) -> tuple[Instrument, ...]:
    """Of channels by name as they were read, and of the channel that the slope is from, where it was smoothed."""
    found = []
    if slope is not None:
        channel, s = slope
        drift = f", drifts by {s.course.drift:.2g} m within {s.course.drift_s:.2g} s" if s.course.drift > 0 else ""
        alone = s.course.drift == 0 and s.repeated is None  # else no one length says how far it is smoothed
        span = f" smoothed over {s.span_m:.2g} m" if alone else " smoothed"
        more = f"{drift}; slope{span}, its error {100 * s.error_rad:.2g} %"
        more += f"; {s.repeated.line()}" if s.repeated is not None else ""
        found.append(Instrument(channel, s.course.white if s.noisy else 0.0, s.step, more))
    for name in _STEPPED:
        if name in columns and (step := step_of(columns[name])) > 0:
            found.append(Instrument(name, 0.0, step))
    return tuple(found)
