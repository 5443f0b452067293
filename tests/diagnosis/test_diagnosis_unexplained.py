"""What is left: cycles are found with their period and size whatever their phase, noise has none; levels; formulas."""

from collections.abc import Mapping
from dataclasses import replace

import lightgbm as lgb
import numpy as np
import pytest
from planted import ROAD_SIDE

from hdev_jax.diagnosis.candidates.expression import (
    TERM,
    DescribedForce,
    Factor,
    _coefficient_unit,
    find_expression,
    monomials,
)
from hdev_jax.diagnosis.noise.spectrum import Clocked, strongest_period
from hdev_jax.diagnosis.remainder.unexplained import (
    Rows,
    _learner,
    _levels,
    _noise,
    _period,
    _scale,
    remainder,
    swing_w,
)
from hdev_jax.diagnosis.scores.look import Loop, Search
from hdev_jax.fleet import synthetic_log
from hdev_jax.inference import Clusters, calibrate, cluster_rows, padded
from hdev_jax.inference.sheet import read_sheet
from hdev_jax.logs import read_log
from hdev_jax.problem import prepare
from hdev_jax.units import _SUFFIXES


def residual(rng, trips: int, rows: int, *, rho: float = 0.0, cycles: float = 0.0, size: float = 0.0) -> Rows:
    """AR(1) noise of variance 1 with a sine of RMS `size` of a phase of its own in each trip; rows of 2 s."""
    noise = rng.standard_normal((trips, rows))
    for k in range(1, rows):
        noise[:, k] = rho * noise[:, k - 1] + np.sqrt(1 - rho**2) * noise[:, k]
    clock = np.arange(rows) / rows
    wave = np.sqrt(2) * np.sin(2 * np.pi * (cycles * clock + rng.random((trips, 1))))
    trip = np.repeat(np.arange(trips), rows)
    clusters = Clusters(trip, trips, "trip")
    return rows_of((noise + size * wave).ravel(), clusters)


def rows_of(residual: np.ndarray, clusters: Clusters) -> Rows:
    """Rows of 2 s and 20 m without features, each cluster a trip."""
    n = len(residual)
    amounts = {"time": np.full(n, 2.0), "distance": np.full(n, 20.0), "energy": np.ones(n)}
    return Rows(
        np.zeros((n, 1)), residual, clusters, clusters.ids, np.full(n, 2.0), np.ones(n), "kW", np.ones(n), amounts
    )


def cycle_of(rows):
    return _period(rows, _noise(rows))


@pytest.mark.parametrize("rho", [0.0, 0.97])
@pytest.mark.parametrize(("trips", "cycles", "size"), [(3, 5, 3.0), (3, 8.5, 3.0), (8, 4, 3.0), (12, 3, 3.0)])
def test_a_cycle_is_found_with_its_period_and_size(rho, trips, cycles, size):
    found = cycle_of(residual(np.random.default_rng(1), trips, 300, rho=rho, cycles=cycles, size=size))
    assert found is not None
    assert found.period_s == pytest.approx(600.0 / cycles, rel=0.03)
    assert found.amplitude == pytest.approx(np.sqrt(2) * size, rel=0.12)


def test_a_cycle_swings_by_its_amplitude_in_watts_where_the_rows_are_a_power():
    rows = residual(np.random.default_rng(1), 8, 300, rho=0.9, cycles=6, size=2.0)
    np.testing.assert_allclose(swing_w(rows), 1000.0 * np.sqrt(2) * 2.0, rtol=0.3)
    np.testing.assert_array_equal(swing_w(replace(rows, cycle_unit="N")), np.zeros(2400))
    np.testing.assert_array_equal(swing_w(residual(np.random.default_rng(1), 8, 300, rho=0.9)), np.zeros(2400))


