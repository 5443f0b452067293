"""The study of loads that switch: how a log is scored, which logs there are."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.planted.switching import Config, noise_w, tasks
from experiments.planted.switching_tables import scored
from experiments.runner.config import resolve, typed
from hdev_jax.fleet import synthetic_log

STUDY = Path(__file__).parents[2] / "configs" / "studies" / "switching.toml"
LOADS = ("switching_load", "second_switching_load")


def result(*others: str, true: list[float], found: list[float]) -> dict[str, Any]:
    """A log's result with loads of these powers [W], planted and found; each decoded load is right about its own."""
    return {
        "named": [{"id": k, "class": [k], "class_size": 1} for k in (*LOADS[: len(found)], *others)],
        "loads": [{"power_w": p, "share": 0.4} for p in true],
        "found": [
            {"id": k, "power_w": p, "interval_90": [0.9 * p, 1.05 * p], "share": 0.42,
             "right": [1.0 - abs(p - q) / 1e5 for q in true], "covered": [9] * len(true)}
            for k, p in zip(LOADS, found, strict=False)
        ],
        "trips": 12,
    }  # fmt: skip


def test_a_load_that_is_found_is_scored_against_the_true_one():
    one = scored([], result(true=[10e3], found=[11e3]))
    assert one.all_found
    assert one.power == [1.1]
    assert one.power_covered == [True]
    assert one.share_off == pytest.approx([0.02])
    assert one.right == pytest.approx([0.99])
    assert one.covered == [0.75]
    assert (one.false, one.instead, one.other) == ([], [], None)


def test_two_loads_are_matched_by_their_powers_in_any_order():
    two = scored([], result(true=[10e3, 25e3], found=[24e3, 10.5e3]))
    assert two.all_found
    assert sorted(two.power) == pytest.approx([0.96, 1.05])
    half = scored([], result(true=[10e3, 25e3], found=[24e3]))
    assert not half.all_found
    assert half.power == [0.96]


@pytest.mark.parametrize(
    ("others", "true", "found", "false", "instead"),
    [
        (["iron_loss"], [10e3], [10e3], ["iron_loss"], []),
        (["auxiliary_power"], [10e3], [], [], ["auxiliary_power"]),
        (["auxiliary_power"], [10e3], [10e3], ["auxiliary_power"], []),
        (["iron_loss"], [10e3], [], ["iron_loss"], []),
        ([], [], [8e3], ["switching_load"], []),
        ([], [10e3], [10e3, 2e3], ["second_switching_load"], []),
        ([], [], [], [], []),
    ],
)
def test_what_counts_as_a_false_name(others, true, found, false, instead):
    log = scored([], result(*others, true=true, found=found))
    assert (log.false, log.instead) == (false, instead)


def test_an_effect_beside_the_load_is_named_or_not():
    both = scored(["headwind"], result("headwind", true=[10e3], found=[10e3]))
    assert both.other is True
    assert both.false == []
    assert scored(["headwind"], result(true=[10e3], found=[10e3])).other is False
    wrong = scored(["headwind"], result("headwind", "iron_loss", true=[10e3], found=[10e3]))
    assert wrong.other is True
    assert wrong.false == ["iron_loss"]


def test_more_logs_of_a_line_leave_the_others_as_they_are():
    table = resolve(STUDY)
    few, more = ([*tasks(typed(Config, {**table, "logs": n}, STUDY))] for n in (1, 3))
    assert len({t["seed"] for t in more}) == len(more), "each log has its own noise"
    assert all(t in more for t in few)
    assert {t["case"] for t in few} == {"one", "two", "beside", "nothing"}


def test_the_noise_as_a_power_is_that_of_a_row_of_median_duration():
    samples, segments = (
        synthetic_log(seed=1, trips=3, rows_per_trip=100, mode=m, entry=e, noise_rms=2.0)
        for m, e in (("samples", "shaft"), ("segments", "road"))
    )
    assert noise_w(samples) == 2000.0
    wh = noise_w(segments) * segments.drive.columns["duration_s"] / 3600.0
    assert np.median(wh) == pytest.approx(2.0)
