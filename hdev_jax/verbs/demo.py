"""`make demo`: a synthetic truck's log with an effect that its sheet does not declare, and the loop that finds it."""

import argparse
import shutil
import sys
from pathlib import Path

from hdev_jax import progress
from hdev_jax.compiling import compile_quickly, keep_compiled
from hdev_jax.errors import InputError

__all__ = ["main"]


def main(argv: list[str] | None = None) -> int:
    """Write the log and the sheet as a customer would send them, diagnose them, and print what was planted."""
    parser = argparse.ArgumentParser(prog="python -m hdev_jax.verbs.demo", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for log, sheet and result")
    parser.add_argument("--seed", type=int, default=3, help="random seed of the synthetic log")
    out: Path = parser.parse_args(argv).out
    seed: int = parser.parse_args(argv).seed

    compile_quickly()
    import jax

    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    from hdev_jax.fleet import demo_log
    from hdev_jax.verbs.diagnose import diagnose

    with progress.shown():
        progress.step("a heavy truck's log (synthetic)")
        synthetic = demo_log(seed)
        files = synthetic.write(out, truth=False)
        result = out / "result"
        if result.exists():
            shutil.rmtree(result)
        try:
            answer = diagnose([files["log"]], files["sheet"], out=result)
        except InputError as e:
            print(f"demo: {e}", file=sys.stderr)
            return 2
    print(answer)
    planted = "; ".join(
        f"{name} ({', '.join(f'{k} {v:g}' for k, v in sizes.items())})"
        for name, sizes in synthetic.vehicle.effects.items()
    )
    print(f"planted (synthetic): {planted}; noise {synthetic.noise_rms:.2f} Wh RMS a row")
    return 0


if __name__ == "__main__":
    sys.exit(main())