def test_a_single_trip_is_its_own_repetition():
    found = cycle_of(residual(np.random.default_rng(2), 1, 3000, cycles=40, size=1.0))
    assert found is not None
    assert found.period_s == pytest.approx(150.0, rel=0.02)


@pytest.mark.parametrize("rho", [0.0, 0.9, 0.97])
@pytest.mark.parametrize("trips", [1, 2, 3, 12])
def test_noise_has_no_cycle(rho, trips):
    rng = np.random.default_rng(3)
    assert sum(cycle_of(residual(rng, trips, 300, rho=rho)) is not None for _ in range(40)) <= 1


@pytest.mark.parametrize("rho", [0.0, 0.9, 0.97])
@pytest.mark.parametrize("trips", [9, 24])
def test_slow_noise_has_no_levels_of_trips(rho, trips):
    rng = np.random.default_rng(5)
    logs = [residual(rng, trips, 250, rho=rho) for _ in range(20)]
    seen = [levels for rows in logs if (levels := _levels(rows, rows.residual))]
    assert len(seen) <= 2  # of 20
    assert not any(levels.told for levels in seen)


@pytest.mark.parametrize("levels", [0.0, 2.0])
def test_an_offset_of_all_trips_is_no_level_of_each(levels):
    """Both are left unexplained, and each is called what it is."""
    rng = np.random.default_rng(6)
    trips = [f"T{k}" for k in range(24)]
    rows = residual(rng, 24, 250, rho=0.9)
    other = np.repeat(rng.normal(0.0, levels, 24), 250)
    left = remainder(rows_of(rows.residual + 5.0 + other, rows.clusters), rows, ["x"], "Wh", trips, seed=0)
    assert left.significant
    assert ("an offset of about +" in left.signature) == (levels == 0.0)
    assert ("levels that differ by trip" in left.signature) == (levels > 0.0)
    assert ("trip_id" in left.depends_on) == (levels > 0.0)
    assert left.rms == pytest.approx(5.0 if levels == 0.0 else np.std(other), rel=0.3)


@pytest.mark.parametrize("trips", [6, 16])
def test_levels_that_differ_about_nothing_are_no_offset(trips):
    """However far chance moves their mean, and however few there are to differ about it."""
    rng = np.random.default_rng(8)
    said = []
    for _ in range(12):
        rows = residual(rng, trips, 250, rho=0.0)
        other = np.repeat(rng.normal(0.0, 0.3, trips), 250)
        rows = rows_of(rows.residual + other, rows.clusters)
        said.append(remainder(rows, rows, ["x"], "Wh", [f"T{k}" for k in range(trips)], seed=0).signature)
    assert sum("levels that differ" in x for x in said) >= 5
    assert sum("offset" in x for x in said) <= 1


def test_a_change_in_a_trip_has_a_size():
    """One alone tells how much is left: what decides whether coefficients of whitened rows are told."""
    rng = np.random.default_rng(7)
    rows = residual(rng, 24, 400, rho=0.0)
    trips = [f"T{k}" for k in range(24)]
    late = (rows.trip == 2) & (np.arange(len(rows.trip)) % 400 >= 150)
    left = remainder(rows_of(rows.residual + 1.5 * late, rows.clusters), rows, ["x"], "Wh", trips, seed=0)
    assert "a change inside trip T2 after 5 min" in left.signature
    # the means of the two parts about the trip's own, over all rows
    assert left.rms == pytest.approx(1.5 * np.sqrt(150 * 250 / 400 / 9600), rel=0.15)


def test_a_trip_of_a_few_rows_does_not_hide_the_levels_of_the_others():
    rng = np.random.default_rng(4)
    rows = residual(rng, 8, 200)
    level = np.repeat(rng.normal(0, 2.0, 8), 200)
    trip, values = np.r_[rows.trip, 8, 8, 8], np.r_[rows.residual + level, 0.1, 0.0, -0.1]
    short = rows_of(values, Clusters(trip, 9, "trip"))
    found = _levels(short, short.residual)
    assert found is not None
    assert found.told
    assert found.worst == int(np.argmax(np.abs(level[::200])))
    assert found.sd == pytest.approx(np.std(level), rel=0.3)


