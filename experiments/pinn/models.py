"""What is compared on the same rows: the paper's regression, trees, networks."""

from collections.abc import Sequence

import numpy as np

from experiments.paper1.halves import fitted
from experiments.pinn.data import Data, Member
from hdev_jax.learn.pinn.fit import Ensemble, Sizes, fit
from hdev_jax.learn.pinn.fit import Member as Seed
from hdev_jax.learn.pinn.model import Recipe, Sized
from hdev_jax.learn.pinn.rows import FEATURES, Rows
from hdev_jax.learn.train import Plan
from hdev_jax.physics import Vehicle

__all__ = ["bayesian", "boosted", "names_of", "networks"]


def names_of(features: str, data: Data) -> tuple[str, ...]:
    """A set of `FEATURES`, without those whose channels this data lacks."""
    needs = {
        "wind_along": ("wind_speed_mps",), "wind_across": ("wind_speed_mps",), "wet": ("wet_road",),
        "surface_1": ("road_surface",), "surface_2": ("road_surface",), "surface_3": ("road_surface",),
        "wind_sine": ("wind_from_rad", "heading_rad"), "wind_cosine": ("wind_from_rad", "heading_rad"),
        "wind_speed_mps": ("wind_speed_mps",), "wet_road": ("wet_road",), "curvature_1pm": ("curvature_1pm",),
        "gear": ("gear",), "cornering": ("curvature_1pm",), "temperature": ("ambient_temp_c",),
        "ambient_temp_c": ("ambient_temp_c",),
    }  # fmt: skip
    return tuple(n for n in FEATURES[features] if all(m.segments.has(*needs.get(n, ())) for m in data.vehicles))


def bayesian(m: Member) -> tuple[Vehicle, list[float]]:
    """The paper's regression on the training rows: the vehicle and its coefficients."""
    train = m.where(0)
    one = fitted(m.vehicle, m.table, m.segments.take(train), m.energy_wh[train], "energy_wh", paper=True)
    return m.table.insert(m.vehicle, one.values), [float(x) for x in one.values]


def boosted(rows: Rows, use: np.ndarray, seed: int) -> np.ndarray:
    """LightGBM on the same features, stopped by the validation rows: energy of every row [Wh]. It learns the energy in
    the row's unit, the squares being of Wh all the same."""
    import lightgbm as lgb

    x, unit = np.asarray(rows.features), np.asarray(rows.unit, float)
    y, weight = np.asarray(rows.energy_wh, float) / unit, unit**2 / np.mean(unit[use == 0] ** 2)
    train, held = (lgb.Dataset(x[at], y[at], weight=weight[at]) for at in (use == 0, use == 1))
    # one thread: beside other work, threads that wait for each other take ten times as long
    settings = {
        "objective": "regression", "learning_rate": 0.05, "num_leaves": 63, "min_data_in_leaf": 20, "verbosity": -1,
        "num_threads": 1, "seed": seed, "deterministic": True, "force_row_wise": True,
    }  # fmt: skip
    stop = [lgb.early_stopping(50, verbose=False)]
    model = lgb.train(settings, train, 2000, valid_sets=[held], callbacks=stop)
    return unit * np.asarray(model.predict(x))


def networks(
    rows: Rows, use: np.ndarray, recipe: Recipe, data: Data, members: Sequence[tuple[int, Sequence[float]]], *,
    plan: Plan, rate: float, effects: tuple[Sized, ...], sizes: Sizes | None,
) -> Ensemble:  # fmt: skip
    """Members by seed and weights, trained side by side on the training rows, kept at their best on the validation."""
    from hdev_jax import progress

    seeds = [Seed(s, (float(w[0]), float(w[1]), float(w[2]))) for s, w in members]

    def tell(epoch: int, loss: float, score: float) -> None:
        if epoch % 10 == 9:
            progress.step(f"epoch {epoch + 1}: loss {loss:.4g}, validation {score:.4g}")

    return fit(
        recipe, rows.take(use == 0), rows.take(use == 1), vehicles=data.trained, plan=plan, rate=rate,
        members=seeds, effects=effects, sizes=sizes, tell=tell,
    )  # fmt: skip
