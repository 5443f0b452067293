"""The verb `init`: a vehicle's sheet, begun with what the log itself shows; or an adapter, where it cannot be read."""

import json
import shlex
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hdev_jax.errors import InputError, MissingColumnError
from hdev_jax.inference.sheet import Sheet, choose_entry
from hdev_jax.logs import Log, read_log, write_adapter_skeleton
from hdev_jax.logs.readers.names import stem
from hdev_jax.physics.driveline import WHEEL_RADIUS_M
from hdev_jax.physics.loads import STANDSTILL_MPS
from hdev_jax.problem import prepare

__all__ = ["init"]

CAR_KG = 4500.0  # lighter than the lightest truck, heavier than a van
DRIVES_MPS = 1.5  # faster, the ratio of motor speed to speed is no noise
ENOUGH = 10  # rows of a gear, or at standstill, for a median
ONE_RATIO = 1.05  # 90th over 10th percentile of a ratio that is one number


def init(logs: str | Path | Sequence[str | Path], adapter: str | Path | None = None, out: str | Path = Path()) -> str:
    """Write NAME.sheet.toml into the folder `out`; or, where columns have other names, NAME.adapter.toml to fill in.

    What the log itself shows is filled in or left out, with a comment. All other coefficients get values typical of
    such vehicles, each with a standard deviation. **Returns:** what was written, and what comes next. **Raises:**
    `InputError`, also where the file exists already.
    """
    paths = [logs] if isinstance(logs, str | Path) else list(logs) if isinstance(logs, list | tuple) else []
    if not paths or not all(isinstance(p, str | Path) for p in paths):
        raise InputError("logs: the paths of one or several files are expected")
    first = Path(paths[0])
    name = stem(first.resolve().name)
    given = shlex.join(map(str, paths))
    try:
        log = read_log(list(paths), adapter)
    except MissingColumnError as e:
        if adapter is not None:
            raise
        if first.is_dir():
            first = next(p for p in sorted(first.iterdir()) if p.is_file())
        file = _write(Path(out) / f"{name}.adapter.toml", write_adapter_skeleton(first))
        again = f"  hdev init {given} --adapter {shlex.quote(str(file))}"
        return f"the log cannot be read as it is: {e}\n{file}: fill in which column is what, then\n{again}"
    text = sheet_text(log, name)
    prepare(log, Sheet(**tomllib.loads(text)), need_measured=bool(log.targets))
    file = _write(Path(out) / f"{name}.sheet.toml", text)
    options = "" if adapter is None else f" --adapter {shlex.quote(str(adapter))}"
    where = f"--vehicle {shlex.quote(str(file))}{options} --out {shlex.quote(f'{name}_result')}"
    return f"{file}: look at its values, replace what you know better, then\n  hdev diagnose {given} {where}"


def _write(path: Path, text: str) -> Path:
    if path.exists():
        raise InputError(f"{path} is there already; rename or delete it, or give another folder by --out")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror or e}); give another folder by --out") from e
    return path


def sheet_text(log: Log, name: str) -> str:
    """The sheet as TOML, with comments that say what of it the log shows."""
    s, gears = log.segments, _gears(log)
    ratios = tomllib.loads("\n".join(["[driveline]", *gears]))
    target: Any = log.default_target if log.targets else None
    entry = choose_entry(s, target, Sheet(**ratios)) if target else "road"
    mass = np.asarray(s.channels["mass_kg"]) if s.has("mass_kg") else None
    heavy = mass is None or float(np.median(mass)) > CAR_KG
    lines = [
        "# A value with an sd is estimated from the log, with that value and sd as its prior; a bare number is kept.",
        f"name = {json.dumps(name, ensure_ascii=False)}",
    ]
    if mass is not None:
        lines += [f"# mass_kg is not needed: the log has its own, {mass.min():,.0f} to {mass.max():,.0f} kg"]
    elif entry == "road":
        lines += ["mass_kg = { value = 18000.0, sd = 4000.0 }  # total mass; the log has none: weigh it if you can"]
    if entry == "road":
        lines += ["", *_road(log, heavy), "[driveline]"]
        lines += ["efficiency = { value = 0.88, sd = 0.03 }  # wheel to battery: gearbox, motor and inverter"]
    else:
        what = {"shaft": "motor torque", "wheel": "traction force"}[entry]
        lines += [
            "",
            f"[machine]  # the log measures {what}: the road's part of the model is not needed",
            "motoring_efficiency = { value = 0.90, sd = 0.05 }",
            "regenerating_efficiency = { value = 0.88, sd = 0.05 }",
            "",
            "[driveline]",
        ]
    return "\n".join([*lines, *gears, "", "[battery]", *_standstill(log), *_voltage(log)]) + "\n"


