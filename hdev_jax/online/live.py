"""One vehicle fed from Python: one compiled call for the rows that have come, and a file that stores the state."""

import json
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from hdev_jax.errors import InputError
from hdev_jax.online.form import Form
from hdev_jax.online.state import Now, State
from hdev_jax.online.update import update
from hdev_jax.rundir import atomic_file

__all__ = ["Live", "keep", "kept"]

SCHEMA = "hdev-follow/1"
MOST_PROGRAMS = 32  # forms of which the compiled program is kept
CHUNK = 64  # rows of a call, at most
_PROGRAMS: dict[Any, "_Program"] = {}


class _Program:
    """Up to `CHUNK` rows, compiled: from all that changes as one vector to the same and what is known after each.

    A loop as long as there are rows: what a row does to the last digit does not depend on how many come with it.
    """

    def __init__(self, state: State):
        changing, constant = eqx.partition(state, _changes(state))
        _, whole = ravel_pytree(changing)
        _, structure = jax.tree.flatten(constant)
        self.restored = lambda flat, leaves: eqx.combine(whole(flat), jax.tree.unflatten(structure, leaves))
        form = state.form
        now = jax.eval_shape(update, state, jnp.zeros(len(form.columns)), jnp.zeros(len(form.candidates)))[1]
        self.sizes = [(leaf.shape, int(leaf.size)) for leaf in jax.tree.leaves(now)]
        self.shape = jax.tree.structure(now)

        def step(flat: Any, leaves: Any, rows: Any, candidates: Any, count: Any) -> tuple[Any, Any]:
            def one(i: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
                new, now = update(self.restored(carry[0], leaves), rows[i], candidates[i])
                flat = ravel_pytree(eqx.filter(new, _changes(new)))[0]
                return flat, carry[1].at[i].set(ravel_pytree(now)[0])

            told = jnp.zeros((CHUNK, sum(size for _, size in self.sizes)), flat.dtype)
            return jax.lax.fori_loop(0, count, one, (flat, told))

        self.step = jax.jit(step, donate_argnums=0)


class Live:
    """A state that each call updates by some rows.

    All that changes is one vector, whose memory each call reuses, so a row costs little beyond its arithmetic. `state`:
    the present state; setting it continues from there.
    """

    def __init__(self, state: State):
        changing, constant = eqx.partition(state, _changes(state))
        self.form: Form = state.form
        self._flat, _ = ravel_pytree(changing)
        self._constant = jax.tree.leaves(constant)
        # vehicles of one form share a compiled program
        leaves, structure = jax.tree.flatten(state)
        key = (structure, tuple((x.shape, str(x.dtype)) for x in leaves))
        if key not in _PROGRAMS:
            if len(_PROGRAMS) >= MOST_PROGRAMS:
                _PROGRAMS.pop(next(iter(_PROGRAMS)))
            _PROGRAMS[key] = _Program(state)
        self._program = _PROGRAMS[key]

    def __call__(self, row: Float[np.ndarray, " column"], candidates: Any = None) -> Now:
        """One row more, as `update`; what is known now, as NumPy arrays."""
        return self.rows(row[None], None if candidates is None else candidates[None]).row(0)

    def rows(self, rows: Float[np.ndarray, "row column"], candidates: Any = None) -> Now:
        """Takes rows `[row, column]` in order, each as `update` does; returns `Now` as NumPy arrays `[row, …]`."""
        parts = []
        for at in range(0, len(rows), CHUNK):
            n = min(CHUNK, len(rows) - at)
            part, each = np.zeros((CHUNK, rows.shape[1])), np.zeros((CHUNK, len(self.form.candidates)))
            part[:n] = rows[at : at + n]
            if candidates is not None:
                each[:n] = candidates[at : at + n]
            self._flat, told = self._program.step(self._flat, self._constant, part, each, n)
            parts.append(np.asarray(told)[:n])
        told, at, leaves = np.concatenate(parts), 0, []
        for shape, size in self._program.sizes:
            leaves.append(told[:, at : at + size].reshape(-1, *shape))
            at += size
        return jax.tree.unflatten(self._program.shape, leaves)

    @property
    def state(self) -> State:
        """What is known after the rows so far."""
        return self._program.restored(self._flat, self._constant)

    @property
    def numbers(self) -> Float[np.ndarray, " number"]:
        """All that changes, as one vector."""
        return np.asarray(self._flat)

    @numbers.setter
    def numbers(self, flat: Float[np.ndarray, " number"]) -> None:
        """Raises `ValueError` for another number of them."""
        if np.shape(flat) != self._flat.shape:
            raise ValueError(f"{self._flat.size} numbers are expected, found {np.size(flat)}")
        self._flat = jnp.asarray(flat)


def _changes(state: State) -> Any:
    """Which leaves a row changes."""
    constant = jax.tree.map(lambda _: True, state)
    where = lambda s: (s.vehicle, s.centre, s.scale, s.drift, s.noise, s.gears)  # noqa: E731
    none = lambda x: x is None  # noqa: E731
    return eqx.tree_at(where, constant, replace_fn=lambda leaf: jax.tree.map(lambda _: False, leaf), is_leaf=none)


def keep(path: str | Path, live: Live, about: dict[str, Any]) -> None:
    """Write the state to a file, whole or not at all. `about`: plain values that are stored with it."""
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, numbers=live.numbers, about=np.array(json.dumps({"schema": SCHEMA} | about)))


def kept(path: str | Path) -> tuple[Float[np.ndarray, " number"], dict[str, Any]]:
    """What `keep` wrote. Raises `InputError` for a file that it did not write, `FileNotFoundError` for none."""
    try:
        with np.load(path, allow_pickle=False) as found:
            numbers, about = found["numbers"].astype(float), json.loads(str(found["about"]))
            schema = about.get("schema")
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, AttributeError, zipfile.BadZipFile, EOFError) as e:
        raise InputError(f"--state {path}: no file of hdev follow; name another, or delete it") from e
    if schema != SCHEMA:
        raise InputError(f"--state {path}: {schema!r} is not {SCHEMA!r}; name another file, or delete it")
    return numbers, about
