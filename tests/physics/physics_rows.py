"""Made-up logs and vehicles for the tests of the kernel."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hdev_jax.physics import LIBRARY, Driveline, Effect, Machine, Vehicle, at_null
from hdev_jax.physics.effect import Grouped
from hdev_jax.physics.loads import Auxiliary
from hdev_jax.physics.road import Aero, Grade, Inertia, RoadGrade, Rolling
from hdev_jax.segments import Segments

GEARS = (9.16, 5.27, 3.33, 2.16)
LENGTHS = (7, 6, 1)  # of the trips; one shape for most tests, so that little is compiled twice

# Every effect of the library, with parameters of a typical size. A new effect is tested by adding one line.
EFFECTS: dict[str, dict[str, Any]] = {
    "accelerometer_bias": {"bias_mps2": 0.07},
    "grade_bias": {"bias_rad": 2e-3},
    "grade_lag": {"lag_s": 1.3},
    "grade_noise": {"sd_rad": 0.01},
    "grade_scale": {"scale": 0.15},
    "mass_scale": {"scale": 0.08},
    "power_gain": {"gain": 0.03, "offset_w": 400.0},
    "sampling_filter": {"tap_1": 0.1, "tap_2": -0.05, "tau_s": 1.7},
    "speed_scale": {"scale": 0.02},
    "time_skew": {"skew_s": 0.37, "cubic": 1.0},
    "torque_offset": {"offset_nm": 3.0, "gain": 0.03},
    "air_density": {"scale": 0.9},
    "constant_headwind": {"speed_mps": 2.3},
    "cornering": {"coefficient": 0.03},
    "crosswind": {"drag_per_rad2": 1.5},
    "drafting": {"reduction": 0.2},
    "friction_brake": {"n_per_unit": 0.004},
    "headwind": {"scale": 0.95},
    "road_grade": {"scale": 0.9},
    "rolling_linear": {"n_per_mps": 12.0},
    "rolling_speed": {"per_mps2": 3e-6},
    "rolling_temperature": {"per_k": -5e-5},
    "rotating_mass": {"factor": 0.06},
    "standstill_hold": {"share": 0.9},
    "road_surface": {"excess": (0.0, 0.1, -0.05, 0.2, 0.3)},
    "tyre_warmup": {"excess": 0.4, "distance_m": 300.0},
    "wet_road": {"excess": 0.3, "spray": 0.2},
    "brake_drag": {"force_n": 300.0, "tau_s": 20.0},
    "driveline_drag": {"torque_nm": (0.0, 2.0, 4.5, 7.0, 3.0)},
    "gear_efficiency": {"delta": (0.0, 0.01, -0.02, 0.03, 0.015)},
    "copper_loss": {"w_per_nm2": 0.02},
    "inverter_loss": {"standby_w": 150.0, "per_nm_w": 2.0},
    "iron_loss": {"w_per_radps": 1.5, "w_per_radps2": 2e-3},
    "auxiliary_power": {"power_w": 1200.0},
    "battery_resistance": {"resistance_ohm": 0.05},
    "cabin_warmup": {"power_w": 3000.0, "tau_s": 15.0},
    "cooling_power": {"w_per_k": 90.0, "start_c": 24.3},
    "efficiency_scale": {"scale": 0.04},
    "friction_blending": {"share": 0.3},
    "hvac_power": {"below_w_per_k": 150.0, "above_w_per_k": 110.0, "heat_c": 15.3, "cool_c": 21.7},
    "mode_change": {"power_w": 700.0, "c_rr": 8e-4, "loss": 0.03, "regeneration": 0.15, "share": 0.4, "in_mode": 1.0},
    "part_load": {"standby_w": 900.0, "per_w": 4e-7, "half_w": 5e3},
    "passenger_heat": {"w_per_passenger": 45.0},
    "periodic_load": {"power_w": 4000.0, "period_s": 11.0, "duty": 0.4, "phase": 0.1},
    "regen_cutoff": {"speed_mps": 4.6},
    "regen_efficiency": {"share": 0.2},
    "regen_limit": {"power_w": 3.1e4, "share": 0.8},
    "standstill_load": {"power_w": 2500.0, "by_door": 0.5},
    "second_switching_load": {"power_w": 700.0, "share_0c": 0.2, "share_30c": 0.9},
    "switching_load": {"power_w": 2300.0, "share_0c": 0.7, "share_20c": 0.1, "memory_s": 40.0},
    "step_change": {"power_w": 900.0, "c_rr": 1e-3, "loss": 0.04, "at_trip": 1.0},
    "traction_limit": {"power_w": 9.1e4},
    "voltage_dependence": {"per_v": 5e-4, "at_v": 640.0},
}


def typical(effect_id: str) -> Effect:
    """The effect at the size above; shapes that the line leaves out have their default."""
    effect = at_null(LIBRARY[effect_id], gears=len(GEARS))
    values = EFFECTS[effect_id]
    assert set(values) <= {p.name for p in effect.parameters}
    for name, value in values.items():
        old = getattr(effect, name)
        new = Grouped(jnp.asarray(value), old.by) if isinstance(old, Grouped) else np.asarray(value)
        effect = eqx.tree_at(lambda e, n=name: getattr(e, n), effect, new, is_leaf=lambda x: isinstance(x, Grouped))
    return effect


def null(effect_id: str) -> Effect:
    return at_null(LIBRARY[effect_id], gears=len(GEARS))


def entry_of(effect_id: str) -> str:
    return LIBRARY[effect_id].entries[0]


def drives(
    *lengths: int, seed: int = 0, dt: float = 1.0, channels: bool = True, without: tuple[str, ...] = ()
) -> Segments:
    """Trips of these lengths, with every channel that an effect reads.

    Rows 1-5 of each trip long enough: a standstill, a flat stretch at one speed, hard braking, a hard start, creeping.
    """
    rng = np.random.default_rng(seed)
    n = sum(lengths)
    trip = np.repeat(np.arange(len(lengths)), lengths)
    within = np.concatenate([np.arange(k) for k in lengths])
    v0, v1 = rng.uniform(2.5, 24.0, n), rng.uniform(2.5, 24.0, n)
    v1 = v0 + 0.06 * (v1 - v0)
    slope = rng.normal(0.0, 0.03, n)
    for place, (start, end, theta) in enumerate(
        [(0, 0, 0.01), (15, 15, 0), (14, 12, -0.03), (9, 11, 0.04), (4, 3, 0)], start=1
    ):
        here = within == place
        v0[here], v1[here], slope[here] = start, end, theta
    duration = dt * rng.uniform(0.8, 1.2, n)
    first = np.cumsum([0, *lengths[:-1]])
    clock = np.cumsum(duration) - duration
    pressure = np.where((rng.uniform(size=n) < 0.3) | (within == 3), 6e5, 0.0)
    channel = {
        "mass_kg": rng.uniform(18e3, 34e3, len(lengths))[trip],
        "grade_rad": slope,
        "accel_mps2": (v1 - v0) / duration + 9.81 * slope + rng.normal(0, 0.02, n),
        "altitude_m": rng.uniform(0.0, 800.0, n),
        "ambient_temp_c": rng.uniform(-10.0, 35.0, n),
        "battery_temp_c": rng.uniform(5.0, 40.0, n),
        "voltage_v": rng.uniform(560.0, 680.0, n),
        "wind_speed_mps": rng.uniform(0.0, 9.0, n),
        "wind_from_rad": rng.uniform(-3.0, 3.0, n),
        "heading_rad": rng.uniform(-3.0, 3.0, n),
        "curvature_1pm": rng.normal(0.0, 0.01, n),
        "wet_road": rng.uniform(0.0, 1.0, n),
        "gap_m": rng.uniform(5.0, 90.0, n),
        "door_open": (within == 1).astype(float),
        "brake_pressure_pa": pressure,
        "passengers": rng.integers(0, 90, n).astype(float),
        "road_surface": rng.integers(0, 4, n).astype(float),
        "gear": rng.integers(1, 5, n).astype(float),
        "traction_force_n": np.where(within == 2, 0.0, rng.normal(2e3, 8e3, n)),
        "motor_torque_nm": np.where(within == 2, 0.0, rng.normal(60.0, 200.0, n)),
        "motor_speed_radps": 40.0 * 0.5 * (v0 + v1),
    }
    return Segments(
        trip=trip,
        vehicle=trip % 2,
        time_s=clock - clock[first][trip],
        duration_s=duration,
        distance_m=0.5 * (v0 + v1) * duration,
        speed_start_mps=v0,
        speed_end_mps=v1,
        channels={k: v for k, v in channel.items() if channels and k not in without},
    )


def log_for(effect_id: str, *lengths: int, **options: Any) -> Segments:
    """A log on which the effect acts."""
    hidden = tuple(LIBRARY[effect_id].lacks)
    return drives(*(lengths or LENGTHS), without=hidden, **options)


def baseline(
    entry: str = "road",
    *,
    rotating: float = 1.05,
    c_rr: Any = 0.006,
    cda_m2: Any = 5.6,
    efficiency: Any = 0.91,
    auxiliary_w: float = 700.0,
    covers_machine: bool = True,
) -> Vehicle:
    """The papers' model of a truck with four gears."""
    road = (Inertia(arr(rotating)), Grade(), Rolling(arr(c_rr)), Aero(arr(cda_m2))) if entry == "road" else ()
    return Vehicle(
        (*road, Auxiliary(arr(auxiliary_w))),
        mass_kg=arr(24e3),
        driveline=Driveline(arr(efficiency), jnp.asarray(GEARS), arr(4.5), arr(0.5), covers_machine),
        machine=Machine(arr(0.93), arr(0.88)),
        entry=entry,
        nominal_voltage_v=620.0,
    )


