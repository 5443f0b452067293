"""The training loop: restarts to the last bit, whom an error names, the schedule, members side by side."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from hdev_jax.errors import InputError
from hdev_jax.learn.train import NotFiniteError, Plan, train

KEY = jax.random.key(3)


@dataclass(frozen=True)
class Line:
    """Least squares, with noise on the inputs from the key; the memory counts how often each entry was seen."""

    noise: float = 0.0
    bad: int = -1  # the entry whose loss is not finite
    after: int = 0  # so many batches

    def loss(self, weights: Any, memory: Any, batch: Any, key: Any, settings: Any) -> Any:
        x = batch["x"] + self.noise * jax.random.normal(key, batch["x"].shape, batch["x"].dtype)
        loss = jnp.mean((x @ weights - batch["y"]) ** 2) * (1.0 if settings is None else settings)
        batches = jnp.sum(memory) // batch["at"].shape[0]
        wrong = jnp.any(batch["at"] == self.bad) & (batches >= self.after)
        return jnp.where(wrong, jnp.nan, loss), memory.at[batch["at"]].add(1)

    def score(self, weights: Any, memory: Any, data: Any, settings: Any) -> Any:
        return jnp.mean((data["x"] @ weights - data["y"]) ** 2)


@dataclass(frozen=True)
class March:
    """One weight that walks up by the rate times its factor in every epoch; scored by the distance from `best`."""

    best: float | None = None

    def loss(self, weights: Any, memory: Any, batch: Any, key: Any, settings: Any) -> Any:
        return -weights, memory

    def score(self, weights: Any, memory: Any, data: Any, settings: Any) -> Any:
        return jnp.ones(()) if self.best is None else jnp.abs(weights - self.best)


def rows(n: int = 40, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    y = x @ [1.0, -2.0, 0.5] + rng.normal(0, 0.3, n)
    return {"x": jnp.asarray(x, jnp.float32), "y": jnp.asarray(y, jnp.float32), "at": jnp.arange(n)}


def start(n: int = 40) -> tuple[Any, Any]:
    return jnp.zeros(3, jnp.float32), jnp.zeros(n, jnp.int32)


UNIT = optax.sgd(1.0)


def marched(plan: Plan, best: float | None = None, held: Any = 0, **kwargs: Any) -> Any:
    data = jnp.zeros((2, 1))
    held = data if held == 0 else held
    return train(March(best), jnp.zeros(()), None, data, UNIT, plan, key=KEY, held=held, **kwargs)


class KilledError(Exception):
    pass


def kill_at(last: int) -> Any:
    def tell(epoch: int, loss: float, score: float) -> None:
        if epoch == last:
            raise KilledError

    return tell


# the same objects, so that what is compiled of them is shared
SGD = optax.sgd(0.05)
NOISY = Line(noise=0.2)
PLAN = Plan(epochs=8, batch=7, patience=2, stop_after=3)


KEYS = jax.random.split(KEY, 4)
STARTS = jax.random.normal(KEY, (4, 3), jnp.float32)


def alone(member: int, setting: float) -> Any:
    """One member by itself."""
    return train(
        NOISY, STARTS[member], start()[1], rows(), SGD, PLAN, key=KEYS[member], settings=jnp.float32(setting),
        held=rows(9, 1),
    )  # fmt: skip


def test_a_run_that_is_resumed_gives_the_same_numbers_to_the_last_bit(tmp_path):
    plan = Plan(epochs=12, batch=7, patience=1, least=0.1)
    adam = optax.adam(0.1)
    make = lambda **more: train(  # noqa: E731
        Line(noise=0.5), *start(), rows(), adam, plan, key=KEY, held=rows(9, 1), **more
    )
    told = []

    def kill(epoch, loss, score):
        told.append(epoch)
        if epoch == 7:
            raise KilledError

    whole = make()
    with pytest.raises(KilledError):
        make(checkpoint=tmp_path / "run.eqx", every=3, tell=kill)
    again = make(checkpoint=tmp_path / "run.eqx", every=3, tell=lambda epoch, *_: told.append(epoch))
    assert told == [*range(8), *range(6, 12)]  # it did go on, from the sixth epoch
    for a, b in zip(jax.tree.leaves((whole.weights, whole.memory)), jax.tree.leaves((again.weights, again.memory)),
                    strict=True):  # fmt: skip
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(whole.losses, again.losses)
    np.testing.assert_array_equal(whole.scores, again.scores)
    assert whole.epochs == again.epochs == 12
    # a file of another training is not taken for one of this
    with pytest.raises(InputError, match=r"run\.eqx") as e:
        train(Line(), *start(), rows(), optax.adam(0.1), Plan(epochs=5), key=KEY, checkpoint=tmp_path / "run.eqx")
    assert "\n" not in str(e.value)


@dataclass(frozen=True)
class Counted:
    """Least squares that counts its batches from Python's 0, as the means of a normalised network do."""

    def loss(self, weights: Any, memory: Any, batch: Any, key: Any, settings: Any) -> Any:
        share = 1.0 - 0.9 ** (memory + 1)
        return jnp.mean((share * (batch["x"] @ weights) - batch["y"]) ** 2), memory + 1


