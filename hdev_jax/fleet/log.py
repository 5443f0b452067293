"""Synthetic logs with known truth: a seeded fleet of one heavy truck, what it measured, and what it hides.

Every log is labelled synthetic: in its sheet's name, its vehicle's name and `frame.attrs`. Randomness is split by
purpose (route, weather, vehicle, cycles, noise), so that the same seed drives the same roads whatever is planted.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from hdev_jax.fleet.driving import (
    FINAL_DRIVE,
    GEAR_RATIOS,
    WHEEL_RADIUS_M,
    Drive,
    drive_trips,
    hold,
    smooth_noise,
    standard_density_kgpm3,
)
from hdev_jax.fleet.noise import NOISES, noise_of_one, root_mean_square
from hdev_jax.fleet.plants import PLANTABLE
from hdev_jax.fleet.truth import Truth, power_w, shaft_channels

__all__ = ["ENTRIES", "NOISES", "SyntheticLog", "demo_log", "size_effect", "synthetic_log"]

ENTRIES = ("road", "shaft", "wheel")
_SD = {"c_rr": 0.0008, "cda_m2": 0.5, "motoring_efficiency": 0.05, "regenerating_efficiency": 0.05}  # contract, 2
_NUISANCE = ("humidity_pct", "cloud_cover", "gps_hdop", "tyre_pressure_kpa_display")
_VEHICLE = "synthetic-truck-34t"


@dataclass(frozen=True)
class SyntheticLog:
    """A log as a customer would send it, and what only the generator knows.

    `frame` has contract column names. `truth` has a row for each of its rows, in the target's unit: `noise_free`,
    `baseline` (nothing planted), `noise`, and `effect:<id>`, each effect's own difference to the baseline. `ratio` is
    the RMS of what is planted, after projecting off the baseline's Jacobian, over `noise_rms`.
    """

    frame: pd.DataFrame
    truth: pd.DataFrame
    sheet: str
    vehicle: Truth
    target: str
    noise_rms: float
    ratio: float
    drive: Drive
    entry: str

    def write(self, folder: str | Path, stem: str = "synthetic_truck", *, truth: bool = True) -> dict[str, Path]:
        """Write `<stem>.csv`, `<stem>.toml` and, in a folder of its own, the truth. **Returns** paths by name."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = {"log": folder / f"{stem}.csv", "sheet": folder / f"{stem}.toml"}
        self.frame.to_csv(paths["log"], index=False, float_format="%.7g", lineterminator="\n")
        paths["sheet"].write_text(self.sheet, encoding="utf-8")
        if truth:
            paths["truth"] = folder / "truth" / f"{stem}_truth.csv"
            paths["truth"].parent.mkdir(exist_ok=True)
            self.truth.to_csv(paths["truth"], index=False, float_format="%.9g", lineterminator="\n")
        return paths


def _target(drive: Drive, truth: Truth, entry: str, effects: Mapping | None = None) -> np.ndarray:
    """The noise-free target: energy [Wh] of segments, power [kW] of samples."""
    power = power_w(drive, truth, entry, effects)
    return power * drive.columns["duration_s"] / 3600 if drive.mode == "segments" else power / 1e3


def _jacobian(drive: Drive, truth: Truth, entry: str) -> np.ndarray:
    """Columns of the coefficients that the sheet leaves open, by central differences of the baseline, scaled to 1."""
    names = ("c_rr", "cda_m2") if entry == "road" else ("motoring_efficiency", "regenerating_efficiency")
    columns = []
    for name in names:
        value = getattr(truth, name)
        up, down = (_target(drive, replace(truth, **{name: value * f}), entry, {}) for f in (1.0001, 0.9999))
        size = root_mean_square(up - down)  # 0 where no row regenerates
        columns.append((up - down) / size if size > 0 else up - down)
    return np.stack(columns, axis=1)


def _beyond(jacobian: np.ndarray, column: np.ndarray) -> np.ndarray:
    """What is left of a column after projecting off the Jacobian."""
    return column - jacobian @ np.linalg.lstsq(jacobian, column, rcond=None)[0]


def _scaled(truth: Truth, effect: str, parameters: Mapping[str, float], factor: float, entry: str) -> dict[str, float]:
    """The effect's parameters with its size at `factor` times its distance from the null."""
    plant, scaled = PLANTABLE[effect], dict(parameters)
    for name in plant.size:
        if name not in scaled:
            continue
        if np.isinf(plant.null):
            scaled[name] = scaled[name] / factor
        elif effect == "mode_change":  # a second value; its null is the first one
            first = getattr(truth, "efficiency" if entry == "road" and name.endswith("efficiency") else name)
            scaled[name] = first + factor * (scaled[name] - first)
        else:
            scaled[name] = scaled[name] * factor
    return scaled


