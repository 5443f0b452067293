"""Every config of paper 2 at a tiny size: it runs, its folder is complete, and a delta changes the keys it names."""

import json
from pathlib import Path

import pytest

from experiments.config import resolve
from experiments.engine import run_config

CONFIGS = sorted((Path(__file__).parents[2] / "configs" / "paper2").glob("*.toml"))
TINY = ["rows=700"]
SMALL = {"starts": 2, "steps": 6, "coarse_steps": 3, "simulation_steps": 3, "trials": 1, "length": 32}
FAST = ("table2", "fig4", "online")


def tiny(path: Path) -> list[str]:
    table, sets = resolve(path), list(TINY)
    for name in table.get("models", {}):
        sets += [f"models.{name}.{key}={value}" for key, value in SMALL.items()]
    return [*sets, "starts=1"] if table["experiment"] == "paper2_selection" else sets


def cases():
    for path in CONFIGS:
        yield pytest.param(path, id=path.stem, marks=[] if path.stem in FAST else pytest.mark.slow)


@pytest.mark.parametrize("path", list(cases()))
def test_config_runs(path, tmp_path, data_dir, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setenv("HDEV_DATA", str(data_dir))
    run_config(path, tiny(path), out=tmp_path / "out")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["data"] == "kia_niro"
    assert metrics["synthetic"] is False
    assert all(row["ours"] is not None or row["reason"] for row in metrics["rows"])
    assert (tmp_path / "out" / "report.html").is_file()
    if path.stem.startswith("fig"):
        assert list((tmp_path / "out" / "figures").glob("*.png"))
        assert list((tmp_path / "out" / "figures").glob("*.pdf"))


def test_without_data_one_line_says_where_it_is_from(tmp_path, monkeypatch):
    from experiments.paper2_data import kia_log
    from hdev_jax.errors import InputError

    monkeypatch.setenv("HDEV_DATA", str(tmp_path))
    kia_log.cache_clear()
    with pytest.raises(InputError, match="set HDEV_DATA") as e:
        kia_log()
    assert "FMLabSouthampton" in str(e.value)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_config_is_named_after_its_artefact(path):
    assert resolve(path)["artefact"] == f"paper2/{path.stem}"
