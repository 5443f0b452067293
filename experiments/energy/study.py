"""Do the answers about energy hold what they promise? `ledger`, `roadload` and `saved`, each asked as a user would.

**ledger**: causes of planted size in a log of a truck, the sheet knowing which there are: do the causes add up to the
measured energy, and do their 90 % intervals hold the generator's own energy by cause, which shares no code with the
kernel? **coasting**: coast-downs simulated from known A, B and C. **service**: vehicles of the synthetic fleet in
service, the force at steady speeds against the simulated vehicle's. **saved**: 2 % less energy in the warmer and
heavier half of the trips, and the same logs with nothing saved.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

import hdev_jax
from experiments.energy.coasting import CAR, TRUCK, coast_downs
from experiments.energy.tables import tabulate
from experiments.runner.config import Strict
from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED
from hdev_jax.energy.road_load import SHOWN_KMH, STILL
from hdev_jax.fleet import FleetVehicle, SyntheticLog, power_w, simulate, synthetic_log
from hdev_jax.fleet.truth import wheel_force_n
from hdev_jax.physics.road import AirDensity
from hdev_jax.physics.tyres import TyreWarmup
from hdev_jax.rundir import Run
from hdev_jax.segments import WITHIN_ROWS, Segments, trip_slices
from hdev_jax.units import GRAVITY_MPS2
from hdev_jax.verbs.energy.result import EnergyResult

__all__ = ["SOURCES", "Config", "collect", "run", "tasks"]

SOURCES = ("coasting.py",)
Noise = Literal["white", "ar1", "ar1_white", "trip_levels", "student_t", "trip_variance"]

# What the sheet says of each cause, value and sd; what is planted is drawn from it, as c_rr and C_dA are
PRIORS = {
    ("auxiliary_power", "power_w"): (4000.0, 1500.0),
    ("hvac_power", "below_w_per_k"): (350.0, 120.0),
    ("headwind", "scale"): (1.0, 0.3),
    ("rolling_temperature", "per_k"): (-4.2e-5, 1e-5),  # 0.7 % of c_rr for each kelvin (ISO 28580)
    ("cornering", "coefficient"): (0.02, 0.006),
}
ROAD = {"c_rr": (0.0060, 0.0008), "cda_m2": (5.6, 0.5)}  # of the generator's sheet
LIMITS_C = {"heat_c": 14.0, "cool_c": 20.0}  # of heating and cooling, known
BATTERY = ("auxiliary_power", "hvac_power")
SD_OF_DRAWS = 1.5  # draws are cut there, as the generator's own of c_rr and C_dA
COASTING = {"truck": TRUCK, "car": CAR}


class Config(Strict):
    """How many logs of each kind, and how long they are."""

    experiment: Literal["energy.study"]
    artefact: str
    caption: str
    seed: int = Field(0, ge=0)
    noises: list[Noise]
    ledger_logs: int = Field(40, ge=1)  # of each noise
    trips: int = Field(12, ge=3)
    rows_per_trip: int = Field(100, ge=60)
    noise_level: float = 0.04  # of a row, over the RMS of its energy
    coasting_sets: int = Field(200, ge=1)  # of each vehicle
    sets_of_a_task: int = Field(50, ge=1)
    variants: list[str]
    diagnosed: list[str]  # of these, whose log is diagnosed too: the road load by the sheet that it writes
    plain: dict[str, dict[str, bool | float]]  # of a second fleet: what neither the sheet nor `roadload` knows, off
    worlds: int = Field(1, ge=1)
    routes: int = Field(20, ge=4)  # of a vehicle in service
    saved_logs: int = Field(100, ge=1)
    saved_trips: list[int]
    share: float = 0.02  # saved
    covered_percent: tuple[float, float] = (85.0, 95.0)
    coasting_percent: tuple[float, float] = (87.0, 93.0)
    service_percent: float = 3.0  # error of the force in the median, at most
    sum_percent: float = 0.1  # of the measured energy that a ledger's sum may be off


def tasks(config: Config) -> Iterator[dict[str, Any]]:
    """One log, or some coast-downs, each with its own seed."""
    made = {"rows_per_trip": config.rows_per_trip, "noise_level": config.noise_level}
    for n, noise in enumerate(config.noises):
        for k in range(config.ledger_logs):
            seed = 10_000 * (n + 1) + k + config.seed
            yield {"kind": "ledger", "noise": noise, "trips": config.trips, "seed": seed, **made}
    for vehicle in COASTING:
        for k in range(0, config.coasting_sets, config.sets_of_a_task):
            sets = min(config.sets_of_a_task, config.coasting_sets - k)
            yield {"kind": "coasting", "vehicle": vehicle, "sets": sets, "seed": 100_000 + k + config.seed}
    for world in range(config.worlds):
        for variant in config.variants:
            for sheet in ("declared", "plain"):
                yield _drive(config, world, variant, sheet)
    for n, trips in enumerate(config.saved_trips):
        for k in range(config.saved_logs):
            seed = 200_000 + 10_000 * n + k + config.seed
            yield {"kind": "saved", "trips": trips, "share": config.share, "seed": seed, **made}
    for world in range(config.worlds):  # a diagnosis takes longest
        for variant in config.diagnosed:
            yield _drive(config, world, variant, "diagnosed")


def _drive(config: Config, world: int, variant: str, sheet: str) -> dict[str, Any]:
    return {"kind": "service", "variant": variant, "routes": config.routes, "seed": world + 1 + config.seed,
            "sheet": sheet, "fleet": config.plain if sheet == "plain" else {}}  # fmt: skip


def run(task: dict[str, Any]) -> dict[str, Any]:
    """What one command said, beside the truth."""
    kinds = {"ledger": _ledger, "coasting": _coasting, "service": _service, "saved": _saved}
    return kinds[task["kind"]](task)


def _planted(task: dict[str, Any]) -> tuple[SyntheticLog, dict[str, Any]]:
    """A log with a size of each cause from the sheet's own distribution, and the sheet as `synthetic_log` has it,
    with an entry for each cause."""
    rng = np.random.default_rng([task["seed"], 3])
    sizes = {k: m + sd * float(np.clip(rng.standard_normal(), -SD_OF_DRAWS, SD_OF_DRAWS))
             for k, (m, sd) in PRIORS.items()}  # fmt: skip
    effects: dict[str, dict[str, float]] = {}
    for (effect, name), x in sizes.items():
        effects.setdefault(effect, {})[name] = x
    effects["hvac_power"] |= {**LIMITS_C, "above_w_per_k": 0.0}
    log = synthetic_log(
        seed=task["seed"], trips=task["trips"], rows_per_trip=task["rows_per_trip"], effects=effects,
        noise=task.get("noise", "ar1"), noise_level=task["noise_level"],
    )  # fmt: skip
    declared = {e: {n: (m, sd) for (k, n), (m, sd) in PRIORS.items() if k == e} for e, _ in PRIORS}
    sheet = {
        "name": "truck (synthetic)", "mass_kg": 29e3, "road": ROAD, "driveline": {"efficiency": log.vehicle.efficiency},
        "battery": {"auxiliary_w": PRIORS["auxiliary_power", "power_w"]},
        "effects": {e: p for e, p in declared.items() if e != "auxiliary_power"},
    }  # fmt: skip
    sheet["effects"]["hvac_power"] |= {**LIMITS_C, "above_w_per_k": 0.0}
    return log, sheet


def _kwh_by_cause(log: SyntheticLog) -> dict[str, float]:
    """The generator's own energy by cause: forces at the wheel, the driveline's loss for all of them, loads [kWh]."""
    truth, drive, fx = log.vehicle, log.drive, dict(log.vehicle.effects)
    road = {k: p for k, p in fx.items() if k not in BATTERY}
    metres, hours = (np.asarray(drive.columns[k]) for k in ("distance_m", "duration_s"))
    hours = hours / 3600.0

    def wheel(effects: dict[str, Any], **other: float) -> float:
        force = wheel_force_n(drive, replace(truth, **other), effects)
        return float(np.sum(force * metres)) / 3.6e6

    def battery(effects: dict[str, Any]) -> float:
        return float(np.sum(power_w(drive, truth, "road", effects) * hours)) / 1e3

    bare = wheel({})
    found = {"rolling": bare - wheel({}, c_rr=0.0), "aero": bare - wheel({}, cda_m2=0.0)}
    found |= {k: wheel({k: p}) - bare for k, p in road.items()}
    found["driveline"] = battery(road) - wheel(road)
    for k in BATTERY:
        found["auxiliary" if k == "auxiliary_power" else k] = battery({k: fx[k]}) - battery({})
    return found


def _ledger(task: dict[str, Any]) -> dict[str, Any]:
    """By cause (kWh, lower, upper, true); the largest difference of a block's sum to its measured energy [%]."""
    log, sheet = _planted(task)
    rows = hdev_jax.ledger(log.frame, sheet).tables["ledger"].to_dict("records")
    whole = {r["cause"]: r for r in rows if r["level"] == "all"}
    causes = {c: [*(float(whole[c][k]) for k in ("kwh", "lower", "upper")), true]
              for c, true in _kwh_by_cause(log).items()}  # fmt: skip
    kwh = log.frame["energy_wh"].to_numpy(float) / 1e3  # what was measured, from the log itself
    trip = log.frame["trip_id"].to_numpy(str)
    measured = {"all": float(kwh.sum()), **{t: float(kwh[trip == t].sum()) for t in np.unique(trip)}}
    sums = dict.fromkeys(measured, 0.0)
    for r in rows:
        if r["cause"] != TOTAL:
            sums[r["name"]] += float(r["kwh"])
    off = max(100.0 * abs(sums[k] / x - 1.0) for k, x in measured.items())
    left = whole[UNEXPLAINED]
    return {"causes": causes, "off_percent": off, "unexplained": [float(left[k]) for k in ("lower", "upper")],
            "unexplained_percent": float(left["share_percent"])}  # fmt: skip