def _uneven(rng, shortest: float, longest: float, period: float, load: float) -> Rows:
    """Eight trips of 400 rows that differ in length: energy with AR(1) noise, and a load of so many mean rows a cycle
    whose phase is each trip's own. Sizes are over the noise's sd."""
    shape = (8, 400)
    seconds = rng.uniform(shortest, longest, shape)
    noise = residual(rng, *shape, rho=0.97).residual
    clock = np.cumsum(seconds, axis=1) - 0.5 * seconds
    turn = clock / (period * 0.5 * (shortest + longest)) + rng.random((8, 1))
    energy = load * (np.sqrt(2) * np.sin(2 * np.pi * turn) * seconds).ravel() / float(np.mean(seconds))
    rows = rows_of(noise + energy, Clusters(np.repeat(np.arange(8), 400), 8, "trip"))
    return replace(rows, duration_s=seconds.ravel(), worth=seconds.ravel() / 3.6, amounts={})


@pytest.mark.parametrize(
    ("rows", "period", "load"),
    [((5.0, 5.5), 6, 0.06), ((5.0, 5.5), 20, 0.2), ((4.0, 9.0), 6, 0.06), ((4.0, 9.0), 40, 0.15)],
)
def test_a_weak_load_is_seen_in_rows_of_unequal_length(rows, period, load):
    """It stands out of coloured noise by what a long row has more of it than a short one."""
    rng = np.random.default_rng(11)

    def told(log: Rows) -> float | None:
        clocked = Clocked.of(log.trip, log.duration_s, log.worth, _noise(log))
        hit = strongest_period(log.residual, clocked)
        return hit.period_s if hit is not None and hit.p < 1e-3 else None

    found = [told(_uneven(rng, *rows, period, load)) for _ in range(8)]
    assert sum(f == pytest.approx(period * np.mean(rows), rel=0.03) for f in found) >= 7
    assert sum(told(_uneven(rng, *rows, period, 0.0)) is not None for _ in range(8)) <= 1


@pytest.mark.parametrize("rho", [0.0, 0.9])
@pytest.mark.parametrize("alike", [True, False])
def test_levels_stay_told_however_large(rho, alike):
    """A constant in each trip is in every lag of the residual: no autoregression may pass for it."""
    for size in (1.0, 2.0, 5.0, 30.0):
        rng = np.random.default_rng(2)
        rows = residual(rng, 12, 200, rho=rho)
        level = size * (np.ones(12) if alike else rng.standard_normal(12))
        found = _levels(rows, rows.residual + np.repeat(level, 200))
        assert found is not None
        assert found.told
        assert found.sd == pytest.approx(np.sqrt(np.mean(level**2)), rel=0.25)


def test_a_weak_offset_of_all_trips_is_not_suspected_to_differ():
    rng, looks = np.random.default_rng(50), []
    for _ in range(10):
        rows = residual(rng, 8, 200, rho=0.9)
        rows = rows_of(rows.residual + 0.6, rows.clusters)
        looks.append(remainder(rows, rows, ["x"], "W", [f"T{k}" for k in range(8)], seed=0))
    assert sum(left.trips_differ for left in looks) <= 1


@pytest.mark.filterwarnings("ignore:overflow encountered")  # of LightGBM, where nothing varies
@pytest.mark.parametrize("offset", [0.1, 1.0])
def test_an_offset_that_leaves_nothing_else_is_no_levels_of_rounding(offset):
    rows = residual(np.random.default_rng(0), 8, 50)
    rows = rows_of(np.full(400, offset), rows.clusters)
    left = remainder(rows, rows, ["x"], "W", [f"T{k}" for k in range(8)], seed=0)
    assert f"an offset of about {offset:+.2g} W" in left.signature
    assert left.rms == pytest.approx(offset)


