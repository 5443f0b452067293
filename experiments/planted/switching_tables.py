"""Tables and the figure of the study of loads that switch: a log is scored, lines are shares over logs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np

from experiments.planted.scores import exact
from experiments.planted.scores import names as names_of
from experiments.runner.figures import save_figure, styled
from experiments.runner.tables import wilson, write_tables
from hdev_jax.report import names
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["Scored", "collect", "scored"]

LOADS = ("switching_load", "second_switching_load")
INSTEAD = ("auxiliary_power", "hvac_power", "periodic_load")  # the mean or the cycle of a load that is not found
POWER, SHARE = 0.10, 0.03
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # of kinds; Okabe and Ito (2008)
CASES = {  # with the sizes of the loads
    "one": "a load of {}×",
    "two": "loads of {}× and {}×",
    "beside": "a load of {}×, another effect beside",
    "nothing": "nothing planted",
}

Log = tuple[dict[str, Any], dict[str, Any]]  # a task with its result


@dataclass(frozen=True)
class Scored:
    """A log's score. Of each load that is found: its power over the true one, whether its 90 % interval holds that, how
    far its share of time on is off, the share of rows whose state is right, the share of trips whose interval holds
    their energy. `false`: what is named and not planted; `instead`: the mean or the cycle of a load that is not found;
    `other`: whether the effect beside is named, None where there is none."""

    all_found: bool
    power: list[float]
    power_covered: list[bool]
    share_off: list[float]
    right: list[float]
    covered: list[float]
    false: list[str]
    instead: list[str]
    other: bool | None


def scored(effects: Sequence[str], result: dict[str, Any]) -> Scored:
    """The score of one log. Decoded loads belong to the planted ones to which their powers are nearest, one to one."""
    found, loads = result["found"], result["loads"]
    pairs = _matched([f["power_w"] for f in found], [x["power_w"] for x in loads])
    others = [e for e in result["named"] if e["id"] not in LOADS]
    known = set(names_of(effects))
    wrong = [e["id"] for e in others if not set(e["class"]) & known]
    missed = len(pairs) < len(loads)
    instead = [k for k in wrong if k in INSTEAD] if missed else []
    extra = [found[k]["id"] for k in range(len(found)) if k not in {i for i, _ in pairs}]
    right = [e for e in others if set(e["class"]) & known]
    return Scored(
        all_found=not missed,
        power=[found[i]["power_w"] / loads[j]["power_w"] for i, j in pairs],
        power_covered=[_within(found[i]["interval_90"], loads[j]["power_w"]) for i, j in pairs],
        share_off=[found[i]["share"] - loads[j]["share"] for i, j in pairs],
        right=[found[i]["right"][j] for i, j in pairs],
        covered=[found[i]["covered"][j] / result["trips"] for i, j in pairs],
        false=[k for k in wrong if k not in instead] + extra,
        instead=instead,
        other=exact(effects, right) if effects else None,
    )


def _within(interval: Sequence[float], true: float) -> bool:
    return interval[0] <= true <= interval[1]


def _matched(found: Sequence[float], true: Sequence[float]) -> list[tuple[int, int]]:
    """Which decoded load is which planted one: by the logarithm of their powers, as many as there are of both."""
    count = min(len(found), len(true))
    ways = [
        list(zip(a, b, strict=True))
        for a in permutations(range(len(found)), count)
        for b in permutations(range(len(true)), count)
    ]
    return min(ways, key=lambda way: sum(abs(np.log(found[i] / true[j])) for i, j in way))


def collect(config: Any, results: Sequence[Log], run: Run) -> dict[str, Any]:
    """Lines by mode and size (kinds together), then by kind, by noise, beside another effect; what was named."""
    done = [(t, r) for t, r in results if "skipped" not in r]
    skipped = [{"seed": t["seed"], "effects": t["effects"], "why": r["skipped"]} for t, r in results if "skipped" in r]
    planted, empty = ([(t, r) for t, r in done if bool(t["loads"]) is side] for side in (True, False))
    rows = _rows(done, _line)
    write_tables(run, "table", rows, f"{config.caption}: shares of logs, and of what is found")
    kinds = _rows([(t, r) for t, r in planted if t["case"] == "one"], lambda t: f"{_line(t)}, {t['kind']}", more=True)
    if kinds:
        write_tables(run, "table_kinds", kinds, f"{config.caption}: by kind")
    noises = [_noise_row(name, group) for name, group in _grouped(empty, lambda t: f"{t['mode']}, {t['noise']}")]
    if noises:
        write_tables(run, "table_noise", noises, "Synthetic logs with nothing planted, by noise")
    both = [(t, r) for t, r in planted if t["effects"] and "skipped" not in r["without"]]
    beside = [_beside_row(n, group) for n, group in _grouped(both, lambda t: f"{t['mode']}, {t['effects'][0]}")]
    if beside:
        write_tables(run, "table_beside", beside, "Another effect beside a load, synthetic: named with and without it")
    told = _names(done)
    if told:
        write_tables(run, "table_names", told, "Names of what is not planted, synthetic: logs with each")
    _figure(run, [(t, r) for t, r in planted if t["case"] == "one"])
    wrong, n = _with_load(empty), len(empty)
    missed = []
    if n and wrong / n > config.wanted_false:
        missed = [f"a load named with nothing planted: {wrong} of {n}, target at most {config.wanted_false:g}"]
    return {
        "artefact": config.artefact, "data": "synthetic_log", "synthetic": True,
        "logs": len(done) + sum(bool(t["effects"]) for t, _ in done),
        "rows": [{"name": r["line"], "paper": None, "ours": {k: v for k, v in r.items() if k != "line"}}
                 for r in (*rows, *({"line": f"nothing planted: {x['noise']}", **x} for x in noises),
                           *({"line": f"beside: {x['beside']}", **x} for x in beside))],
        "better_than_paper": 0, "of": 0, "skipped": skipped, "missed": missed,
        "findings": [*_found_sentences(planted), *_interval_sentence(planted), *_false_sentences(empty, planted),
                     *_beside_sentence(beside)],
        "notes": [
            "Load/noise: the power of the load divided by the RMS of the noise; in segments, by the RMS of the noise's "
            "energy over the median duration of a row. Samples have the battery's power each second, with torque "
            "and motor speed measured; segments have the energy of each row, and the model goes from speed and "
            "slope to the battery. The noise is AR(1), 0.9 from row to row, unless the row of the table says "
            "otherwise; random walk: a random walk in each trip plus AR(1) of the same RMS",
            "Found: all loads of the log are named. For the loads that are found, the table has the share whose power "
            "is within 10 % of the true one; the share whose time on in the training trips is within 3 points of the "
            "true one; the mean share of rows whose state is right; and the mean share of trips whose 90 % interval of "
            "energy holds the true one",
            "False name: the share of logs in which something is named that is not planted. If a load is missed, a "
            "constant load, heating and cooling or a periodic load do not count as false: they describe its mean or "
            "its cycle",
        ],
    }  # fmt: skip


def _line(task: dict[str, Any]) -> str:
    """A line of the first table; kinds and noises together."""
    sizes = [f"{x['size']:g}" for x in task["loads"]]
    return f"{task['mode']}, {CASES[task['case']].format(*sizes)}"


def _grouped(logs: Sequence[Log], key: Callable[[dict[str, Any]], str]) -> list[tuple[str, list[Log]]]:
    groups: dict[str, list[Log]] = {}
    for t, r in sorted(logs, key=lambda log: (log[0]["mode"], [*CASES].index(log[0]["case"]))):
        groups.setdefault(key(t), []).append((t, r))
    return list(groups.items())


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _rows(logs: Sequence[Log], key: Callable[[dict[str, Any]], str], more: bool = False) -> list[dict[str, Any]]:
    rows = []
    for name, group in _grouped(logs, key):
        every = [scored(t["effects"], r) for t, r in group]
        power = [x for s in every for x in s.power]
        off = [x for s in every for x in s.share_off]
        row = {
            "line": name, "n": len(group),
            "found": _mean([s.all_found for s in every]) if group[0][0]["loads"] else None,
            "power within 10 %": _mean([abs(x - 1.0) <= POWER for x in power]),
            "share of time on within 3 points": _mean([abs(x) <= SHARE for x in off]),
            "rows with the right state": _mean([x for s in every for x in s.right]),
            "trips whose energy is covered": _mean([x for s in every for x in s.covered]),
            "false name": _mean([bool(s.false) for s in every]),
        }  # fmt: skip
        if more:
            row["mean or cycle named instead"] = _mean([bool(s.instead) for s in every])
            row["power covered"] = _mean([x for s in every for x in s.power_covered])
            row["median power over true"] = float(np.median(power)) if power else None
            row["median error of the share of time on [points]"] = (
                100.0 * float(np.median(np.abs(off))) if off else None
            )
        rows.append(row)
    return rows


def _with_load(logs: Sequence[Log]) -> int:
    """In how many of these logs a load that switches is named."""
    return sum(any(e["id"] in LOADS for e in r["named"]) for _, r in logs)


def _noise_row(name: str, group: Sequence[Log]) -> dict[str, Any]:
    n = len(group)
    return {
        "noise": name, "n": n, "load named": _with_load(group) / n, "interval 95": list(wilson(_with_load(group), n)),
        "any name": float(np.mean([bool(r["named"]) for _, r in group])),
    }  # fmt: skip


def _beside_row(name: str, group: Sequence[Log]) -> dict[str, Any]:
    pairs = [(scored(t["effects"], r), scored(t["effects"], r["without"])) for t, r in group]
    return {
        "beside": name, "n": len(group),
        "effect named, with the load": _mean([bool(a.other) for a, _ in pairs]),
        "effect named, without": _mean([bool(b.other) for _, b in pairs]),
        "load found": _mean([a.all_found for a, _ in pairs]),
        "false name, with the load": _mean([bool(a.false) for a, _ in pairs]),
        "false name, without": _mean([bool(b.false) for _, b in pairs]),
    }  # fmt: skip


def _names(logs: Sequence[Log]) -> list[dict[str, Any]]:
    """How many logs of each line have each name that nothing planted has, and each in place of a load."""
    rows = []
    for name, group in _grouped(logs, _line):
        every = [scored(t["effects"], r) for t, r in group]
        for how in ("false", "instead"):
            counts: dict[str, int] = {}
            for s in every:
                for k in set(getattr(s, how)):
                    counts[k] = counts.get(k, 0) + 1
            what = "false" if how == "false" else "in place of a load"
            rows += [{"logs": name, "n": len(group), "counts as": what, "name": k, "in": v}
                     for k, v in sorted(counts.items())]  # fmt: skip
    return rows


def _found_sentences(planted: Sequence[Log]) -> list[str]:
    """In how many logs one load is found, by its size."""
    one = [(t, r) for t, r in planted if t["case"] == "one"]
    parts = []
    for size in sorted({t["loads"][0]["size"] for t, _ in one}):
        every = [scored(t["effects"], r).all_found for t, r in one if t["loads"][0]["size"] == size]
        parts.append(f"{sum(every)} of {len(every)} logs at load/noise {size:g}")
    return [f"A single load is found in {names.verbose_join(parts)}"] if parts else []


def _interval_sentence(planted: Sequence[Log]) -> list[str]:
    """How often the 90 % intervals hold the truth, over all loads that are found."""
    every = [scored(t["effects"], r) for t, r in planted]
    power, energy = [x for s in every for x in s.power_covered], [x for s in every for x in s.covered]
    if not power:
        return []
    trips = f"their energy in {100.0 * np.mean(energy):.0f} % of the trips"
    return [f"90 % intervals cover the power of {sum(power)} of the {len(power)} loads found, and {trips}"]


def _false_sentences(empty: Sequence[Log], planted: Sequence[Log]) -> list[str]:
    """In how many logs with no load one is named: with nothing planted, and with another effect."""
    wrong, n = _with_load(empty), len(empty)
    out = []
    if n:
        most = f"95 % interval up to {100.0 * wilson(wrong, n)[1]:.2g} %"
        others = sum(bool(r["named"]) for _, r in empty) - wrong
        out = [f"With nothing planted a load is named in {wrong} of {n} logs ({most}), another effect in {others}"]
    others = [(t, r["without"]) for t, r in planted if "named" in r.get("without", {})]
    if others:
        out.append(f"With another effect and no load, a load is named in {_with_load(others)} of {len(others)} logs")
    return out


def _beside_sentence(rows: Sequence[dict[str, Any]]) -> list[str]:
    if not rows:
        return []
    a, b = (round(sum(r["n"] * r[k] for r in rows)) for k in ("effect named, with the load", "effect named, without"))
    n = sum(r["n"] for r in rows)
    return [f"That other effect is named in {b} of {n} logs without a load, and in {a} of {n} once a load is added"]


@styled
def _figure(run: Run, logs: Sequence[Log]) -> None:
    """How often one load is found, and the power of what is found, by its size."""
    fig = figure(8.6, 3.0)
    left, right = fig.add_subplot(1, 2, 1), fig.add_subplot(1, 2, 2)
    every = [(t, t["loads"][0]["size"], scored(t["effects"], r)) for t, r in logs]
    sizes, kinds = sorted({s for _, s, _ in every}), list(dict.fromkeys(t["kind"] for t, _, _ in every))
    for k, (mode, colour) in enumerate((("samples", AFTER), ("segments", BEFORE))):
        lines = []
        for size in sizes:
            hits = [x.all_found for t, s, x in every if t["mode"] == mode and s == size]
            if hits:
                lines.append((size * 1.02 ** (2 * k - 1), np.mean(hits), *wilson(sum(hits), len(hits))))
        if lines:
            x, y, low, high = np.array(lines).T
            left.plot(x, 100.0 * y, color=colour, marker="o", ms=4, label=mode)
            left.vlines(x, 100.0 * low, 100.0 * high, color=colour, lw=1)
    left.set_ylabel("logs in which the load is found [%]")
    left.set_ylim(-3, 103)
    right.axhspan(1.0 - POWER, 1.0 + POWER, color=GREY, alpha=0.2, lw=0)
    for kind, colour in zip(kinds, COLOURS, strict=False):
        for mode, marker in (("samples", "o"), ("segments", "s")):
            dots = [(s, p) for t, s, x in every for p in x.power if (t["kind"], t["mode"]) == (kind, mode)]
            if dots:
                beside = 1.05 ** (kinds.index(kind) - (len(kinds) - 1) / 2)
                x, y = np.array(dots).T
                label = kind if mode == "samples" else None
                right.plot(x * beside, y, marker, color=colour, ms=4, alpha=0.8, mew=0, label=label)
    right.plot([], [], "o", color=GREY, ms=4, label="circles: samples")
    right.plot([], [], "s", color=GREY, ms=4, label="squares: segments")
    right.set_ylabel("estimated power over the true one")
    for ax in (left, right):
        ax.set_xscale("log")
        ax.set_xticks(sizes, [f"{s:g}" for s in sizes])
        ax.minorticks_off()
        ax.set_xlabel("power of the load over the RMS of the noise")
        tidy(ax)
    left.set_title("Synthetic logs with one load")
    right.set_title(f"Power of the loads found; band: ± {POWER:.0%}")
    left.legend(loc="lower right", fontsize=7)
    right.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7)
    save_figure(run, fig, "switching")