def _coasting(task: dict[str, Any]) -> dict[str, Any]:
    """Of each set: by speed (force, lower, upper, true) [N]."""
    v = COASTING[task["vehicle"]]
    sheet = {"name": "synthetic", "mass_kg": v.mass_kg, "road": {"rotating_mass_factor": v.rotating}}
    out = []
    for frame in coast_downs(v, seed=task["seed"], sets=task["sets"]):
        rows = _shown(hdev_jax.roadload(frame, sheet))
        out.append([[*_force(row), v.force(kmh)] for kmh, row in zip(SHOWN_KMH, rows, strict=True)])
    return {"sets": out}


def _shown(load: EnergyResult) -> list[dict[str, Any]]:
    """The rows of the force at the speeds that are shown."""
    rows = {r["speed_kmh"]: r for r in load.tables["force"].to_dict("records")}
    return [rows[kmh] for kmh in SHOWN_KMH]


def _force(row: dict[str, Any]) -> list[float]:
    return [float(row[k]) for k in ("force_n", "lower", "upper")]


def _service(task: dict[str, Any]) -> dict[str, Any]:
    """By speed (force, lower, upper, true) [N], and whether the speed was driven."""
    made = {"seed": task["seed"], "routes": task["routes"], "variants": [task["variant"]], **task["fleet"]}
    fleet = simulate(made)
    v, cold = fleet.vehicles[0], True
    with tempfile.TemporaryDirectory() as folder:
        sheet = fleet.write_sheets(folder)[v.id]
        if task["sheet"] == "diagnosed":
            found = hdev_jax.diagnose(v.frame, sheet)
            sheet = Path(folder) / "diagnosed.toml"  # beside the sheet's efficiency map
            sheet.write_text(found.sheet)
            cold = TyreWarmup.id not in set(found.effects["effect"])
        load = hdev_jax.roadload(v.frame, sheet)
    rows = _shown(load)
    true = _true_force(v, float(load.summary["mass_kg"]), cold=cold)
    return {"force": [[*_force(row), x] for row, x in zip(rows, true, strict=True)],
            "driven": [bool(row["driven"]) for row in rows]}  # fmt: skip


