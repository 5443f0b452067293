"""The vehicles as they are and as their sheets declare them: sums of the kernel's effects, nothing else."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from hdev_jax.fleet.config import FleetConfig
from hdev_jax.fleet.efficiency import MAX_GEARS, padded_map
from hdev_jax.fleet.shifting import Program
from hdev_jax.fleet.variants import Variant
from hdev_jax.physics import LIBRARY, Driveline, Effect, EfficiencyMap, Grouped, Machine, Vehicle
from hdev_jax.physics.loads import Auxiliary
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling

__all__ = ["ROTATING_MASS_FACTOR", "hidden_effects", "shift_program", "tabular_vehicle", "true_vehicle"]

ROTATING_MASS_FACTOR = (
    1.04  # wheels and motor (Mitschke and Wallentowitz, Dynamik der Kraftfahrzeuge), known to the sheet
)
# More rolling resistance on coarse asphalt, concrete, setts or gravel: Sandberg, MIRIAM (2011); the last is assumed
_SURFACE_EXCESS = (0.0, 0.10, 0.05, 0.45)


def hidden_effects(v: Variant, config: FleetConfig, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Parameters of the effects that this vehicle has and its sheet lacks, by id, as switched on in `config.truth`.

    What differs from vehicle to vehicle is drawn from `rng`, whatever is switched on: a switch changes nothing else.
    """
    a, b, c, d = rng.uniform(0.85, 1.15, 4)
    trailer = v.axles.endswith("trailer")
    every: dict[str, dict[str, Any]] = {
        # ISO 28580: 0.6 to 0.8 % less for each kelvin for truck tyres
        "rolling_temperature": {"per_k": -0.007 * v.true_c_rr * a},
        "rolling_speed": {"per_mps2": 0.12 * v.true_c_rr / 22.2**2},
        "tyre_warmup": {"excess": 0.30 * b, "distance_m": 6000.0},
        "wet_road": {"excess": 0.15 * c, "spray": 0.06},
        "road_surface": {"excess": _SURFACE_EXCESS},
        "cornering": {"coefficient": 0.02},
        "headwind": {"scale": 0.95},
        "crosswind": {"drag_per_rad2": 3.0 if trailer else 1.5},
        "air_density": {"scale": 1.0},
        "auxiliary_power": {"power_w": v.extra_auxiliary_w * d},
        "hvac_power": {"below_w_per_k": v.hvac_w_per_k[0] * a, "above_w_per_k": v.hvac_w_per_k[1] * c,
                       "heat_c": 18.0, "cool_c": 22.0},
        "regen_limit": {"power_w": 550.0 * v.power_kw},
        "regen_cutoff": {"speed_mps": 2.5},
    }  # fmt: skip
    skew = config.log.clock_skew_s * float(np.clip(rng.standard_normal(), -2.0, 2.0))
    kept = {k: p for k, p in every.items() if getattr(config.truth, k)}
    return kept | ({"time_skew": {"skew_s": skew, "cubic": 0.0}} if config.log.clock_skew_s > 0 else {})


def _effect(id: str, parameters: dict[str, Any]) -> Effect:
    values = {
        k: Grouped(jnp.asarray(x, dtype=float), "road_surface") if isinstance(x, tuple) else jnp.asarray(x, dtype=float)
        for k, x in parameters.items()
    }
    return LIBRARY[id](**values)


def true_vehicle(v: Variant, effects: dict[str, dict[str, Any]]) -> Vehicle:
    """The vehicle as it is. Its arrays have the shapes of every variant: one compiled program serves the fleet."""
    return _declared(v, v.true_c_rr, v.true_cda_m2).plus(*(_effect(k, p) for k, p in effects.items()))


def tabular_vehicle(v: Variant, config: FleetConfig) -> Vehicle:
    """The vehicle as its sheet declares it, at the tabular values."""
    if not config.truth.tabular_error:
        return _declared(v, v.true_c_rr, v.true_cda_m2)
    return _declared(v, v.c_rr[0], v.cda_m2[0])


def _declared(v: Variant, c_rr: float, cda_m2: float) -> Vehicle:
    def number(x: float | int) -> Any:
        return jnp.asarray(x, dtype=float)

    ratios = np.array(v.gear_ratios + (v.gear_ratios[-1],) * (MAX_GEARS - v.gears))
    driveline = Driveline(
        EfficiencyMap(*(jnp.asarray(x, dtype=float) for x in padded_map(v))),
        jnp.asarray(ratios, dtype=float),
        number(v.final_drive),
        number(v.wheel_radius_m),
        covers_machine=True,
    )
    effects = (
        Inertia(number(ROTATING_MASS_FACTOR)),
        Grade(),
        Rolling(number(c_rr)),
        Aero(number(cda_m2)),
        Auxiliary(number(v.auxiliary_w)),
    )
    return Vehicle(
        effects, mass_kg=number(v.mass_kg[1]), driveline=driveline, machine=Machine(number(1.0), number(1.0))
    )


def shift_program(v: Variant, config: FleetConfig) -> Program:
    """The shift program of the vehicle's gearbox."""

    def number(x: float | int) -> Any:
        return jnp.asarray(x, dtype=float)

    ratios = np.array(v.gear_ratios + (v.gear_ratios[-1],) * (MAX_GEARS - v.gears))
    return Program(
        jnp.asarray(ratios * v.final_drive / v.wheel_radius_m, dtype=float),
        number(v.gears), number(v.base_speed_radps), number(v.max_speed_radps), number(v.power_kw * 1e3),
        number(config.gears.hysteresis), number(config.gears.hysteresis_load),
    )  # fmt: skip
