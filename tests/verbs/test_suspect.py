"""A log whose sign or unit is wrong: no effect is named, the verdict says what is suspected."""

import numpy as np
import pandas as pd
import pytest

import hdev_jax

SHEET = {
    "mass_kg": 1800.0,
    "road": {"c_rr": (0.011, 0.002), "cda_m2": (0.62, 0.06)},
    "driveline": {"efficiency": (0.88, 0.04)},
    "battery": {"auxiliary_w": (600.0, 300.0)},
}


def coasting() -> list[float]:
    """Speed of a car in each second in which the drive does nothing."""
    v = [40.0]
    while v[-1] > 8.0:
        force = 1500.0 * 9.80665 * 0.012 + 0.5 * 1.225 * 0.65 * v[-1] ** 2
        v.append(v[-1] - force / 1500.0)
    return v


ROWS = len(coasting())  # of each trip: what is compiled is shared


def trips(sign: float = 1.0) -> pd.DataFrame:
    """Three trips of a car by the equation of motion."""
    rng = np.random.default_rng(5)
    parts = []
    for name in ("a", "b", "c"):
        v = np.abs(14.0 + np.cumsum(rng.normal(0.0, 0.5, ROWS)))
        force = 1800.0 * np.gradient(v) + 1800.0 * 9.80665 * 0.011 + 0.5 * 1.225 * 0.62 * v**2
        power = np.where(force > 0, force * v / 0.88, force * v * 0.88) + 600.0 + rng.normal(0.0, 100.0, ROWS)
        frame = {"trip_id": name, "time_s": np.arange(float(ROWS)), "speed_mps": v, "battery_power_w": sign * power}
        parts.append(pd.DataFrame(frame))
    return pd.concat(parts, ignore_index=True)


def test_no_effect_is_named_on_a_suspect_log(tmp_path):
    found = hdev_jax.diagnose(trips(-1.0), SHEET, only=["headwind"])
    assert found.summary["verdict"] == "suspect_log"
    assert found.summary["effects"] == []
    (one,) = found.summary["suspicions"]
    assert one["what"] == "sign of battery_power_w"
    assert set(one) == {"what", "evidence", "mend"}
    assert "affine = [0, -1]" in str(found)
    page = found.report(tmp_path / "page.html").read_text()
    assert "This log is suspect: sign of battery_power_w" in page
    assert "Nothing was tried" not in page


@pytest.mark.parametrize(("sign", "trust"), [(1.0, False), (-1.0, True)])
def test_a_right_log_is_searched_and_one_that_is_trusted(sign, trust):
    found = hdev_jax.diagnose(trips(sign), SHEET, only=["headwind"], trust=trust)
    assert found.summary["verdict"] != "suspect_log"
    assert "suspicions" not in found.summary


def test_a_calibration_says_what_is_suspected():
    assert any(n.startswith("suspected: sign of") for n in hdev_jax.calibrate(trips(-1.0), SHEET).summary["notes"])
    assert not any("suspected" in n for n in hdev_jax.calibrate(trips(), SHEET).summary["notes"])


def test_a_coast_down_is_calibrated_and_not_searched():
    """The drive does nothing: its road load is what there is to find."""
    v = coasting()
    one = {"time_s": np.arange(float(len(v))), "speed_mps": v, "traction_force_n": 0.0}
    log = pd.concat([pd.DataFrame({"trip_id": name, **one}) for name in ("a", "b", "c")], ignore_index=True)
    sheet = {"mass_kg": 1500.0, "road": {"c_rr": (0.02, 0.008), "cda_m2": (0.9, 0.3)}}
    found = hdev_jax.diagnose(log, sheet, only=["headwind"])
    assert (found.summary["verdict"], found.summary["effects"]) == ("suspect_log", [])
    assert found.summary["suspicions"][0]["what"] == "constant target 0"
    fitted = hdev_jax.calibrate(log, sheet)
    assert not any("suspected" in note or "gives energy back" in note for note in fitted.summary["notes"])
    assert abs(fitted.coefficients.loc["road.c_rr", "value"] / 0.012 - 1.0) < 0.05
