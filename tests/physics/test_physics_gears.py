"""Rows whose gear is known as probabilities: one-hot is the gear itself, the rest a mean, all with a gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import physics_rows as made
import pytest

from hdev_jax.physics import GEAR_PROBABILITY, EfficiencyMap, Vehicle
from hdev_jax.segments import Segments


@pytest.fixture
def car() -> Vehicle:
    rng = np.random.default_rng(3)
    return made.baseline(
        efficiency=EfficiencyMap(
            jnp.arange(1.0, 5.0),
            jnp.linspace(0.0, 500.0, 6),
            jnp.linspace(-3000.0, 3000.0, 8),
            jnp.asarray(rng.uniform(0.75, 0.95, (4, 6, 8))),
        )
    )


def with_shares(log: Segments, shares: np.ndarray) -> Segments:
    return log.without("gear").with_channels(**{GEAR_PROBABILITY: jnp.asarray(shares)})


def one_hot(log: Segments) -> np.ndarray:
    return np.eye(4)[np.asarray(log.channels["gear"]).astype(int) - 1]


def test_a_probability_of_one_is_the_gear_exactly(car: Vehicle) -> None:
    log = made.drives(*made.LENGTHS)
    compiled = eqx.filter_jit(lambda c, s: (c.energy(s), c.torque(s), jnp.stack([*c.breakdown(s).values()])))
    for one, other in zip(compiled(car, log), compiled(car, with_shares(log, one_hot(log))), strict=True):
        # to rounding: how a sum is ordered is the compiler's
        np.testing.assert_allclose(one, other, rtol=1e-14)


def test_efficiency_is_the_mean_over_the_gears(car: Vehicle) -> None:
    log = made.drives(*made.LENGTHS).without("motor_speed_radps")
    shares = np.random.default_rng(0).dirichlet(np.ones(4), len(log))
    force, speed, radius = np.asarray(car.force(log)), np.asarray(log.speed_mps), 0.5
    eta = np.zeros(len(log))
    for g, ratio in enumerate(np.asarray(car.driveline.gear_ratios) * 4.5 / radius):
        of = jax.vmap(lambda s, t, g=g: car.driveline.efficiency(g + 1.0, s, t))
        eta += shares[:, g] * np.asarray(of(speed * ratio, force / ratio))
    power = np.where(force > 0, force / eta, force * eta) * speed + 700.0  # the auxiliaries of these rows
    np.testing.assert_allclose(car.power(with_shares(log, shares)), power, rtol=1e-10, atol=1e-7)


def test_gradients_by_vehicle_and_by_probability(car: Vehicle) -> None:
    log = made.drives(*made.LENGTHS).without("motor_speed_radps")
    shares = jnp.asarray(np.random.default_rng(1).dirichlet(np.ones(4), len(log)))

    def energy(c_rr, values, ratios, shares):
        where = lambda c: (c.effect("rolling").c_rr, c.driveline.efficiency.values, c.driveline.gear_ratios)  # noqa: E731
        changed = eqx.tree_at(where, car, (c_rr, values, ratios))
        return jnp.sum(changed.energy(with_shares(log, shares))) / len(log)

    numbers = (car.effect("rolling").c_rr, car.driveline.efficiency.values, car.driveline.gear_ratios, shares)
    given = tuple(map(jnp.asarray, numbers))
    rng = np.random.default_rng(0)
    direction = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in given)
    reverse = jax.jit(jax.value_and_grad(lambda g: energy(*g)))
    jvp = jax.jit(lambda g, d: jax.jvp(energy, g, d)[1])
    _, gradient = reverse(given)
    for k, along in enumerate(direction):
        # by one kind of number at a time, as they are of different sizes
        only = tuple(along if j == k else jnp.zeros_like(x) for j, x in enumerate(given))
        forward = jvp(given, only)
        np.testing.assert_allclose(jnp.sum(gradient[k] * along), forward, rtol=1e-9, atol=1e-9)
        more, less = (reverse(jax.tree.map(lambda x, d, h=h: x + h * d, given, only))[0] for h in (1e-6, -1e-6))
        np.testing.assert_allclose((more - less) / 2e-6, forward, rtol=2e-4, atol=1e-4)
    by_share = gradient[3]
    assert np.all(np.isfinite(by_share))
    assert np.any(np.asarray(by_share) != 0)


def test_as_many_probabilities_as_ratios(car: Vehicle) -> None:
    log = made.drives(*made.LENGTHS)
    with pytest.raises(ValueError, match=r"shape \(3,\) for 4 gear ratios"):
        car.energy(with_shares(log, np.full((len(log), 3), 1 / 3)))
