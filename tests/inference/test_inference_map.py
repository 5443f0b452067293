"""Maps against logs: rows beyond the table, gears it lacks, and a map that is learned, beside the true one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdev_jax.errors import InputError
from hdev_jax.inference import padded
from hdev_jax.inference.maps import fit as map_fit
from hdev_jax.inference.maps.fit import learn_map
from hdev_jax.inference.sheet import build, read_sheet
from hdev_jax.physics import Driveline, EfficiencyMap, Machine, Vehicle
from hdev_jax.physics.road import Aero, Grade, Inertia, Rolling
from hdev_jax.segments import Segments

ONE = {"smooth": (1.0,)}  # where which strength is best is not what is asked

SHEET = """
mass_kg = 20000.0
[road]
c_rr = 0.006
cda_m2 = 5.5
[driveline]
map = "map.csv"
gear_ratios = [5.0, 2.0]
final_drive = 5.0
wheel_radius_m = 0.5
"""


def log(count: int, seed: int = 0) -> Segments:
    rng = np.random.default_rng(seed)
    v0 = rng.uniform(2.0, 22.0, count)
    v1 = np.maximum(v0 + rng.normal(0, 1.2, count), 0.5)
    duration = rng.uniform(4.0, 9.0, count)
    channels = {"gear": 1.0 + (v0 > 11), "grade_rad": rng.normal(0, 0.02, count), "mass_kg": np.full(count, 2e4)}
    zero = np.zeros(count, int)
    return Segments(zero, zero, np.cumsum(duration), duration, 0.5 * (v0 + v1) * duration, v0, v1, channels)


def true_map() -> EfficiencyMap:
    speeds = np.linspace(0.0, 1200.0, 7)
    torques = np.concatenate([-np.geomspace(2600, 60, 6), np.geomspace(60, 2600, 6)])
    w, t = np.meshgrid(speeds + 20, np.abs(torques), indexing="ij")
    eta = t * w / (t * w + 3.0 * w + 0.004 * t**2 + 400.0)
    return EfficiencyMap(
        jnp.array([1.0, 2.0]), jnp.asarray(speeds), jnp.asarray(torques), jnp.asarray([eta * 0.97, eta])
    )


def car(efficiency: EfficiencyMap) -> Vehicle:
    number = jnp.asarray
    road = (Inertia(number(1.0)), Grade(), Rolling(number(0.006)), Aero(number(5.5)))
    line = Driveline(efficiency, jnp.array([5.0, 2.0]), number(5.0), number(0.5))
    return Vehicle(road, mass_kg=number(2e4), driveline=line, machine=Machine(number(1.0), number(1.0)))


def unlearned(m: EfficiencyMap) -> EfficiencyMap:
    """The grid with one efficiency everywhere; of the same type as any other map, so that it shares their programs."""
    return eqx.tree_at(lambda m: m.values, m, jnp.asarray(np.full(m.values.shape, 0.85)))


def across(middle: float) -> np.ndarray:
    """Torques [Nm] as many as of the true map, one of them nearly or quite 0."""
    torques = np.linspace(-2600.0, 2600.0, 13)[1:]
    torques[5] = middle
    return torques


def write(folder, gears: tuple[int, ...], most_nm: float) -> None:
    lines = ["gear,motor_speed_radps,motor_torque_nm,efficiency"]
    lines += [f"{g},{s},{t},0.9" for g in gears for s in (0, 2000) for t in (-most_nm, most_nm)]
    (folder / "map.csv").write_text("\n".join(lines))
    (folder / "sheet.toml").write_text(SHEET)


def test_rows_beyond_the_map_are_reported(tmp_path):
    rows = log(600)
    write(tmp_path, (1, 2), 500.0)
    built = build(read_sheet(tmp_path / "sheet.toml"), rows, "road", "energy_wh")
    (note,) = (n for n in built.notes if "beyond its edge" in n)
    ratio = np.where(rows.channels["gear"] == 1, 50.0, 20.0)
    share = 100 * np.mean(np.abs(np.asarray(car(true_map()).force(rows)) / ratio) > 500.0)
    assert share > 0.2
    assert f"{share:.2g} % of the moving rows" in note
    write(tmp_path, (1, 2), 1e5)
    assert not [n for n in build(read_sheet(tmp_path / "sheet.toml"), rows, "road", "energy_wh").notes if "edge" in n]


def test_a_gear_that_the_map_lacks_is_refused(tmp_path):
    rows = log(50)
    write(tmp_path, (2, 3), 1e5)
    with pytest.raises(InputError, match=r"map\.csv: the log's row \d+ drives in gear 1, .* it has gears 2, 3") as e:
        build(read_sheet(tmp_path / "sheet.toml"), rows, "road", "energy_wh")
    assert "\n" not in str(e.value)
    with pytest.raises(InputError, match="gear 2, which the grid does not have"):
        one = true_map()
        learn_map(
            car(one), rows, np.zeros(50), EfficiencyMap(one.gears[:1], one.speeds_radps, one.torques_nm, one.values[:1])
        )
    with pytest.raises(InputError, match="no column 'gear'"):
        learn_map(car(true_map()), rows.without("gear"), np.zeros(50), true_map())


@pytest.mark.parametrize("gears", [(1,), (1, 2, 3)])
def test_a_gear_without_a_ratio_is_refused(tmp_path, gears):
    rows = log(50)
    rows = rows.with_channels(gear=np.where(np.arange(50) == 7, 3.0, rows.channels["gear"]))
    write(tmp_path, gears, 1e5)  # a map of one gear holds for all, the sheet has two ratios
    with pytest.raises(InputError, match=r"gear_ratios has 2 gears, but the log is in gear 3; a ratio") as e:
        build(read_sheet(tmp_path / "sheet.toml"), rows, "road", "energy_wh")
    assert "\n" not in str(e.value)


def of_shape(speeds: int, torques: int) -> EfficiencyMap:
    m = true_map()
    return EfficiencyMap(m.gears, m.speeds_radps[:speeds], m.torques_nm[:torques], m.values[:, :speeds, :torques])


@pytest.mark.parametrize(
    ("energy", "start", "said"),
    [
        (np.full(60, np.nan), true_map(), "a finite energy for each of 60 rows"),
        (np.zeros(59), true_map(), "found 59"),
        (np.zeros(60), of_shape(1, 12), "two speeds and two torques"),
        (np.zeros(60), of_shape(7, 1), "two speeds and two torques"),
    ],
)
def test_what_cannot_be_learned_from_is_said_in_a_line(energy, start, said):
    with pytest.raises(InputError, match=said):
        learn_map(car(true_map()), log(60), energy, start)


def test_the_jacobian_by_colours_is_the_kernels():
    fit, start = padded(log(80), np.zeros(80)), true_map()
    rows, problem = fit.segments, map_fit._Problem(car(start), fit.segments, fit.measured, start)
    eta = np.asarray(start.values).ravel() + 0.01 * np.random.default_rng(0).normal(size=start.values.size)
    whole = jax.jacobian(lambda x: map_fit._energy(car(start), start, rows, x)[:80])(jnp.asarray(eta))
    np.testing.assert_allclose(problem.jacobian(eta).toarray(), whole, atol=1e-10)


def test_a_grid_that_holds_a_torque_of_nearly_zero():
    rows, truth = log(600), true_map()
    energy = np.asarray(car(truth).energy(rows)) + 0.5 * np.random.default_rng(1).normal(size=len(rows))
    start = EfficiencyMap(truth.gears, truth.speeds_radps, jnp.asarray(across(5e-13)), unlearned(truth).values)
    found = learn_map(car(start), rows, energy, start, **ONE)
    assert found.converged
    assert found.noise_wh < 1.0
    assert found.map.values.min() > 0.2


@pytest.mark.parametrize("floor", [0.05, 0.3])
def test_what_a_table_says_of_no_torque_does_not_touch_its_neighbours(floor):
    rows, truth = log(600, 1), true_map()
    torques = across(0.0)
    w, t = np.meshgrid(np.asarray(truth.speeds_radps) + 20.0, np.abs(torques), indexing="ij")
    eta = np.maximum(t * w / (t * w + 3.0 * w + 0.004 * t**2 + 400.0), floor)
    truth = EfficiencyMap(truth.gears, truth.speeds_radps, jnp.asarray(torques), jnp.asarray([eta * 0.97, eta]))
    energy = np.asarray(car(truth).energy(rows)) + 0.5 * np.random.default_rng(2).normal(size=len(rows))
    found = learn_map(car(truth), rows, energy, unlearned(truth), **ONE)
    assert found.noise_wh < 0.65
    speed, torque = (np.asarray(x) for x in map_fit.operating_points(car(truth), rows))
    away = np.abs(torque) > 434.0  # beyond the nodes next to it
    points = rows.channels["gear"][away], speed[away], torque[away]
    off = [np.asarray(jax.vmap(m)(*points)) for m in (found.map, truth)]
    assert away.sum() > 50
    assert np.sqrt(np.mean((off[0] - off[1]) ** 2)) < 0.005


def test_rows_that_stand_say_nothing_of_a_map():
    rows, truth = log(600), true_map()
    energy = np.asarray(car(truth).energy(rows)) + 0.5 * np.random.default_rng(1).normal(size=len(rows))
    still = np.zeros(len(rows), bool)
    still[::3] = True
    stand = lambda x: np.where(still, 0.0, np.asarray(x))  # noqa: E731
    stopped = eqx.tree_at(
        lambda s: (s.distance_m, s.speed_start_mps, s.speed_end_mps), rows,
        tuple(map(stand, (rows.distance_m, rows.speed_start_mps, rows.speed_end_mps))),
    )  # fmt: skip
    start = unlearned(truth)
    with_them = learn_map(car(start), stopped, np.where(still, 20.0, energy), start, **ONE)
    without = learn_map(car(start), rows.take(~still), energy[~still], start, **ONE)
    np.testing.assert_allclose(with_them.map.values, without.map.values, atol=1e-6)
    assert with_them.noise_wh == pytest.approx(without.noise_wh, rel=1e-6)


@pytest.mark.parametrize("wrong", [{"smooth": ()}, {"smooth": (-1.0,)}, {"mean": 1.0}, {"wide": 0.0}])
def test_a_prior_that_is_none(wrong):
    with pytest.raises(ValueError, match="strengths of the prior"):
        learn_map(car(true_map()), log(60), np.zeros(60), true_map(), **wrong)


def test_a_hole_in_a_channel_is_named():
    rows = log(60)
    rows.channels["grade_rad"][7] = np.nan
    with pytest.raises(InputError, match="row 8, column 'grade_rad'"):
        learn_map(car(true_map()), rows, np.zeros(60), true_map())


def test_equal_rows_of_equal_energy():
    rows = log(60).take(np.zeros(100, int))
    found = learn_map(car(true_map()), rows, np.full(100, 30.0), true_map(), **ONE)
    assert np.all(np.isfinite(found.map.values))


def test_energies_without_noise_are_met():
    rows, truth = log(600), true_map()
    found = learn_map(car(truth), rows, np.asarray(car(truth).energy(rows)), truth, **ONE)
    assert found.noise_wh < 0.1


def test_axes_must_increase():
    m = true_map()
    with pytest.raises(ValueError, match="torques_nm must increase"):
        EfficiencyMap(m.gears, m.speeds_radps, m.torques_nm[::-1], m.values)


def test_a_learned_map_is_the_true_one_where_the_log_has_been():
    rows, truth = log(1000, 2), true_map()
    vehicle = car(truth)
    rng = np.random.default_rng(1)
    energy = np.asarray(vehicle.energy(rows)) + 0.5 * rng.normal(size=len(rows))
    start = unlearned(truth)
    found = learn_map(car(start), rows, energy, start)
    assert found.converged
    assert 0.45 < found.noise_wh < 0.55
    assert found.rows.sum() == len(rows)
    ratio = np.where(rows.channels["gear"] == 1, 50.0, 20.0)
    speed, torque = np.asarray(rows.speed_mps) * ratio, np.asarray(vehicle.force(rows)) / ratio
    eta = [np.asarray(jax.vmap(m)(rows.channels["gear"], speed, torque)) for m in (found.map, truth)]
    i = np.clip(np.searchsorted(truth.speeds_radps, speed) - 1, 0, 5)
    j = np.clip(np.searchsorted(truth.torques_nm, torque) - 1, 0, 10)
    cell = (rows.channels["gear"].astype(int) * 6 + i) * 11 + j
    seen = [c for c in np.unique(cell) if np.sum(cell == c) >= 25 and c % 11 != 5]  # 5: torque changes sign, no power
    errors = np.array([np.mean((eta[0] - eta[1])[cell == c]) for c in seen])
    sd = np.array([found.sd[c // 66 - 1, c // 11 % 6 : c // 11 % 6 + 2, c % 11 : c % 11 + 2].max() for c in seen])
    assert len(seen) > 8
    assert np.all(np.abs(errors) < 0.01)
    assert np.all(np.abs(errors) < np.maximum(0.003, 4.0 * sd)), "what is off is known to be uncertain"
    many, none = found.rows.max(), np.argwhere(found.rows == 0)[0]
    busiest = np.argwhere(found.rows == many)[0]
    assert found.sd[tuple(busiest)] < 0.5 * found.sd[tuple(none)], "it knows less where the log has not been"


def rms_of_cells(seen, rows, energy):
    """Root mean square of cells' mean errors, cells of 50 rows and more, and what was found."""
    truth = true_map()
    vehicle = car(unlearned(truth))
    points = rows.channels["gear"], *map_fit.operating_points(vehicle, rows)
    g, i, j = map_fit.cells_of(truth, *(np.asarray(x) for x in points))
    cell = (g * 6 + i) * 11 + j
    found = learn_map(vehicle, seen, energy, truth, **ONE)
    error = np.asarray(jax.vmap(found.map)(*points)) - np.asarray(jax.vmap(truth)(*points))
    often = [c for c in np.unique(cell) if np.sum(cell == c) >= 50]
    return float(np.sqrt(np.mean([np.mean(error[cell == c]) ** 2 for c in often]))), found


