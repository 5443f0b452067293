"""One table of parameters (path, unit, prior, support, free): it drives every estimator and the report."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hdev_jax.physics import DECLARED, LIBRARY, Effect, Grouped, Shape, Size, Vehicle

__all__ = ["Coefficient", "ParameterTable", "effect_coefficients", "in_effect", "insert", "insert_by", "leaf_of"]

# path in the sheet → (effect that holds it, its field)
_DECLARED = {path: (c.id, field) for c in (*DECLARED, *LIBRARY.values()) for field, path in c.declared.items()}


@dataclass(frozen=True)
class Coefficient:
    """One number of a vehicle. `value` and `sd` are its tabular prior; without an `sd` nothing but the log speaks.

    `path` as in the sheet (`road.c_rr`, `effects.headwind.scale`); `group` is the place in a coefficient that has one
    value per vehicle or gear, `label` its name. `lower` and `upper` are the support; `scale` conditions the solver.
    `known`: value and standard error by generalised least squares on the same log. Ordinary least squares take them in
    place of the table's (`prior`); evidence by generalised least squares must not count them a second time.
    """

    path: str
    unit: str
    value: float
    sd: float | None
    scale: float
    lower: float = -np.inf
    upper: float = np.inf
    free: bool = True
    group: int | None = None
    label: str = ""
    known: tuple[float, float] | None = None

    @property
    def prior(self) -> tuple[float, float | None]:
        """Value and sd that a calibration starts from: by generalised least squares, or the table's."""
        return self.known or (self.value, self.sd)

    @property
    def name(self) -> str:
        """The path, with the group's label where there is one."""
        return f"{self.path}[{self.label}]" if self.group is not None else self.path


def leaf_of(vehicle: Vehicle, path: str) -> Any:
    """The leaf at a path. Raises `KeyError` for a path that the vehicle does not have."""
    if path == "mass_kg":
        return vehicle.mass_kg
    head, _, rest = in_effect(path).partition(".")
    if head in ("driveline", "machine"):
        return getattr(getattr(vehicle, head), rest)
    if head == "effects":
        effect_id, _, field = rest.partition(".")
        return getattr(vehicle.effect(effect_id), field)
    raise KeyError(path)


def in_effect(path: str) -> str:
    """The path by way of the effect that holds the coefficient: `effects.rolling.c_rr` of `road.c_rr`."""
    return f"effects.{'.'.join(_DECLARED[path])}" if path in _DECLARED else path


@dataclass(frozen=True)
class ParameterTable:
    """Coefficients of one vehicle, in a fixed order. Functions return new tables."""

    rows: tuple[Coefficient, ...]

    @property
    def free(self) -> tuple[Coefficient, ...]:
        """The coefficients that are estimated."""
        return tuple(c for c in self.rows if c.free)

    @property
    def structure(self) -> tuple[tuple[str, int | None, float, float], ...]:
        """What jit must know: where each free coefficient sits and its support. Hashable."""
        return tuple((c.path, c.group, c.lower, c.upper) for c in self.free)

    def plus(self, *rows: Coefficient) -> "ParameterTable":
        """The table with more rows."""
        return ParameterTable((*self.rows, *rows))

    def minus(self, *effect_ids: str) -> "ParameterTable":
        """The table without these effects' rows."""
        heads = tuple(f"effects.{k}." for k in effect_ids)
        return ParameterTable(tuple(c for c in self.rows if not c.path.startswith(heads)))

    def with_free(self, **free: bool) -> "ParameterTable":
        """The table with rows held or freed, by name."""
        return ParameterTable(tuple(replace(c, free=free.get(c.name, c.free)) for c in self.rows))

    def values(self, vehicle: Vehicle) -> Float[np.ndarray, " free"]:
        """The free coefficients as they are in the vehicle."""
        return np.array([_pick(leaf_of(vehicle, c.path), c.group) for c in self.free], dtype=float)

    def insert(self, vehicle: Vehicle, values: Any) -> Vehicle:
        """A vehicle with these values for the free coefficients; traceable in `values`."""
        return insert(vehicle, self.structure, jnp.asarray(values))


def _pick(leaf: Any, group: int | None) -> Any:
    return leaf if group is None else leaf.values[group]


def insert(vehicle: Vehicle, structure: Any, values: Any) -> Vehicle:
    """`ParameterTable.insert` from the table's static structure."""
    at: dict[str, list[tuple[int, int | None]]] = {}
    for k, (path, group, _, _) in enumerate(structure):
        at.setdefault(path, []).append((k, group))
    if not at:
        return vehicle
    new: dict[str, Any] = {}
    for path, places in at.items():
        ks, groups = (list(x) for x in zip(*places, strict=True))
        if groups[0] is None:
            new[path] = values[ks[0]]
        else:
            old = leaf_of(vehicle, path)
            new[path] = Grouped(jnp.asarray(old.values).at[np.array(groups)].set(values[np.array(ks)]), old.by)
    return eqx.tree_at(  # all at once: one at a time takes longer than the trace of the kernel
        lambda v: [leaf_of(v, path) for path in new], vehicle, [*new.values()], is_leaf=lambda x: isinstance(x, Grouped)
    )


def insert_by(vehicle: Vehicle, structure: Any, values: Any, by: str) -> Vehicle:
    """A vehicle with values `[group, free]`, of each row those of the group that its channel `by` names.

    Raises `ValueError` for a coefficient that has groups already, or acts across rows.
    """
    for k, (path, group, _, _) in enumerate(structure):
        if group is not None:
            raise ValueError(f"{path} has values by gear, vehicle or surface already; hold it, or take one of each row")
        if path.startswith("effects."):
            effect = vehicle.effect(path.split(".")[1])
            if effect.overrides("across") or effect.overrides("observe"):
                raise ValueError(f"{path} acts across rows; one value for all groups is accepted")
        where = lambda v, p=path: leaf_of(v, p)  # noqa: E731
        vehicle = eqx.tree_at(where, vehicle, Grouped(values[:, k], by))
    return vehicle


def effect_coefficients(
    effect: Effect, sizes: Sequence[str], *, shapes: bool = True, groups: Sequence[str] = ()
) -> tuple[Coefficient, ...]:
    """Rows for an effect's parameters: those in `sizes` and, where `shapes`, its shapes free, the others held.

    A found effect's sizes have no tabular prior; shapes have the usual value of such an effect, give or take its
    `scale` (a heating threshold of 18 ± 4 °C): few trips say little about them.
    """
    rows = []
    for p in effect.parameters:
        leaf = getattr(effect, p.name)
        if leaf is None or (isinstance(leaf, Grouped) and leaf.by == "trip"):  # what is chosen trip by trip is held
            continue
        free = p.name in sizes or (shapes and isinstance(p, Shape) and len(p.grid) > 1)
        values = leaf.values if isinstance(leaf, Grouped) else [leaf]
        for g, value in enumerate(np.asarray(jax.device_get(values), dtype=float)):
            grouped = isinstance(leaf, Grouped)
            rows.append(
                Coefficient(
                    path=f"effects.{effect.id}.{p.name}",
                    unit=p.unit,
                    value=p.null if isinstance(p, Shape) else float(value),
                    sd=abs(p.scale) if isinstance(p, Shape) else None,
                    scale=abs(p.scale),
                    lower=-np.inf if isinstance(p, Size) else p.lower,
                    upper=np.inf if isinstance(p, Size) else p.upper,
                    free=free and (not grouped or not groups or str(g) in groups),
                    group=g if grouped else None,
                    label=str(g) if grouped else "",
                )
            )
    return tuple(rows)
