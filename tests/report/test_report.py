"""The report: it opens offline, says the right thing for each verdict, and takes whatever a log may bring."""

import ast
import html
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

from hdev_jax.problem import metrics as errors
from hdev_jax.report import data as report_data
from hdev_jax.report import names as shown
from hdev_jax.report import page, statistics, words
from hdev_jax.report.data import ReportData
from hdev_jax.report.figures import before_after
from hdev_jax.report.page import write_calibration_report, write_report
from hdev_jax.report.residuals import panels
from hdev_jax.report.words import answer

VERDICTS = ("effects_found", "nothing_missing", "unexplained_structure", "effects_found_and_unexplained_structure")
VOID = {"meta", "img", "br", "link", "hr", "input"}


def metrics(predicted, measured):
    e = predicted - measured
    gross = np.abs(measured).sum()
    return {
        "rmse": float(np.sqrt(np.mean(e**2))),
        "mse": float(np.mean(e**2)),
        "bias": float(e.mean()),
        "pe_percent": float(100 * e.sum() / measured.sum()) if abs(measured.sum()) > 0.05 * gross else None,
        "fit_percent": float(100 * (1 - np.sqrt(np.mean(e**2)) / measured.std())),
        "n": len(e),
    }


def fake(verdict="effects_found", trips=6, rows=120, names=None, synthetic=True, **channels) -> ReportData:
    """A log in which wind is missing, and the diagnosis that goes with the verdict."""
    rng = np.random.default_rng(0)
    n = trips * rows
    trip = np.repeat(np.arange(trips), rows)
    duration = rng.uniform(5.0, 9.0, n)
    time_s = np.concatenate([np.cumsum(duration[trip == i]) - duration[trip == i] for i in range(trips)])
    speed, wind = rng.uniform(0.0, 25.0, n), rng.normal(0.0, 3.0, n)
    base = 60.0 + 40.0 * np.sin(time_s / 90.0) + speed
    noise = rng.normal(0.0, 7.0, n)
    found = "effects_found" in verdict
    measured = base + noise + (4.0 * wind if found else 0.0)
    after = base + (3.9 * wind if found else 0.0)
    test = trip % 3 == min(trips - 1, 2) if trips > 1 else np.arange(n) >= 2 * n // 3
    names = names or tuple(f"T{i + 1:02d}" for i in range(trips))
    if trips == 1:  # as the split of a single trip has it
        trip, names = test.astype(int), ("T01 (first two thirds)", "T01 (last third)")

    def block(p):
        by = {names[i]: metrics(p[test & (trip == i)], measured[test & (trip == i)]) for i in np.unique(trip[test])}
        return {
            "train": metrics(p[~test], measured[~test]),
            "test": metrics(p[test], measured[test]),
            "test_by_trip": by,
        }

    before_block, after_block = block(base), block(after)
    effect = {
        "id": "headwind",
        "stage": "road",
        "order": 1,
        "verdict": "found",
        "parameters": {"scale": {"value": 0.9812, "sd": 0.031, "unit": "1"}},
        "q_value": 1e-9,
        "stability": 0.95,
        "test_rmse_before": before_block["test"]["rmse"],
        "test_rmse_after": after_block["test"]["rmse"],
        "indistinguishable_from": [],
    }
    unexplained = "unexplained" in verdict
    summary = {
        "schema": "hdev-diagnosis/1",
        "target": "energy_wh",
        "split": {
            "train_trips": [names[i] for i in np.unique(trip[~test])],
            "test_trips": [names[i] for i in np.unique(trip[test])],
            "unused_trips": [],
        },
        "before": before_block,
        "after": after_block,
        "baseline": {
            "parameters": {
                "road.cda_m2": {
                    "value": 7.2,
                    "sd": 0.08,
                    "prior_value": 5.6,
                    "prior_sd": 0.5,
                    "prior_z": 3.2,
                    "absorbs": ["constant_headwind"],
                },
                "battery.auxiliary_w": {"value": 2130.0, "sd": 61.0, "prior_value": None, "prior_sd": None},
            }
        },
        "effects": [effect] if found else [],
        "candidates": [
            {
                "id": f"idea_{k}",
                "score": 6.0 - 0.3 * k,
                "q_value": 0.5,
                "kind": "placebo",
                "why_not": "a placebo does as well",
            }
            for k in range(20)
        ]
        + [
            {
                "id": "wet_road",
                "score": None,
                "q_value": 1.0,
                "kind": "unavailable",
                "why_not": "not tried: needs a channel that the log lacks: wet_road",
            }
        ],
        "unexplained": {
            "significant": unexplained,
            "share_of_test_variance": 0.12 if unexplained else 0.0,
            "noise_floor_rmse": 6.9,
            "depends_on": ["time_s", "ambient_temp_c"] if unexplained else [],
            "signature": "a 25-minute cycle of 5 kW" if unexplained else "no structure above the noise",
        },
        "verdict": verdict,
        "notes": ["The log has no slope."],
        "clusters": {"kind": "trips", "count": 4},
        "parameters_fitted": 3,
        "subsets": {"above 2 m/s": {"before": before_block["test"], "after": after_block["test"]}},
        "excluded": [{"id": "road_surface", "why": "--exclude"}],
    }
    distance = speed * duration
    columns = {"time_s": time_s, "duration_s": duration, "distance_m": distance, "measured": measured}
    columns["distance_since_start_m"] = (np.cumsum(distance.reshape(trips, rows), axis=1)).ravel() - 0.5 * distance
    return ReportData(
        summary=summary,
        vehicle="truck, 34 t",
        synthetic=synthetic,
        unit="Wh",
        rows={"trip": trip, **columns, "before": base, "after": after, "test": test, "used": np.ones(n, bool)},
        channels={
            "speed_mps": speed,
            "wind_speed_mps": wind,
            "mass_kg": np.full(n, 24e3),
            "energy_wh": measured,
            **channels,
        },
        trip_names=names,
        breakdown={
            "before": {"rolling": 30.5, "grade": -2.0},
            "after": {"rolling": 28.0, "grade": -2.0, "headwind": 4.0},
        },
        ledger=[
            {"kind": "dropped", "where": "trip T01", "column": "speed_mps", "count": 12, "reason": "not a number"},
            {"kind": "noted", "file": "a.csv", "trip": "", "column": "grade_rad", "count": 0, "reason": "no slope"},
        ],
        command="hdev diagnose log.csv --vehicle truck.toml --out out",
        seconds=12.3,
    )