@pytest.mark.slow
def test_readings_are_not_taken_for_exact(monkeypatch):
    rows = jax.tree.map(jnp.asarray, log(6000))
    energy, errors = np.asarray(car(true_map()).energy(rows)), 8e-3 * np.random.default_rng(1).normal(size=len(rows))
    noisy = rows.with_channels(grade_rad=rows.channels["grade_rad"] + errors)
    logs = {"noisy": noisy, "none": rows.without("grade_rad")}
    ours = {name: rms_of_cells(seen, rows, energy) for name, seen in logs.items()}
    # about what their readings tell, slopes are uncertain by less than the readings err
    shrunk = 1.0 - 8e-3**2 / float(np.var(noisy.channels["grade_rad"]))
    assert ours["noisy"][1].instruments["grade_rad"] == pytest.approx(8e-3 * np.sqrt(shrunk), rel=0.1)
    exact = lambda log, instruments, moves: [log]  # noqa: E731
    monkeypatch.setattr(map_fit, "believed", exact)
    plain = {name: rms_of_cells(seen, rows, energy) for name, seen in logs.items()}
    assert ours["noisy"][0] < 0.75 * plain["noisy"][0]
    assert ours["none"][0] < plain["none"][0], "slopes that nobody read are none that were read as 0"


def test_a_row_whose_speed_is_no_number_is_named():
    rows = log(300)
    rows.speed_end_mps[30] = np.nan
    with pytest.raises(InputError, match="in row 31 is not finite"):
        learn_map(car(true_map()), rows, np.ones(300), true_map())