_NOTHING = "{} changes nothing in this log: other parameters, or more rows"


def size_effect(
    drive: Drive, truth: Truth, effect: str, parameters: Mapping[str, float], *, rms: float, entry: str = "road"
) -> dict[str, float]:
    """Parameters at which the effect's column, after projecting off the baseline's Jacobian, has this RMS.

    **Arguments:** `rms` in the target's unit; `parameters` give the direction (signs, time constants) of the search.
    **Raises:** `ValueError` where no size within a factor of 300 reaches it, or the energy jumps over it
    (`regen_cutoff`): the noise is matched to the effect instead.
    """
    jacobian, base = _jacobian(drive, truth, entry), _target(drive, truth, entry, {})

    def reached(log_factor: float) -> float:
        fx = {effect: _scaled(truth, effect, parameters, float(np.exp(log_factor)), entry)}
        return root_mean_square(_beyond(jacobian, _target(drive, truth, entry, fx) - base))

    low, high = -np.log(300.0), np.log(300.0)
    grid = np.linspace(low, high, 60)
    values = np.array([reached(x) for x in grid])
    above = np.flatnonzero(values >= rms)
    if not len(above) or above[0] == 0:
        raise ValueError(
            f"{effect}: RMS {rms:.4g} beyond the baseline is out of reach ({values.min():.4g} to {values.max():.4g}); "
            "choose other starting parameters"
        )
    low, high = grid[above[0] - 1], grid[above[0]]
    for _ in range(45):
        mid = 0.5 * (low + high)
        low, high = (mid, high) if reached(mid) < rms else (low, mid)
    if abs(reached(high) / rms - 1) > 1e-6:
        raise ValueError(f"{effect}: its energy jumps over RMS {rms:.4g}")
    return _scaled(truth, effect, parameters, float(np.exp(high)), entry)


def _matched(
    drive: Drive, truth: Truth, wanted: Mapping[str, Mapping[str, float]], ratio: float, rms: float, entry: str
) -> tuple[dict[str, Mapping[str, float]], float]:
    """Effects and the noise's RMS such that each effect has `ratio` times it: see `synthetic_log`."""
    jacobian, base = _jacobian(drive, truth, entry), _target(drive, truth, entry, {})
    kept = {
        k: root_mean_square(_beyond(jacobian, _target(drive, truth, entry, {k: p}) - base))
        for k, p in wanted.items()
        if PLANTABLE[k].match == "noise"
    }
    if nothing := [k for k, size in kept.items() if not size > 0]:
        raise ValueError(_NOTHING.format(", ".join(nothing)))
    rms = min(kept.values()) / ratio if kept else rms
    sized: dict[str, Mapping[str, float]] = {}
    for k, p in wanted.items():
        try:
            alone = k in kept and kept[k] <= ratio * rms * (1 + 1e-9)
            sized[k] = p if alone else size_effect(drive, truth, k, p, rms=ratio * rms, entry=entry)
        except ValueError:
            if k not in kept:
                raise
            sized[k] = p
    return sized, rms


def _instruments(drive: Drive, truth: Truth, rng: np.random.Generator) -> None:
    """Add channels that follow from driving with nothing planted: shaft and wheel, brake, battery."""
    c = drive.columns
    c |= shaft_channels(drive, truth)
    retard = np.maximum(-c["traction_force_n"] / c["mass_kg"] - 0.25, 0.0) * (c["distance_m"] > 0)
    c["brake_pressure_pa"] = np.where(c["distance_m"] > 0, 2.0e5 * retard, 1.5e5)  # held at standstill
    power = power_w(drive, truth, "road", {})
    soc, open_v, warm = np.zeros_like(power), np.zeros_like(power), np.zeros_like(power)
    for i in range(int(c["trip"][-1]) + 1):
        rows = c["trip"] == i
        used = np.cumsum(power[rows] * c["duration_s"][rows]) / 3600
        soc[rows] = np.clip(rng.uniform(0.55, 0.95) - used / 450e3, 0.02, 1.0)  # 450 kWh
        slow = 1 - np.exp(-c["time_s"][rows] / 2500)
        warm[rows] = c["ambient_temp_c"][rows] * 0.5 + 10 + (6 + rng.uniform(0, 4)) * slow
        warm[rows] += 0.2 * smooth_noise(rng, int(rows.sum()), 20.0)
    open_v = 600 + 90 * soc
    c["soc"], c["battery_temp_c"] = soc, warm
    c["voltage_v"] = open_v - 0.03 * power / open_v  # the pack's own sag, already in what is measured