class Page(HTMLParser):
    """Checks nesting and collects what a browser would fetch."""

    def __init__(self, text):
        super().__init__()
        self.open, self.fetched, self.alts, self.tags = [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append(tag)
        self.fetched += [v for k, v in attrs.items() if k in ("src", "srcset", "href", "data", "poster", "action")]
        if tag == "img" and "src" in attrs:  # not the frame for an enlarged figure
            self.alts.append(attrs.get("alt"))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def written(data, directory, write=write_report) -> str:
    """The page as text, after the checks that every page must pass."""
    write(data, directory)
    text = (directory / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert all(link.startswith(("data:image/png;base64,", "data:image/svg+xml;base64,", "#")) for link in page.fetched)
    assert page.tags.count("script") == 1, "the page's own, and none that a name brings"
    assert "link" not in page.tags
    bare = re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)
    assert not re.search(r"https?:|//\w+\.|url\(|@import", bare)
    assert not re.search(r"\bnan\b|\bNone\b|\{\{|\}\}", re.sub(r"<style>.*?</style>", "", bare, flags=re.S))
    assert page.alts
    assert all(page.alts)
    figures = list((directory / "figures").glob("*.png"))
    assert len(figures) == len(page.alts)
    for path in figures:
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) > 5000, path.name
    assert sorted(p.name for p in directory.iterdir()) == ["figures", "report.html"]
    return text


