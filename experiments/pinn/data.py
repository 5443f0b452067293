"""The rows that networks are compared on: the synthetic fleet, or buses by 100 m, split by route or mission."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from experiments.paper1.halves import AUXILIARY_SD_W, coefficient, fitted, paper_table
from experiments.pinn.buses import BUSES, SHEET, buses
from hdev_jax.errors import InputError
from hdev_jax.fleet import simulate
from hdev_jax.inference import ParameterTable
from hdev_jax.inference.sheet import build, read_sheet
from hdev_jax.learn.pinn.rows import Rows, concatenated, rows_of
from hdev_jax.physics import LIBRARY, Vehicle, at_null, unavailable
from hdev_jax.segments import Segments

__all__ = ["Data", "Known", "Member", "load", "weighed"]

# What no network and no learner gets: it would give away the force of the drive, and with it the energy.
TELLS = ("requested_torque_nm", "brake_pressure_pa", "halt_brake", "door_open", "passengers", "gear_middle")
SPLIT = (0.70, 0.15)  # training and validation, by route (paper 1, section 3.3.2); the rest tests


@dataclass(frozen=True)
class Member:
    """One vehicle: its log, what its sheet declares with its sds, and (synthetic) the coefficients that were true."""

    id: str
    segments: Segments
    energy_wh: np.ndarray
    vehicle: Vehicle
    table: ParameterTable
    routes: np.ndarray  # of each row, its own in all the data
    use: np.ndarray  # of each row: 0 training, 1 validation, 2 test, 3 unseen (variant or season), 4 not used
    c_rr: np.ndarray | None = None
    cda_m2: np.ndarray | None = None
    variant: Any = None

    def where(self, use: int) -> np.ndarray:
        """Indices of the rows of a use."""
        return np.flatnonzero(self.use == use)


class Known(NamedTuple):
    """What networks take over from the closed form: a `vehicle`, as declared but with its thresholds that act within a
    row; the vehicle with all effects that do, as the fleet has them (`fitted`; None without effects), at whose force
    efficiencies are read; by row what effects that act across rows add (`across_wh`), what the mass is off by
    (`payload`, a share) and what one standard deviation of a mass that nobody found out adds (`loose_wh`)."""

    vehicle: Vehicle
    fitted: Vehicle | None
    across_wh: np.ndarray
    payload: np.ndarray
    loose_wh: np.ndarray


@dataclass(frozen=True, eq=False)  # the same data is the same object: `load` keeps it
class Data:
    """Vehicles, those that are trained on first; `trained` is how many these are."""

    vehicles: tuple[Member, ...]
    trained: int

    def rows(self, features: Sequence[str], effects: Sequence[str], known: Sequence[Known]) -> tuple[Rows, np.ndarray]:
        """Rows of all vehicles as networks read them, and the use of each.

        Efficiencies are read at the force of a vehicle that is calibrated on its own training rows (`calibrated`), with
        its effects where those are known.
        **Arguments:** `effects`, those that are trained; `known`, what is taken over of each vehicle.
        """
        made = [at_null(LIBRARY[e]) for e in effects]
        parts = []
        for k, (m, own, fit) in enumerate(zip(self.vehicles, known, self._calibrated, strict=True)):
            s = dataclasses.replace(m.segments, trip=m.routes)
            s = weighed(s, own.payload)
            one = rows_of(
                own.vehicle, s, m.energy_wh, number=min(k, self.trained), features=features, effects=made,
                calibrated=own.fitted or fit, across_wh=own.across_wh, loose_wh=own.loose_wh,
            )  # fmt: skip
            parts.append(one)
        return concatenated(parts), self.column("use")

    @cached_property
    def _calibrated(self) -> list[Vehicle]:
        """Each vehicle with c_rr, C_d·A and auxiliary load by closed form from its training rows; one without any has
        the others' median ratios to their tables, and their median load."""
        self.trains()
        fits = [calibrated(m) if np.any(m.use == 0) else None for m in self.vehicles]
        ratio = np.median([f for f in fits if f is not None], axis=0)
        out = []
        for m, f in zip(self.vehicles, fits, strict=True):
            c_rr, cda, load = ratio if f is None else f
            table = (m.vehicle.effect("rolling").c_rr, m.vehicle.effect("aero").cda_m2)
            out.append(eqx.tree_at(
                lambda c: (c.effect("rolling").c_rr, c.effect("aero").cda_m2, c.effect("auxiliary").auxiliary_w),
                m.vehicle, (table[0] * c_rr, table[1] * cda, jnp.asarray(float(load))),
            ))  # fmt: skip
        return out

    def shown(self, effects: Mapping[str, Any]) -> dict[str, Any]:
        """Those of the effects whose channels this data has."""
        s = self.vehicles[0].segments
        return {k: v for k, v in effects.items() if unavailable(LIBRARY[k], s, "road") is None}

    def trains(self) -> None:
        """Raises `InputError` where no vehicle has a training row."""
        if not any(np.any(m.use == 0) for m in self.vehicles):
            raise InputError("no vehicle has a training route; hold out less, or take more routes")

    def column(self, name: str) -> np.ndarray:
        """A column of all vehicles, one after the other."""
        return np.concatenate([getattr(m, name) for m in self.vehicles])

    def counts(self) -> dict[str, int]:
        """Rows of each use, and training routes."""
        use = self.column("use")
        names = ("training", "validation", "test", "unseen", "unused")
        routes = len(np.unique(self.column("routes")[use == 0]))
        return {n: int(np.sum(use == k)) for k, n in enumerate(names)} | {"routes": routes}


