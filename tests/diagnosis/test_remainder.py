"""What is left: cycles are found with their period and size whatever their phase, noise has none; levels; formulas."""

import re
from collections.abc import Mapping
from dataclasses import replace

import lightgbm as lgb
import numpy as np
import pytest
from planted import opened

from hdev_jax.diagnosis.candidates.unnamed import Factor, _coefficient_unit, monomials, thresholds
from hdev_jax.diagnosis.noise.noise import Noise, estimate_noise
from hdev_jax.diagnosis.noise.spectrum import Clocked, strongest_period
from hdev_jax.diagnosis.remainder.learner import curve, learn, share_of
from hdev_jax.diagnosis.remainder.remainder import Formula, Remainder, remainder
from hdev_jax.diagnosis.remainder.rows import Rows
from hdev_jax.diagnosis.remainder.structure import (
    change_point,
    cycle_rms,
    levels_of,
    period_of,
    scales_with,
    shared_offset,
)
from hdev_jax.diagnosis.settings import SETTINGS
from hdev_jax.inference import Clusters
from hdev_jax.problem import Problem, Split
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


def noise_of(rows: Rows) -> Noise:
    return estimate_noise(rows.residual, rows.trip, rows.duration_s, levels=False)


def cycle_of(rows: Rows):
    return period_of(rows, noise_of(rows), SETTINGS)


@pytest.mark.parametrize("rho", [0.0, 0.97])
@pytest.mark.parametrize(("trips", "cycles", "size"), [(3, 5, 3.0), (3, 8.5, 3.0), (12, 3, 3.0)])
def test_a_cycle_is_found_with_its_period_and_size(rho, trips, cycles, size):
    found = cycle_of(residual(np.random.default_rng(1), trips, 300, rho=rho, cycles=cycles, size=size))
    assert found is not None
    assert found.period_s == pytest.approx(600.0 / cycles, rel=0.03)
    assert found.amplitude == pytest.approx(np.sqrt(2) * size, rel=0.12)


def test_a_single_trip_is_its_own_repetition():
    found = cycle_of(residual(np.random.default_rng(2), 1, 3000, cycles=40, size=1.0))
    assert found is not None
    assert found.period_s == pytest.approx(150.0, rel=0.02)


@pytest.mark.parametrize(("trips", "rho"), [(1, 0.97), (3, 0.9), (12, 0.0)])
def test_noise_has_no_cycle(trips, rho):
    rng = np.random.default_rng(3)
    assert sum(cycle_of(residual(rng, trips, 200, rho=rho)) is not None for _ in range(20)) <= 1


@pytest.mark.parametrize(("trips", "rho"), [(9, 0.0), (9, 0.97), (24, 0.9)])
def test_slow_noise_has_no_levels_of_trips(trips, rho):
    rng = np.random.default_rng(5)
    logs = [residual(rng, trips, 250, rho=rho) for _ in range(20)]
    seen = [levels for rows in logs if (levels := levels_of(rows, rows.residual, SETTINGS))]
    assert len(seen) <= 2  # of 20
    assert not any(levels.significant for levels in seen)


def test_a_trip_of_a_few_rows_does_not_hide_the_levels_of_the_others():
    rng = np.random.default_rng(4)
    rows = residual(rng, 8, 200)
    level = np.repeat(rng.normal(0, 2.0, 8), 200)
    trip, values = np.r_[rows.trip, 8, 8, 8], np.r_[rows.residual + level, 0.1, 0.0, -0.1]
    short = rows_of(values, Clusters(trip, 9, "trip"))
    found = levels_of(short, short.residual, SETTINGS)
    assert found is not None
    assert found.significant
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
    [((5.0, 5.5), 6, 0.06), ((4.0, 9.0), 40, 0.15)],
)
def test_a_weak_load_is_seen_in_rows_of_unequal_length(rows, period, load):
    """It stands out of coloured noise by what a long row has more of it than a short one."""
    rng = np.random.default_rng(11)

    def told(log: Rows) -> float | None:
        clocked = Clocked.of(log.trip, log.duration_s, log.worth, noise_of(log))
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
        found = levels_of(rows, rows.residual + np.repeat(level, 200), SETTINGS)
        assert found is not None
        assert found.significant
        assert found.sd == pytest.approx(np.sqrt(np.mean(level**2)), rel=0.25)


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
    assert [scales_with(travelled(seed, of), SETTINGS) for seed in range(5)] == [of] * 5


def test_trips_of_one_length_and_speed_tell_no_amounts_apart():
    assert scales_with(travelled(0, "time", alike=True), SETTINGS) is None


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
    correction, p, leading = learn(rows, rows, ["one", "other"], 0)
    assert share_of(rows.residual, correction) > 0.9
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