@pytest.mark.parametrize("seed", [7, 9])
def test_pieces_of_a_few_rows_have_no_say_in_what_trips_share(seed):
    rng = np.random.default_rng(seed)
    trip = np.r_[np.repeat(np.arange(12), 200), np.repeat(np.arange(12, 16), 2)]
    rows = rows_of(2.0 + 4.0 * rng.standard_normal(len(trip)), Clusters(trip, 16, "trip"))
    left = remainder(rows, rows, ["x"], "W", [f"T{k}" for k in range(16)], seed=0)
    assert "an offset of about +" in left.signature
    assert "levels" not in left.signature


def test_levels_of_a_few_trips_are_suspected_before_they_are_told():
    """Slow noise wanders nearly as far. What lives between trips may hide there all the same, and nothing is named."""
    rng = np.random.default_rng(9)
    names, looks = [f"T{k}" for k in range(8)], []
    for _ in range(12):
        rows = residual(rng, 8, 600, rho=0.97)
        rows = rows_of(rows.residual + np.repeat(rng.normal(0.0, 0.7, 8), 600), rows.clusters)
        looks.append(remainder(rows, rows, ["x"], "W", names, seed=0))
    told = ["trip_id" in left.depends_on for left in looks]
    assert sum(left.trips_differ for left in looks) >= 8
    assert all(left.trips_differ for left, by_trip in zip(looks, told, strict=True) if by_trip)
    suspected = [left for left, by_trip in zip(looks, told, strict=True) if left.trips_differ and not by_trip]
    assert suspected
    assert not any("levels" in left.signature for left in suspected)


def travelled(seed: int, of: str | None, *, alike: bool = False) -> Rows:
    """Trips of one length or of several, and of speeds and forces of their own; a remainder so much of one amount."""
    rng = np.random.default_rng(seed)
    trips, longest = 12, 400
    lengths = np.full(trips, longest) if alike else rng.integers(60, longest, trips)
    trip = np.repeat(np.arange(trips), lengths)
    speed, force = np.ones(trips), np.ones(trips)
    if not alike:
        speed, force = rng.uniform(5, 25, trips), rng.uniform(1, 9, trips)
    amounts: Mapping[str, np.ndarray] = {
        "time": np.full(len(trip), 2.0), "distance": 2.0 * speed[trip], "energy": 2.0 * (speed * force)[trip]
    }  # fmt: skip
    residual = rng.standard_normal(len(trip))
    if of is not None:
        residual += 0.6 * amounts[of] / np.sqrt(np.mean(amounts[of] ** 2))
    return replace(rows_of(residual, Clusters(trip, trips, "trip")), amounts=amounts)


@pytest.mark.parametrize("of", ["time", "distance", "energy", None])
def test_what_a_trips_remainder_is_in_proportion_to(of):
    assert [_scale(travelled(seed, of)) for seed in range(5)] == [of] * 5


def test_trips_of_one_length_and_speed_tell_no_amounts_apart():
    assert _scale(travelled(0, "time", alike=True)) is None


def test_a_fold_has_no_say_in_the_rounds_that_predict_it(monkeypatch):
    """The rows that a model predicts are in neither part of the run that chooses its number of rounds."""
    rng, trained, judged = np.random.default_rng(0), [], []
    n, real = 800, lgb.train
    rows = replace(rows_of(rng.standard_normal(n), Clusters(np.repeat(np.arange(8), 100), 8, "trip")))
    x = rng.standard_normal((n, 2))
    rows = replace(rows, features=x, residual=x[:, 0] + 0.1 * rng.standard_normal(n))

    def train(parameters, data, rounds, valid_sets=(), **options):
        trained.append([set(np.asarray(d.label)) for d in (data, *valid_sets)])
        return real(parameters, data, rounds, valid_sets=list(valid_sets), **options)

    monkeypatch.setattr(lgb, "train", train)
    _, share, p, leading = _learner(rows, rows, ["one", "other"], 0)
    assert share > 0.9
    assert p < 1e-3
    assert leading == ("one",)
    *folds, (last,) = trained
    labels = {np.float32(y) for y in rows.residual / np.std(rows.residual)}
    assert len(last) == len(labels) == n
    for (inside, stop), (fitted,) in zip(folds[::2], folds[1::2], strict=True):
        out = last - fitted  # the fold that this model predicts
        judged.append(out)
        assert not out & (inside | stop)
        assert inside | stop == fitted
    assert set.union(*judged) == last
    assert sum(len(out) for out in judged) == n


