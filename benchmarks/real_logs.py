"""What the loop does on the measured logs: `python benchmarks/real_logs.py [PART …] --work DIR`, from a checkout.

Parts: niro (trained on each trip in turn), road (the Niro's force balance), ztbus (three folds of missions). Each run
is one `hdev diagnose`; a run that is there already is read, not repeated. Prints a table and, with --write, keeps it
in docs/real_logs.md. HDEV_DATA names the data (default ../shared/data).
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

__all__ = ["main"]

DATA = Path(os.environ.get("HDEV_DATA", "../shared/data"))
TRIPS = ("1", "2", "3", "4")


def main() -> int:
    """Run the parts asked for and print what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["niro", "road", "ztbus"])
    parser.add_argument("--work", type=Path, default=Path("out/real_logs"))
    parser.add_argument("--write", action="store_true", help="keep the tables in docs/real_logs.md")
    options = parser.parse_args()
    if not DATA.is_dir():
        print(f"no measured data in {DATA}: set HDEV_DATA; README.md says where it is from", file=sys.stderr)
        return 2
    lines = [
        "# Measured logs",
        "",
        "Made by `python benchmarks/real_logs.py --write`. Every number is on trips that no",
    ]
    lines += ["choice has seen; predictions are free of measured power (no feedback).", ""]
    for part in options.parts:
        lines += [*{"niro": niro, "road": road, "ztbus": ztbus}[part](options.work), ""]
    print("\n".join(lines))
    if options.write:
        Path("docs/real_logs.md").write_text("\n".join(lines).rstrip() + "\n")
    return 0


def _run(out: Path, *arguments: str) -> dict:
    """One diagnosis; its wall-clock seconds and peak memory are kept beside it."""
    if not (out / "diagnosis.json").exists():
        started = time.time()
        command = [sys.executable, "-m", "hdev_jax.cli", "diagnose", *arguments, "--out", str(out)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        cost = {"seconds": time.time() - started, "peak_gib": peak}
        out.with_name(out.name + ".cost.json").write_text(json.dumps(cost))
    result = json.loads((out / "diagnosis.json").read_text())
    cost = out.with_name(out.name + ".cost.json")
    result["cost"] = json.loads(cost.read_text()) if cost.exists() else {"seconds": np.nan, "peak_gib": np.nan}
    return result


def _found(result: dict) -> str:
    return ", ".join(e["id"] for e in result["effects"])


def _cost(result: dict) -> str:
    return f"{result['cost']['seconds']:.0f} s, {result['cost']['peak_gib']:.1f} GiB"


def niro(work: Path) -> list[str]:
    """Battery power from motor torque and speed; the sheet declares two efficiencies."""
    lines = ["## Kia Niro: battery power from motor torque and speed", ""]
    lines += ["| trained on | before, mean test MSE [kW²] | after | parameters | worst trip energy | found | cost |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for trip in TRIPS:
        r = _run(
            work / f"niro_{trip}", str(DATA / "kia_niro"), "--vehicle", "configs/vehicles/kia_niro.toml",
            "--adapter", "configs/adapters/kia_niro.toml", "--train-trips", trip,
        )  # fmt: skip
        before, after = ([m["mse"] for m in r[when]["test_by_trip"].values()] for when in ("before", "after"))
        worst = max((m["pe_percent"] for m in r["after"]["test_by_trip"].values()), key=abs)
        lines.append(
            f"| {trip} | {np.mean(before):.3f} | {np.mean(after):.4f} | {r['parameters_fitted']} | {worst:+.2f} % | "
            f"{_found(r)} | {_cost(r)} |"
        )
    lines += ["", "The paper's network of 282 parameters, trained on trip 1 (theirs): 0.1604 in free run; LSTM 0.2322."]
    return lines


def road(work: Path) -> list[str]:
    """The force at the wheels from speed; the sheet declares mass, rolling resistance and drag, the log no slope."""
    r = _run(
        work / "niro_road", str(DATA / "kia_niro"), "--vehicle", "configs/vehicles/kia_niro_road.toml",
        "--adapter", "configs/adapters/kia_niro.toml", "--target", "traction_force_n", "--train-trips", "1",
    )  # fmt: skip
    lines = ["## Kia Niro: traction force, no slope in the log, trained on trip 1", ""]
    lines += ["| rows of trips 2-4 | n | before, RMSE [N] | after | less by |", "|---|---|---|---|---|"]
    parts = {"all": {k: r[k]["test"] for k in ("before", "after")}, **r["subsets"]}
    for name, m in parts.items():
        b, a = m["before"]["rmse"], m["after"]["rmse"]
        lines.append(f"| {name} | {m['after']['n']} | {b:.1f} | {a:.1f} | {100 * (1 - a / b):.1f} % |")
    lines += ["", f"Training trip: {r['before']['train']['rmse']:.0f} N before. Found: {_found(r)}. Cost: {_cost(r)}."]
    return lines


def ztbus(work: Path) -> list[str]:
    """Electric power of a bus from force and speed; every third mission held out, three times."""
    files = sorted(p for p in (DATA / "ztbus").glob("B*.csv.gz") if ".grade." not in p.name)
    names = [p.name[:24] for p in files]
    import pandas as pd

    warm = {
        n: pd.read_csv(f, usecols=["temperature_ambient"]).iloc[:, 0].mean() - 273.15
        for n, f in zip(names, files, strict=True)
    }
    trips, squares, rows = {}, {"before": 0.0, "after": 0.0}, 0
    lines = ["## ZTBus: electric power from traction force and speed, every third mission held out", ""]
    lines += ["| held out from | before, RMSE [kW] | after | found | unexplained | cost |", "|---|---|---|---|---|---|"]
    for k in range(3):
        r = _run(
            work / f"ztbus_{k + 1}", *map(str, files), "--vehicle", "configs/vehicles/ztbus.toml",
            "--adapter", "configs/adapters/ztbus.toml", "--test-trips", ",".join(names[k::3]),
        )  # fmt: skip
        b, a = r["before"]["test"], r["after"]["test"]
        lines.append(
            f"| {k + 1} | {b['rmse']:.2f} | {a['rmse']:.2f} | {_found(r)} | {r['unexplained']['signature']} "
            f"| {_cost(r)} |"
        )
        trips |= r["after"]["test_by_trip"]
        rows += a["n"]
        squares["before"] += b["mse"] * b["n"]
        squares["after"] += a["mse"] * a["n"]
    error = np.array([m["pe_percent"] for m in trips.values()])
    lines += ["", "| pooled, 24 missions | |", "|---|---|"]
    lines += [
        f"| RMSE before → after | {np.sqrt(squares['before'] / rows):.2f} → {np.sqrt(squares['after'] / rows):.2f} kW |"
    ]
    lines += [f"| signed mean of the missions' energy errors | {error.mean():+.2f} % |"]
    lines += [f"| mean absolute energy error | {np.abs(error).mean():.2f} % |"]
    for label, keep in (("missions at 12 °C and colder", lambda t: t <= 12), ("warmer missions", lambda t: t > 12)):
        chosen = [m for n, m in trips.items() if keep(warm[n])]
        rmse = np.sqrt(sum(m["mse"] * m["n"] for m in chosen) / sum(m["n"] for m in chosen))
        lines += [f"| {label} ({len(chosen)}) | {rmse:.2f} kW |"]
    worst = max(trips, key=lambda n: trips[n]["rmse"])
    lines += [f"| worst mission | {worst}, {trips[worst]['rmse']:.2f} kW, {trips[worst]['pe_percent']:+.1f} % |"]
    return lines


if __name__ == "__main__":
    sys.exit(main())
