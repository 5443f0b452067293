"""From a run's results to what the page, the figures and the terminal show."""

import time
from typing import Any

import numpy as np

from hdev_jax.diagnosis.diagnose import Outcome
from hdev_jax.inference import padded
from hdev_jax.physics.across import distance_since_start
from hdev_jax.physics.states import state_channel
from hdev_jax.problem import Problem, Split
from hdev_jax.report.data import ReportData
from hdev_jax.report.switching import on_column
from hdev_jax.report.words import answer, known_errors, next_drives, plus_minus, switching
from hdev_jax.targets import TARGETS

__all__ = ["answer_text", "of_diagnosis", "report_data"]


def report_data(
    problem: Problem, split: Split, summary: dict[str, Any], before: np.ndarray, after: np.ndarray, command: str,
    started: float, breakdown: dict[str, dict[str, float]] | None = None,
) -> ReportData:  # fmt: skip
    s = problem.segments
    used = problem.rows((*split.train, *split.test))
    return ReportData(
        summary=summary,
        vehicle=problem.sheet.name,
        synthetic="synthetic" in f"{problem.sheet.name} {' '.join(problem.log.files)}".lower(),
        unit=problem.unit,
        rows={
            "trip": problem.log.trip,
            "time_s": np.asarray(s.time_s),
            "duration_s": np.asarray(s.duration_s),
            "distance_m": np.asarray(s.distance_m),
            "distance_since_start_m": np.asarray(distance_since_start(s)),
            "measured": problem.measured, "before": before, "after": after,
            "test": problem.rows(split.test), "used": used,
        },
        channels={"speed_mps": np.asarray(s.speed_mps), **{k: np.asarray(v) for k, v in s.channels.items()}},
        trip_names=problem.log.trip_names,
        breakdown=breakdown or {},
        ledger=problem.log.ledger.to_dicts(),
        command=command,
        seconds=time.time() - started,
    )  # fmt: skip


def of_diagnosis(result: Outcome, command: str, started: float) -> ReportData:
    problem, split = result.problem, result.split
    breakdown = {}
    if TARGETS[problem.target].of_battery:
        test = problem.rows(split.test)
        trip = np.asarray(problem.segments.trip)
        whole = np.isin(trip, trip[test])  # of a trip that is tested in part, what came before belongs to it
        known = problem.segments if result.given is None else result.given.segments
        rows = padded(known.take(whole), problem.measured[whole])
        for when, car in (("before", result.before), ("after", result.after)):
            parts = car.breakdown(rows.segments)
            breakdown[when] = {
                k: float(np.sum(np.asarray(v)[: rows.rows][test[whole]])) / 1e3 for k, v in parts.items()
            }
    data = report_data(
        problem, split, result.summary, result.predicted_before, result.predicted_after, command, started, breakdown
    )
    if given := result.given:
        states = {on_column(i): np.asarray(given.segments.channels[state_channel(i)]) for i in given.ids}
        data.rows.update({"given": given.predicted, **states})
    return data


def answer_text(data: ReportData) -> str:
    """The answer in plain text: what is missing, errors before and after, effects with their sizes, what remains."""
    s = data.summary
    lines = [answer(data), "", f"{'':10s}{'test RMSE':>12s}{'energy/work error':>20s}   [{data.unit}]"]
    for when in ("before", "after"):
        m = s[when]["test"]
        pe = "-" if m["pe_percent"] is None else f"{m['pe_percent']:+.2f} %"
        lines.append(f"{when:10s}{m['rmse']:12.4g}{pe:>20s}")
    lines += known_errors(s, data.unit)
    for e in s["effects"]:
        sizes = ", ".join(f"{k} {plus_minus(p['value'], p['sd'], p['unit'])}" for k, p in e["parameters"].items())
        if "state" in e:
            lines.append(f"  {e['id']} ({e['stage']}): {switching(e)}")
            continue
        others = ", ".join(e["indistinguishable_from"])
        twins = f"; cannot be distinguished from {others}" if others else ""
        lines.append(f"  {e['id']} ({e['stage']}): {sizes}{twins}")
    lines += next_drives(s)
    lines.append(s["unexplained"]["signature"])
    lines += [f"note: {note}" for note in s.get("notes", [])]
    return "\n".join(lines)
