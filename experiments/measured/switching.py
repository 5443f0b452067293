"""Loads that switch on measured logs: the levels of each training set, how often each is on, the three errors."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.measured.tables import Runs, pooled_rmse, table
from hdev_jax.report import names

__all__ = ["loads_section"]


def loads_section(runs: Runs, head: str, unit: str) -> list[str]:
    """The section's lines; empty where no run has a load with a state."""
    found = [(k, e) for k, r in runs.items() for e in r["effects"] if "state" in e]
    if not found:
        return []
    temps = sorted({c for _, e in found for c, *_ in e["state"]["share_on"]})
    rows = [
        [
            k, names.effect(e["id"]), f"{p['value'] / 1e3:.1f} ± {p['sd'] / 1e3:.1f}",
            *(_share(e["state"], c) for c in temps), f"{e['state']['dwell_on_s']:.0f} s",
        ]
        for k, e in found
        for p in [e["parameters"]["power_w"]]
    ]  # fmt: skip
    lines = [
        "### Loads that switch",
        "",
        "No channel of the log says when these loads are on: their states are decoded from the measured power.",
        "",
    ]
    lines += table(
        [head, "load", "power [kW]", *(f"share of time on at {c:.0f} °C (90 %)" for c in temps), "mean time on"], rows
    )
    lines += [
        "",
        "Errors on held-out test trips. Free run: no measured power; one step ahead: measured power up to the row "
        "before; given the states: on and off decoded from the measured power.",
        "",
    ]
    errors = [[k, *_errors(r)] for k, r in runs.items() if "given_states" in r["after"]]
    with_states = [r for r in runs.values() if "given_states" in r["after"]]
    every = [
        f"{pooled_rmse([*(m for r in with_states for m in _by_trip(r, 'test_by_trip'))]):.2f}",
        f"{np.sqrt(np.average([r['after']['one_step']['mse'] for r in with_states], weights=_rows(with_states))):.2f}",
        f"{pooled_rmse([*(m for r in with_states for m in _by_trip(r, 'given_states_by_trip'))]):.2f}",
        _energy([m for r in with_states for m in _by_trip(r, "test_by_trip")]),
        _energy([m for r in with_states for m in _by_trip(r, "given_states_by_trip")]),
    ]
    columns = [
        f"RMSE, free run [{unit}]", "RMSE, one step ahead", "RMSE, given the states",
        "mean absolute energy error, free run", "the same, given the states",
    ]  # fmt: skip
    return [*lines, *table([head, *columns], [*errors, ["pooled", *every]]), ""]


def _rows(runs: list[Mapping[str, Any]]) -> list[int]:
    return [r["after"]["one_step"]["n"] for r in runs]


def _by_trip(result: Mapping[str, Any], block: str) -> list[Mapping[str, Any]]:
    return list(result["after"][block].values())


def _share(state: Mapping[str, Any], temp_c: float) -> str:
    for c, share, low, high in state["share_on"]:
        if c == temp_c:
            if high < 0.01:
                return "< 1 %"
            return f"{100 * share:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    return "–"


def _energy(by_trip: list[Mapping[str, Any]]) -> str:
    return f"{np.mean([abs(m['pe_percent']) for m in by_trip]):.1f} %"


def _errors(r: Mapping[str, Any]) -> list[str]:
    after = r["after"]
    each = [f"{after[k]['rmse']:.2f}" for k in ("test", "one_step", "given_states")]
    return [*each, _energy(_by_trip(r, "test_by_trip")), _energy(_by_trip(r, "given_states_by_trip"))]