def _true_force(v: FleetVehicle, mass_kg: float, *, cold: bool) -> list[float]:
    """The simulated vehicle's force at steady speed on a smooth, flat, dry road in still air at 20 °C [N].

    **Arguments:** `cold`: with what its tyres resist more while they warm up, in the mean over the way, as `roadload`
    has it where the sheet does not know of it.
    """
    passing = [e.id for e in v.true.effects
               if e.id == AirDensity.id or e.acts_across_rows() or e.overrides("sense")]  # fmt: skip
    speed, s = np.array(SHOWN_KMH) / 3.6, v.segments
    channels = {k: STILL.get(k, float(np.median(np.asarray(x)))) for k, x in s.without(*WITHIN_ROWS).channels.items()}
    channels |= {"mass_kg": mass_kg, "gear": float(len(v.variant.gear_ratios))}
    rows = Segments.from_arrays(duration_s=np.ones(len(speed)), speed_start_mps=speed, speed_end_mps=speed, **channels)
    force = np.asarray(v.true.minus(*passing).force(rows))
    if cold and TyreWarmup.id in v.effects:
        p, way = v.effects[TyreWarmup.id], np.asarray(s.distance_m)
        since = np.concatenate([np.cumsum(way[r]) - 0.5 * way[r] for _, r in trip_slices(np.asarray(s.trip))])
        share = p["excess"] * float(np.average(np.exp(-since / p["distance_m"]), weights=way))
        force = force + share * v.variant.true_c_rr * mass_kg * GRAVITY_MPS2
    return force.tolist()