def weighed(segments: Segments, off: np.ndarray) -> Segments:
    """The rows with a logged mass that is off by these shares; as they are where the log has none."""
    if not segments.has("mass_kg"):
        return segments
    return segments.with_channels(mass_kg=np.asarray(segments.channels["mass_kg"]) * (1.0 + off))


def calibrated(m: Member) -> np.ndarray:
    """c_rr and C_d·A over their tables, and the auxiliary load [W], by the closed form on the training rows."""
    train = m.where(0)
    load = float(m.vehicle.effect("auxiliary").auxiliary_w)
    table = m.table if "battery.auxiliary_w" in [c.path for c in m.table.free] else m.table.plus(
        coefficient("battery.auxiliary_w", "W", load, AUXILIARY_SD_W, positive=False)
    )  # fmt: skip
    one = fitted(m.vehicle, table, m.segments.take(train), m.energy_wh[train], "energy_wh", paper=True)
    values = dict(zip([c.path for c in table.free], np.asarray(one.values), strict=True))
    c_rr, cda = float(m.vehicle.effect("rolling").c_rr), float(m.vehicle.effect("aero").cda_m2)
    return np.array([values["road.c_rr"] / c_rr, values["road.cda_m2"] / cda, values["battery.auxiliary_w"]])


@cache
def load(kind: str, seed: int, routes: int, held: tuple[str, ...], share: float, warmer_than: float | None, fold: int,
         variants: tuple[str, ...]) -> Data:  # fmt: skip
    """`fleet` or `ztbus`.

    **Arguments:** `held`, variants that nothing is trained on; `share` of the training routes that are used;
    `warmer_than` [°C], the season that is trained on, the other being unseen; `fold` of three (`ztbus`: missions).
    """
    if kind == "ztbus":
        return _buses(fold, share, routes)
    return _fleet(seed, routes, held, share, warmer_than, variants)


def _fleet(
    seed: int, routes: int, held: tuple[str, ...], share: float, warmer_than: float | None, variants: tuple[str, ...]
) -> Data:
    fleet = simulate({"seed": seed, "routes": routes, "variants": variants})
    made, first = [], 0
    for v in sorted(fleet.vehicles, key=lambda v: v.id in held):
        route = np.asarray(v.segments.trip) + first
        count = len(v.trip_names)
        order = np.random.default_rng([seed, 7, int(v.segments.vehicle[0])]).permutation(count)
        place = np.empty(count)
        place[order] = (np.arange(count) + 0.5) / count
        by_route = np.where(place < SPLIT[0], 0, np.where(place < sum(SPLIT), 1, 2))
        if v.id in held:
            by_route[:] = 3
        if warmer_than is not None:
            trip, temp = np.asarray(v.segments.trip), np.asarray(v.segments.channels["ambient_temp_c"])
            cold = np.array([
                np.mean(temp[trip == t]) < warmer_than for t in range(count)
            ])  # fmt: skip
            by_route = np.where(cold, np.where(by_route == 2, 3, 4), by_route)
        made.append((v, route, by_route, place, first))
        first += count
    if share < 1:
        _thin(made, share, seed)
    members = []
    for v, route, by_route, _, begin in made:
        members.append(Member(
            v.id, v.segments.without(*TELLS), v.energy_wh, v.tabular, paper_table(v.variant.c_rr, v.variant.cda_m2),
            route, by_route[route - begin], v.truth["c_rr"], v.truth["cda_m2"], v.variant,
        ))  # fmt: skip
    return Data(tuple(members), sum(m.id not in held for m in members))


def _thin(made: list[Any], share: float, seed: int) -> None:
    """Keep so many of all training routes, at least two, drawn over the fleet; and as many to validate as 15 to 70."""
    for use in (0, 1):
        every = [(k, t) for k, (_, _, by_route, _, _) in enumerate(made) for t in np.flatnonzero(by_route == use)]
        order = np.random.default_rng([seed, 8, use]).permutation(len(every))
        for i in order[max(2 - use, round(share * len(every))) :]:
            k, t = every[i]
            made[k][2][t] = 4


def _buses(fold: int, share: float, missions: int) -> Data:
    sheet = read_sheet(SHEET)
    members, first = [], 0
    every = buses(missions=missions)
    for bus in BUSES:
        own = [m for m in every if m.bus == bus]
        parts = [m.segments.without(*TELLS) for m in own]
        names = set.intersection(*(set(s.channels) for s in parts))
        count = [len(s) for s in parts]
        trip = np.repeat(np.arange(len(own)), count)
        fields = {
            k: np.concatenate([np.asarray(getattr(s, k)) for s in parts])
            for k in ("time_s", "duration_s", "distance_m", "speed_start_mps", "speed_end_mps")
        }
        channels: dict[str, Any] = {
            k: np.concatenate([np.asarray(s.channels[k]) for s in parts]) for k in sorted(names)
        }
        segments = Segments(trip=trip, vehicle=np.zeros(len(trip), int), channels=channels, **fields)
        vehicle = build(sheet, segments, "road", "energy_wh", vehicle_names=(bus,)).vehicle
        # by date: every third tests, and of the rest every fourth validates
        use = np.array([2 if k % 3 == fold else 0 for k in range(len(own))])
        rest = np.flatnonzero(use == 0)
        use[rest[1::4]] = 1
        if share < 1:
            use[rest[max(1, round(share * len(rest))) :]] = 4
        table = paper_table((0.0080, 0.0016), (6.0, 1.0)).plus(
            coefficient("battery.auxiliary_w", "W", 5000.0, 3000.0, positive=False)
        )
        energy = np.concatenate([m.energy_wh for m in own])
        members.append(Member(bus, segments, energy, vehicle, table, trip + first, use[trip]))
        first += len(own)
    return Data(tuple(members), len(members))