def arr(x: Any) -> Any:
    """A number as an array; what is one already, or a module, as it is."""
    return np.asarray(x) if isinstance(x, int | float) else x


def without_effect(effect_id: str) -> Vehicle:
    """What the effect is added to: the baseline at an entry where it acts."""
    car = baseline(entry_of(effect_id))
    return car.plus(RoadGrade(arr(1.0))) if effect_id == "accelerometer_bias" else car


def single(effect: Effect, **options: Any) -> Vehicle:
    """A vehicle of one effect, without losses."""
    return Vehicle(
        (effect,), mass_kg=arr(24e3), driveline=Driveline(arr(1.0)), machine=Machine(arr(1.0), arr(1.0)), **options
    )


def one_row(**values: Any) -> Segments:
    """One interval of 10 s at 10 m/s on the flat, or as given; other names are channels."""
    fields = {"time_s": 0.0, "duration_s": 10.0, "distance_m": 100.0, "speed_start_mps": 10.0, "speed_end_mps": 10.0}
    fields |= {k: values.pop(k) for k in list(values) if k in fields}
    return Segments(
        trip=np.zeros(1, int),
        vehicle=np.zeros(1, int),
        **{k: np.array([float(v)]) for k, v in fields.items()},
        channels={k: np.array([float(v)]) for k, v in values.items()},
    )


def join(*logs: Segments) -> Segments:
    """Logs one after the other; trips are numbered anew."""
    numbered, last = [], 0
    for log in logs:
        trip = np.asarray(log.trip) - np.min(log.trip) + last
        last = int(np.max(trip)) + 1
        numbered.append(eqx.tree_at(lambda s: s.trip, log, trip))
    return jax.tree.map(lambda *x: np.concatenate(x), *numbered)


def is_real(x: Any) -> bool:
    """Whether a leaf is a real number or a column of them."""
    return np.issubdtype(np.asarray(x).dtype, np.floating)
