"""The parameters of an effect, of four kinds, and the conversion of numbers to arrays for its fields."""

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["GROUPS", "Choice", "Parameter", "Shape", "Size", "Switch", "as_array"]

GROUPS = ("gear", "road_surface")  # channels of ids that a coefficient may be grouped by


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect: its name, unit, null value and plausible range.

    It is one of four kinds: `Size`, `Switch`, `Shape`, `Choice`. `lower` and `upper` bound the plausible range (a drag
    cannot push). `scale` is a typical size; it conditions the fit and is the weak prior of an effect that is found.

    **Raises:** `ValueError` for a combination that could never be fitted or tried.
    """

    name: str
    unit: str
    null: float
    scale: float
    lower: float = -math.inf
    upper: float = math.inf
    label: str = field(default="", kw_only=True)  # what a report calls it, where that is not the name without its unit

    # what only some kinds have; the others read it so
    grid: ClassVar[Sequence[float] | np.ndarray] = ()
    least: ClassVar[float] = 0.0
    by: ClassVar[str] = ""
    whole: ClassVar[bool] = False
    constant: ClassVar[bool] = False
    smooth: ClassVar[bool] = False
    in_rows: ClassVar[bool] = False
    of: ClassVar[str] = ""
    mean_of: ClassVar[str] = ""

    has_column: ClassVar[bool] = False  # whether it has a column of its own in the design matrix

    def __post_init__(self) -> None:
        if type(self) is Parameter:
            raise ValueError(f"parameter {self.name!r}: one of its kinds is expected: Size, Switch, Shape, Choice")
        if not isinstance(self.name, str):
            raise ValueError(f"a parameter's name is {self.name!r}; text is expected")
        if why := self._malformed():
            raise ValueError(f"parameter {self.name!r}: {why}")
        if len(self.grid):
            object.__setattr__(self, "grid", tuple(float(g) for g in self.grid))  # hashable, whatever was given

    def _malformed(self) -> str:
        """Why it could never be fitted or tried, in one phrase; empty where it can."""
        grid: Any = self.grid
        if not isinstance(grid, tuple | list | np.ndarray):
            return f"grid is {grid!r}; a tuple of values is expected"
        each = (self.scale, self.lower, self.upper, self.least, *grid)
        if not (all(_is_number(x) for x in each) and (_is_number(self.null) or self._may_be_unknown)):
            return "null, scale, lower, upper, least and the values of grid are numbers"
        if self.scale == 0 or math.isinf(self.scale):
            return f"scale is {self.scale:g}; a typical size other than 0 is expected"
        if not self.lower < self.upper:
            return f"lower is {self.lower:g} and upper {self.upper:g}; a range is expected"
        if not self.in_rows and (out := [g for g in grid if not self.lower <= g <= self.upper]):
            return f"grid has {out[0]:g}, outside of its range {self.lower:g} to {self.upper:g}"
        return self._malformed_kind()

    _may_be_unknown: ClassVar[bool] = False

    def _malformed_kind(self) -> str:
        return ""

    def _null_outside(self) -> str:
        if math.isfinite(self.null) and self.lower <= self.null <= self.upper:
            return ""
        return f"null is {self.null:g}, no number of its range {self.lower:g} to {self.upper:g}"

    def _no_grid(self) -> str:
        return "" if len(self.grid) else f"a {type(self).__name__} without a grid is never tried; give it values to try"


@dataclass(frozen=True)
class Size(Parameter):
    """A parameter with a derivative at its null value, where the effect is absent: its column is one `jvp`.

    `least`: the smallest size worth naming. `by`: a channel; each id in it has a value of its own, except the
    commonest, for which the declared coefficient stands. `whole`: the commonest has one too, as no declared coefficient
    stands for it, and a log without that channel has one number. `constant`: the effect adds the same in every row.
    """

    least: float = field(default=0.0, kw_only=True)
    by: str = field(default="", kw_only=True)
    whole: bool = field(default=False, kw_only=True)
    constant: bool = field(default=False, kw_only=True)
    has_column: ClassVar[bool] = True

    def _malformed_kind(self) -> str:
        if self.by not in ("", *GROUPS):
            return f"by is {self.by!r}; empty or one of {', '.join(GROUPS)} is expected"
        if self.whole and not self.by:
            return "whole is for a size that has groups; give the channel in by"
        return self._null_outside()


@dataclass(frozen=True)
class Switch(Parameter):
    """A parameter without a derivative at its null value (a limit, a delay): each value of `grid` gives a column.

    The column is the difference that the value makes. `smooth`: the difference is nearly proportional to the value, so
    values between those of the grid count too. `in_rows`: `grid` and `scale` count rows of the log; they are multiplied
    by the median duration of a row.
    """

    grid: Sequence[float] | np.ndarray = field(kw_only=True)
    least: float = field(default=0.0, kw_only=True)
    smooth: bool = field(default=False, kw_only=True)
    in_rows: bool = field(default=False, kw_only=True)
    has_column: ClassVar[bool] = True

    def _malformed_kind(self) -> str:
        return self._no_grid()


@dataclass(frozen=True)
class Shape(Parameter):
    """A parameter that acts only once a size is not null (a time constant, a threshold): tried on `grid`, then refined.

    `of`: the only size that it acts on. Its null is its usual value.
    """

    grid: Sequence[float] | np.ndarray = field(kw_only=True)
    of: str = field(default="", kw_only=True)

    def _malformed_kind(self) -> str:
        return self._no_grid() or self._null_outside()


@dataclass(frozen=True)
class Choice(Parameter):
    """A shape that takes only the values of its `grid`; without a grid the log or a search of its own sets it.

    Its null may be NaN: unknown until a value is chosen. `of`: as in `Shape`. `mean_of`: a channel; its mean over the
    log is the value.
    """

    grid: Sequence[float] | np.ndarray = field(default=(), kw_only=True)
    of: str = field(default="", kw_only=True)
    mean_of: str = field(default="", kw_only=True)
    _may_be_unknown: ClassVar[bool] = True


def _is_number(x: Any) -> bool:
    return isinstance(x, numbers.Real) and not math.isnan(x)


def as_array(x: Any) -> Any:
    """A number, or a list of numbers, as a strongly typed array of floats, for `equinox.field(converter=…)`.

    `None`, groups, maps and texts stay as they are. A Python number would be static under jit: no gradient, and a new
    compilation for each value. A weakly typed array would compile once more. Floats keep their precision.
    """
    if isinstance(x, list | tuple):
        x = jnp.asarray(x)
    if isinstance(x, np.generic | np.ndarray | jax.Array):
        if not jnp.issubdtype(x.dtype, jnp.number):
            return x
        own = jax.dtypes.canonicalize_dtype(x.dtype) if jnp.issubdtype(x.dtype, jnp.floating) else float
        return jnp.asarray(x, dtype=own)
    return jnp.asarray(x, dtype=float) if isinstance(x, int | float) and not isinstance(x, bool) else x
