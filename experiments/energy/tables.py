"""Tables and the figure of the study of answers about energy."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import wilson, write_tables
from hdev_jax.energy.road_load import SHOWN_KMH
from hdev_jax.report import names
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, figure, tidy
from hdev_jax.report.words import count
from hdev_jax.rundir import Run

__all__ = ["tabulate"]

Results = Sequence[tuple[dict[str, Any], dict[str, Any]]]
Line = dict[str, Any]
DETECTED = "logs with a saving detected"
GREEN = "#009E73"  # the third of Okabe and Ito's colours
SHEETS = {"declared": "declared sheet", "diagnosed": "diagnosed sheet",
          "plain": "declared sheet, fleet without hidden effects"}  # fmt: skip


def tabulate(results: Results, run: Run, config: Any) -> tuple[list[str], list[str], list[Line]]:
    """Write the tables and the figure. Returns what was found, the targets missed, and the rows of the first table."""
    ledger, coasting, service, saved = ([(t, r) for t, r in results if t["kind"] == k]
                                        for k in ("ledger", "coasting", "service", "saved"))  # fmt: skip
    causes, left = list(_causes(ledger)), _unexplained(ledger)
    whole = _line("energy by cause, all", [x for _, r in ledger for x in r["causes"].values()])
    coasted, driven, after = list(_coasted(coasting)), list(_driven(service)), list(_saved(saved))
    lines = [whole, left, *coasted, *driven, *after]
    write_tables(run, "table", [_shown(x) for x in lines], config.caption)
    write_tables(run, "causes", [_shown(x) for x in causes], "Energy by cause, whole log; synthetic logs")
    write_tables(run, "noises", list(_noises(ledger)), "All causes, by the noise of the log; synthetic logs")
    write_tables(run, "service", list(_vehicles(service)), "Road load in service, vehicle by vehicle; synthetic fleet")
    _figure(run, [whole, left, *coasted, *driven, *after], service, config)
    off = max(r["off_percent"] for _, r in ledger)
    missed = (
        [] if off <= config.sum_percent else [f"sum of a ledger: off by {off:.2g} %, target {config.sum_percent:g}"]
    )
    bands = [(x, config.covered_percent) for x in (whole, *causes, *after)]
    bands += [(x, config.coasting_percent) for x in coasted]
    for x, (low, high) in bands:
        if not low <= x["inside_90"] <= high:
            missed.append(f"{x['name']}: 90 % intervals cover {x['inside_90']:.0f} %, target {low:g} to {high:g}")
    for x in driven:
        if x["median_error_percent"] > config.service_percent:
            missed.append(f"{x['name']}: {x['median_error_percent']:.2g} % in the median, "
                          f"target {config.service_percent:g}")  # fmt: skip
    found = [
        f"In {len(ledger)} logs the energies by cause and the unexplained rest add up to the measured energy of the "
        f"log and of each trip{', to rounding' if off < 1e-6 else f' within {off:.1g} %'}",
        f"90 % intervals cover {whole['inside_90']:.0f} % of the true energies by cause and, in coast-downs, "
        f"{np.mean([x['inside_90'] for x in coasted]):.0f} % of the true forces",
    ]
    for words in SHEETS.values():
        if mine := [x for x in driven if x["name"].endswith(words)]:
            error, held = ([x[k] for x in mine] for k in ("median_error_percent", "inside_90"))
            one = mine[0]["n"] == 1
            found.append(
                f"From driving in service, {words}: the force at {_both(SHOWN_KMH, 'g')} km/h is off by "
                f"{_both(error, '.2g')} %{'' if one else ' in the median'} ({count(mine[0]['n'], 'vehicle')})"
                + ("" if one else f", and the intervals cover {_both(held, '.0f')} %")
            )
    share = 100.0 * config.share
    shown = [f"{x[DETECTED]} of {x['n']} logs of {x['trips']} trips" for x in after if x["planted"]]
    false = [f"{x[DETECTED]} of {x['n']}" for x in after if not x["planted"]]
    found.append(f"A saving of {share:g} % is detected in {' and '.join(shown)}; where nothing changed, the interval "
                 f"excludes 0 in {' and '.join(false)}")  # fmt: skip
    return found, missed, [*lines, *causes]


def _both(values: Sequence[float], digits: str) -> str:
    return " and ".join(format(v, digits) for v in values)


def _line(name: str, each: Sequence[Sequence[float]]) -> Line:
    """A row of the table; `each`: value, lower, upper, true."""
    value, low, high, true = np.array(each).T
    inside = (low <= true) & (true <= high)
    between = wilson(int(inside.sum()), len(inside))
    return {
        "name": name, "n": len(inside), "median_error_percent": 100.0 * float(np.median(np.abs(value / true - 1.0))),
        "median_half_interval_percent": 100.0 * float(np.median((high - low) / 2.0 / np.abs(true))),
        "inside_90": 100.0 * float(np.mean(inside)), "interval_95": [100.0 * x for x in between],
    }  # fmt: skip


def _shown(line: Line) -> Line:
    """The same as it is printed: whole numbers of percent in the interval."""
    cells = {k: v for k, v in line.items() if k not in ("planted", "trips")}
    return cells | {"interval_95": "–".join(f"{x:.0f}" for x in line["interval_95"])}


def _causes(ledger: Results) -> Iterator[Line]:
    for cause in ledger[0][1]["causes"]:
        yield _line(f"energy by cause, {names.effect(cause)}", [r["causes"][cause] for _, r in ledger])


def _unexplained(ledger: Results) -> Line:
    """Nearly always, and no target: the vehicle is fitted to the same trips, so little of their noise is left over."""
    inside = [r["unexplained"][0] <= 0 <= r["unexplained"][1] for _, r in ledger]
    between = wilson(sum(inside), len(inside))
    return {"name": "energy by cause, rest: interval holds 0", "n": len(inside), "median_error_percent": None,
            "inside_90": 100.0 * float(np.mean(inside)), "interval_95": [100.0 * x for x in between]}  # fmt: skip


def _noises(ledger: Results) -> Iterator[Line]:
    """Causes of a log are not independent: no interval of the share."""
    for noise in dict.fromkeys(t["noise"] for t, _ in ledger):
        mine = [r for t, r in ledger if t["noise"] == noise]
        x = _line(noise, [c for r in mine for c in r["causes"].values()])
        yield {
            "noise": noise, "logs": len(mine), "median_error_percent": x["median_error_percent"],
            "inside_90": x["inside_90"],
            "unexplained_percent": float(np.median([abs(r["unexplained_percent"]) for r in mine])),
        }  # fmt: skip


def _coasted(coasting: Results) -> Iterator[Line]:
    for vehicle in dict.fromkeys(t["vehicle"] for t, _ in coasting):
        for k, kmh in enumerate(SHOWN_KMH):
            each = [s[k] for t, r in coasting if t["vehicle"] == vehicle for s in r["sets"]]
            yield _line(f"coast-down, {vehicle}, {kmh:g} km/h", each)


def _driven(service: Results) -> Iterator[Line]:
    for sheet, words in SHEETS.items():
        for k, kmh in enumerate(SHOWN_KMH):
            if each := [r["force"][k] for t, r in service if t["sheet"] == sheet]:
                yield _line(f"in service, {kmh:g} km/h, {words}", each)


def _vehicles(service: Results) -> Iterator[Line]:
    for t, r in service:
        row: Line = {"vehicle": t["variant"].replace("_", " "), "fleet": t["seed"], "sheet": SHEETS[t["sheet"]]}
        for kmh, driven, (value, low, high, true) in zip(SHOWN_KMH, r["driven"], r["force"], strict=True):
            row |= {
                f"true force at {kmh:g} km/h [N]": f"{true:.0f}",
                f"estimate at {kmh:g} km/h [N]": f"{value:.0f}",
                f"90 % interval at {kmh:g} km/h": f"{low:.0f} to {high:.0f}{'' if driven else ', extrapolated'}",
                f"error at {kmh:g} km/h [%]": 100.0 * (value / true - 1.0),
            }
        yield row


def _saved(saved: Results) -> Iterator[Line]:
    """Found: the interval is on one side of 0 and the saving has the sign of what was planted, or any where nothing
    was."""
    for trips in dict.fromkeys(t["trips"] for t, _ in saved):
        for what in ("nothing", "planted"):
            mine = [(t["share"] if what == "planted" else 0.0, r[what]) for t, r in saved if t["trips"] == trips]
            inside = [low <= true <= high for true, (_, low, high) in mine]
            shown = sum(low > 0 if true > 0 else low > 0 or high < 0 for true, (_, low, high) in mine)
            planted = f"{100 * mine[0][0]:g} %" if what == "planted" else "no change"
            between = wilson(sum(inside), len(inside))
            half = [100.0 * (high - low) / 2.0 for _, (_, low, high) in mine]
            yield {
                "name": f"saving, {planted}, {trips} trips", "n": len(mine), DETECTED: shown,
                "median_half_interval_percent": float(np.median(half)),
                "inside_90": 100.0 * float(np.mean(inside)), "interval_95": [100.0 * x for x in between],
                "planted": what == "planted", "trips": trips,
            }  # fmt: skip


@styled
def _figure(run: Run, lines: Sequence[Line], service: Results, config: Any) -> None:
    """How often intervals hold the truth, and the force in service over the true one."""
    fig = figure(9.6, 0.8 + 0.26 * max(len(lines), 18))
    left, right = fig.subplots(1, 2, width_ratios=(1.0, 1.2))
    y = np.arange(len(lines))[::-1]
    left.axvspan(*config.covered_percent, color=GREY, alpha=0.2, lw=0)
    left.axvline(90.0, color=GREY, lw=0.8)
    left.hlines(y, *np.array([x["interval_95"] for x in lines]).T, color=AFTER, lw=1.4)
    left.plot([x["inside_90"] for x in lines], y, "o", color=AFTER, ms=4)
    left.set_yticks(y, [x["name"] for x in lines])
    left.set(xlim=(0, 101), xlabel="90 % intervals that hold the truth [%]")
    left.set_title("How often the intervals hold")
    tidy(left, grid="x")
    variants = list(dict.fromkeys(t["variant"] for t, _ in service))
    at = {v: len(variants) - 1 - k for k, v in enumerate(variants)}
    for (sheet, words), colour, aside in zip(SHEETS.items(), (BEFORE, AFTER, GREEN), (0.25, 0.0, -0.25), strict=True):
        mine = [(at[t["variant"]] + aside, *r["force"][0]) for t, r in service if t["sheet"] == sheet]
        if mine:
            place, value, low, high, true = np.array(mine).T
            right.hlines(place, low / true, high / true, color=colour, lw=1.4)
            right.plot(value / true, place, "o", color=colour, ms=3, label=words)
    right.axvline(1.0, color=GREY, lw=0.8)
    right.set_yticks(
        list(at.values()), [f"vehicle {v}" if len(v) == 1 else v.replace("_", " ") for v in variants], fontsize=7
    )
    right.set_xlabel(f"estimated over true force at {SHOWN_KMH[0]:g} km/h")
    right.set_title("In service, synthetic fleet")
    fig.legend(*right.get_legend_handles_labels(), loc="outside lower right", ncols=3)
    tidy(right, grid="x")
    save_figure(run, fig, "energy_study")
