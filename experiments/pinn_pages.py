"""Pages of the networks' studies: the table with figures 6 and 7, error against the amount of data, loss weights."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import NullFormatter

from experiments.figures import save_figure, styled
from experiments.pinn_scores import QUANTILES, pooled
from experiments.tables import write_tables
from hdev_jax.errors import InputError
from hdev_jax.learn.pinn_fit import PAPER_WEIGHTS
from hdev_jax.report.canvas import AFTER, BEFORE, GREY, figure, tidy
from hdev_jax.rundir import Run

__all__ = ["coefficients", "grid", "shares", "table"]

Results = Sequence[tuple[dict[str, Any], dict[str, Any]]]
MODELS = ("A", "B", "C", "D")
WAYS = {"tabular": "physics, tables", "bayesian": "physics, Bayesian coefficients",
        "kernel": "physics, effects by closed form", "diagnosed": "physics, as diagnosed"}  # fmt: skip
PAPER_MODEL = "paper"  # the network as printed, and ours, among the models of a config
OURS = "ours"
GIVEN = ("ours and the closed form are given the list of effects that the fleet hides, limits apart; what a diagnosis "
         "names by itself: `--set 'diagnosed=[\"A\"]'`")  # fmt: skip
# Names of the papers' rows in metrics.json.
NAMED = {PAPER_MODEL: "PINN", f"{PAPER_MODEL}, its physics alone": "physics_predicted",
         WAYS["tabular"]: "physics_tabular"}  # fmt: skip


def _gathered(results: Results) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Scores by (way of predicting, use), over vehicles, folds and seeds."""
    out: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for task, result in results:
        name = task["name"]
        for key, found in result.items():
            if key not in (*WAYS, "network", "physics", "lightgbm"):
                continue
            if task["model"]["kind"] == "vehicles":
                way = WAYS[key]
            else:
                way = f"{name}, its physics alone" if key == "physics" else name
            for use, scored in found.items():
                out.setdefault((way, use), []).append(scored)
    return out


def _distinct(results: Results) -> dict[tuple[str, str], tuple[int, int]]:
    """Rows and trips by (way, use) without those that another seed has, too: of each fold and vehicle once."""
    once: dict[tuple[str, str], dict[tuple[Any, ...], tuple[int, int]]] = {}
    for task, result in results:
        of = (task["data"].get("fold"), task.get("vehicle"))
        for key, (scored,) in _gathered([(task, result)]).items():
            once.setdefault(key, {})[of] = (scored["rows"], scored["trips"])
    return {key: (sum(n for n, _ in of.values()), sum(t for _, t in of.values())) for key, of in once.items()}


def _trainings(results: Results) -> dict[str, tuple[int, int]]:
    """By model that is trained: how many trainings there are, and how many of them diverged."""
    out: dict[str, tuple[int, int]] = {}
    for task, result in results:
        if task["model"]["kind"] != "vehicles":
            n, lost = out.get(task["name"], (0, 0))
            out[task["name"]] = (n + 1, lost + ("diverged" in result))
    return out


def _line(name: str, use: str, found: list[dict[str, Any]], distinct: tuple[int, int]) -> dict[str, Any]:
    """A row of the table; of several seeds, errors are of all of them together."""
    p = pooled(found)
    return {
        "model": name, "rows of": use, "n": distinct[0], "trips": distinct[1], "RMSE [Wh]": p["rmse_wh"],
        "PE [%]": p["pe_percent"], "PE of a trip, mean [%]": p["trip_pe_mean"],
        "|PE| of a trip, median [%]": p["trip_pe_median"],
        "c_rr error, median of vehicles [%]": p.get("c_rr_error_percent"),
        "C_d·A error, median of vehicles [%]": p.get("cda_m2_error_percent"), "in 90 %": p.get("inside_90"),
    }  # fmt: skip


