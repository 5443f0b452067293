"""SUMO's electric vehicles in traffic (package `eclipse-sumo`, extra `truth`).

`netgenerate` makes a grid with traffic lights on hills, `sumo` drives other traffic and the observed vehicle through
it, `emissionsDrivingCycle` gives its electric power by SUMO's energy model, in ten steps a second between which speed
is linear: the model takes a step's end speed for all of it, which over a whole second no vehicle does. A headwind is
driven as the slope of the same force, for SUMO knows none; what is not recovered below a speed is taken off the braking
steps' electric power.
"""

import os
import subprocess
import tempfile
import xml.etree.ElementTree as ET
from collections import defaultdict
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np

from experiments.simulators.drives import Drive
from experiments.simulators.vehicles import Simulated, Vehicle, headwind_force_n, slope_with_force

__all__ = ["VEHICLES", "drives", "run_tool", "simulate"]

VEHICLES = {
    "car": lambda: Vehicle("car", "sumo", 1830.0, 0.010, 0.69, 40.0, 250.0, 0.32, 0.88, 0.85, top_mps=33.0),
    "van": lambda: Vehicle("van", "sumo", 3200.0, 0.010, 1.8, 80.0, 400.0, 0.34, 0.88, 0.85, top_mps=30.0),
    "truck": lambda: Vehicle("truck", "sumo", 22000.0, 0.0065, 5.2, 600.0, 1500.0, 0.5, 0.88, 0.85, top_mps=24.0),
    "bus": lambda: Vehicle("bus", "sumo", 17500.0, 0.0075, 5.0, 400.0, 3000.0, 0.48, 0.88, 0.85, top_mps=24.0),
}
# SUMO's class, and how the driver accelerates and brakes [m/s²]
_CLASSES = {
    "car": ("passenger", 1.8, 2.0), "van": ("delivery", 1.5, 1.8), "truck": ("truck", 0.5, 0.8),
    "bus": ("bus", 0.7, 1.0),
}  # fmt: skip
_SIGMA = 0.3  # how far the driver is from perfect
_DENSITY = 1.2041  # kg/m³, of SUMO's energy model
_GRID, _STREET_M, _LIMIT_MPS = 5, 900.0, 25.0
_HILL_M = 10.0  # standard deviation of the height of a junction
_OTHERS = 160  # vehicles beside the observed one's trips
_STEPS = 10  # of the energy model in a second
_APART_S = 60  # between departures of the observed trips