def test_noise_teaches_nothing():
    """Of twelve residuals of noise, none is confirmed by clusters left out at a thousandth."""
    rng, p = np.random.default_rng(1), []
    for seed in range(12):
        rows = residual(rng, 8, 100, rho=0.9)
        rows = replace(rows, features=rng.standard_normal((800, 3)))
        p.append(learn(rows, rows, ["one", "two", "three"], seed)[1])
    assert min(p) > 1e-3


def test_a_share_is_of_squares_and_a_curve_is_means_in_bins():
    rng = np.random.default_rng(0)
    rows = residual(rng, 4, 250)
    assert share_of(rows.residual, rows.residual) == 1.0
    assert share_of(rows.residual, -rows.residual) == 0.0
    assert share_of(rows.residual, 0.5 * rows.residual) == pytest.approx(0.75)
    rows = replace(rows, features=rng.uniform(-1, 1, (1000, 2)))
    told = curve(rows.features[:, 1] ** 2, rows, ["one", "other"], "other", "Wh")
    assert (told["channel"], told["unit"]) == ("other", "Wh")
    np.testing.assert_allclose(told["value"], np.square(told["at"]), atol=0.02)


# --- change points and shared offsets -------------------------------------------------------------------------------


def test_a_change_inside_a_trip_is_found_where_it_is():
    rng = np.random.default_rng(7)
    rows = residual(rng, 24, 400)
    late = (rows.trip == 2) & (np.arange(len(rows.trip)) % 400 >= 150)
    found = change_point(rows.residual + 1.5 * late, rows.trip, SETTINGS)
    assert found is not None
    trip, row = found
    assert trip == 2
    assert row - 800 == pytest.approx(150, abs=10)
    assert sum(change_point(residual(rng, 8, 200).residual, np.repeat(np.arange(8), 200), SETTINGS) is not None
               for _ in range(40)) == 0  # fmt: skip


def test_a_mean_that_all_trips_share_is_theirs_and_one_by_chance_is_not():
    rng, chance = np.random.default_rng(5), 0
    for _ in range(40):
        rows = residual(rng, 8, 50)
        levels = np.repeat(rng.normal(0.0, 2.0, 8), 50)
        chance += shared_offset(rows_of(rows.residual + levels, rows.clusters)) != 0.0
        assert shared_offset(rows_of(rows.residual + 5.0, rows.clusters)) == pytest.approx(5.0, abs=0.3)
    assert chance <= 3  # at a level of 1 %
    assert shared_offset(residual(rng, 1, 50)) == 0.0


def test_the_size_of_a_cycle_is_its_root_mean_square():
    rows = residual(np.random.default_rng(1), 8, 300, rho=0.9, cycles=6, size=2.0)
    found = cycle_of(rows)
    assert found is not None
    assert cycle_rms(rows, found.amplitude) == pytest.approx(2.0, rel=0.15)
    half = replace(rows, worth=np.full(2400, 0.5))
    assert cycle_rms(half, found.amplitude) == pytest.approx(0.5 * cycle_rms(rows, found.amplitude))


# --- all looks at what a model leaves of a log -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> tuple[Problem, Split]:
    return opened(tmp_path_factory.mktemp("log"), seed=31, trips=15, rows_per_trip=150)[1:]


def left_of(log: tuple[Problem, Split], residual: np.ndarray, formula: Formula | None = None) -> Remainder:
    problem, split = log
    predicted = problem.measured - residual
    return remainder(problem, split, predicted, predicted, formula, SETTINGS, given=predicted, seed=0)


def white(log) -> np.ndarray:
    return np.random.default_rng(4).standard_normal(len(log[0].measured))


def by_trip(log, sd: float) -> np.ndarray:
    _, trip = np.unique(np.asarray(log[0].segments.trip), return_inverse=True)
    return np.random.default_rng(5).normal(0.0, sd, trip.max() + 1)[trip]


def bump(log) -> np.ndarray:
    humid = np.asarray(log[0].segments.channels["humidity_pct"], dtype=float)
    low, high = np.quantile(humid, [0.3, 0.7])
    return np.where((humid > low) & (humid < high), 1.0, -1.0)


def test_noise_is_called_noise(log):
    left = left_of(log, white(log))
    assert not left.significant
    assert left.signature == "What is left looks like noise: independent from row to row."
    assert (left.depends_on, left.correction, left.scales_with) == ((), None, None)
    test = log[0].rows(log[1].test)
    assert left.noise_floor_rmse == pytest.approx(np.sqrt(np.mean(white(log)[test] ** 2)))