def plain(text) -> str:
    """What a reader sees, without tags, on one line."""
    text = re.sub(r"<style>.*?</style>", "", text, flags=re.S)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", "", text)).split())


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    return {}


@pytest.fixture
def page_of(texts, tmp_path_factory) -> Callable[[str], str]:
    """The page of a verdict, written once, by a fixture of a test so that its plots are not drawn."""

    def once(verdict: str) -> str:
        if verdict not in texts:
            texts[verdict] = written(fake(verdict), tmp_path_factory.mktemp("page"))
        return texts[verdict]

    return once


@pytest.mark.parametrize("verdict", VERDICTS)
def test_a_strong_suspect_is_named_as_one(verdict):
    data = fake(verdict)
    data.summary["candidates"] += [{"id": "grade_bias", "score": 90.0, "q_value": 1.0, "why_not": "absorbed"}]
    data.summary["clusters"] = {"kind": "trip", "count": 9}
    data.summary["not_decidable"] = [{"id": "regen_cutoff", "clusters_needed": 14, "why_not": "too few trips"}]
    said = answer(data)
    assert ("Not decidable on this log: with 9 trips for training" in said) == (verdict == "nothing_missing")
    assert ("could not be named with confidence" in said) == ("unexplained" in verdict)
    decided = "cannot decide on cut-off of regeneration at low speed (about 14 trips like these would be enough)"
    assert (decided in said) == (verdict != "effects_found")
    assert "slope bias" not in said
    assert "No missing effect found" not in said


@pytest.mark.parametrize("verdict", VERDICTS)
def test_page_leads_with_the_answer(verdict, page_of):
    data, text = fake(verdict), page_of(verdict)
    said = " ".join(answer(data).split())
    assert said in plain(text)
    assert text.index('class="answer"') < text.index("<img") < text.index("What was found")
    before, after = (data.summary[w]["test"] for w in ("before", "after"))
    if "effects_found" in verdict:
        assert "misses headwind (scale 0.98 ± 0.03): on 2 held-out test trips the error falls from" in said
        assert f"from {before['rmse']:.1f} to {after['rmse']:.1f} Wh RMSE per row, energy error from" in said
        assert f"to {words.percent(after['pe_percent'])}".replace("\u00a0", " ") in said
        assert "<strong>headwind</strong>" in text
        assert "½ρ" in text
    assert ("No missing effect found: none of the 20 effects tried" in said) == (verdict == "nothing_missing")
    assert ("that no effect of the library explains: it depends on time since start" in said) == (
        "unexplained" in verdict
    )
    assert "constant headwind" in text  # what the drag area may have absorbed
    assert "12 more candidates" in text or "13 more candidates" in text
    assert "what drifts" not in text


@pytest.mark.parametrize(
    ("clusters", "scored", "said"),
    [
        ({"kind": "block", "count": 1}, True, "Not decidable on this log: with 1 stretch of driving for training"),
        ({"kind": "block", "count": 2}, True, "Not decidable on this log: with 2 stretches of driving for training"),
        ({"kind": "block", "count": 3}, True, "No missing effect found: none of the 20 effects"),
        ({"kind": "block", "count": 3}, False, "Nothing was tried: every requested effect is declared in the sheet"),
    ],
)
def test_nothing_is_missing_only_where_it_could_have_been_found(clusters, scored, said):
    data = fake("nothing_missing")
    data.summary["clusters"] = clusters
    if not scored:
        why = "not tried: needs a channel that the log lacks: gear"
        data.summary["candidates"] = [
            {**c, "score": None, "kind": "unavailable", "why_not": why} for c in data.summary["candidates"]
        ]
    assert said in answer(data)


def test_one_of_a_class_names_the_others_and_how_to_separate_them(tmp_path):
    data = fake()
    data.summary["effects"][0] |= {"verdict": "one_of_class", "indistinguishable_from": ["crosswind", "drafting"]}
    text = plain(written(data, tmp_path))
    assert "headwind (scale 0.98 ± 0.03) or crosswind or drafting, which this log cannot distinguish: on" in text
    assert "To separate them: headings all around on one windy day" in text


def test_the_first_figure_names_what_was_missing_classes_in_brackets():
    data = fake()
    first = data.summary["effects"][0]
    title = lambda: (before_after(data).get_suptitle() or "").replace("\n", " ")  # noqa: E731
    assert title() == "Missing in the model: headwind"
    first["indistinguishable_from"] = ["crosswind", "drafting"]
    data.summary["effects"] = [
        first,
        *({**first, "id": k, "indistinguishable_from": []} for k in ("wet_road", "x", "y")),
    ]
    assert title() == "Missing in the model: headwind (or crosswind or drafting); wet road; x; 1 more"
    assert before_after(fake("nothing_missing")).get_suptitle() == ""


@pytest.mark.parametrize(("scale", "said"), [("distance", "distance"), (None, "neither time, distance nor energy")])
def test_what_is_left_is_shown_with_what_it_grows_with(scale, said, page_of, tmp_path):
    data = fake("unexplained_structure")
    curve = {"channel": "humidity_pct", "at": [40.0, 80.0], "value": [-1.25, 2.5], "unit": "Wh"}
    data.summary["unexplained"] |= {"scales_with": scale, "correction": curve}
    text = plain(written(data, tmp_path / "left"))
    assert f"Grows with{said}" in text
    assert "Unexplained, and not in the sheet." in text
    assert "by humidity_pct: 40.0: −1.2 Wh, 80.0: 2.5 Wh." in text
    assert "Grows with" not in plain(page_of("nothing_missing"))


def test_a_mode_is_dated_where_the_log_has_times():
    data = fake()
    for effect in data.summary["effects"]:
        effect["modes"] = {
            "probability": {"T01": 0.01, "T02": 0.99, "T03": 0.98, "T04": 0.02},
            "changes": [
                {"trip": "T02", "to": "second", "start": "2022-01-06T05:02:00", "after": "T01"},
                {"trip": "T04", "to": "first", "start": None, "after": "T03"},
            ],
        }
    assert "; the second mode from 2022-01-06 05:02 (trip T02) on, until trip T04" in answer(data)
    data.summary["effects"][0]["modes"]["changes"] *= 2
    assert "; the second mode in 2 of 4 trips" in answer(data)


@pytest.mark.parametrize(
    ("confirmed", "share", "doubt"), [(True, 0.12, False), (False, 0.12, True), (False, 0.01, False)]
)
def test_a_share_that_cross_validation_does_not_confirm_says_so(confirmed, share, doubt, tmp_path):
    data = fake("unexplained_structure")
    data.summary["unexplained"] |= {"share_of_test_variance": share, "share_borne_out": confirmed}
    assert ("not confirmed by cross-validation" in answer(data)) == doubt
    if not confirmed:
        said = "of the variance of the remaining error, not confirmed by cross-validation on training trips"
        assert (said in plain(written(data, tmp_path))) == doubt


def test_synthetic_data_are_labelled(page_of, tmp_path):
    text = page_of("effects_found")
    assert re.search(r"<title>synthetic", text)
    captions = re.findall(r"<caption>(.*?)</caption>", text)
    assert captions
    assert all("synthetic" in c for c in captions)
    assert "synthetic" not in written(fake(synthetic=False), tmp_path)


@pytest.mark.drawn
def test_names_of_others_are_escaped_and_drawn_beside_what_drifts_and_what_is_no_number(tmp_path):
    names = ("<b>T1</b>", "$\\frac$ & co", "T3 <script>alert(1)</script>", "旅4", "x" * 90, "T6")
    n = 6 * 120
    odd = {"<i>odd</i> $x": np.random.default_rng(1).normal(size=n)}
    data = fake(names=names, **odd)
    data.ledger.append({"kind": "noted", "where": "<u>", "column": "<s>", "count": 1, "reason": "<q>"})
    # what is null or not a number
    for when in ("before", "after"):
        data.summary[when]["test"]["pe_percent"] = None
        for m in data.summary[when]["test_by_trip"].values():
            m["pe_percent"] = None
            m["fit_percent"] = None
    data.summary["unexplained"]["noise_floor_rmse"] = float("nan")
    holes = np.where(np.arange(n) % 7 == 0, np.nan, 1.0)
    rows = {**data.rows, "after": data.rows["after"] * holes, "measured": data.rows["measured"] * holes[::-1]}
    channels = {**data.channels, "gone": np.full(n, np.nan), "holes": data.channels["speed_mps"] * holes}
    data = replace(data, rows=rows, channels=channels, seconds=float("nan"))
    # what drifts, with its energy
    minute = np.arange(12.0)
    data.summary["unexplained"]["course"] = {
        "kwh_by_trip": {t: [1.234, 0.5, 1.9] for t in data.trip_names}, "trip": names[2],
        "time_s": (60.0 * minute + 30.0).tolist(), "left_w": (2e3 * np.sin(minute)).tolist(),
        **{k: (1.5e3 * np.sin(minute) + x).tolist() for k, x in (("power_w", 0), ("lower_w", -400), ("upper_w", 400))},
    }  # fmt: skip
    text = written(replace(data, vehicle="<h1>bus", command="hdev <x>"), tmp_path)
    assert not re.search(r"<(b|script|i|u|s|q|x)>", text)
    assert "T3 &lt;script&gt;" in text
    assert "energy error from" not in text
    assert "kWh of what drifts" in text
    assert plain(text).count("1.23") == len(data.summary["split"]["test_trips"])
    assert (tmp_path / "figures" / "drift_course.png").stat().st_size > 5_000


# Each page of an odd log is of another target too.
TARGETS = {"kW": "battery_power_kw", "Nm": "motor_torque_nm", "N": "traction_force_n"}


def of_target(data: ReportData, unit: str) -> ReportData:
    data.summary["target"] = TARGETS[unit]
    data = replace(data, unit=unit)
    assert f"{unit} RMSE per row" in answer(data)
    return data


@pytest.mark.drawn
def test_few_rows_of_a_force(tmp_path):
    """Three trips of one row."""
    data = of_target(fake(trips=3, rows=3), "N")
    keep = np.arange(0, len(data.rows["trip"]), 3)
    cut = {k: v[keep] for k, v in data.rows.items()}
    data = replace(data, rows=cut, channels={k: v[keep] for k, v in data.channels.items()})
    assert "held-out last third of" not in plain(written(data, tmp_path))


@pytest.mark.drawn
def test_many_trips_of_a_torque(tmp_path):
    text = written(of_target(fake("nothing_missing", trips=40, rows=30), "Nm"), tmp_path)
    assert "held-out last third of" not in plain(text)


@pytest.mark.drawn
def test_one_trip_with_a_bare_summary_without_channels_twice(tmp_path):
    """The same data give the same bytes, and no trace is left."""
    data = of_target(fake(trips=1, rows=90), "kW")
    for key in ("notes", "clusters", "parameters_fitted", "subsets", "excluded"):
        del data.summary[key]
    data.summary["baseline"]["parameters"] = {}
    data.summary["stages"] = {
        "road": {"before": data.summary["before"]["test"], "after": data.summary["after"]["test"]}
    }
    data = replace(data, channels={}, breakdown={}, ledger=[], command="")
    settings = dict(mpl.rcParams)
    text, again = (written(data, tmp_path / k) for k in "ab")
    assert text == again
    assert dict(mpl.rcParams) == settings
    assert "every row was used as it stands" in text
    assert "By stage" in text
    assert "on the held-out last third of T01" in plain(text)


@pytest.mark.drawn
def test_calibration_report(tmp_path):
    data = fake()
    rows = {k: v for k, v in data.rows.items() if k not in ("after", "test", "used")}
    summary = {k: data.summary[k] for k in ("target", "baseline")} | {"method": "map"}
    text = plain(written(replace(data, rows=rows, summary=summary, channels={}), tmp_path, write_calibration_report))
    everything = metrics(rows["before"], rows["measured"])
    assert f"The log fits at {everything['rmse']:.1f} Wh RMSE per row" in text
    assert "Drag area lies far from the table" in text
    assert "7.20 ± 0.08 m²" in text
    assert "by least squares" in text


def test_sizes_by_gear_are_shown_with_their_gear():
    assert shown.parameter("torque_nm[2]", "driveline_drag") == "torque (gear 2)"
    assert shown.coefficient("effects.wet_road.excess[B183]")[0] == "wet road: excess [B183]"
    assert shown.coefficient("effects.gear_efficiency.delta[3]")[0] == "efficiency by gear: delta (gear 3)"
    assert shown.coefficient("effects.road_surface.excess[1]")[0].endswith("(road surface 1)")
    assert shown.coefficient("effects.driveline_drag.torque_nm")[0].endswith(": torque")
    assert shown.parameter("phase_s[4]").endswith("[4]")


def test_trips_of_a_diagnosis_are_those_of_its_json():
    data = fake()
    data.summary["after"]["test_by_trip"]["T03"]["rmse"] = 123.0
    lines = {t.name: t for t in report_data.trip_lines(data)}
    assert lines["T03"].after["rmse"] == 123.0
    assert [t.role for t in lines.values()] == ["train", "train", "test"] * 2
    for name in ("T01", "T06"):
        rows = data.rows["trip"] == int(name[1:]) - 1
        expected = metrics(data.rows["after"][rows], data.rows["measured"][rows])
        assert lines[name].after["pe_percent"] == pytest.approx(expected["pe_percent"])
        assert lines[name].total == pytest.approx(data.rows["measured"][rows].sum() / 1000)


def test_a_mean_torque_is_one_by_distance_on_the_page_as_in_the_diagnosis():
    """One weight for sums everywhere: a trip's share of error is the diagnosis's own, and standing still adds none."""
    data = replace(fake(), unit="Nm")
    data.summary["target"] = "motor_torque_nm"
    data.rows["distance_m"] = np.where(data.rows["time_s"] < 300.0, 0.0, data.rows["distance_m"])
    rows = np.flatnonzero(data.rows["trip"] == 0)
    measured, predicted, distance = (data.rows[k][rows] for k in ("measured", "before", "distance_m"))
    expected = errors(measured, predicted, distance)["pe_percent"]
    assert report_data.metrics(data, rows, "before")["pe_percent"] == pytest.approx(expected)
    assert report_data.total(data, rows) == pytest.approx(np.sum(measured * distance) / np.sum(distance))


def test_channels_that_matter_come_first_and_constant_ones_not_at_all():
    shown, count = panels(fake(steps=np.tile([1.0, 2.0, 3.0], 240)))
    assert shown[0].name == "wind_speed_mps"
    assert shown[0].share["before"] > 0.5
    assert shown[0].share["after"] < 0.1
    assert {p.name for p in shown} >= {"time_s", "distance_since_start_m", "steps", "speed_mps"}
    assert not {p.name for p in shown} & {"mass_kg", "energy_wh"}
    assert count == len(shown) == 6


def test_error_of_a_binned_mean_counts_clusters():
    # 200 trips of 50 equal rows: the error of the mean is that of 200 numbers, not of 10,000
    rng = np.random.default_rng(0)
    level = rng.normal(size=200)
    cluster, x = np.repeat(np.arange(200), 50), rng.uniform(size=10_000)
    b = statistics.binned(x, np.repeat(level, 50), cluster, np.array([0.5]))
    np.testing.assert_allclose(b.error, level.std() / np.sqrt(200), rtol=0.15)
    assert np.isnan(statistics.binned(x, x, np.zeros(10_000, int), np.array([0.5])).error).all()


def test_spectrum_adds_up_and_finds_the_cycle():
    t = np.arange(8192.0)
    wave = 3.0 * np.sin(2 * np.pi * t / 120.0)
    period, variance = statistics.variance_by_period(wave, np.zeros(8192, int), 1.0)
    assert 0.8 < period[np.argmax(variance)] / 120.0 < 1.25
    noise = np.random.default_rng(0).normal(size=8192)
    period, variance = statistics.variance_by_period(noise, np.zeros(8192, int), 1.0)
    # white noise of variance 1: density 2 a Hz, ln 2 · 2 · f an octave
    np.testing.assert_allclose(variance[-6:] * period[-6:], 2 * np.log(2), rtol=0.25)
    acf = statistics.autocorrelation(noise, np.repeat([0, 1], 4096), 5)
    assert acf[0] == pytest.approx(1.0)
    assert np.abs(acf[1:]).max() < 0.05


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (words.plus_minus(0.9812, 0.031), "0.98 ± 0.03"),
        (words.plus_minus(4980.0, 212.0, "W"), "4,980 ± 210 W"),
        (words.plus_minus(-3.02e-6, 1.2e-7, "s²/m²"), "(−3.02 ± 0.12)×10⁻⁶ s²/m²"),
        (words.plus_minus(0.0065, None), "0.006500"),
        (words.plus_minus(None, 1.0), "–"),
        (words.known({"value": 0.98, "sd": 0.03, "interval_90": [0.93, 1.03], "unit": "1"}), "0.98 ± 0.03"),
        (words.known({"value": 0.98, "sd": 0.03, "unit": "m"}), "0.98 ± 0.03 m"),
        (
            words.known({"value": 150.0, "sd": 140.0, "interval_90": [52.0, 410.0], "unit": "W/K"}),
            "150 W/K (90 %: 52.0 to 410)",
        ),
        (words.known({"value": 0.0, "sd": 0.0, "interval_90": [0.0, 0.0], "unit": "W"}), "0 W"),
        (words.pair(18.93, 7.62), ("18.9", "7.6")),
        (words.pair(0.7712, 0.4041), ("0.77", "0.40")),
        (words.pair(515.2, 190.4), ("515", "190")),
        (words.pair(7.641, 7.612), ("7.64", "7.61")),
        (words.pair(None, 7.6), ("–", "7.60")),
        (words.percent(-4.12), "−4.1 %"),
        (words.percent(-0.01), "0.0 %"),
        (words.percent(float("nan")), "–"),
        (words.number(24000.0), "24,000"),
        (words.number(3.02e-6), "3.02×10⁻⁶"),
        (words.q_value(1e-9), "< 0.0001"),
    ],
)
def test_numbers_as_a_reader_wants_them(made, expected):
    same = made.replace("\u00a0", " ") if isinstance(made, str) else made
    assert same == expected


@pytest.mark.drawn
def test_the_report_of_a_large_log_is_no_larger_than_its_figures(tmp_path):
    def bytes_of(rows: int) -> int:
        folder = tmp_path / str(rows)
        folder.mkdir()
        data = fake("nothing_missing", trips=3, rows=rows)
        data.summary["baseline"]["parameters"] = {}
        written(replace(data, breakdown={}), folder)  # without the figures that no row is in
        return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())

    assert bytes_of(12_000) < 1.5 * bytes_of(1_200)


@pytest.mark.parametrize("path", sorted(Path(page.__file__).parent.glob("*.py")), ids=lambda p: p.stem)
def test_plotting_is_loaded_on_first_use_and_pyplot_never(path):
    source = path.read_text(encoding="utf-8")
    assert "pyplot" not in source.replace("without pyplot", "")
    heads = [
        n.names[0].name if isinstance(n, ast.Import) else n.module
        for n in ast.parse(source).body
        if isinstance(n, (ast.Import, ast.ImportFrom))
    ]
    assert not {h.partition(".")[0] for h in heads} & {"matplotlib", "jinja2"}