def test_a_counter_without_a_type_of_its_own_is_resumed_without_one(tmp_path):
    make = lambda epochs, **more: train(  # noqa: E731
        Counted(), start()[0], jnp.asarray(0), rows(), SGD, Plan(epochs=epochs, batch=7), key=KEY, **more
    )
    whole = make(6)
    stopped = {"checkpoint": tmp_path / "run.eqx", "every": 3}
    with pytest.raises(KilledError):
        make(6, **stopped, tell=kill_at(3))
    again = make(6, **stopped)
    np.testing.assert_array_equal(whole.weights, again.weights)
    assert again.memory == whole.memory == 30
    assert again.memory.weak_type


def test_a_loss_that_is_not_finite_names_epoch_batch_and_rows():
    bad, after = 30, 11
    with pytest.raises(NotFiniteError) as e:
        train(Line(bad=bad, after=after), *start(), rows(), optax.sgd(0.01), Plan(epochs=5, batch=8), key=KEY)
    found = e.value
    assert bad in found.rows
    assert len(found.rows) == 8
    seen = found.epoch * 5 + found.step  # five batches an epoch, each with every entry once
    assert after <= seen < after + 10
    assert f"epoch {found.epoch}, batch {found.step}" in str(found)
    assert "\n" not in str(found)


def test_a_slope_that_is_not_finite_names_the_batch_that_it_came_from():
    """The loss of √ at 0 is finite, its slope is not: the row to blame is of this batch, not of the next."""

    class Root(Line):
        def loss(self, weights, memory, batch, key, settings):
            return jnp.mean(jnp.sqrt(jnp.abs(batch["x"] @ weights))), memory

    data = rows()
    data["x"] = data["x"].at[21].set(0.0)
    with pytest.raises(NotFiniteError) as e:
        train(Root(), jnp.ones(3, jnp.float32), None, data, optax.sgd(1e-3), Plan(epochs=2, batch=8), key=KEY)
    assert e.value.epoch == 0
    assert 21 in e.value.rows


def test_scores_that_are_never_finite_are_an_error_not_an_untrained_model():
    held = rows(9, 1)
    held["y"] = held["y"].at[2].set(jnp.nan)
    with pytest.raises(InputError, match="score"):
        train(Line(), *start(), rows(), optax.sgd(0.01), Plan(epochs=2, batch=8), key=KEY, held=held)


@pytest.mark.parametrize("patience", [0, 1, 3])
def test_the_rate_shrinks_after_so_many_epochs_and_never_below_the_least(patience):
    plan = Plan(epochs=14, batch=2, shrink=0.5, patience=patience, least=0.2)
    expected, factor, waited = [], 1.0, 0
    for epoch in range(plan.epochs):  # the score is the same ever after the first
        expected.append(factor)
        waited = 0 if epoch == 0 else waited + 1
        if patience and waited >= patience:
            factor, waited = max(0.5 * factor, 0.2), 0
    steps = np.diff(-marched(plan).losses)
    np.testing.assert_allclose(steps, expected[:-1], rtol=1e-5)
    if patience == 1:
        assert steps[-1] == pytest.approx(0.2, rel=1e-5)
        # without a validation set nothing shrinks and nothing stops
        np.testing.assert_allclose(np.diff(-marched(plan, held=None).losses), 1.0, rtol=1e-5)