_CHANNELS = (
    "mass_kg", "grade_rad", "altitude_m", "ambient_temp_c", "wind_speed_mps", "wind_from_rad",
    "heading_rad", "curvature_1pm", "wet_road", "gear", "brake_pressure_pa", "soc", "voltage_v", "battery_temp_c",
    "door_open", "standstill_flag", *_NUISANCE,
)  # fmt: skip
_KINEMATICS = {
    "segments": ("time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps"),
    "samples": ("time_s", "speed_mps"),
}
_SHAFT = {"road": (), "shaft": ("motor_torque_nm", "motor_speed_radps"), "wheel": ("traction_force_n",)}


def _sheet(entry: str, sd: Mapping[str, float]) -> str:
    """The vehicle sheet that goes with the log: the tabular values, nothing of what is planted."""
    head = 'name = "articulated truck, 34 t (synthetic)"\nmass_kg = 29000.0\n'
    if entry != "road":
        return head + (
            f"[machine]\nmotoring_efficiency     = {{ value = 0.93, sd = {sd['motoring_efficiency']:g} }}\n"
            f"regenerating_efficiency = {{ value = 0.93, sd = {sd['regenerating_efficiency']:g} }}\n"
            "[battery]\nauxiliary_w = 0.0\n"
        )
    return head + (
        f"[road]\nc_rr   = {{ value = 0.0060, sd = {sd['c_rr']:g} }}\n"
        f"cda_m2 = {{ value = 5.6, sd = {sd['cda_m2']:g} }}\n"
        f"[driveline]\nefficiency = 0.91\ngear_ratios = {list(GEAR_RATIOS)}\nfinal_drive = {FINAL_DRIVE}\n"
        f"wheel_radius_m = {WHEEL_RADIUS_M}\n[battery]\nauxiliary_w = 0.0\n"
    )


def _check(entry: str, mode: str, noise: str, trips: int, rows: int, effects: Mapping) -> None:
    for name, value, allowed in (
        ("entry", entry, ENTRIES),
        ("mode", mode, tuple(_KINEMATICS)),
        ("noise", noise, NOISES),
    ):
        if value not in allowed:
            raise ValueError(f"{name}: expected one of {', '.join(allowed)}; got {value!r}")
    if trips < 1 or rows < 60:
        raise ValueError(f"expected at least 1 trip of 60 rows; got {trips} of {rows}")
    for effect, parameters in effects.items():
        if effect not in PLANTABLE:
            raise ValueError(f"{effect!r} cannot be planted; known: {', '.join(PLANTABLE)}")
        plant = PLANTABLE[effect]
        if entry not in plant.entries + plant.absorbed or mode not in plant.modes:
            raise ValueError(f"{effect} needs entry {'|'.join(plant.entries)} and mode {'|'.join(plant.modes)}")
        known = {*plant.parameters, *plant.size}
        if unknown := set(parameters) - known:
            raise ValueError(f"{effect}: unknown {', '.join(sorted(unknown))}; known: {', '.join(sorted(known))}")