def run_tool(tool: str, *arguments: str, folder: Path) -> None:
    """One of SUMO's programs. Raises `RuntimeError` with what it said."""
    home = Path(import_module("sumo").SUMO_HOME)  # by name: it is in an extra of its own
    environment = {**os.environ, "SUMO_HOME": str(home)}
    done = subprocess.run(
        [str(home / "bin" / tool), *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{tool} {' '.join(arguments)}: {done.stderr.strip()[-400:]}")


def drives(vehicle: Vehicle, rng: np.random.Generator, trips: int, seconds: float) -> list[Drive]:
    """The observed vehicle's trips through the net, from standstill on; slope as SUMO gives it at each second."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        seed = int(rng.integers(1, 2**31 - 1))
        run_tool(
            "netgenerate", "--grid", f"--grid.number={_GRID}", f"--grid.length={_STREET_M}", "--seed", str(seed),
            f"--default.speed={_LIMIT_MPS}", f"--perturb-z=norm(0,{_HILL_M})", "--perturb-x=norm(0,150)",
            "--perturb-y=norm(0,150)", "--default-junction-type=traffic_light", "--default.lanenumber=2",
            "-o", "net.xml", folder=folder,
        )  # fmt: skip
        _write_routes(folder, vehicle, rng, trips, seconds)
        run_tool(
            "sumo", "-n", "net.xml", "-r", "routes.xml", "--seed", str(seed), "--no-step-log", "--no-warnings",
            "--time-to-teleport", "300", "--step-method.ballistic",
            "--fcd-output", "fcd.xml", "--fcd-output.attributes", "speed,slope",
            "--precision", "6",
            "--device.fcd.explicit", ",".join(f"own{k}" for k in range(trips)), "--device.fcd.probability", "0",
            "--end", "7200", folder=folder,
        )  # fmt: skip
        own: dict[str, list[tuple[float, float]]] = defaultdict(list)
        for _, e in ET.iterparse(folder / "fcd.xml"):
            if e.tag == "timestep":
                for v in e:
                    own[v.get("id", "")].append((float(v.get("speed", 0)), float(v.get("slope", 0))))
                e.clear()
    out = []
    for k in range(trips):
        speed, slope = np.array(own[f"own{k}"]).T
        rest = np.zeros(int(rng.integers(3, 15)))
        out.append(
            Drive(np.r_[rest, speed, rest], np.tan(np.radians(np.r_[0 * rest + slope[0], slope, 0 * rest + slope[-1]])))
        )
    return out


def _write_routes(folder: Path, vehicle: Vehicle, rng: np.random.Generator, trips: int, seconds: float) -> None:
    """Trips over random streets: the observed vehicle's one after another, and other traffic all the time."""
    edges = [e.get("id", "") for e in ET.parse(folder / "net.xml").getroot().iter("edge") if e.get("function") is None]
    lasts = trips * _APART_S + seconds
    ways = max(2, round(seconds / 75.0))  # streets to go by: one takes about this long

    def some(n: int) -> list[str]:
        return [str(e) for e in rng.choice(edges, n, replace=False)]

    every = [
        (float(t), f"other{k}", "passenger", some(4)) for k, t in enumerate(np.sort(rng.uniform(0, lasts, _OTHERS)))
    ]
    every += [(60.0 + _APART_S * k, f"own{k}", "own", some(max(3, ways // 2))) for k in range(trips)]
    own, accel, decel = _CLASSES[vehicle.name]
    lines = [
        "<routes>", '<vType id="passenger" vClass="passenger"/>',
        f'<vType id="own" vClass="{own}" maxSpeed="{vehicle.top_mps}" accel="{accel}" decel="{decel}" '
        f'sigma="{_SIGMA}"/>',
    ]  # fmt: skip
    for depart, id_, kind, (first, *via, last) in sorted(every):
        lines.append(
            f'<trip id="{id_}" type="{kind}" depart="{depart:.0f}" departSpeed="0" arrivalSpeed="0" '
            f'from="{first}" to="{last}" via="{" ".join(via)}"/>'
        )
    (folder / "routes.xml").write_text("\n".join([*lines, "</routes>"]), encoding="utf-8")


def simulate(vehicle: Vehicle, drives: list[Drive]) -> list[Simulated]:
    """Each trip's power by SUMO's energy model."""
    v0, v1, grade = ([f(d) for d in drives] for f in (_starts, _ends, _slopes))
    start, end, slope = (np.concatenate(x) for x in (v0, v1, grade))
    part = (np.arange(_STEPS) + 1) / _STEPS
    fine_end = (start[:, None] + part * (end - start)[:, None]).ravel()
    fine_start = fine_end - np.repeat((end - start) / _STEPS, _STEPS)
    slope = slope_with_force(np.repeat(slope, _STEPS), headwind_force_n(vehicle, fine_end, _DENSITY), vehicle.mass_kg)
    ideal = replace(vehicle, driving=1.0, regenerating=1.0, recovered=1.0, auxiliary_w=0.0)
    electric, wheel = (_power_w(v, fine_start, fine_end, slope) for v in (vehicle, ideal))
    lost = (wheel < 0) & (fine_end < vehicle.cutoff_mps)
    electric = np.where(lost, vehicle.auxiliary_w, electric)
    cuts = np.cumsum([len(x) for x in v1])[:-1]
    seconds = (np.split(x.reshape(-1, _STEPS).mean(axis=1), cuts) for x in (wheel, electric))
    return [
        Simulated(a, b, 0.5 * (a + b), g, w, np.full(len(a), np.nan), e, _DENSITY)
        for a, b, g, w, e in zip(v0, v1, grade, *seconds, strict=True)
    ]


def _starts(drive: Drive) -> np.ndarray:
    return drive.speed_mps[:-1]


def _ends(drive: Drive) -> np.ndarray:
    return drive.speed_mps[1:]


def _slopes(drive: Drive) -> np.ndarray:
    return np.arctan(drive.grade[1:])


def _power_w(vehicle: Vehicle, start: np.ndarray, end: np.ndarray, slope_rad: np.ndarray) -> np.ndarray:
    """Electric power of each step [W]. The program's steps are of a second: what changes kinetic energy over a step of
    1/n s is n times as much in power, so its mass is, by the rotating one."""
    values = {
        "airDragCoefficient": vehicle.cda_m2, "frontSurfaceArea": 1.0, "rollDragCoefficient": vehicle.c_rr,
        "radialDragCoefficient": 0.0, "constantPowerIntake": vehicle.auxiliary_w,
        "propulsionEfficiency": vehicle.driving, "recuperationEfficiency": vehicle.regenerating * vehicle.recovered,
        "rotatingMass": _STEPS * vehicle.rotating_kg + (_STEPS - 1) * vehicle.mass_kg,
    }  # fmt: skip
    keys = "".join(f'<param key="{k}" value="{v!r}"/>' for k, v in values.items())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "type.xml").write_text(
            f'<additional><vType id="own" mass="{vehicle.mass_kg!r}" emissionClass="Energy/unknown">'
            f'<param key="has.battery.device" value="true"/>{keys}</vType></additional>',
            encoding="utf-8",
        )
        rows = zip(end, end - start, np.degrees(slope_rad), strict=True)
        text = "".join(f"{t};{v:.9f};{a:.9f};{s:.9f}\n" for t, (v, a, s) in enumerate(rows))
        (folder / "drive.csv").write_text(text, encoding="utf-8")
        run_tool(
            "emissionsDrivingCycle", "-t", "drive.csv", "-e", "Energy/unknown", "--additional-files", "type.xml",
            "--vtype", "own", "--have-slope", "--precision", "9", "-o", "power.csv", folder=folder,
        )  # fmt: skip
        lines = (folder / "power.csv").read_text(encoding="utf-8").splitlines()
    found = np.array([float(line.rsplit(";", 1)[1]) for line in lines if line.count(";") >= 10])
    if len(found) != len(end):
        raise RuntimeError(f"emissionsDrivingCycle gave {len(found)} of {len(end)} seconds")
    return found * 3600.0  # Wh of one second
