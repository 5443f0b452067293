"""Every test runs with float64, without silent rank promotion, and with the shapes in annotations checked."""

import functools
import gc
import inspect
import io
import itertools
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import hypothesis
import jax
import jaxtyping
import matplotlib as mpl
import matplotlib.figure
import numpy as np
import PIL.Image
import pytest
from jax._src import lru_cache
from jax._src.interpreters import mlir
from measured_data import data_dir, pytest_collection_modifyitems, pytest_runtest_makereport

__all__ = ["data_dir", "pytest_collection_modifyitems", "pytest_runtest_makereport"]

# One cache of compiled programs for all test processes and those that they start: the tests compile the same few
# programs for log after log.
if "PYTEST_XDIST_WORKER" not in os.environ:
    _COMPILED = tempfile.TemporaryDirectory(prefix="hdev-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _COMPILED.name
for _name, _value in {
    "jax_compilation_cache_dir": os.environ["JAX_COMPILATION_CACHE_DIR"],
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}.items():
    jax.config.update(_name, _value)
    os.environ[_name.upper()] = str(_value)  # the same for the processes that a test starts


def _put(self: lru_cache.LRUCache, key: str, value: bytes) -> None:
    """In one step, as JAX does not: another process could read half of an entry."""
    path = Path(str(self.path)) / f"{key}{lru_cache._CACHE_SUFFIX}"
    if not path.exists():
        part = path.with_name(f"{path.name}.{os.getpid()}")
        part.write_bytes(value)
        part.replace(path)


lru_cache.LRUCache.put = _put  # type: ignore[method-assign]

_programs = itertools.count()
_make_context = mlir.make_ir_context


@functools.lru_cache(maxsize=1)
def _context(_block: int) -> Any:
    """One context for fifty programs: a new one, as JAX takes, costs as much as all else of lowering a small program.
    What a context has interned stays, so it is not kept for all."""
    return _make_context()


mlir.make_ir_context = lambda: _context(next(_programs) // 50)


def _with_shapes() -> list[str]:
    """The modules whose annotations have shapes: only these are checked, for a check costs more than most calls."""
    root = Path(__file__).parents[1]
    files = [f for f in (root / "hdev_jax").rglob("*.py") if "jaxtyping" in f.read_text()]
    return [".".join(f.relative_to(root).with_suffix("").parts) for f in files]


_jaxtyped = jaxtyping.jaxtyped


def _of_shapes(typechecker: str):
    """The hook's decorator, of what has shapes in its annotations: on all else it would cost more than most calls. What
    is defined within a function has none, and would have its checks built anew by each call."""
    decorated = _jaxtyped(typechecker=typechecker)

    def shaped(x) -> bool:
        x = getattr(x, "fget", None) or getattr(x, "__func__", x)  # of a property, of a class or static method
        return "<locals>" not in x.__qualname__ and "jaxtyping." in str(x.__annotations__)

    def hooked(x):
        if not shaped(x):
            return x
        return _now_and_then(decorated(x), x) if inspect.isfunction(x) else decorated(x)

    return hooked


def _now_and_then(checked: Callable, bare: Callable) -> Callable:
    """The function with its shapes checked in its first hundred calls of each process, then in one of ten: a search
    calls some of them ten thousand times."""
    calls = itertools.count()

    @functools.wraps(bare)
    def call(*args, **kwargs):
        k = next(calls)
        return (checked if k < 100 or k % 10 == 0 else bare)(*args, **kwargs)

    return call


jaxtyping.jaxtyped = _of_shapes
# Before any module of the package is imported.
jaxtyping.install_import_hook(_with_shapes(), "beartype.beartype")
from hdev_jax.compiling import compile_quickly  # noqa: E402

compile_quickly()  # each program runs once or twice; studies and benchmarks run as XLA compiles by default
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
mpl.use("Agg")
# What is imported stays: it need not be looked through again, nor the many short-lived objects of a trace so often.
gc.freeze()
gc.set_threshold(50_000, 10, 10)
hypothesis.settings.register_profile("hdev", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("hdev")

_savefig = matplotlib.figure.Figure.savefig


@cache
def _picture() -> bytes:
    """A PNG of noise: as many bytes as a plot, in none of its time."""
    file = io.BytesIO()
    PIL.Image.fromarray(np.random.default_rng(0).integers(0, 256, (60, 100, 3), np.uint8)).save(file, "png")
    return file.getvalue()


@pytest.fixture(autouse=True)
def _plots(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots are made, and only tests marked `drawn` lay them out and draw their pixels: half of the time of a page.
    What a module or a session shares is drawn."""
    if request.node.get_closest_marker("drawn") is None:
        monkeypatch.setattr(matplotlib.figure.Figure, "savefig", _save_noise)


_UNDRAWN: dict[str, Callable[[], bytes]] = {
    "png": _picture,
    "svg": lambda: b'<svg xmlns="http://www.w3.org/2000/svg" width="900" height="300"/>',
    "pdf": lambda: b"%PDF-1.4" + bytes(1000),
}


def _save_noise(self: matplotlib.figure.Figure, to: Any, **options: Any) -> None:
    kind = options.get("format") or (Path(to).suffix.removeprefix(".") if isinstance(to, str | Path) else "")
    if kind not in _UNDRAWN:
        _savefig(self, to, **options)
    elif isinstance(to, str | Path):
        Path(to).write_bytes(_UNDRAWN[kind]())
    else:
        to.write(_UNDRAWN[kind]())