def test_training_stops_and_the_best_epoch_is_kept():
    plan = Plan(epochs=20, batch=2, stop_after=4)
    told = []
    one = marched(plan, best=6.0, tell=lambda *x: told.append(x))
    assert one.epochs == 6 + 4 == len(told)  # best after the sixth
    assert float(one.weights) == 6.0
    assert np.isfinite(one.losses[:10]).all()
    assert np.isnan(one.losses[10:]).all()
    assert np.isnan(one.scores[10:]).all()
    assert told[5] == (5, -5.0, 0.0)
    last = marched(plan, held=None, tell=lambda *x: told.append(x))  # no score to tell of
    assert last.epochs == 20
    assert float(last.weights) == 20.0
    assert np.isnan(told[-1][2])


@pytest.mark.parametrize("how", ["in turn", "side by side"])
def test_members_are_each_as_alone_and_one_that_diverges_harms_no_other(how):
    settings = (1.0, 3e38, 0.5, 20.0)  # the second overflows, the last is not stable
    every = train(
        NOISY, STARTS, jnp.zeros((4, 40), jnp.int32), rows(), SGD, PLAN, key=KEYS,
        settings=jnp.asarray(settings, jnp.float32), held=rows(9, 1), members=how,
    )  # fmt: skip
    assert np.isfinite(every.weights).all()
    np.testing.assert_array_equal(every.weights[1], STARTS[1])  # it has what it had
    assert np.isnan(every.losses[1]).all()
    ends = set()
    for k in (0, 3):
        one = alone(k, settings[k])
        ends.add(one.epochs)
        assert np.isfinite(every.scores[k]).sum() == one.epochs
        np.testing.assert_allclose(every.weights[k], one.weights, rtol=1e-4)
        np.testing.assert_array_equal(every.memory[k], one.memory)
        np.testing.assert_allclose(every.losses[k], one.losses, rtol=1e-4)
        np.testing.assert_allclose(every.scores[k], one.scores, rtol=1e-4)
    assert len(ends) > 1  # they did not all stop at once


def test_the_same_key_gives_the_same_numbers_and_another_others():
    make = lambda key: train(  # noqa: E731
        NOISY, *start(), rows(), SGD, PLAN, key=key, settings=jnp.float32(1.0), held=rows(9, 1)
    )
    first, same, other = make(KEY), make(KEY), make(jax.random.key(4))
    np.testing.assert_array_equal(first.weights, same.weights)
    np.testing.assert_array_equal(first.losses, same.losses)
    assert np.all(np.abs(first.weights - other.weights) > 1e-6)


def test_an_entry_is_seen_at_most_once_an_epoch_and_who_waits_changes():
    class Seen(Line):
        def loss(self, weights, memory, batch, key, settings):
            batches, seen = memory
            return super().loss(weights, seen[0], batch, key, settings)[0], (
                batches + 1, seen.at[batches // 4, batch["at"]].add(1)
            )  # fmt: skip

    memory = (jnp.zeros((), jnp.int32), jnp.zeros((12, 40), jnp.int32))
    seen = np.asarray(train(Seen(), start()[0], memory, rows(), optax.sgd(0.1), Plan(12, 9), key=KEY).memory[1])
    assert seen.max() == 1
    assert np.all(seen.sum(axis=1) == 36)
    assert np.all(seen.sum(axis=0) >= 8)
    assert len({tuple(row) for row in seen}) == 12


def test_least_squares_end_at_the_normal_equations():
    data = rows(200)
    # a batch larger than the data is the data
    one = train(Line(), *start(200), data, optax.sgd(0.2), Plan(epochs=200, batch=1000), key=KEY)
    assert np.all(np.asarray(one.memory) == 200)
    x, y = np.asarray(data["x"], float), np.asarray(data["y"], float)
    exact = np.linalg.solve(x.T @ x, x.T @ y)
    np.testing.assert_allclose(one.weights, exact, rtol=2e-6)
    assert one.losses[-1] == pytest.approx(np.mean((x @ exact - y) ** 2), rel=1e-5)
