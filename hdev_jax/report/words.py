"""Numbers and sentences as a reader wants them: the answer first."""

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

from hdev_jax.diagnosis.gates.rejection import UNTRIED
from hdev_jax.diagnosis.scores.significance import least_clusters
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.problem import LAST_THIRD
from hdev_jax.report import names
from hdev_jax.report.data import ReportData, total_name
from hdev_jax.report.states import contrast, modes

__all__ = [
    "NBSP",
    "answer",
    "answer_parts",
    "count",
    "doubt",
    "known",
    "known_errors",
    "next_drives",
    "number",
    "pair",
    "percent",
    "plus_minus",
    "q_value",
    "remaining",
    "switching",
]

NBSP = "\u00a0"
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MINUS = str.maketrans("-", "−")
_DASH = "–"
MOST_SUSPECTS = 3
LEANING = 1.5  # one side of an interval over the other


def _finite(*values: Any) -> bool:
    return all(isinstance(v, Real) and math.isfinite(v) for v in values)


def _fixed(x: float, decimals: int) -> str:
    text = f"{round(x, decimals):,.{max(decimals, 0)}f}"
    if float(text.replace(",", "")) == 0:
        text = text.lstrip("-")
    return text.translate(_MINUS)


def _decimals(x: float, digits: int) -> int:
    """Decimals that show `digits` significant digits of x, none above the point."""
    return max(digits - 1 - math.floor(math.log10(abs(x))), 0) if x else 0


def _unit(text: str, unit: str | None) -> str:
    return text if unit in (None, "", "1") else f"{text}{NBSP}{unit}"


def number(x: Any, digits: int = 3, unit: str | None = "") -> str:
    """`digits` significant digits: 0.0123, 18.9, 24,000, 3.02×10⁻⁶; a dash for what is no number."""
    if not _finite(x):
        return _DASH
    if x and not 1e-4 <= abs(x) < 1e7:
        exponent = math.floor(math.log10(abs(x)))
        return _unit(f"{_fixed(x / 10.0**exponent, digits - 1)}×10{str(exponent).translate(_SUPERSCRIPT)}", unit)
    return _unit(_fixed(x, _decimals(x, digits)), unit)


def plus_minus(value: Any, sd: Any, unit: str | None = "") -> str:
    """`0.98 ± 0.03 m`: the standard deviation to one digit (two where it begins with 1 or 2), the value to match."""
    if not _finite(value):
        return _DASH
    if not _finite(sd) or sd <= 0:
        return number(value, 4, unit)
    size = max(abs(value), sd)
    exponent = math.floor(math.log10(size))
    exponent = 0 if -3 <= exponent < 7 else exponent
    value, sd = value / 10.0**exponent, sd / 10.0**exponent
    lead = sd / 10.0 ** math.floor(math.log10(sd))
    digits = 2 if lead < 2.95 else 1
    decimals = digits - 1 - math.floor(math.log10(sd))  # negative: 4,980 ± 210
    if decimals > 7:  # an sd far below the digits worth reading
        return number(value * 10.0**exponent, 6, unit)
    text = f"{_fixed(value, decimals)} ± {_fixed(sd, decimals)}"
    if exponent:
        text = f"({text})×10{str(exponent).translate(_SUPERSCRIPT)}"
    return _unit(text, unit)


def known(p: dict[str, Any]) -> str:
    """A parameter of diagnosis.json: `0.98 ± 0.03 m`; `150 W/K (90 %: 52 to 410)` where the interval is far
    from symmetric, as of a slope whose threshold rests on few trips."""
    value, low, high = (float("nan") if x is None else x for x in (p.get("value"), *p.get("interval_90", (None, None))))
    if _finite(value, low, high) and high - low > 0:
        below, above = value - low, high - value
        if max(below, above) > LEANING * min(below, above):
            return f"{number(value, 3, p.get('unit'))} (90{NBSP}%: {number(low)} to {number(high)})"
    return plus_minus(value, p.get("sd"), p.get("unit"))


def pair(before: Any, after: Any) -> tuple[str, str]:
    """Two numbers with the same decimals: two digits of the smaller one, more where they would look the same."""
    if not _finite(before, after):
        return number(before), number(after)
    sizes = [abs(x) for x in (before, after) if x]
    if not sizes:
        return "0", "0"
    if min(sizes) < 1e-4:
        return number(before), number(after)
    start = max(_decimals(min(sizes), 2), 0 if max(sizes) >= 100 else 1 if max(sizes) >= 10 else 0)
    for decimals in range(start, start + 3):
        texts = _fixed(before, decimals), _fixed(after, decimals)
        if texts[0] != texts[1]:
            return texts
    return _fixed(before, start), _fixed(after, start)


def percent(x: Any, *, signed: bool = True, decimals: int = 1) -> str:
    """`−4.1 %`, `0.0 %`; no decimals from 100 % on, a dash for null."""
    if not _finite(x):
        return _DASH
    decimals = 0 if abs(x) >= 100 else decimals
    text = _fixed(x, decimals)
    plus = "+" if signed and x > 0 and float(f"{x:.{decimals}f}") else ""
    return f"{plus}{text}{NBSP}%"