@pytest.mark.parametrize("levels", [0.0, 2.0])
def test_an_offset_of_all_trips_is_no_level_of_each(levels, log):
    """Both are left unexplained, and each is called what it is."""
    other = by_trip(log, levels)
    left = left_of(log, white(log) + (other if levels else 5.0))
    assert left.significant
    assert ("an offset of about +" in left.signature) == (levels == 0.0)
    assert ("random intercepts by trip" in left.signature) == (levels > 0.0)
    assert ("trip_id" in left.depends_on) == left.trips_differ == (levels > 0.0)
    train = log[0].rows(log[1].train)
    size = re.search(r"(?:offset of about \+|sd about )([\d.]+)", left.signature)
    assert size is not None
    assert float(size[1]) == pytest.approx(5.0 if levels == 0.0 else np.std(other[train]), rel=0.3)


@pytest.mark.filterwarnings("ignore:overflow encountered")  # of LightGBM, where nothing varies
def test_an_offset_that_leaves_nothing_else_is_no_levels_of_rounding(log):
    left = left_of(log, np.full(len(log[0].measured), 0.1))
    assert "an offset of about +0.1 Wh" in left.signature
    assert "levels" not in left.signature


def test_what_a_channel_predicts_is_told_with_its_shape_and_its_share(log):
    train, test = (log[0].rows(x) for x in (log[1].train, log[1].test))
    left = left_of(log, white(log) + 3.0 * bump(log))
    assert left.significant
    assert left.confirmed
    assert left.depends_on[0] == "humidity_pct"
    assert left.share > 0.5
    assert left.noise_floor_rmse == pytest.approx(np.sqrt(np.mean(white(log)[test] ** 2)), rel=0.35)
    assert left.correction is not None
    assert left.correction["channel"] == "humidity_pct"
    # training rows alone do not show it, nor test rows alone
    gone = left_of(log, white(log) + 3.0 * bump(log) * train)
    assert gone.share < 0.02
    assert not gone.confirmed
    assert gone.correction is None
    only_tested = left_of(log, white(log) + 3.0 * bump(log) * test)
    assert not only_tested.significant


def test_a_formula_is_told_with_its_words_and_lowers_the_floor(log):
    cause = 3.0 * bump(log)
    predicted = log[0].measured - white(log)
    left = left_of(log, white(log) + cause, Formula("3 Wh · bump", ("humidity_pct",), predicted))
    assert left.expression == "3 Wh · bump"
    assert "it follows 3 Wh · bump, which is no effect of the library" in left.signature
    test = log[0].rows(log[1].test)
    assert left.noise_floor_rmse <= np.sqrt(np.mean(white(log)[test] ** 2)) * (1 + 1e-9)


# --- terms without a name --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [s for kind in _SUFFIXES.values() for s in kind])
def test_every_suffix_gives_a_coefficient_its_unit(suffix):
    assert _coefficient_unit((Factor(f"something_{suffix}"), Factor("speed_mps", 2)), "W")


def test_monomials_carry_units_that_make_a_power(log):
    problem, _ = log
    sets = monomials(problem.segments, len(problem.segments))
    assert len(set(sets)) == len(sets)
    assert any({f.name for f in s} == {"humidity_pct", "cloud_cover"} for s in sets)
    square = Factor("ambient_temp_c", 2, 12.5)
    assert square.words() == "(ambient_temp_c − 12.5)²"
    np.testing.assert_allclose(square(problem.segments), (problem.segments.channels["ambient_temp_c"] - 12.5) ** 2)
    above = Factor("humidity_pct", above=70.0)
    assert above.words() == "[humidity_pct > 70]"
    np.testing.assert_array_equal(above(problem.segments), problem.segments.channels["humidity_pct"] > 70.0)


def test_thresholds_are_sought_ever_nearer(log):
    """First at every twentieth of the rows, then about the one that was best; a motion has none."""
    problem, n = log[0], len(log[0].measured)
    humid = np.asarray(problem.segments.channels["humidity_pct"], dtype=float)
    wide = thresholds((Factor("humidity_pct"), Factor("speed_mps")), problem.segments, n)
    assert {f.name for (f,) in wide} == {"humidity_pct"}
    best = wide[len(wide) // 2][0]
    near = thresholds((best,), problem.segments, n)
    assert best.above is not None
    ranks = [np.mean(humid <= f.above) - np.mean(humid <= best.above) for (f,) in near]
    assert max(np.abs(ranks)) < 0.15
    assert best not in [f for (f,) in near]
    assert thresholds((Factor("speed_mps", 2),), problem.segments, n) == []
