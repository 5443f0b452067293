"""The vehicles of the synthetic fleet: 28 variants of electric trucks and buses, as a typed table.

Where the numbers come from, and which are ours:

- Masses: Council Directive 96/53/EC (18 t for two axles, 26 t for three, 32 t for four, 40 t and 44 t for
  combinations, 28 t and 29 t for articulated buses, two tonnes more for zero-emission vehicles); kerb masses are
  engineering assumptions with the battery in them.
- Gearboxes: the ratios of `AMT_12` are those that Volvo Trucks publishes for the direct-drive I-Shift (AT2612).
  Makers of e-axles publish the number of speeds and the largest torque at the wheels, seldom the ratios: those with 1
  to 4 speeds are engineering assumptions that give a start at 15 % slope or more and the limited speed within the
  motor's range.
- Motors: continuous power as published for vehicles of the class (about 165 kW for a 16 t truck to 490 kW for a heavy
  tractor); torque and highest speed are assumptions that go with the ratios.
- Drag areas and rolling resistance: `true_cda_m2` is of the size that Commission Regulation (EU) 2017/2400 lists for
  the vehicle groups of VECTO (about 5 to 6 m² for tractors with semitrailer), buses as in Hucho, Aerodynamik des
  Automobils; `true_c_rr` is of tyres of classes C to E of Regulation (EU) 2020/740. The *tabular* values `c_rr` and
  `cda_m2`, which a sheet declares, are off: set so that the sheets' energy errors are those of paper 1, tables 1 and
  2 (models A to D −15.5, −5.18, −7.25 and +34.1 %, the fleet −40.4 %), by `benchmarks/fleet_tabular.py`. So most are
  of a best-case test site, and D's is that of traction tyres on unmade ground.
- Auxiliary and climate loads: assumptions within what Basma et al., Energy 207 (2020), give for buses.

Every vehicle is invented: none of them is a product, and none was measured.
"""

import math
from dataclasses import dataclass

from hdev_jax.units import GRAVITY_MPS2

__all__ = ["AXLE_LOAD_SHARE", "VARIANTS", "Variant", "variant"]

# Share of the weight on driven axles, for adhesion (engineering assumptions for loaded vehicles).
AXLE_LOAD_SHARE = {"4x2": 0.55, "6x2": 0.42, "6x4": 0.68, "8x4": 0.56, "4x2+trailer": 0.30, "6x2+trailer": 0.28,
                   "6x4+trailer": 0.42}  # fmt: skip

AMT_12 = (14.94, 11.73, 9.04, 7.09, 5.54, 4.35, 3.44, 2.70, 2.08, 1.63, 1.27, 1.00)
FOUR = (4.20, 2.42, 1.53, 1.00)
THREE = (4.10, 1.95, 1.00)
TWO = (2.95, 1.00)
ONE = (1.00,)


@dataclass(frozen=True)
class Variant:
    """One kind of vehicle: what its sheet declares, and (`true_…`, `extra_…`) what only the simulator knows.

    `mass_kg` is the range from empty to full. `usage` chooses the roads: `urban`, `regional`, `long_haul`,
    `construction`, `city_bus`. `model` is the paper's letter of the four models of its tables. Ratios count from the
    first gear.
    `hvac_w_per_k` is the load for each kelvin below 18 °C and above 22 °C.
    """

    id: str
    name: str
    axles: str
    usage: str
    mass_kg: tuple[float, float]
    c_rr: tuple[float, float]  # tabular value and sd
    cda_m2: tuple[float, float]  # tabular value and sd [m²]
    true_c_rr: float
    true_cda_m2: float
    power_kw: float
    torque_nm: float
    max_speed_radps: float
    gear_ratios: tuple[float, ...]
    final_drive: float
    wheel_radius_m: float
    auxiliary_w: float
    extra_auxiliary_w: float
    hvac_w_per_k: tuple[float, float]
    model: str = ""

    @property
    def gears(self) -> int:
        """Number of speeds of the gearbox."""
        return len(self.gear_ratios)

    @property
    def bus(self) -> bool:
        """Whether it carries passengers, who come and go at its stops."""
        return self.usage == "city_bus"

    @property
    def base_speed_radps(self) -> float:
        """Motor speed above which power, below which torque is the limit [rad/s]."""
        return self.power_kw * 1e3 / self.torque_nm

    @property
    def top_speed_mps(self) -> float:
        """Road speed at the motor's highest in the last gear [m/s]."""
        return self.max_speed_radps * self.wheel_radius_m / (self.gear_ratios[-1] * self.final_drive)


def _v(id: str, name: str, axles: str, usage: str, mass: tuple[int, int], tyre: tuple[float, float],
       air: tuple[float, float], motor: tuple[int, int, int], gears: tuple[float, ...], final: float, radius: float,
       loads: tuple[int, int, int, int], model: str = "") -> Variant:  # fmt: skip
    """A row: `tyre` and `air` are (tabular, true), `loads` declared, undeclared [W], below, above [W/K]."""
    declared, extra, below, above = (float(x) for x in loads)
    power, torque, speed = (float(x) for x in motor)
    return Variant(
        id, name, axles, usage, (float(mass[0]), float(mass[1])),
        (tyre[0], round(0.2 * tyre[0], 5)), (air[0], round(0.15 * air[0], 2)), tyre[1], air[1],
        power, torque, speed, gears, final, radius, declared, extra, (below, above), model,
    )  # fmt: skip