def doubt(unexplained: Mapping[str, Any]) -> str:
    """What to add to a flexible learner's share that cross-validation does not confirm; empty where it does."""
    share = unexplained.get("share_of_test_variance")
    if unexplained.get("share_borne_out", True) or share is None or not share >= SETTINGS.least_share:
        return ""
    return ", not confirmed by cross-validation on training trips"


def q_value(q: Any) -> str:
    """An FDR-adjusted p-value: `0.03`, `< 0.0001`."""
    if not _finite(q):
        return _DASH
    return f"<{NBSP}0.0001" if q < 1e-4 else f"{q:.4f}" if q < 0.001 else f"{q:.3f}" if q < 0.1 else f"{q:.2f}"


def count(n: int, word: str) -> str:
    """`1 trip`, `4 trips`, `143,000 rows`."""
    return f"{n:,} {word}{'' if n == 1 else 's'}"


def _sizes(effect: dict[str, Any]) -> str:
    """` (scale 0.98 ± 0.03)`."""
    found = [
        f"{names.parameter(name, effect['id'])} {known(p)}"
        for name, p in effect.get("parameters", {}).items()
        if p.get("sd")  # choices among a few values are in the table
    ]
    if len(found) > 3:
        return f" ({', '.join(found[:2])} and {len(found) - 2} more values)"
    return f" ({', '.join(found)})" if found else ""


def switching(effect: Mapping[str, Any]) -> str:
    """`22.2 ± 0.2 kW, on 39 % of the time at 0 °C, 5 % at 20 °C; 21 % of the energy of the test trips`."""
    state, p = effect["state"], effect["parameters"]["power_w"]
    parts = [f"{plus_minus(p['value'] / 1e3, p['sd'] / 1e3, 'kW')}, on"]
    shares = [(c, x) for c, x, *_ in state["share_on"]] or [(None, state["mean_share_on"])]
    at = [f"{100 * x:.0f}{NBSP}%{'' if c is None else f' at {c:.0f}{NBSP}°C'}" for c, x in shares]
    parts.append(f"{at[0].replace('%', '% of the time', 1)}{''.join(f', {a}' for a in at[1:])}")
    text = " ".join(parts) + "".join(f", {contrast(c)}" for c in state.get("depends_on", ()))
    share = state.get("share_of_test_energy")
    return text + (f"; {100 * share:.0f}{NBSP}% of the energy of the test trips" if _finite(share) else "")


def known_errors(summary: Mapping[str, Any], unit: str) -> list[str]:
    """A line for the errors that know measured power, beside the free run's; none where no load has a state."""
    after = summary.get("after", {})
    if "given_states" not in after:
        return []
    ahead, given = after["one_step"]["rmse"], after["given_states"]["rmse"]
    return [
        f"(free run, no measured power; one step ahead, from the rows before: {ahead:.4g} {unit}; given the states of "
        f"the loads that switch, an explanation and no prediction: {given:.4g} {unit})"
    ]


def _missing(effects: list[dict[str, Any]]) -> str:
    items = []
    for e in effects[:4]:
        twins = [names.effect(t) for t in e.get("indistinguishable_from") or []]
        alike = f" or {names.verbose_join(twins, 'or')}, which this log cannot distinguish," if twins else ""
        said = f" ({switching(e)})" if "state" in e else _sizes(e)
        items.append(f"\x02{names.effect(e['id'])}\x03{said}{modes(e)}{alike}")
    if len(effects) > 4:
        items.append(f"{len(effects) - 4} more")
    return names.verbose_join(items).rstrip(",")


def _errors(data: ReportData) -> str:
    """`the error falls from 18.9 to 7.6 Wh RMSE per row, energy error from −4.1 % to −0.2 %`."""
    before, after = data.summary["before"]["test"], data.summary["after"]["test"]
    b, a = pair(before.get("rmse"), after.get("rmse"))
    if b == a:
        text = f"the error stays at {b}{NBSP}{data.unit} RMSE per row"
    else:
        way = "falls" if after["rmse"] < before["rmse"] else "rises"
        text = f"the error {way} from {b} to {a}{NBSP}{data.unit} RMSE per row"
    if _finite(before.get("pe_percent"), after.get("pe_percent")):
        name = total_name(data)[0]
        text += f", {name} error from {percent(before['pe_percent'])} to {percent(after['pe_percent'])}"
    return text


def _where(data: ReportData) -> str:
    tested = data.summary.get("split", {}).get("test_trips", [])
    if len(tested) == 1 and tested[0].endswith(LAST_THIRD):  # a log of one trip: its end is held out
        return f"on the held-out last third of {tested[0].removesuffix(LAST_THIRD)}"
    return f"on {count(len(tested), 'held-out test trip')}"


def remaining(data: ReportData) -> str:
    """What is left, in a sentence: what it depends on and what it looks like."""
    u = data.summary.get("unexplained", {})
    on = [names.channel(c).label for c in u.get("depends_on") or []]
    text = f"it depends on {names.verbose_join(on)}" if on else "it depends on no single channel of the log"
    if signature := str(u.get("signature") or "").strip():
        text += f" – {signature.rstrip('.').removeprefix('What is left: ')}"
    return text