@pytest.mark.parametrize("target", ["traction_force_n", "motor_torque_nm"])
def test_a_formula_is_found_where_the_target_lies_before_the_battery(target, tmp_path):
    """A force in proportion to a channel, where the target is the force at the wheels or the torque at the shaft."""
    files = synthetic_log(seed=2, trips=12, rows_per_trip=120, entry="shaft", mode="samples").write(tmp_path)
    files["sheet"].write_text(files["sheet"].read_text() + ROAD_SIDE)
    problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]), target)
    sway = np.random.default_rng(1).standard_normal(len(problem.segments))
    problem = replace(problem, segments=problem.segments.with_channels(sway=sway))
    base = problem.predict(problem.vehicle)
    pushed = problem.segments.with_channels(**{TERM: 900.0 * sway})
    cause = problem.predict(problem.vehicle.plus(DescribedForce(np.asarray(1.0))), pushed) - base
    if target == "traction_force_n":
        moving = np.asarray(problem.segments.speed_mps) > 0  # brakes hold a vehicle that stands
        np.testing.assert_allclose(cause, np.where(moving, 900.0 * sway, 0.0))
    noise = 0.3 * np.std(cause) * np.random.default_rng(0).standard_normal(len(base))
    rows, clusters = padded(problem.segments, base + cause + noise), cluster_rows(problem.segments)
    fit = calibrate(problem.vehicle, problem.table, rows, problem.target, clusters)
    loop = Loop(rows, problem.target, clusters, [], 0.05, np.random.default_rng(0), 4)
    found = find_expression(
        Search(problem.vehicle, problem.table, fit), loop, problem.segments, predict=problem.predict
    )
    assert found is not None
    assert found.factors[0] == Factor("sway")  # maybe times a channel that hardly changes
    assert " N" in found.formula
    better = np.std(base + cause - found.predicted) / np.std(base + cause - fit.predicted)
    assert better < 0.2


@pytest.mark.parametrize("suffix", [s for kind in _SUFFIXES.values() for s in kind])
def test_every_suffix_gives_a_coefficient_its_unit(suffix):
    assert _coefficient_unit((Factor(f"something_{suffix}"), Factor("speed_mps", 2)), "W")


def test_monomials_carry_units_that_make_a_power(tmp_path):
    files = synthetic_log(seed=3, trips=6, rows_per_trip=60).write(tmp_path, truth=False)
    problem = prepare(read_log([files["log"]]), read_sheet(files["sheet"]))
    sets = monomials(problem.segments, len(problem.segments))
    assert len(set(sets)) == len(sets)
    assert any({f.name for f in s} == {"humidity_pct", "cloud_cover"} for s in sets)
    square = Factor("ambient_temp_c", 2, 12.5)
    assert square.words() == "(ambient_temp_c − 12.5)²"
    np.testing.assert_allclose(square(problem.segments), (problem.segments.channels["ambient_temp_c"] - 12.5) ** 2)
    above = Factor("humidity_pct", above=70.0)
    assert above.words() == "[humidity_pct > 70]"
    np.testing.assert_array_equal(above(problem.segments), problem.segments.channels["humidity_pct"] > 70.0)
