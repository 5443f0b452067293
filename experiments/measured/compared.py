"""What the diagnosis concludes without a known channel and with it: a table and sentences from diagnosis.json.

Every sentence follows from numbers and names in the two results; where they are the same, it says so.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from experiments.measured import figures
from experiments.measured.tables import Runs, found_ids, named, nearest, signature, size_rows, table
from experiments.measured.withheld import WITHHELD
from hdev_jax.report import names, words

__all__ = [
    "MOVED",
    "UNCHANGED",
    "Change",
    "changes",
    "fold_and_what",
    "held_table",
    "moved_sizes",
    "new_names",
    "sentences",
    "withheld",
]

MOVED = 2.0  # standard deviations from which on a size is said to have moved
UNCHANGED = 0.005  # share of the RMSE below which it is said to be the same
Result = Mapping[str, Any]


def fold_and_what(name: str) -> tuple[str, str]:
    """`ztbus_1_no_steering` -> fold `1` and `steering`."""
    run, _, what = name.partition("_no_")
    return run.removeprefix("ztbus_"), what


def withheld(folds: Runs, held: Runs, rest: Mapping[str, Any], picture: str) -> tuple[list[str], dict[str, bytes]]:
    """The section of the page and its figure: each run without a channel beside the fold that has every channel."""
    lines = [
        "## A channel withheld and given back", "",
        "Each run repeats a fold of ZTBus with an adapter that leaves out one channel and whatever is made from the",
        "same source. A *new name* is an effect that no fold of ZTBus with every channel finds.", "",
        f"![ZTBus: error and effects found with and without each channel]({picture})", "",
    ]  # fmt: skip
    runs: dict[str, Result] = {}
    pairs: dict[str, str] = {}
    for name, r in held.items():
        fold, what = fold_and_what(name)
        every, label = f"fold {fold}: every channel", f"fold {fold}: no {what}"
        runs[every], runs[label], pairs[label] = folds[fold], r, every
        words_ = WITHHELD[what][0]
        others = {k: v for k, v in folds.items() if k != fold}
        lines += [f"### {words_.capitalize()} withheld, fold {fold}", "", _same(r, folds[fold], rest.get(what, {})), ""]
        lines += [*held_table(r, folds[fold], "kW"), ""]
        lines += [f"- {said}" for said in sentences(words_, r, folds[fold], others)] + [""]
    runs = dict(sorted(runs.items(), key=lambda kv: (kv[0].partition(":")[0], kv[0] in pairs)))
    title = "ZTBus (measured): error with and without"
    return lines, {picture.rpartition("/")[2]: figures.withheld(runs, pairs, title, "kW")}


def _same(without: Result, full: Result, rest: Mapping[str, Any]) -> str:
    """What the two runs have in common, as their configurations and the two logs read say."""
    ran, held = full.get("ran") or {}, without.get("ran") or {}
    kept = {"vehicle_sha256": "sheet", "split": "split", "seed": "seed", "fdr": "level of false discoveries"}
    a, b = ({**r, "split": d["split"]} for r, d in ((ran, full), (held, without)))
    kept = {key: words_ for key, words_ in kept.items() if key in a and key in b}
    differs = [words_ for key, words_ in kept.items() if a[key] != b[key]]
    text = f"**Not the same in both: {', '.join(differs)}.**" if differs else f"The same: {', '.join(kept.values())}."
    if rest:
        gone = ", ".join(f"`{c}`" for c in rest["gone"])
        text = (
            f"Gone: {gone}. The other {len(rest['same'])} columns are equal in all {rest['rows']:,} rows of "
            f"{rest['trips']} missions, and so are the {rest['ledger']} entries of the ledger that are not of {gone}. "
        ) + text
    return text


def held_table(without: Result, full: Result, unit: str) -> list[str]:
    """The two conclusions side by side."""
    rows = []
    for words_, say in (
        ("found", lambda r: ", ".join(f"`{i}`" for i in sorted(found_ids(r))) or "nothing"),
        (f"test RMSE before [{unit}]", lambda r: f"{r['before']['test']['rmse']:.2f}"),
        (f"test RMSE after [{unit}]", lambda r: f"{r['after']['test']['rmse']:.2f}"),
        ("energy error of all test trips", lambda r: words.percent(r["after"]["test"]["pe_percent"])),
        ("parameters fitted", lambda r: str(r["parameters_fitted"])),
        ("verdict", lambda r: r["verdict"].replace("_", " ")),
        ("share of the rest that a flexible learner predicts", _share),
        ("the rest depends on", lambda r: ", ".join(f"`{c}`" for c in r["unexplained"]["depends_on"]) or "–"),
        ("signature of the rest", lambda r: signature(r["unexplained"])),
        ("best rejected candidate", nearest),
    ):
        rows.append([words_, say(without), say(full)])
    return table(["", "without", "with"], rows)


def sentences(words_: str, without: Result, full: Result, others: Runs) -> list[str]:
    """What changed, a sentence an entry. `others` are the runs on other training sets with every channel."""
    change = changes(without, full)
    needing = _untried(without, full)
    out = [_reads(words_, needing)]
    if change.lost or change.gained:
        parts = [f"no longer finds {named(change.lost)}"] * bool(change.lost)
        parts += [f"finds {named(change.gained)} besides"] * bool(change.gained)
        out.append(f"Without the {words_} the diagnosis {' and '.join(parts)}.")
    else:
        out.append(f"It finds the same effects without the {words_} as with it.")
    out += [
        f"{_first(a)} is called `{b}` with it: one class, which the log cannot distinguish." for a, b in change.renamed
    ]
    out += _stand_ins(change, needing, without, full, others)
    return [*out, *_moves(words_, without, full), _error(words_, without, full), _rest(without, full)]


class Change(NamedTuple):
    """Effects lost and gained by withholding; those only called by another name of their class stand apart."""

    lost: list[str]
    gained: list[str]
    renamed: list[tuple[str, str]]  # without, with


def changes(without: Result, full: Result) -> Change:
    """Compare what two runs found."""
    lost = [i for i in found_ids(full) if i not in found_ids(without)]
    gained = [i for i in found_ids(without) if i not in found_ids(full)]
    alike = {
        frozenset((e["id"], t)) for r in (without, full) for e in r["effects"] for t in e["indistinguishable_from"]
    }
    renamed = []
    for g in list(gained):
        if (was := next((i for i in lost if frozenset((g, i)) in alike), None)) is not None:
            renamed.append((g, was))
            gained.remove(g)
            lost.remove(was)
    return Change(lost, gained, renamed)


def new_names(without: Result, full: Result, others: Runs) -> list[str]:
    """Effects that only the run without the channel finds: no run with every channel does, nor calls it a twin."""
    known = {i for r in (full, *others.values()) for i in found_ids(r)}
    known |= {t for e in full["effects"] for t in e["indistinguishable_from"]}
    return [i for i in changes(without, full).gained if i not in known]


def moved_sizes(without: Result, full: Result) -> list[tuple[str, float, float, str]]:
    """Sizes that both runs find and that differ: (path, without, with, unit). The rows are the same in both, so the
    larger of the two standard deviations is the measure, not that of a difference of independent numbers."""
    out = []
    for row in size_rows({"with": full, "without": without}):
        if len(row.cells) == 2:
            (path, b, sd_b), (_, a, sd_a) = row.cells["with"], row.cells["without"]
            if abs(a - b) > MOVED * max(sd_a, sd_b):
                out.append((path, a, b, row.unit))
    return out


def _untried(without: Result, full: Result) -> list[str]:
    """The effects that the channel alone makes possible, as the diagnosis said."""

    def lacking(r: Result) -> set[str]:
        return {c["id"] for c in r["candidates"] if c["why_not"].startswith("not tried: needs a channel")}

    return sorted(lacking(without) - lacking(full))


def _reads(words_: str, needing: Sequence[str]) -> str:
    if needing:
        return f"Without the {words_} the diagnosis cannot try {named(needing)}."
    return (
        f"No effect that the diagnosis tries on this target reads the {words_}: only the search for a formula and the "
        "flexible learner do. The run is a control."
    )


def _stand_ins(change: Change, needing: Sequence[str], without: Result, full: Result, others: Runs) -> list[str]:
    """Whether the withheld cause is replaced by a name that the full log does not confirm."""
    new = new_names(without, full, others)
    out = []
    for i in change.gained:
        e = next(e for e in without["effects"] if e["id"] == i)
        b, a = words.pair(e["test_rmse_before"], e["test_rmse_after"])
        where = [k for k, r in others.items() if i in found_ids(r)]
        if i in new:
            kind = "a **new name**: no fold with every channel finds it"
        elif where:
            kind = f"no new name: fold {names.verbose_join(where)} finds it with every channel"
        else:
            kind = "no new name: with every channel it is one class with what is found"
        out.append(f"{_first(i)} is {kind}. When it comes in, the test RMSE goes from {b} to {a} kW.")
    cause = [i for i in change.lost if i in needing]
    if not cause:
        text = "With every channel this fold finds no effect that needs the channel, so there was no cause to replace."
        return [*out, text] if needing else out
    if new:
        return [
            *out,
            f"In place of {named(cause)} it names what the full log does not confirm: {named(new)}.",
        ]
    return [*out, f"No false name takes the place of {named(cause)}."]


def _moves(words_: str, without: Result, full: Result) -> list[str]:
    """The sizes that withholding moves; where no name took the cause's place, this is where it went, if anywhere."""
    moved = moved_sizes(without, full)
    if not moved:
        return [f"No size that both find moves by more than {MOVED:.0f} standard deviations."]
    said = [f"`{p}` {words.number(a, 3)} without and {words.number(b, 3, unit)} with" for p, a, b, unit in moved]
    return [f"Sizes that move by more than {MOVED:.0f} standard deviations: {'; '.join(said)}."]


