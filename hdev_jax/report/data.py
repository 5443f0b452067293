"""What a report is made of, and the error of each trip."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hdev_jax.problem import metrics as errors
from hdev_jax.problem import sum_weight
from hdev_jax.targets import TARGETS

__all__ = ["ReportData", "TripLine", "metrics", "same_model", "test_rows", "total", "total_name", "trip_lines"]


@dataclass(frozen=True)
class ReportData:
    """All that a page shows. Nothing is computed from it but summaries; no model is run.

    `summary` is diagnosis.json (contract §4) and may hold besides: `notes` (sentences), `clusters` (`kind`, `count`),
    `parameters_fitted`, `subsets` (name -> `before`, `after` metrics), `excluded` (`id`, `why`). For a calibration:
    `target`, `baseline`, `before`, and optionally `method`.

    `rows`: `trip` (index into `trip_names`), `time_s`, `duration_s`, `distance_m`, `distance_since_start_m` (to the
    middle of the row), `measured`, `before`, `after` (in `unit`), `test` and `used` (bool; a row that is used and no
    test row was trained on). `after`, `test` and `used` are not needed for a calibration.
    `channels`: columns of the log by their contract names, as long as the rows.
    `breakdown`: `before` and `after` -> effect id -> kWh over the test trips; may be empty.
    `ledger`: `kind`, `where` (or `file` and `trip`), `column`, `count`, `reason`.
    """

    summary: dict[str, Any]
    vehicle: str
    synthetic: bool
    unit: str
    rows: dict[str, np.ndarray]
    channels: dict[str, np.ndarray] = field(default_factory=dict)
    trip_names: tuple[str, ...] = ()
    breakdown: dict[str, dict[str, float]] = field(default_factory=dict)
    ledger: list[dict[str, Any]] = field(default_factory=list)
    command: str = ""
    seconds: float = float("nan")

    def row(self, name: str) -> np.ndarray:
        """A column of the rows: `after` is `before` where there is none, nothing is test, everything is used."""
        n = len(self.rows["measured"])
        if name in ("test", "used"):
            found = self.rows.get(name)
            return np.full(n, name == "used") if found is None else np.asarray(found, dtype=bool)
        if name == "trip":
            return np.asarray(self.rows["trip"], dtype=np.int64)
        found = self.rows["before"] if name == "after" and "after" not in self.rows else self.rows[name]
        return np.asarray(found, dtype=float)

    def residual(self, when: str) -> np.ndarray:
        """Measured − predicted, `when` before or after."""
        return self.row("measured") - self.row(when)


@dataclass(frozen=True)
class TripLine:
    """One trip (or its part, where a trip is both trained on and tested): role, rows, measured total, errors."""

    name: str
    role: str
    n: int
    hours: float
    km: float
    total: float
    before: dict[str, Any]
    after: dict[str, Any]


def same_model(data: ReportData) -> bool:
    """Whether nothing was added: before and after are one model."""
    return bool(np.array_equal(data.row("before"), data.row("after"), equal_nan=True))


def test_rows(data: ReportData) -> np.ndarray:
    """Rows that the figures show: the test rows, or all used ones where there are none; finite ones only."""
    test = data.row("test")
    chosen = test if test.any() else data.row("used")
    return chosen & np.isfinite(data.residual("before")) & np.isfinite(data.residual("after"))


def _weight(data: ReportData, rows: np.ndarray) -> np.ndarray:
    """What some rows (by index) weigh in a sum."""
    return sum_weight(data.summary["target"], data.row("duration_s")[rows], data.row("distance_m")[rows])


def total_name(data: ReportData) -> tuple[str, str]:
    """What the target sums to, and its unit: `("energy", "kWh")`."""
    target = TARGETS[data.summary["target"]]
    return target.total, target.unit if target.per_kwh is None else "kWh"


def total(data: ReportData, rows: np.ndarray) -> float:
    """The measured total of some rows (by index) in the unit of `total_name`: kWh, or the mean torque in Nm."""
    rows = rows[np.isfinite(data.row("measured")[rows])]
    weight = _weight(data, rows)
    per_kwh = TARGETS[data.summary["target"]].per_kwh
    s = float(np.sum(data.row("measured")[rows] * weight))
    return s / max(float(np.sum(weight)), 1e-12) if per_kwh is None else s / per_kwh


def metrics(data: ReportData, rows: np.ndarray, when: str) -> dict[str, Any]:
    """METRICS of contract §4 over rows by index, for trips that diagnosis.json does not list."""
    rows = rows[np.isfinite(data.residual(when)[rows])]
    if not len(rows):
        return {"rmse": None, "mse": None, "bias": None, "pe_percent": None, "fit_percent": None, "n": 0}
    return errors(data.row("measured")[rows], data.row(when)[rows], _weight(data, rows))


def _parts(data: ReportData) -> Iterator[tuple[int, str, np.ndarray]]:
    trip = data.row("trip")
    role = np.where(~data.row("used"), "unused", np.where(data.row("test"), "test", "train"))
    order = np.argsort(trip, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(trip[order])) + 1) if len(trip) else []
    for rows in sorted(groups, key=lambda g: int(g[0])):
        roles = [r for r in ("train", "test", "unused") if np.any(role[rows] == r)]
        for r in roles:
            yield int(trip[rows[0]]), r, rows[role[rows] == r]


def trip_lines(data: ReportData) -> list[TripLine]:
    """Every trip in the order of the log. Test trips take their errors from diagnosis.json, where it lists them."""
    lines = []
    for i, role, rows in _parts(data):
        name = data.trip_names[i] if 0 <= i < len(data.trip_names) else f"trip {i + 1}"
        listed = {w: data.summary.get(w, {}).get("test_by_trip", {}).get(name) for w in ("before", "after")}
        found = {w: (role == "test" and listed[w]) or metrics(data, rows, w) for w in ("before", "after")}
        lines.append(
            TripLine(
                name=name,
                role=role,
                n=len(rows),
                hours=float(np.nansum(data.row("duration_s")[rows])) / 3600.0,
                km=float(np.nansum(data.row("distance_m")[rows])) / 1000.0,
                total=total(data, rows),
                before=found["before"],
                after=found["after"],
            )
        )
    return lines
