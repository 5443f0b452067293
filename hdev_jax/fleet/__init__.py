"""Synthetic fleets with known truth: planted logs of one truck, and a whole fleet on thousands of routes.

**Planted logs** (`driving`, `log`, `noise`, `plants`, `truth`): plain NumPy, nothing shared with `hdev_jax.physics`;
for tests of the diagnosis.

**The fleet** (all other modules): 28 variants of trucks, tractors and buses (`VARIANTS`), driven forward over roads,
with the energy of each row from the kernel. In memory:

```python
from hdev_jax.fleet import simulate

fleet = simulate({"seed": 1, "routes": 280})      # or a FleetConfig, or a path such as configs/studies/fleet.toml
for v in fleet.vehicles:
    v.id, v.variant            # "A" … "D" are the paper's four models; the variant has gears, ratios, motor, …
    v.segments                 # Segments as logged, NumPy columns; trip ids count within the vehicle
    v.energy_wh                # the measured target
    v.truth["gear"]            # columns of truth.parquet, row by row, below
    v.tabular, v.true          # kernel Vehicles: what the sheet declares, and what was simulated
fleet["A"]; fleet.column("energy_wh"); fleet.column("truth:gear"); fleet.column("vehicle"); fleet.column("trip")
```

Rows are 100 m of road, or a halt (distance 0). Channels of the log besides the fields of `Segments`: `mass_kg` (with
the payload's error), `grade_rad`, `altitude_m`, `heading_rad`, `curvature_1pm`, `road_surface`, `ambient_temp_c`,
`wind_speed_mps`, `wind_from_rad`, `wet_road`, `gear` (1 … gears), `requested_torque_nm` (at the wheels, before the
driveline).

The truth, by row: `energy_true_wh` (what the vehicle took), `energy_shown_wh` (the same with the target's clock skew,
without noise), `energy_wh:<effect>` (its parts, which add up), `tabular_wh` (what the sheet predicts from the log),
`tabular_wheel_wh` (the same at the wheels, paper 1, equation 4), `c_rr`, `cda_m2` (that hold in the row, with all
effects), `efficiency` (wheel to battery), `mass_kg`, `payload_error` (true mass over logged, less one), `grade_rad`,
`motor_speed_radps`, `motor_torque_nm`, `requested_torque_nm`, `load_share` (power at the wheels over rated, 0 … 1);
for the gears `gear`, `gear_previous`, `gear_lowest` and `gear_highest` (gear = clip(previous, lowest, highest): where
they agree the row alone tells the gear), `gear_static` (the program without hysteresis), `shift_up_mps`,
`shift_down_mps` (the speeds at which it leaves this gear at this row's load and grade; infinite and 0 where it
cannot); `road_kind`, `limit_mps`, and of the drive in steps of 5 m: `shifts` in the row, `gear_middle` (in its
middle), `wheel_energy_fine_wh`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hdev_jax.fleet.driving import Drive
from hdev_jax.fleet.log import ENTRIES, SyntheticLog, demo_log, size_effect, synthetic_log
from hdev_jax.fleet.noise import NOISES
from hdev_jax.fleet.plants import PLANTABLE, Plant, plantable
from hdev_jax.fleet.truth import Truth, power_w

if TYPE_CHECKING:
    from hdev_jax.fleet.config import FleetConfig, load_config
    from hdev_jax.fleet.efficiency import efficiency_map
    from hdev_jax.fleet.simulated import Fleet, FleetVehicle, simulate
    from hdev_jax.fleet.variants import VARIANTS, Variant

__all__ = [
    "ENTRIES",
    "NOISES",
    "PLANTABLE",
    "VARIANTS",
    "Drive",
    "Fleet",
    "FleetConfig",
    "FleetVehicle",
    "Plant",
    "SyntheticLog",
    "Truth",
    "Variant",
    "demo_log",
    "efficiency_map",
    "load_config",
    "plantable",
    "power_w",
    "simulate",
    "size_effect",
    "synthetic_log",
]

_HOME = {
    "Fleet": "simulated",
    "FleetConfig": "config",
    "FleetVehicle": "simulated",
    "VARIANTS": "variants",
    "Variant": "variants",
    "efficiency_map": "efficiency",
    "load_config": "config",
    "simulate": "simulated",
}


def __getattr__(name: str) -> Any:
    # On first use: planted logs need neither JAX nor the kernel.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"hdev_jax.fleet.{_HOME[name]}"), name)