def synthetic_log(
    *,
    seed: int,
    trips: int = 24,
    rows_per_trip: int | None = None,
    effects: Mapping[str, Mapping[str, float | int]] | None = None,
    ratio: float | int | None = None,
    noise: str = "ar1",
    noise_level: float | int = 0.04,
    noise_rms: float | int | None = None,
    ar_coefficient: float | int = 0.9,
    entry: str = "road",
    mode: str = "segments",
    sample_s: float | int = 1.0,
    held: Collection[str] = (),
    table_sd: Mapping[str, float] | None = None,
) -> SyntheticLog:
    """A synthetic log of one truck.

    **Arguments:**

    - `trips`, `rows_per_trip`: trips vary in length by ±30 %; the log has trips·rows_per_trip rows exactly (250 of
      segments, 1200 of samples by default).
    - `effects`: id → parameters. `{}` plants the default size; time constants and the like left out have defaults
      (a step comes after 42 % of the trips).
    - `ratio`: RMS of each planted effect, after projecting off the baseline's Jacobian, over that of the noise. What
      `PLANTABLE[id].match` says gives way: the effect, or the noise, to the weakest of the effects that it is matched
      to; stronger ones are made as weak, or stay as they are where their energy jumps.
    - `noise`, `ar_coefficient`: colour (`NOISES`), and lag-1 correlation from row to row. `noise_level` is relative to
      the RMS of the baseline's target; `noise_rms` is absolute (Wh a row, or kW) and wins.
    - `entry`: road (slope and speed), shaft (torque and motor speed measured) or wheel (traction force measured).
    - `mode`: segments (target `energy_wh`) or samples every `sample_s` (target `battery_power_kw`).
    - `held`: channels of the weather that stay at the trip's mean, in the log and in what happened.
    - `table_sd`: how well the sheet says that it knows a coefficient, which is drawn about its value as loosely;
      0.0008 for `c_rr`, 0.5 m² for `cda_m2` and 0.05 for the efficiencies otherwise.

    **Raises:** `ValueError` for what cannot be planted or sized.
    """
    wanted = {k: {n: float(x) for n, x in v.items()} for k, v in (effects or {}).items()}
    rows_per_trip = rows_per_trip or (250 if mode == "segments" else 1200)
    _check(entry, mode, noise, trips, rows_per_trip, wanted)
    if unknown := set(table_sd or {}) - set(_SD):
        raise ValueError(f"table_sd: unknown {', '.join(sorted(unknown))}; known: {', '.join(_SD)}")
    table_sd = {**_SD, **(table_sd or {})}
    for effect, parameters in wanted.items():  # no size given: the default one; time constants and the like always
        plant = PLANTABLE[effect]
        sized = any(name in parameters for name in plant.size)
        defaults = {k: plant.null if sized and k in plant.size else v for k, v in plant.parameters.items()}
        if effect == "mode_change" and sized:  # a second value has no null of its own
            defaults = {"share": defaults["share"]}
        if effect == "step_change":
            defaults["trip"] = float(int(0.42 * trips))
        wanted[effect] = {**defaults, **parameters}
    route, weather, vehicle, cycles, noises = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5))

    lengths = np.floor(rows_per_trip * route.uniform(0.7, 1.3, trips)).astype(int)
    lengths += np.diff(np.linspace(0, trips * rows_per_trip - lengths.sum(), trips + 1).round()).astype(int)
    drive = drive_trips(route, weather, rows=lengths, mode=mode, sample_s=float(sample_s))
    c = drive.columns  # without a barometer in the log, a day's pressure would be noise that no row shows
    c["air_density_kgpm3"] = standard_density_kgpm3(c["altitude_m"], c["ambient_temp_c"])
    hold(drive, held)
    draws = {k: getattr(Truth(), k) + sd * np.clip(vehicle.normal(), -1.5, 1.5) for k, sd in table_sd.items()}
    draws = {k: float(min(v, 0.97) if k.endswith("efficiency") else v) for k, v in draws.items()}
    truth = replace(Truth(), **draws, phase=tuple(cycles.random(trips).tolist()), lottery=_lottery(cycles, trips))
    _instruments(drive, truth, vehicle)

    baseline = _target(drive, truth, entry, {})
    rms = noise_rms if noise_rms is not None else noise_level * root_mean_square(baseline)
    if wanted and ratio is not None:
        wanted, rms = _matched(drive, truth, wanted, ratio, rms, entry)
    truth = replace(truth, effects=wanted)
    clean = _target(drive, truth, entry)
    beyond = root_mean_square(_beyond(_jacobian(drive, truth, entry), clean - baseline))
    if wanted and not beyond > 0:
        raise ValueError(_NOTHING.format(", ".join(wanted)))
    error = rms * noise_of_one(noises, lengths, noise, ar_coefficient)

    target = "energy_wh" if mode == "segments" else "battery_power_kw"
    c = drive.columns
    trip = np.array([f"T{i + 1:02d}" for i in range(trips)])[c["trip"]]
    names = (*_KINEMATICS[mode], *_CHANNELS, *_SHAFT[entry])
    frame = pd.DataFrame({"vehicle_id": _VEHICLE, "trip_id": trip, **{k: c[k] for k in names}, target: clean + error})
    frame.attrs = {"synthetic": True, "seed": seed, "target": target}
    hidden = {"trip_id": trip, "time_s": c["time_s"], "noise_free": clean, "baseline": baseline, "noise": error}
    hidden |= {f"effect:{k}": _target(drive, truth, entry, {k: p}) - baseline for k, p in wanted.items()}
    ratio = beyond / rms if rms else np.inf
    sheet = _sheet(entry, table_sd)
    return SyntheticLog(frame, pd.DataFrame(hidden), sheet, truth, target, rms, ratio, drive, entry)


def _lottery(rng: np.random.Generator, trips: int) -> tuple[float, ...]:
    """An even spread of (0, 1) over the trips in random order: a share of trips is that share, not a draw of it."""
    return tuple(rng.permutation((np.arange(trips) + 0.5) / trips).tolist())


def demo_log(seed: int = 7, *, trips: int = 14) -> SyntheticLog:
    """The demo's log: a 34 t truck in real wind, with measured wind channels and a sheet that does not declare it."""
    return synthetic_log(seed=seed, trips=trips, effects={"headwind": {"scale": 0.98}}, noise_level=0.02)
