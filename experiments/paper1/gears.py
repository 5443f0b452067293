"""The fleet as the gear study reads it: rows with their gear, split by route and variant; how a prediction scores."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from hdev_jax.fleet import Fleet, simulate
from hdev_jax.learn.gears.classifiers import alike, balanced_accuracy, route_folds
from hdev_jax.learn.gears.gears import EVERY, MOST_GEARS, Gearbox, features

__all__ = ["GROUPS", "Rows", "box_of", "fleet_rows", "scores", "the_fleet"]

GROUPS = ("all", "2 to 4 speeds", "12 speeds")


@dataclass(frozen=True)
class Rows:
    """Rows of all vehicles with more than one speed. `x` by `EVERY` feature; `vehicle` is the place in the fleet.

    `lowest` and `highest` are the gears that the shift program allows in the row, from the simulator's truth. `oracle`
    are the features that the bound is estimated with: those that decide within the hysteresis band, without noise.
    """

    x: np.ndarray
    oracle: np.ndarray
    gear: np.ndarray
    previous: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray
    route: np.ndarray
    vehicle: np.ndarray
    gears: np.ndarray
    train: np.ndarray
    unseen_routes: np.ndarray
    unseen_variants: np.ndarray

    def group(self, name: str) -> np.ndarray:
        """Rows of a group of gearboxes; a box of one speed has nothing to tell."""
        many = self.gears == MOST_GEARS
        return {"all": np.ones(len(many), dtype=bool), "2 to 4 speeds": ~many, "12 speeds": many}[name]

    def where(self, *parts: np.ndarray) -> np.ndarray:
        """Rows in all of these."""
        return np.flatnonzero(np.logical_and.reduce(parts))


@cache
def the_fleet(seed: int, routes: int, variants: tuple[str, ...]) -> Fleet:
    """A fleet of the defaults of `configs/studies/fleet.toml`."""
    return simulate({"seed": seed, "routes": routes, "variants": variants})


def box_of(variant: Any) -> Gearbox:
    """What the sheet of a variant says of gears and motor."""
    v = variant
    return Gearbox(v.gear_ratios, v.final_drive, v.wheel_radius_m, 1e3 * v.power_kw, v.base_speed_radps)


@cache
def fleet_rows(fleet: tuple[int, int, tuple[str, ...]], held: tuple[str, ...], left_out: int) -> Rows:
    """The rows of `the_fleet` of these arguments. Of the variants `held` none is trained on, of the others one route in
    `left_out` is not."""
    parts: list[tuple[np.ndarray, ...]] = []
    first = 0
    for k, v in enumerate(the_fleet(*fleet).vehicles):
        if v.variant.gears > 1:
            torque = np.asarray(v.segments.channels["requested_torque_nm"])
            x = np.asarray(features(EVERY, box_of(v.variant), v.segments, torque))
            t, gear = v.truth, v.truth["gear"].astype(int)
            speed = np.asarray(v.segments.speed_mps)
            oracle = np.stack(
                [t["gear_lowest"], t["gear_highest"], speed, t["load_share"], t["grade_rad"], t["mass_kg"],
                 t["requested_torque_nm"], *x.T[5:17]], axis=1,
            )  # fmt: skip
            whole = lambda a, like=gear: np.full(like.shape, a)  # noqa: E731
            parts.append((
                x, oracle, gear, t["gear_previous"].astype(int), t["gear_lowest"], t["gear_highest"],
                np.asarray(v.segments.trip) + first, whole(k), whole(v.variant.gears), whole(v.id in held),
            ))  # fmt: skip
        first += len(v.trip_names)
    columns = [np.concatenate(c) for c in zip(*parts, strict=True)]
    x, oracle, gear, previous, lowest, highest, route, vehicle, gears, kept = columns
    test = next(route_folds(route, left_out, fleet[0]))
    return Rows(
        x, oracle, gear, previous, lowest, highest, route, vehicle, gears, ~kept & ~test, ~kept & test, kept
    )  # fmt: skip


def scores(rows: Rows, p: np.ndarray, common: float) -> dict[str, float]:
    """Accuracies by group of gearboxes, on unseen routes and on unseen variants, of probabilities [row, gear].

    Of the likeliest gear; balanced, of the likeliest where each gear of the group is as common as any other (`alike`).
    """
    told = 1 + np.argmax(p, axis=1)
    out: dict[str, float] = {}
    for name in GROUPS:
        end = "" if name == "all" else "_" + name.replace(" ", "_")
        count = np.bincount(rows.gear[rows.where(rows.group(name), rows.train)], minlength=p.shape[1] + 1)[1:]
        rare = 1 + alike(p, count / max(count.sum(), 1), common)
        for split in ("unseen_routes", "unseen_variants"):
            at = rows.where(rows.group(name), getattr(rows, split))
            if len(at):
                out[f"accuracy_{split}{end}"] = float(np.mean(told[at] == rows.gear[at]))
                out[f"balanced_{split}{end}"] = balanced_accuracy(rows.gear[at], rare[at])
    return out