def _saved(task: dict[str, Any]) -> dict[str, Any]:
    """By what was planted (nothing, the share): the share found with its interval; by how much the halves differ.

    After the change are the trips of the half that is warmer and heavier, in standard deviations of the trips.
    """
    log, sheet = _planted(task)
    frame = log.frame
    trips, place = np.unique(frame["trip_id"].to_numpy(str), return_inverse=True)
    warm, mass = (_means(frame[k], place) for k in ("ambient_temp_c", "mass_kg"))
    order = np.argsort(sum((x - x.mean()) / x.std() for x in (warm, mass)))
    before, after = order[: len(order) // 2], order[len(order) // 2 :]
    later = np.isin(place, after)
    out: dict[str, Any] = {
        "warmer_k": float(warm[after].mean() - warm[before].mean()),
        "heavier_t": float(mass[after].mean() - mass[before].mean()) / 1e3,
    }
    for name, share in (("nothing", 0.0), ("planted", task["share"])):
        less = np.where(later, share * log.truth["noise_free"].to_numpy(float), 0.0)
        after_it = frame.assign(energy_wh=frame["energy_wh"].to_numpy(float) - less)
        found = hdev_jax.saved(after_it, sheet, ",".join(trips[before]), ",".join(trips[after])).summary
        out[name] = [found[k] for k in ("share", "lower", "upper")]
    return out


def _means(column: Any, group: np.ndarray) -> np.ndarray:
    return np.bincount(group, weights=np.asarray(column, float)) / np.bincount(group)


def collect(config: Config, results: Sequence[tuple[dict[str, Any], dict[str, Any]]], run: Run) -> dict[str, Any]:
    """Tables and a figure; what is missed."""
    found, missed, lines = tabulate(results, run, config)
    rows = [{"name": x["name"], "paper": None, "ours": x} for x in lines]
    return {"artefact": config.artefact, "data": "synthetic logs, coast-downs and fleet", "synthetic": True,
            "rows": rows, "better_than_paper": 0, "of": 0, "missed": missed, "findings": found}  # fmt: skip