def _first(id_: str) -> str:
    text = named([id_])
    return text[0].upper() + text[1:]


def _error(words_: str, without: Result, full: Result) -> str:
    a, b = without["after"]["test"]["rmse"], full["after"]["test"]["rmse"]
    trips = full["after"]["test_by_trip"]
    better = sum(m["rmse"] < without["after"]["test_by_trip"][k]["rmse"] for k, m in trips.items())
    if abs(a - b) < UNCHANGED * a:
        return f"Giving the {words_} back leaves the test RMSE as it is ({a:.2f} and {b:.2f} kW)."
    way = "lowers" if b < a else "raises"
    return (
        f"Giving the {words_} back {way} the test RMSE from {a:.2f} to {b:.2f} kW "
        f"({words.percent(100 * (b / a - 1))}); it is lower on {better} of {len(trips)} missions."
    )


def _share(r: Result) -> str:
    u = r["unexplained"]
    return words.percent(100 * u["share_of_test_variance"], signed=False) + words.doubt(u)


def _rest(without: Result, full: Result) -> str:
    """What stays unexplained, where that differs."""
    a, b = without["unexplained"], full["unexplained"]
    if a["significant"] and not b["significant"]:
        text = f"Without it the diagnosis reports unexplained structure ({signature(a)}), with it none."
    elif b["significant"] and not a["significant"]:
        text = f"With it the diagnosis reports unexplained structure ({signature(b)}), without it none."
    elif signature(a) == signature(b) and a["depends_on"] == b["depends_on"]:
        text = "What stays unexplained is the same with and without."
    else:
        text = f"Unexplained, without: {signature(a)}; with: {signature(b)}."
    if _share(without) != _share(full):
        text += f" A flexible learner predicts {_share(without)} of the rest without, {_share(full)} with."
    return text
