"""The Sankey diagram of a ledger: widths add up and are drawn so; labels stay clear of bands and each other."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from hdev_jax.energy.ledger import TOTAL, UNEXPLAINED
from hdev_jax.report.canvas import style
from hdev_jax.report.energy.flow import BACK, LEAST_SHARE, MEASURED, OTHER, energy_flow, flow_of

TRUCK = {
    "rolling": 38.0, "aero": 25.0, "grade": 3.0, "inertia": 0.4, "cornering": 2.6, "wet_road": 0.5, "headwind": 0.6,
    "driveline": 17.0, "auxiliary": 6.0, "hvac_power": 3.0, UNEXPLAINED: 1.4,
}  # fmt: skip
DOWNHILL = {
    "rolling": 38.0, "aero": 25.0, "grade": -34.0, "headwind": -2.0, "driveline": 12.0, "auxiliary": 6.0,
    UNEXPLAINED: -1.4,
}  # fmt: skip
FULL = {**TRUCK, "crosswind": 1.5, "tyre_warmup": 2.0, "road_surface": 1.8, "rolling_temperature": 3.0,
        "cabin_warmup": 1.3, "second_switching_load": 4.0, "battery_resistance": 1.9, "iron_loss": 1.6}  # fmt: skip
CASES = {
    "truck": (TRUCK, 14.0), "no regeneration": (TRUCK, 0.0), "downhill": (DOWNHILL, 30.0), "many causes": (FULL, 22.0),
    "more back than taken": ({"rolling": 30.0, "grade": -60.0, "driveline": 8.0, UNEXPLAINED: 0.5}, 40.0),
    "almost all comes back": ({"rolling": 2.0, "grade": -60.0, "driveline": 1.0, UNEXPLAINED: 0.5}, 58.0),
}  # fmt: skip


def block(causes: dict[str, float]) -> pd.DataFrame:
    total = sum(causes.values())
    rows = [{"cause": c, "kwh": x, "share_percent": 100 * x / total} for c, x in {**causes, TOTAL: total}.items()]
    return pd.DataFrame(rows)


@pytest.mark.parametrize("case", CASES)
def test_what_enters_is_what_is_taken_and_comes_back(case):
    causes, back = CASES[case]
    flow = flow_of(block(causes), back)
    assert flow is not None
    entering = flow.out_kwh + sum(b.kwh for b in flow.gives)
    np.testing.assert_allclose(entering, flow.back_kwh + sum(b.kwh for b in flow.takes))
    np.testing.assert_allclose(flow.out_kwh - flow.back_kwh, sum(causes.values()))
    assert {b.cause for b in flow.gives} == {c for c, x in causes.items() if x < 0}


def test_small_causes_are_one_band_and_what_is_unexplained_stays_itself():
    flow = flow_of(block({**TRUCK, UNEXPLAINED: 0.01}), 10.0)
    assert flow is not None
    by = {b.cause: b for b in flow.takes}
    assert {"inertia", "wet_road", "headwind"}.isdisjoint(by)
    assert by[OTHER].kwh == pytest.approx(1.5)
    assert UNEXPLAINED in by
    assert all(b.kwh >= LEAST_SHARE * flow.out_kwh for c, b in by.items() if c not in (OTHER, UNEXPLAINED))
    assert [by[c].place for c in ("auxiliary", "driveline", "rolling")] == ["load", "loss", "wheel"]


def test_a_log_from_which_nothing_left_the_battery_has_no_diagram():
    assert flow_of(block({"rolling": 1.0, "grade": -5.0}), 4.0) is None
    assert energy_flow(block({"rolling": 1.0, "grade": -5.0}), 4.0, 100.0) is None


@pytest.mark.parametrize("case", CASES)
def test_bars_are_in_proportion_and_labels_clear(case):
    from matplotlib.colors import to_hex
    from matplotlib.patches import Rectangle

    causes, back = CASES[case]
    flow = flow_of(block(causes), back)
    assert flow is not None
    with style():
        fig: Any = energy_flow(block(causes), back, 100.0)
        fig.canvas.draw()
        ax, sheet = fig.axes[0], fig.bbox
        bars = [p for p in ax.patches if isinstance(p, Rectangle)]
        left, middle, right = ([p for p in bars if p.get_x() == x] for x in sorted({p.get_x() for p in bars}))
        per = sum(p.get_height() for p in middle) / (flow.out_kwh + sum(b.kwh for b in flow.gives))
        (battery,) = (p for p in left if to_hex(p.get_facecolor()) == MEASURED)
        for column, kwh in (
            ([battery], [max(flow.out_kwh, back)]),
            ([p for p in left if p is not battery], [b.kwh for b in flow.gives]),
            (right, [b.kwh for b in flow.takes]),
        ):
            np.testing.assert_allclose([p.get_height() for p in column], per * np.array(kwh), rtol=1e-9)
        lane = [p for p in ax.patches if not isinstance(p, Rectangle) and to_hex(p.get_facecolor()) == BACK.lower()]
        assert bool(lane) == (back > 0 or bool(flow.gives))
        boxes = [(t.get_text(), t.get_window_extent()) for t in ax.texts]
        drawn = [p.get_path().transformed(p.get_transform()) for p in ax.patches]
    for k, (text, box) in enumerate(boxes):
        assert min(box.x0 - sheet.x0, sheet.x1 - box.x1, box.y0 - sheet.y0, sheet.y1 - box.y1) >= 0, text
        assert not [other for other, b in boxes[k + 1 :] if box.overlaps(b)], text
        assert not any(path.intersects_bbox(box, filled=True) for path in drawn), text


def test_labels_have_the_ledgers_numbers():
    with style():
        fig: Any = energy_flow(block(DOWNHILL), 30.0, 50.0)
    said = " ".join(t.get_text() for t in fig.axes[0].texts)
    total = sum(DOWNHILL.values())
    assert f"76 kWh/100 km ({100 * 38 / total:.1f} %)" in said  # 38 kWh over 50 km
    assert f"−68 kWh/100 km (−{100 * 34 / total:.1f} %)" in said
    assert f"{2 * (total + 30):.3g} kWh/100 km" in said
    assert f"60 kWh/100 km ({100 * 30 / (total + 30):.1f} % of what left it)" in said
    with style():
        still: Any = energy_flow(block(TRUCK), 0.0, 0.0)
    assert "/100 km" not in " ".join(t.get_text() for t in still.axes[0].texts)