def table(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Every model on the same rows, the paper's numbers beside those that it prints."""
    gathered = _gathered(results)
    data = "measured (ZTBus)" if config.data == "ztbus" else "synthetic fleet"
    distinct, trainings = _distinct(results), _trainings(results)
    rows, lines = [], []
    for (way, use), found in gathered.items():
        p = pooled(found)
        line = _line(way, use, found, distinct[way, use])
        name = NAMED.get(way, way)
        paper = config.paper.get(name) if use == "test" else None
        lines.append({"data": data, **line, "paper RMSE": (paper or {}).get("rmse"),
                      "paper PE": (paper or {}).get("pe")})  # fmt: skip
        mine = {"rmse": p.pop("rmse_wh"), "pe": p.pop("pe_percent"), **p}
        rows.append({"name": name if use == "test" else f"{name} ({use})", "paper": paper, "ours": mine})
    for model, (n, lost) in trainings.items():
        if n == lost:
            name, said = NAMED.get(model, model), f"diverged, {lost} of {n} trainings"
            lines.append({"data": data, "model": f"{model}: {said}", "rows of": "test", "n": 0})
            rows.append({"name": name, "paper": config.paper.get(name), "ours": None, "reason": said})
    write_tables(run, "table", lines, config.caption)
    at_bound = _at_bound(results)
    if at_bound:
        bound = [{"model": n, "c_rr": 100 * b["c_rr"], "C_d·A": 100 * b["cda_m2"]} for n, b in at_bound.items()]
        caption = "Share of predictions within 1 % of the range of a bound [%], test rows of all trainings"
        write_tables(run, "bounds", bound, caption)
    effects = _effects(results)
    if effects:
        write_tables(run, "effects", effects, "What the diagnosis found, by vehicle: how often, and its median size")
    _bars(run, gathered, data)
    used = (r["effects"] for t, r in results if t["name"] == OURS and "effects" in r)
    return {
        "artefact": config.artefact, "data": data, "synthetic": config.data == "fleet", "rows": rows,
        "better_than_paper": 0, "of": 0, "headline": "rmse", "missed": _missed(config, gathered, at_bound),
        "notes": [
            "the paper's numbers are of its own, private fleet; ours are of "
            + ("measured buses" if config.data == "ztbus" else "a synthetic one, whose noise they share by no means"),
            "training, validation and test by route" if config.data == "fleet" else "missions held out, by fold",
            "features without units hold the energy by the calibrated kernel: only a black box with no kernel, where "
            "there is one, is without physics",
            "errors of coefficients: median of predicted over true, less one; spray counts as air",
            *_lost(results),
            *([GIVEN] if config.data == "fleet" else []),
            "effects in ours: " + ", ".join(next(used, ["none"])),
        ],
    }  # fmt: skip


def coefficients(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Figures 6 and 7: quantiles of a coefficient by truck model, the truth beside."""
    quantiles, name = _quantiles(results), config.coefficient
    _boxes(run, quantiles, name, {"c_rr": "c_rr", "cda_m2": "C_d·A [m²]"}[name])
    rows, lines = [], []
    for way, found in quantiles.items():
        for m in MODELS:
            if way not in ("tables", PAPER_MODEL, OURS) or m not in found:
                continue
            q, t = found[m][name], found[m][f"{name}_true"]
            lines.append({"model": m, "by": way, **{f"{k} %": x for k, x in zip(QUANTILES, q, strict=True)},
                          "error of the median [%]": 100 * found[m][f"{name}_error"]})  # fmt: skip
            rows.append({"name": f"{m}, {way}", "paper": None, "ours": {"median": q[2], "true_median": t[2]}})
    write_tables(run, "coefficients", lines, config.caption)
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "rows": rows,
        "better_than_paper": 0, "of": 0, "missed": [],
        "notes": ["the paper prints no numbers beside its boxes, and could not know the truth", *_lost(results)],
    }  # fmt: skip


def _lost(results: Results) -> list[str]:
    """How many trainings diverged, where any did."""
    lost = [f"{model} {k} of {n}" for model, (n, k) in _trainings(results).items() if k]
    return [f"trainings that diverged, and are in no error: {', '.join(lost)}"] if lost else []


def _missed(config: Any, gathered: Mapping[Any, list[dict[str, Any]]], at_bound: Mapping[str, Any]) -> list[str]:
    """What ours is meant to reach, and does not."""
    test = {way: pooled(f) for (way, use), f in gathered.items() if use == "test"}
    out = []
    if {PAPER_MODEL, f"{PAPER_MODEL}, its physics alone", WAYS["tabular"]} <= set(test) and config.data == "fleet":
        order = [test[k]["rmse_wh"] for k in (PAPER_MODEL, f"{PAPER_MODEL}, its physics alone", WAYS["tabular"])]
        if not order[0] < order[1] < order[2]:
            out.append("RMSE is not in the order of table 2: " + ", ".join(f"{x:.2f}" for x in order))
    if OURS in test:
        mine = test[OURS]
        limit = 1.0 if config.data == "fleet" else 3.0
        pe = mine["pe_percent"] if config.data == "fleet" else mine["trip_pe_mean"]
        if abs(pe) > limit:
            out.append(f"ours: PE {pe:+.2f} %, ±{limit:g} wanted")
        if PAPER_MODEL in test and mine["rmse_wh"] > 0.9 * test[PAPER_MODEL]["rmse_wh"]:
            out.append(f"ours: RMSE {mine['rmse_wh'] / test[PAPER_MODEL]['rmse_wh']:.2f} of the paper's, 0.9 wanted")
        best = min(test, key=lambda k: test[k]["rmse_wh"])
        if config.data == "ztbus" and best != OURS:
            out.append(f"ours: RMSE {mine['rmse_wh']:.1f} Wh, the best is {best} with {test[best]['rmse_wh']:.1f}")
        for k in ("c_rr", "cda_m2"):
            if mine.get(f"{k}_error_percent", 0.0) > 5.0:
                out.append(f"ours: {k} off by {mine[f'{k}_error_percent']:.1f} % in the median of vehicles, 5 wanted")
            if mine.get(f"{k}_error_worst", 0.0) > 5.0:
                out.append(f"ours: {k} off by {mine[f'{k}_error_worst']:.1f} % in the worst vehicle, 5 wanted")
    out += [f"{n}: {100 * max(b.values()):.1f} % at a bound" for n, b in at_bound.items() if n == OURS]
    return out


def _at_bound(results: Results) -> dict[str, dict[str, float]]:
    """By model, the shares of predictions at a bound of each coefficient, over all its seeds and folds."""
    found: dict[str, list[dict[str, int]]] = {}
    for task, result in results:
        if "at_bound" in result:
            found.setdefault(task["name"], []).append(result["at_bound"])
    return {
        name: {k: sum(b[k] for b in every) / sum(b["rows"] for b in every) for k in ("c_rr", "cda_m2")}
        for name, every in found.items()
    }


def _effects(results: Results) -> list[dict[str, Any]]:
    """Effects by how many vehicles' diagnoses named them, with medians of their parameters."""
    found = [r["found"] for _, r in results if "found" in r]
    out = []
    for id in sorted({e for f in found for e in f}, key=lambda e: -sum(e in f for f in found)):
        having = [f[id] for f in found if id in f]
        names = sorted({k for h in having for k in h})
        values = {k: float(np.median([h[k] for h in having if k in h])) for k in names}
        text = ", ".join(f"{k} {x:.3g}" for k, x in values.items())
        out.append({"effect": id, "vehicles": f"{len(having)} of {len(found)}", "median": text})
    return out


def _quantiles(results: Results) -> dict[str, dict[str, Any]]:
    """Quantiles of coefficients by network and vehicle, of the first seed."""
    out: dict[str, dict[str, Any]] = {}
    for task, result in results:
        if task["model"]["kind"] == "vehicles":
            tab = result.get("tabular", {}).get("test", {}).get("coefficients", {})
            for id, c in tab.items():
                out.setdefault("tables", {})[id] = c
        elif "network" in result:
            into = out.setdefault(task["name"], {})
            for id, c in result["network"].get("test", {}).get("coefficients", {}).items():
                into.setdefault(id, c)
    return out


def _spread(ax: Any, at: float, q: Sequence[float], colour: str, label: str | None) -> None:
    """A box of five quantiles."""
    box = {"whislo": q[0], "q1": q[1], "med": q[2], "q3": q[3], "whishi": q[4]}
    drawn = ax.bxp([box], positions=[at], widths=0.2, showfliers=False, patch_artist=True, manage_ticks=False)
    drawn["boxes"][0].set(facecolor=colour, alpha=0.6)
    drawn["medians"][0].set(color="black")
    if label:
        ax.plot([], [], color=colour, linewidth=5, alpha=0.6, label=label)


@styled
def _boxes(run: Run, quantiles: Mapping[str, Any], name: str, label: str) -> None:
    """Figures 6 and 7: the prediction by truck model, and what the paper could not know, the truth."""
    ways = [k for k in (PAPER_MODEL, OURS) if k in quantiles]
    if not ways:
        raise InputError("every training of the networks diverged; lower the rate")
    models = [m for m in MODELS if all(m in quantiles[k] for k in ways)]
    fig = figure(8.0, 3.4)
    ax = fig.add_subplot()
    for i, m in enumerate(models):
        for j, way in enumerate(ways):
            c = quantiles[way][m]
            _spread(ax, i + 0.25 * (j - 1), c[name], (BEFORE, AFTER)[way == OURS], way if i == 0 else None)
        _spread(ax, i + 0.25, quantiles[ways[0]][m][f"{name}_true"], GREY, "truth (synthetic)" if i == 0 else None)
        table = quantiles.get("tables", {}).get(m)
        if table:
            ax.plot([i - 0.4, i + 0.4], [table[name][2]] * 2, color="#c03030", linewidth=1.4,
                    label="table" if i == 0 else None)  # fmt: skip
    ax.set_xticks(range(len(models)), [f"model {m}" for m in models])
    ax.set_ylabel(label)
    ax.set_ylim(bottom=0)
    ax.set_title(f"{label} on test routes of the synthetic fleet: 5, 25, 50, 75, 95 %")
    ax.legend(ncols=4, loc="upper left")
    ax.set_ylim(top=1.25 * ax.get_ylim()[1])
    tidy(ax)
    save_figure(run, fig, name)


@styled
def _bars(run: Run, gathered: Mapping[tuple[str, str], list[dict[str, Any]]], data: str) -> None:
    """RMSE and PE of every model on test rows."""
    test = [(way, pooled(f)) for (way, use), f in gathered.items() if use == "test"]
    fig = figure(9.0, 0.9 + 0.28 * len(test))
    for k, (key, label) in enumerate((("rmse_wh", "RMSE [Wh]"), ("pe_percent", "PE of all trips [%]"))):
        ax = fig.add_subplot(1, 2, k + 1)
        colours = [AFTER if way == OURS else BEFORE if way == PAPER_MODEL else GREY for way, _ in test]
        ax.barh(range(len(test)), [p[key] for _, p in test], color=colours, alpha=0.75)
        ax.set_yticks(range(len(test)), [way for way, _ in test] if k == 0 else [])
        ax.invert_yaxis()
        ax.set_xlabel(label)
        ax.axvline(0, color="black", linewidth=0.6)
        tidy(ax)
    fig.suptitle(f"Test rows, {data}")
    save_figure(run, fig, "models")


def shares(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Error by the amount of training data: a learning curve of each model, with the spread over seeds."""
    lines, curves = [], {}
    for share in sorted({t["data"]["share"] for t, _ in results}):
        part = [(t, r) for t, r in results if t["data"]["share"] == share]
        for (way, use), found in _gathered(part).items():
            seeds = [pooled([f])["rmse_wh"] for f in found] if way in config.models else [pooled(found)["rmse_wh"]]
            curves.setdefault((way, use), []).append((share, seeds))
            lines.append({"share of training routes": share, "model": way, "rows of": use, "seeds": len(seeds),
                          "RMSE [Wh]": float(np.median(seeds)), "least": min(seeds), "most": max(seeds),
                          "PE [%]": pooled(found)["pe_percent"]})  # fmt: skip
    write_tables(run, "shares", lines, config.caption)
    _curves(run, curves)
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "better_than_paper": 0, "of": 0,
        "rows": [{"name": f"{x['model']}, {x['share of training routes']:g}, {x['rows of']}", "paper": None,
                  "ours": {"rmse_wh": x["RMSE [Wh]"], "pe_percent": x["PE [%]"]}} for x in lines],
        "missed": _against_black_boxes(config, curves),
        "notes": ["the line is the median over seeds, the band all", *_lost(results)],
    }  # fmt: skip


def _against_black_boxes(config: Any, curves: Mapping[tuple[str, str], list[tuple[float, list[float]]]]) -> list[str]:
    """Where ours is not 30 % better than the network without physics or LightGBM, at the least data and on unseen."""
    out = []
    if (OURS, "test") not in curves:
        return out
    for use in ("test", "unseen"):
        for other in ("network without physics", "lightgbm"):
            if (other, use) not in curves or (OURS, use) not in curves:
                continue
            others, mine_at = dict(curves[other, use]), dict(curves[OURS, use])
            for share in sorted(others)[: 1 if use == "test" else None]:
                if share not in mine_at:
                    out.append(f"{share:g} of the routes, {use}: ours has no result")
                    continue
                ratio = float(np.median(mine_at[share]) / np.median(others[share]))
                if ratio > 0.7:
                    out.append(f"{share:g} of the routes, {use}: RMSE {ratio:.2f} of {other}'s, 0.7 wanted")
    return out


@styled
def _curves(run: Run, curves: Mapping[tuple[str, str], list[tuple[float, list[float]]]]) -> None:
    uses = [u for u in ("test", "unseen") if any(k[1] == u for k in curves)]
    fig = figure(4.6 * len(uses), 3.6)
    for i, use in enumerate(uses):
        ax = fig.add_subplot(1, len(uses), i + 1)
        for way in dict.fromkeys(k[0] for k in curves if k[1] == use and "alone" not in k[0]):
            points = curves[way, use]
            x = [100 * s for s, _ in points]
            drawn = ax.plot(x, [np.median(v) for _, v in points], "o-", markersize=3, label=way)
            ax.fill_between(x, [min(v) for _, v in points], [max(v) for _, v in points], alpha=0.2,
                            color=drawn[0].get_color(), linewidth=0)  # fmt: skip
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xlabel("training routes used [%]")
        ax.set_ylabel("RMSE [Wh]")
        # plain numbers: the project's look does not set powers of ten
        ax.set_xticks(sorted({100 * s for k, points in curves.items() if k[1] == use for s, _ in points}))
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter(lambda x, _: f"{x:g}")
            axis.set_minor_formatter(NullFormatter())
        ax.set_yticks([y for y in (5, 10, 20, 50, 100, 200) if ax.get_ylim()[0] <= y <= ax.get_ylim()[1]])
        ax.set_title({"test": "Test routes", "unseen": "Never trained on"}[use] + " (synthetic)")
        ax.legend(fontsize=7)
        tidy(ax)
    save_figure(run, fig, "shares")


def grid(config: Any, results: Results, run: Run) -> dict[str, Any]:
    """Heat maps of the error over pairs of loss weights, the third as printed; medians over seeds."""
    found: dict[tuple[float, ...], list[float]] = {}
    for task, result in results:
        if "network" in result:
            found.setdefault(tuple(task["weights"]), []).append(pooled([result["network"]["test"]])["rmse_wh"])
    if not found:
        raise InputError("every training of the grid diverged; lower the rate")
    lines = [{"λ₁": w[0], "λ₂": w[1], "λ₃": w[2], "seeds": len(x), "RMSE [Wh]": float(np.median(x)), "least": min(x),
              "most": max(x)} for w, x in sorted(found.items())]  # fmt: skip
    write_tables(run, "grid", lines, config.caption)
    _maps(run, {w: float(np.median(x)) for w, x in found.items()})
    best = min(lines, key=lambda x: x["RMSE [Wh]"])
    lost = sum("diverged" in r for _, r in results)
    where = f"{best['λ₁']:g}, {best['λ₂']:g}, {best['λ₃']:g}"
    note = f"{lost} of {len(results)} diverged; best at λ = {where}: {best['RMSE [Wh]']:.2f} Wh"
    return {
        "artefact": config.artefact, "data": "synthetic fleet", "synthetic": True, "better_than_paper": 0, "of": 0,
        "rows": [{"name": f"{x['λ₁']:g}, {x['λ₂']:g}, {x['λ₃']:g}", "paper": None, "ours": {"rmse_wh": x["RMSE [Wh]"]}}
                 for x in lines],
        "missed": [], "notes": [note, "chosen by nobody: the paper's weights stand in table 2"],
    }  # fmt: skip


@styled
def _maps(run: Run, found: Mapping[tuple[float, ...], float]) -> None:
    pairs = [(i, j) for i, j in ((1, 2), (0, 1), (0, 2))
             if len({(w[i], w[j]) for w in found if _held(w, i, j)}) > 3]  # fmt: skip
    fig = figure(3.6 * max(len(pairs), 1), 3.2)
    low, high = min(found.values()), np.percentile(list(found.values()), 95)
    for k, (i, j) in enumerate(pairs):
        part = {(w[i], w[j]): x for w, x in found.items() if _held(w, i, j)}
        rows, columns = sorted({a for a, _ in part}), sorted({b for _, b in part})
        values = np.array([[part.get((a, b), np.nan) for b in columns] for a in rows])
        ax = fig.add_subplot(1, len(pairs), k + 1)
        ax.imshow(values, origin="lower", vmin=low, vmax=high, cmap="viridis_r", aspect="auto")
        for a in range(len(rows)):
            for b in range(len(columns)):
                ax.text(b, a, f"{values[a, b]:.1f}", ha="center", va="center", fontsize=6)
        ax.set_xticks(range(len(columns)), [f"{x:g}" for x in columns])
        ax.set_yticks(range(len(rows)), [f"{x:g}" for x in rows])
        ax.set_xlabel(f"λ{'₁₂₃'[j]}")
        ax.set_ylabel(f"λ{'₁₂₃'[i]}")
        third = ({0, 1, 2} - {i, j}).pop()
        ax.set_title(f"RMSE [Wh], λ{'₁₂₃'[third]} = {PAPER_WEIGHTS[third]:g}")
    save_figure(run, fig, "grid")


def _held(w: tuple[float, ...], i: int, j: int) -> bool:
    """Whether the weight that is in neither axis is the printed one."""
    return all(w[k] == PAPER_WEIGHTS[k] for k in range(3) if k not in (i, j))
