"""The loop on a measured log: what it must reach on the Kia Niro, trained on trip 1, tested on trips 2-4."""

import numpy as np
import pytest
from planted import diagnosed

from experiments.runner.config import CONFIGS
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.physics import LIBRARY
from hdev_jax.problem import prepare, split_trips


@pytest.mark.slow
def test_the_niro_is_explained_by_few_parameters(data_dir):
    log = read_log(sorted((data_dir / "kia_niro").glob("Trip_*.mat")), CONFIGS / "adapters" / "kia_niro.toml")
    split = split_trips(log, train=["1"])
    # what a motor's and an instrument's side may lack: a search of the whole library takes ten times as long
    suspects = {k: LIBRARY[k] for k in ("copper_loss", "inverter_loss", "iron_loss", "time_skew")}
    problem = prepare(split.log, read_sheet(CONFIGS / "vehicles" / "kia_niro.toml"))
    result = diagnosed(problem, split, suspects).summary
    before, after = (list(result[when]["test_by_trip"].values()) for when in ("before", "after"))
    assert len(after) == 3
    assert np.mean([m["mse"] for m in before]) == pytest.approx(0.60, abs=0.02)  # kW²; a bad start is no gain
    # the paper's best network (NARXS) reaches 0.1604 in free run, its LSTM 0.2322
    assert np.mean([m["mse"] for m in after]) <= 0.17
    assert result["parameters_fitted"] <= 14
    assert max(abs(m["pe_percent"]) for m in after) <= 1.2