# fmt: off
VARIANTS: tuple[Variant, ...] = (
    # --- the four models of the paper's tables ---------------------------------------------------------------------
    _v("A", "tractor 4x2 with semitrailer, 40 t, 12 speeds", "4x2+trailer", "long_haul", (16500, 40000),
       (0.00616, 0.0058), (5.70, 5.5), (400, 2000, 320), AMT_12, 3.60, 0.492, (2500, 1200, 60, 70), "A"),
    _v("B", "rigid 6x2, 26 t, 2 speeds", "6x2", "regional", (13500, 27000),
       (0.00845, 0.0062), (6.40, 5.8), (260, 900, 800), TWO, 10.5, 0.478, (2000, 500, 45, 55), "B"),
    _v("C", "rigid 6x4, 28 t, 4 speeds", "6x4", "construction", (14500, 29000),
       (0.01003, 0.0074), (6.80, 6.3), (330, 1100, 700), FOUR, 7.6, 0.492, (2200, 700, 50, 60), "C"),
    _v("D", "rigid 8x4, 32 t, 3 speeds", "8x4", "regional", (16000, 34000),
       (0.01196, 0.0054), (7.40, 5.4), (350, 1300, 650), THREE, 6.6, 0.492, (2600, 0, 25, 30), "D"),
    # --- rigid trucks ----------------------------------------------------------------------------------------------
    _v("truck_4x2_12t", "rigid 4x2, 12 t, 1 speed", "4x2", "urban", (6500, 12500),
       (0.00448, 0.0072), (3.27, 5.0), (150, 620, 900), ONE, 14.0, 0.40, (900, 1100, 70, 80)),
    _v("truck_4x2_16t", "rigid 4x2, 16 t, 2 speeds", "4x2", "urban", (8000, 17000),
       (0.00448, 0.0070), (3.47, 5.3), (165, 425, 1050), TWO, 12.9, 0.44, (1000, 1400, 75, 85)),
    _v("truck_4x2_18t_box", "rigid 4x2, 18 t, box body, 2 speeds", "4x2", "regional", (9500, 19000),
       (0.00416, 0.0066), (3.76, 5.7), (200, 650, 900), TWO, 11.2, 0.465, (1200, 1500, 75, 80)),
    _v("truck_4x2_18t_reefer", "rigid 4x2, 18 t, refrigerated, 4 speeds", "4x2", "regional", (10500, 19500),
       (0.00416, 0.0066), (3.86, 5.8), (230, 800, 750), FOUR, 8.4, 0.465, (1200, 4200, 70, 180)),
    _v("truck_4x2_19t_12speed", "rigid 4x2, 19 t, drawbar-ready, 12 speeds", "4x2", "regional", (9800, 19500),
       (0.00416, 0.0064), (3.76, 5.6), (300, 1650, 320), AMT_12, 3.40, 0.478, (1400, 1500, 70, 80)),
    _v("truck_6x2_26t_city", "rigid 6x2, 26 t, city distribution, 1 speed", "6x2", "urban", (13000, 27000),
       (0.00437, 0.0068), (3.86, 5.9), (250, 1400, 850), ONE, 15.8, 0.478, (1500, 1700, 75, 85)),
    _v("truck_6x2_27t_refuse", "refuse collector 6x2, 27 t, 2 speeds", "6x2", "urban", (15500, 27500),
       (0.00459, 0.0074), (4.25, 6.4), (260, 900, 800), TWO, 10.5, 0.478, (2000, 5200, 80, 90)),
    _v("truck_6x2_26t_12speed", "rigid 6x2, 26 t, box body, 12 speeds", "6x2", "long_haul", (12500, 27000),
       (0.00394, 0.0061), (3.86, 5.7), (330, 1800, 320), AMT_12, 3.40, 0.492, (1500, 1500, 65, 80)),
    _v("truck_6x4_26t_tipper", "tipper 6x4, 26 t, 12 speeds", "6x4", "construction", (13500, 28000),
       (0.00492, 0.0078), (4.35, 6.5), (330, 2000, 320), AMT_12, 3.80, 0.492, (1500, 2000, 65, 80)),
    _v("truck_6x4_26t_crane", "truck with crane 6x4, 26 t, 2 speeds", "6x4", "construction", (16500, 28000),
       (0.00492, 0.0076), (4.35, 6.5), (300, 1150, 750), TWO, 10.8, 0.492, (1500, 2800, 65, 80)),
    _v("truck_8x4_32t_mixer", "concrete mixer 8x4, 32 t, 3 speeds", "8x4", "construction", (15500, 34000),
       (0.00492, 0.0078), (4.25, 6.4), (350, 1300, 650), THREE, 7.2, 0.492, (1800, 5500, 65, 80)),
    _v("truck_8x4_32t_tipper", "tipper 8x4, 32 t, 12 speeds", "8x4", "construction", (15000, 34000),
       (0.00492, 0.0079), (4.45, 6.7), (400, 2200, 320), AMT_12, 3.80, 0.492, (1800, 2000, 65, 80)),
    _v("truck_8x4_37t", "rigid 8x4, 37 t, hook lift, 4 speeds", "8x4", "regional", (16500, 37500),
       (0.00459, 0.0070), (4.25, 6.4), (400, 1350, 700), FOUR, 7.8, 0.492, (1800, 1800, 60, 75)),
    # --- tractors with trailers ------------------------------------------------------------------------------------
    _v("tractor_4x2_40t_4speed", "tractor 4x2 with semitrailer, 40 t, 4 speeds", "4x2+trailer", "long_haul",
       (17000, 41000), (0.00361, 0.0055), (3.57, 5.3), (400, 1250, 650), FOUR, 7.4, 0.492, (1800, 1600, 60, 75)),
    _v("tractor_4x2_40t_2speed", "tractor 4x2 with semitrailer, 40 t, 2 speeds", "4x2+trailer", "regional",
       (16500, 40500), (0.00372, 0.0057), (3.67, 5.5), (360, 1500, 700), TWO, 11.0, 0.492, (1800, 1600, 60, 75)),
    _v("tractor_4x2_reefer", "tractor 4x2 with refrigerated semitrailer, 40 t, 12 speeds", "4x2+trailer", "long_haul",
       (18500, 40500), (0.00361, 0.0056), (3.76, 5.6), (400, 2000, 320), AMT_12, 3.60, 0.492, (1800, 6500, 60, 260)),
    _v("tractor_6x2_44t", "tractor 6x2 with semitrailer, 44 t, 12 speeds", "6x2+trailer", "long_haul",
       (18500, 44000), (0.00372, 0.0057), (3.67, 5.5), (450, 2200, 320), AMT_12, 3.60, 0.492, (2000, 1700, 60, 75)),
    _v("tractor_6x4_60t", "tractor 6x4 with two trailers, 60 t, 12 speeds", "6x4+trailer", "regional",
       (24000, 60000), (0.00394, 0.0060), (4.55, 6.9), (490, 2600, 320), AMT_12, 4.10, 0.492, (2200, 1800, 60, 75)),
    # --- buses -----------------------------------------------------------------------------------------------------
    _v("bus_10m", "city bus 4x2, 10.5 m, 1 speed", "4x2", "city_bus", (10200, 16500),
       (0.00448, 0.0072), (3.37, 5.0), (160, 1100, 560), ONE, 11.5, 0.44, (1800, 1700, 190, 270)),
    _v("bus_12m_1speed", "city bus 4x2, 12 m, 1 speed", "4x2", "city_bus", (12800, 19500),
       (0.00448, 0.0072), (3.67, 5.3), (200, 1500, 500), ONE, 11.0, 0.478, (2000, 2000, 230, 330)),
    _v("bus_12m_2speed", "city bus 4x2, 12 m, 2 speeds", "4x2", "city_bus", (12500, 19500),
       (0.00448, 0.0070), (3.67, 5.3), (200, 640, 900), TWO, 10.9, 0.478, (2000, 2000, 230, 330)),
    _v("bus_12m_3speed", "suburban bus 4x2, 12 m, 3 speeds", "4x2", "city_bus", (12900, 19500),
       (0.00448, 0.0068), (3.57, 5.2), (220, 800, 750), THREE, 7.4, 0.478, (2000, 2000, 220, 310)),
    _v("bus_18m_1speed", "articulated bus 6x2, 18 m, 1 speed", "6x2", "city_bus", (19000, 29500),
       (0.00459, 0.0074), (3.86, 5.7), (300, 2300, 500), ONE, 11.0, 0.478, (2600, 2600, 300, 430)),
    _v("bus_18m_2speed", "articulated bus 6x4, 18 m, 2 speeds", "6x4", "city_bus", (19500, 30000),
       (0.00459, 0.0073), (3.86, 5.7), (320, 1150, 850), TWO, 10.9, 0.478, (2600, 2600, 300, 430)),
)
# fmt: on


def variant(id: str) -> Variant:
    """The variant of that id. Raises `KeyError`."""
    for v in VARIANTS:
        if v.id == id:
            return v
    raise KeyError(id)


def _sound(v: Variant) -> bool:
    """Whether a row can drive at all: starts loaded on 15 %, and reaches 80 km/h (buses 70)."""
    start = v.torque_nm * v.gear_ratios[0] * v.final_drive / v.wheel_radius_m * 0.9
    return (
        start > 0.15 * GRAVITY_MPS2 * v.mass_kg[1]
        and v.top_speed_mps > (19.4 if v.bus else 22.2)
        and math.isfinite(start)
    )


assert len({v.id for v in VARIANTS}) == len(VARIANTS)
assert all(_sound(v) for v in VARIANTS), [v.id for v in VARIANTS if not _sound(v)]