def _suspects(data: ReportData) -> str:
    """What only more trips could decide, and how many would be enough; empty where there is nothing."""
    able, clusters = data.summary.get("not_decidable") or [], data.summary.get("clusters") or {}
    if not able:
        return ""
    count, by_trip = clusters.get("count", 1), clusters.get("kind") == "trip"
    there = clusters.get("trips", count) if by_trip else count  # many trips share clusters
    unit = "trips" if by_trip else "stretches of driving"
    needed = [(names.effect(c["id"]), math.ceil(c["clusters_needed"] * there / count)) for c in able]
    named = [f"{name} (about {many} {unit} like these would be enough)" for name, many in needed[:MOST_SUSPECTS]]
    if len(needed) > MOST_SUSPECTS:
        named.append(f"{len(needed) - MOST_SUSPECTS} more that differ between {unit} alone")
    return f"with {there} {unit} for training this log cannot decide on {names.verbose_join(named)}"


def _too_few(summary: dict[str, Any]) -> str:
    """Why no effect could have been found, where clusters are too few; empty otherwise."""
    clusters, least = summary.get("clusters") or {}, least_clusters(1)
    if (there := clusters.get("count", least)) >= least:
        return ""
    unit = "trip" if clusters.get("kind") == "trip" else "stretch"
    have = f"1 {unit}" if there == 1 else f"{there} {unit}{'s' if unit == 'trip' else 'es'}"
    return f"with {have} of driving for training no effect can be separated from chance (at least {least} are needed)"


def _unnamed(data: ReportData) -> str:
    """Whether no effect of the library explains what is left, or one might that is not significant."""
    if suspects := _suspects(data):
        return f"could not be named with confidence ({suspects})"
    return "no effect of the library explains"


def answer_parts(data: ReportData) -> list[tuple[str, bool]]:
    """The answer as (text, bold) pieces, so that a page can escape names and mark them."""
    s = data.summary
    verdict, effects = s.get("verdict", ""), s.get("effects", [])
    if verdict == "suspect_log":
        first, *more = s["suspicions"]
        said = [x[:1].upper() + x[1:] for x in (first["evidence"], first["mend"])]
        text = f"\x02This log is suspect: {first['what']}\x03. {'. '.join(said)}."
        if more:
            text += f" Suspected too: {names.verbose_join([m['what'] for m in more])}."
        text += " No effect was searched for; --trust searches nonetheless."
    elif effects:
        text = f"The declared model misses {_missing(effects)}: {_where(data)} {_errors(data)}."
        if "unexplained" in verdict:
            text += f" \x02Something more\x03 is missing that {_unnamed(data)}: {remaining(data)}."
    elif "unexplained" in verdict:
        share = s.get("unexplained", {}).get("share_of_test_variance")
        text = f"\x02Something is missing that {_unnamed(data)}\x03: {remaining(data)}."
        if _finite(share):
            text += (
                f" A flexible learner still predicts {percent(100 * share, signed=False, decimals=0)} of its variance"
                f"{doubt(s['unexplained'])}."
            )
    else:
        tried = sum(c.get("kind") not in UNTRIED for c in s.get("candidates", []))
        test = s["after"]["test"]
        if suspects := _suspects(data) or _too_few(s):
            text = f"\x02Not decidable on this log\x03: {suspects}; "
        elif not tried:
            text = (
                "\x02Nothing was tried\x03: every requested effect is declared in the sheet already, or cannot be seen "
                "in this log; "
            )
        else:
            text = (
                f"\x02No missing effect found\x03: none of the {count(tried, 'effect')} tried explains what is left; "
            )
        text += (
            f"{_where(data)} the error is {pair(test.get('rmse'), test.get('rmse'))[1]}{NBSP}{data.unit} RMSE per row"
        )
        if _finite(test.get("pe_percent")):
            text += f", {total_name(data)[0]} error {percent(test['pe_percent'])}"
        text += "."
    pieces = []
    for i, piece in enumerate(text.replace("\x03", "\x02").split("\x02")):
        if piece:
            pieces.append((piece, i % 2 == 1))
    return pieces


def next_drives(summary: dict[str, Any]) -> list[str]:
    """One sentence for each drive that separates a found effect from its rival, the shortest first."""
    out = []
    for d in summary.get("next_drives", []):
        pair = f"{names.effect(d['effect'])} from {names.effect(d['rival'])}"
        if not d["drive"]:
            how = next((e["separated_by"] for e in summary["effects"] if e["id"] == d["effect"]), "")
            out.append(f"no simulated drive separates {pair} in reasonable time{f'; try: {how}' if how else ''}")
            continue
        length = f"{number(d['kilometres'], 2)} km, " if d["kilometres"] > 0 else ""
        out.append(f"to separate {pair}: {d['drive']} ({length}{number(d['hours'], 2)} h)")
    return out


def answer(data: ReportData) -> str:
    """The answer in one sentence, as plain text."""
    return "".join(text for text, _ in answer_parts(data))
