"""A made-up drive for the tests of `learn`, and the NARX of paper 2 as a loop in NumPy that shares no code with it."""

import numpy as np

from hdev_jax.learn import Trip
from hdev_jax.segments import Segments


def drive(rows: int = 600, seed: int = 0, name: str = "1", noise: float = 0.05) -> Trip:
    """Torque and speed of a car that wanders, and power [kW] with losses, late by half a row."""
    rng = np.random.default_rng(seed)
    speed = 15 + 8 * np.sin(np.arange(rows) / 40 + rng.uniform(0, 6)) + np.cumsum(rng.normal(0, 0.05, rows))
    speed = np.maximum(speed, 0.0)
    torque = 60 * np.sin(np.arange(rows) / 13 + rng.uniform(0, 6)) + rng.normal(0, 10, rows)
    turning = 33.28 * speed
    power = torque * turning / 1000 + 1e-4 * torque**2 + 0.006 * turning + 0.2
    late = 0.5 * power + 0.5 * np.r_[power[0], power[:-1]]
    zero = np.zeros(rows)
    segments = Segments(
        trip=np.zeros(rows, dtype=int), vehicle=np.zeros(rows, dtype=int), time_s=0.22 * np.arange(rows),
        duration_s=np.full(rows, 0.22), distance_m=0.22 * speed, speed_start_mps=speed, speed_end_mps=speed,
        channels={"motor_torque_nm": torque, "motor_speed_radps": turning, "battery_temp_c": zero + 8.0},
    )  # fmt: skip
    inputs = {"speed_mps": speed, "motor_torque_nm": torque, "motor_speed_radps": turning}
    return Trip(name, 0.22, inputs, late + rng.normal(0, noise, rows), segments)


def narx_loop(theta, y, u, outputs, lags, units, seen_from, free):
    """Equations 17-19 row by row: predictions, or the free run, from the first row that has its regressors."""
    columns = outputs + u.shape[1] * len(lags)
    q = columns - seen_from
    offset, linear = theta[0], theta[1 : 1 + columns]
    size = theta[1 + columns : 1 + columns + units]
    slope = theta[1 + columns + units : 1 + columns + units + units * q].reshape(units, q)
    shift = theta[1 + columns + units + units * q :]
    first = max(outputs, max(lags))
    past = list(y[:first])
    out = []
    for k in range(first, len(y)):
        x = [past[k - i] for i in range(1, outputs + 1)]
        for j in range(u.shape[1]):
            x += [u[k - lag, j] for lag in lags]
        x = np.array(x)
        value = offset + x @ linear
        for i in range(units):
            value += size[i] / (1 + np.exp(-(x[seen_from:] @ slope[i] + shift[i])))
        out.append(value)
        past.append(value if free else y[k])
    return np.array(out)
