"""The verb `init`: a vehicle's sheet and an adapter, begun with what the log itself shows."""

from pathlib import Path

import numpy as np

from hdev_jax.errors import InputError
from hdev_jax.logs import Log, write_adapter_skeleton
from hdev_jax.logs.names import stem
from hdev_jax.verbs.opening import Logs, log_of

__all__ = ["init"]

CAR_KG = 4500.0  # lighter than the lightest truck, heavier than a van
STANDS_MPS, DRIVES_MPS = 0.1, 1.5
ENOUGH = 10  # rows in a gear


def init(logs: Logs, adapter: str | Path | None = None, out: str | Path = Path()) -> str:
    """Write a sheet of the vehicle, and an adapter where the log's columns have other names, into the folder `out`.

    What the log tells is filled in or left out, with a comment; the rest has values that such vehicles have, each with
    a standard deviation, to be replaced by better ones. **Returns:** what was written, and what comes next. Raises
    `InputError`, also where one of the files is there already.
    """
    paths = [Path(logs)] if isinstance(logs, str | Path) else [Path(p) for p in logs]
    name = stem(paths[0].name)
    at = Path(out)
    files = {"sheet": at / f"{name}.sheet.toml", "adapter": at / f"{name}.adapter.toml"}
    said: list[str] = []
    try:
        log = log_of(paths, adapter)
    except InputError as e:
        if adapter is not None:
            raise
        first = (
            next((p for p in sorted(paths[0].iterdir()) if p.is_file()), paths[0]) if paths[0].is_dir() else paths[0]
        )
        _write(files["adapter"], write_adapter_skeleton(first))
        return "\n".join([
            f"the log cannot be read as it is: {e}",
            f"{files['adapter']}: fill in which column is what, then",
            f"  hdev init {paths[0]} --adapter {files['adapter']}",
        ])  # fmt: skip
    _write(files["sheet"], sheet_text(log, name))
    said.append(f"{files['sheet']}: look at its values, replace what you know better")
    known = "" if adapter is None else f" --adapter {adapter}"
    if adapter is None:
        said.append("an adapter is not needed: the columns have names and units that are known")
    logged = " ".join(map(str, paths)) if len(paths) < 4 else f"{paths[0]} …"
    said += ["then:", f"  hdev diagnose {logged} --vehicle {files['sheet']}{known} --out {name}_result"]
    return "\n".join(said)


def _write(path: Path, text: str) -> None:
    if path.exists():
        raise InputError(f"{path} is there already; rename or delete it, or give another folder by --out")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror or e}); give another folder by --out") from e


def sheet_text(log: Log, name: str) -> str:
    """The sheet as TOML, with comments that say what of it the log shows."""
    s = log.segments
    mass = np.asarray(s.channels["mass_kg"]) if s.has("mass_kg") else None
    heavy = mass is None or float(np.median(mass)) > CAR_KG
    shaft = s.has("motor_torque_nm")
    wheel = s.has("traction_force_n") and "traction_force_n" not in log.targets[:1]
    lines = [
        "# A value with an sd is estimated from the log, with that value and sd as its prior; a bare number is kept.",
        f'name = "{name}"',
        *(_mass(mass) if mass is not None or not (shaft or wheel) else []),
        "",
    ]
    if shaft or wheel:
        what = "motor torque" if shaft else "traction force"
        lines += [
            f"[machine]  # the log measures {what}: the road's part of the model is not needed",
            "motoring_efficiency = { value = 0.90, sd = 0.05 }",
            "regenerating_efficiency = { value = 0.88, sd = 0.05 }",
            "",
        ]
    else:
        lines += _road(log, heavy)
    lines += [
        "[driveline]",
        *([] if shaft or wheel else ["efficiency = { value = 0.88, sd = 0.03 }"]),
        *_gears(log),
        "",
    ]
    lines += ["[battery]", *_standstill(log), *_voltage(log)]
    return "\n".join(lines) + "\n"


def _mass(mass: np.ndarray | None) -> list[str]:
    if mass is None:
        return [
            "mass_kg = 18000.0  # total mass; the log has none: weigh the vehicle, or add the load to its curb weight"
        ]
    return [f"# mass_kg is not needed: the log has its own, {mass.min():,.0f} to {mass.max():,.0f} kg"]


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
    """Ratios, where motor speed shows them: rad of the motor for each metre."""
    s, v = log.segments, np.asarray(log.segments.speed_mps)
    if not s.has("motor_speed_radps"):
        return ["# gear_ratios = [9.16, 5.27], final_drive = 4.5, wheel_radius_m = 0.5  # for losses by gear"]
    drives = v > DRIVES_MPS
    ratio = np.asarray(s.channels["motor_speed_radps"])[drives] / v[drives]
    if not len(ratio) or not np.median(ratio) > 0:
        return []
    gear = np.asarray(s.channels["gear"])[drives] if s.has("gear") else np.ones(len(ratio))
    forward = [g for g in np.unique(gear[np.isfinite(gear)]).astype(int) if g > 0 and np.sum(gear == g) > ENOUGH]
    if not forward or forward != list(range(1, len(forward) + 1)):
        return [f"# the log shows {np.median(ratio):.4g} rad of the motor for each metre"]
    each = [float(np.median(ratio[gear == g])) for g in forward]
    return [
        f"gear_ratios = [{', '.join(f'{x / 2:.4g}' for x in each)}]  # with the wheel radius, as the log shows",
        "wheel_radius_m = 0.5  # assumed: only gear_ratios / wheel_radius_m matters",
    ]


def _standstill(log: Log) -> list[str]:
    """The auxiliaries: what the vehicle draws while it stands."""
    v = np.asarray(log.segments.speed_mps)
    if "battery_power_kw" not in log.targets or np.sum(v < STANDS_MPS) < 20:
        return ["auxiliary_w = { value = 2000.0, sd = 1500.0 }  # consumers that are always on"]
    watts = 1e3 * log.target("battery_power_kw")[v < STANDS_MPS]
    low, middle, high = (float(x) for x in np.quantile(watts, (0.1, 0.5, 0.9)))
    value = max(round(middle, -1), 0.0)
    return [
        f"# at standstill the log shows {middle / 1e3:.1f} kW median, {low / 1e3:.1f} to {high / 1e3:.1f} in 80 %",
        f"auxiliary_w = {{ value = {value}, sd = {max(round(0.5 * (high - low), -1), 200.0)} }}",
    ]


def _voltage(log: Log) -> list[str]:
    if log.segments.has("voltage_v"):
        return []
    return ["# nominal_voltage_v = …  # the log has no voltage: with this, losses by current can be found"]