def _road(log: Log, heavy: bool) -> list[str]:
    rolling = (
        (0.0065, 0.0015, "tyres of trucks and buses: 0.004 to 0.009") if heavy else (0.010, 0.002, "tyres of cars")
    )
    drag = (5.5, 1.5, "truck 4.5 to 7, bus 4 to 6") if heavy else (0.7, 0.15, "car 0.5 to 0.9")
    level = "" if log.segments.has("grade_rad") else "  # the log has no slope: a flat road is assumed"
    return [
        f"[road]{level}",
        f"c_rr = {{ value = {rolling[0]}, sd = {rolling[1]} }}  # rolling resistance; {rolling[2]}",
        f"cda_m2 = {{ value = {drag[0]}, sd = {drag[1]} }}  # drag coefficient times frontal area [m²]; {drag[2]}",
        f"rotating_mass_factor = {1.03 if heavy else 1.04}  # inertia of wheels and motor, over the mass",
        "",
    ]


def _gears(log: Log) -> list[str]:
    """Ratios, where motor speed shows them in every gear: rad of the motor for each metre."""
    s, v = log.segments, np.asarray(log.segments.speed_mps)
    if not s.has("motor_speed_radps"):
        return ["# gear_ratios = [9.16, 5.27], final_drive = 4.5, wheel_radius_m = 0.5  # for losses by gear"]
    drives = v > DRIVES_MPS
    ratio = np.asarray(s.channels["motor_speed_radps"])[drives] / v[drives]
    gear = np.asarray(s.channels["gear"]) if s.has("gear") else np.ones(len(v))
    forward = sorted({int(g) for g in gear[np.isfinite(gear)] if g >= 1})
    by_gear = [ratio[gear[drives] == g] for g in forward]
    one = all(len(x) > ENOUGH and 0 < np.quantile(x, 0.9) < ONE_RATIO * np.quantile(x, 0.1) for x in by_gear)
    if not by_gear or not one or forward != list(range(1, len(forward) + 1)):
        return ["# the log's motor speed does not show the ratio of each gear: gear_ratios = […], wheel_radius_m = …"]
    radius = round(WHEEL_RADIUS_M, 3)
    each = ", ".join(f"{float(np.median(x)) * radius:.4g}" for x in by_gear)
    return [
        f"gear_ratios = [{each}]  # with the wheel radius, as the log shows",
        f"wheel_radius_m = {radius}  # assumed: only gear_ratios / wheel_radius_m matters",
    ]


def _standstill(log: Log) -> list[str]:
    """The auxiliaries: what the vehicle draws while it stands and does not charge."""
    usual = ["auxiliary_w = { value = 2000.0, sd = 1500.0 }  # consumers that are always on"]
    if "battery_power_kw" not in log.targets:
        return usual
    watts = 1e3 * log.target("battery_power_kw")[np.asarray(log.segments.speed_mps) < STANDSTILL_MPS]
    watts = watts[watts > 0]
    if len(watts) <= ENOUGH:
        return usual
    low, middle, high = (float(x) for x in np.quantile(watts, (0.1, 0.5, 0.9)))
    return [
        f"# at standstill the log shows {middle / 1e3:.1f} kW median, {low / 1e3:.1f} to {high / 1e3:.1f} in 80 %",
        f"auxiliary_w = {{ value = {round(middle, -1)}, sd = {max(round(0.5 * (high - low), -1), 200.0)} }}",
    ]


def _voltage(log: Log) -> list[str]:
    if log.segments.has("voltage_v"):
        return []
    return ["# nominal_voltage_v = …  # the log has no voltage: with this, losses by current can be found"]
