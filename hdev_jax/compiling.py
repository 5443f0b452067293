"""How XLA compiles: quickly, and once: compiled programs are kept between commands.

Of a diagnosis of 2,000 rows with an efficiency map, compiling is three quarters of the time: programs that are not
optimised (level 0) bring the answer 2.6 times sooner. Of 20,000 rows it is half of the time: level 1 compiles in 60 %
of what XLA takes by default, and its programs run a tenth longer. Results differ in the last bits of a double.
"""

import contextlib
import itertools
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

__all__ = ["compile_quickly", "crowded", "environment", "keep_compiled", "level_of", "make_room", "of_threads"]

# In one piece: the parts that threads share take a half more in all, and few machines have cores for them.
FLAGS = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
SMALL_BYTES = 3_000_000  # some 20,000 rows of a CSV file
LARGE_BYTES = 50_000_000  # of larger logs level 1 costs more than it saves: with 87 MB a diagnosis took 14 % longer
PACKED = 5  # times smaller than that, where a file is compressed
KEPT_BYTES = 40_000_000  # some 2,000 programs; JAX looks at each when it adds one; those not used for longest go first
# Memory maps of a process: Linux gives it 65,530. So many are 1 GB of compiled programs, those of three searches on
# 20,000 rows.
MOST_MAPS = 10_000
FORGET_EVERY = 40  # calls, where nobody says how many maps there are
_calls = itertools.count(1)
_COMPRESSED = {".gz", ".parquet", ".mat", ".zip", ".xz", ".bz2"}


def compile_quickly(level: int = 0) -> None:
    """For this process, if nothing has been compiled in it yet. What `XLA_FLAGS` holds already has the last word.

    **Arguments:** `level`, XLA's level of optimisation (`level_of`).
    """
    asked = os.environ.get("XLA_FLAGS", "")
    if FLAGS not in asked:
        os.environ["XLA_FLAGS"] = f"--xla_backend_optimization_level={level} {FLAGS} {asked}".strip()


def level_of(vehicles: Sequence[Sequence[Path]]) -> int | None:
    """The level that suits the logs of these vehicles, each a list of files; None: as XLA does by default.

    What is no file counts as nothing.
    """

    def size(files: Sequence[Path]) -> int:
        return sum(p.stat().st_size * (PACKED if p.suffix in _COMPRESSED else 1) for p in files if p.is_file())

    each = [size(files) for files in vehicles]
    if sum(each) < SMALL_BYTES:
        return 0
    return 1 if max(each) < LARGE_BYTES else None


def of_threads(count: int) -> dict[str, str]:
    """The environment of a process that is to use so many threads: OpenMP, BLAS, XLA's pool and its linear algebra."""
    one = "--xla_cpu_multi_thread_eigen=false"
    asked = os.environ.get("XLA_FLAGS", "")
    flags = {"XLA_FLAGS": f"{asked} {one}".strip()} if count == 1 and one not in asked else {}
    return dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NPROC"), str(count)) | flags


@contextlib.contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """These variables for the processes that start inside."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def crowded(calls: int, maps: Path = Path("/proc/self/maps")) -> bool:
    """Whether it is time to forget what was compiled, after so many calls; `maps`: where Linux lists memory maps."""
    try:
        with maps.open("rb") as lines:
            return sum(1 for _ in lines) > MOST_MAPS
    except OSError:
        return calls % FORGET_EVERY == 0


def make_room() -> None:
    """Before the next log of many: JAX keeps every program in memory, and a process would run out of it.

    It is forgotten only where it is in use: an experiment may do without.
    """
    if crowded(next(_calls)) and (jax := sys.modules.get("jax")) is not None:
        jax.clear_caches()


def keep_compiled() -> Path | None:
    """Keep compiled programs for the next command: JAX's persistent cache, in the user's cache folder.

    `HDEV_CACHE` names another folder, or is `off`; where `JAX_COMPILATION_CACHE_DIR` is set, that holds. JAX takes a
    lock for each entry, so that two processes may share the folder. **Returns:** the folder, None where nothing is
    kept.
    """
    import jax
    import platformdirs

    asked = os.environ.get("HDEV_CACHE", "")
    if asked.lower() == "off" or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return None
    folder = Path(asked or platformdirs.user_cache_dir("hdev_jax")) / "compiled"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".lockfile").touch()
    except OSError:
        return None  # a machine without a home: everything is compiled each time
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", KEPT_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder
