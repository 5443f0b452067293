"""The page of settings has every setting, and the study of halves and doubles changes each one of them."""

import json
from pathlib import Path

import pytest

from experiments.planted.config import Config
from experiments.planted.settings_page import changed, main, page, points
from experiments.runner.config import CONFIGS, expanded, resolve, typed
from hdev_jax.diagnosis.settings import Settings, described
from hdev_jax.errors import InputError

STUDY = CONFIGS / "studies" / "settings.toml"
DOCS = Path(__file__).parents[2] / "docs"


def test_the_study_changes_each_setting_once_to_half_and_once_to_double():
    found = list(expanded(resolve(STUDY), STUDY))
    assert [delta["settings"] for delta, _ in found] == points()
    for delta, config in found:
        assert Settings(**typed(Config, config, STUDY).settings) == Settings(**delta["settings"])


@pytest.mark.parametrize(
    ("default", "unit", "expected"),
    [
        (0.05, "1", {"half": 0.025, "double": 0.1}),
        (0.8, "1", {"half": 0.4}),
        (2.5, "1", {"half": 1.25, "double": 5.0}),
        (19, "draws", {"half": 10, "double": 38}),
    ],
)
def test_half_and_double(default, unit, expected):
    assert changed(default, unit) == expected


@pytest.mark.parametrize(
    ("given", "words"), [("{closer=1.0}", "closer: one of fdr,"), ("{placebos=1.5}", "whole number")]
)
def test_a_setting_that_is_none_is_refused(given, words):
    sets = [f"settings={given}"]
    table = resolve(CONFIGS / "studies" / "planted_quick.toml", sets)
    with pytest.raises(InputError, match=words):
        typed(Config, table, STUDY, sets)


def test_the_page_in_docs_is_as_the_settings_are():
    """Its columns half and double may hold results, which are kept nowhere else."""
    rows = [line.split(" | ") for line in (DOCS / "settings.md").read_text(encoding="utf-8").splitlines()]
    shown = {r[0].strip("| `"): r for r in rows if r[0].startswith("| `")}
    assert list(shown) == [s["name"] for s in described()]
    for s in described():
        name, default, half, double, unit, meaning, source = shown[s["name"]]
        assert name.endswith(f"`{s['name']}`")
        assert (default, unit) == (f"{s['default']:g}", "–" if s["unit"] == "1" else s["unit"])
        assert meaning.replace("\\|", "|") == s["meaning"]
        assert source.removesuffix(" |") == s["source"]
        ways = changed(s["default"], s["unit"])
        assert half.startswith(f"{ways['half']:g}")
        assert double.startswith(f"{ways['double']:g}" if "double" in ways else "–")


def test_results_of_the_study_fill_half_and_double(tmp_path, capsys):
    def run(settings, right):
        ours = {"n": 4, "right": right / 4, "false_name": 0.25}
        pooled = {"name": "nothing planted, all together", "paper": None, "ours": ours}
        twin = {"name": "one effect: no twin", "paper": None, "ours": {"n": 4, "right": 1.0}}
        return {"sweep": {"settings": settings}, "rows": [{"name": "x", "paper": None, "ours": ours}, pooled, twin]}

    (tmp_path / "sweep.json").write_text(json.dumps([run({}, 4), run({"mode_side": 1}, 3)]))
    assert main(["--docs", str(tmp_path / "docs"), "--run", str(tmp_path)]) == 0
    text = " ".join((tmp_path / "docs" / "settings.md").read_text(encoding="utf-8").split())
    assert "with the defaults, 4/4, 1 false." in text
    assert "| `mode_side` | 2 | 1: 3/4, 1 false | 4 |" in text
    assert "No results" in page(command="x")
    assert main(["--docs", str(tmp_path), "--run", str(tmp_path / "none")]) == 2
    assert "no complete sweep.json" in capsys.readouterr().err
