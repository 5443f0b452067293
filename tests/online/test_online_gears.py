"""A gear that is not logged, inferred by the trees of the sheet while the rows come."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.errors import InputError
from hdev_jax.inference.sheet import Sheet, augmented_sheet, read_sheet
from hdev_jax.learn.gears.classifiers import Classifier
from hdev_jax.learn.gears.gears import PLACE
from hdev_jax.learn.gears.saved import read_gear_model, save_gear_model
from hdev_jax.online import packed, scan, start
from hdev_jax.online.live import Live
from hdev_jax.online.update import expected
from hdev_jax.physics import GEAR_PROBABILITY

lightgbm = pytest.importorskip("lightgbm")
FEATURES = ("speed_mps", "requested_torque_nm", "mass_kg")
SHIFT_MPS = 9.0
CHANNELS = ("grade_rad", "mass_kg")
QUICK = {"levels": False, "memories": (0.0,)}  # one model of the noise


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sheet with a map in which the first gear loses a third, and trees that learned where the box shifts."""
    home = tmp_path_factory.mktemp("gears")
    rng = np.random.default_rng(0)
    x = np.stack([rng.uniform(0, 25, 2000), rng.uniform(-4e3, 1e4, 2000), rng.uniform(12e3, 26e3, 2000)], axis=1)
    settings = {"objective": "multiclass", "num_class": 2, "verbosity": -1, "num_threads": 1, "num_leaves": 4}
    settings |= {"learning_rate": 0.6}
    model = lightgbm.train(settings, lightgbm.Dataset(x, (x[:, 0] > SHIFT_MPS).astype(int)), 10)
    save_gear_model(home / "gears.json", Classifier("lightgbm", model, (1, 2), FEATURES, {}, 0.0, 0.0))
    points = [f"{g},{s},{t},{0.62 if g == 1 else 0.93}" for g in (1, 2) for s in (0, 900) for t in (-3000, 0, 3000)]
    (home / "map.csv").write_text("\n".join(["gear,motor_speed_radps,motor_torque_nm,efficiency", *points]) + "\n")
    (home / "v.toml").write_text(
        'mass_kg = 18000.0\n[road]\nc_rr = { value = 0.006, sd = 0.001 }\ncda_m2 = 5.6\n[driveline]\nmap = "map.csv"\n'
        'gear_ratios = [9.0, 4.0]\nfinal_drive = 4.0\nwheel_radius_m = 0.5\ngear_model = "gears.json"\n'
    )
    return home


def driven(state, gear: bool) -> np.ndarray:
    """Rows of stop and go with the energy of the vehicle in the gear that it was in, as `Form.columns`."""
    t = np.arange(120.0)
    v = 9.0 * (1.0 - np.cos(2 * np.pi * t / 60.0))
    true = np.where(0.5 * (v[1:] + v[:-1]) > SHIFT_MPS, 2.0, 1.0)
    rows = []
    for k in range(len(t) - 1):
        row = {"trip": 1, "time_s": t[k], "duration_s": 1.0, "distance_m": 0.5 * (v[k] + v[k + 1])}
        row |= {"speed_start_mps": v[k], "speed_end_mps": v[k + 1], "grade_rad": 0.005, "mass_kg": 18e3}
        rows.append(packed(state.form, row | ({"gear": true[k]} if gear else {})))
    return np.array(rows)


def declared(sheet, gear: bool):
    """The declared vehicle's energy of each row."""
    state, notes = start(sheet, (*CHANNELS, "gear") if gear else CHANNELS, **QUICK)
    of_row = lambda row: expected(state, jnp.zeros(state.form.size), row)[0]  # noqa: E731
    return np.asarray(jax.jit(jax.vmap(of_row))(driven(state, gear))), notes


def test_rows_without_a_gear_are_predicted_as_in_the_gear_that_was_driven(folder):
    sheet = read_sheet(folder / "v.toml")
    logged, _ = declared(sheet, gear=True)
    state, notes = start(sheet, CHANNELS, **QUICK)
    assert any("trees" in n for n in notes)
    assert not any("last gear" in n for n in notes)
    told = np.asarray(scan(state, driven(state, gear=False))[1].model)  # nothing is measured: as it is declared
    sheet.gear_model = None
    last, notes = declared(sheet, gear=False)
    assert any("last gear" in n for n in notes)
    rms = lambda x: float(np.sqrt(np.mean((x - logged) ** 2)))  # noqa: E731
    assert rms(told) < 0.1 * rms(last)


def test_row_by_row_is_the_scan_and_the_trees_do_not_change(folder):
    sheet = read_sheet(folder / "v.toml")
    state, _ = start(sheet, CHANNELS, **QUICK)
    rows = driven(state, gear=False)  # as many as above: one compiled scan
    rows[:, state.form.columns.index("measured")] = 3.0
    after, now = scan(state, rows)
    live = Live(state)
    each = [live(row) for row in rows]
    np.testing.assert_allclose([n.predicted for n in each], now.predicted, rtol=1e-9)
    assert live.numbers.size < 3000, "the trees are no part of what a row changes"
    assert live.state.gears is not None
    np.testing.assert_array_equal(np.asarray(after.gears.trees.offset), np.asarray(state.gears.trees.offset))


def test_a_saved_model_is_the_classifier(folder):
    trees = read_gear_model(folder / "gears.json")
    assert trees.features == FEATURES
    assert trees.classes == (1.0, 2.0)
    x = np.array([[3.0, 1e3, 15e3], [20.0, 1e3, 15e3]])
    own = lightgbm.Booster(model_file=folder / "gears.txt").predict(x)
    told = jax.jit(lambda rows: trees.probabilities(rows))(jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(told, own, rtol=1e-5)
    assert GEAR_PROBABILITY not in trees.features


def test_a_file_of_distances_from_a_reference_gear_is_refused_where_it_does_not_say_which(folder, tmp_path):
    names = (folder / "gears.txt").read_text()
    learned = next(line for line in names.splitlines() if line.startswith("feature_names="))
    (tmp_path / "far.txt").write_text(names.replace(learned, f"feature_names={PLACE} a b"))
    with pytest.raises(InputError, match=f"has the feature '{PLACE}'.*save_gear_model"):
        read_gear_model(tmp_path / "far.txt")


def test_the_fitted_sheet_keeps_its_gear_model(folder, tmp_path):
    text = augmented_sheet(read_sheet(folder / "v.toml"), {"road.c_rr": (0.007, 1e-4)}, {})
    (tmp_path / "w.toml").write_text(text)
    assert read_sheet(tmp_path / "w.toml").gear_model == (folder / "gears.json").resolve()


@pytest.mark.parametrize(
    ("file", "more", "says"),
    [
        ("nothing.json", {}, "no such file"),
        ("map.csv", {}, "neither"),
        ("gears.json", {"gear_ratios": [9.0, 6.0, 4.0]}, "gear 3 of the sheet's 3"),
        ("gears.json", {"wheel_radius_m": None}, "wheel_radius_m is missing"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(folder, file, more, says):
    line = {"map": "map.csv", "gear_ratios": [9.0, 4.0], "final_drive": 4.0, "wheel_radius_m": 0.5, "gear_model": file}
    line = {k: v for k, v in (line | more).items() if v is not None}
    sheet = Sheet(path=folder / "x.toml", mass_kg=18e3, road={"c_rr": (0.006, 0.001), "cda_m2": 5.6}, driveline=line)
    with pytest.raises(InputError, match=says):
        start(sheet, CHANNELS)
