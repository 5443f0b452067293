"""`python -m experiments CONFIG.toml [--set key=value …] --out DIR [--workers N]`."""

import argparse
import os
import sys
from pathlib import Path

from hdev_jax import progress
from hdev_jax.errors import InputError

__all__ = ["main"]


def main(argv: list[str] | None = None) -> int:
    """Exit status 0: done; 2: the config is at fault, in one line; 130: interrupted, to be resumed."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description="Run one experiment from its config.")
    parser.add_argument("config", type=Path, help="a TOML file under configs/")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a key (repeatable)")
    parser.add_argument("--out", type=Path, required=True, help="the run's folder")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes (0: one for each core)")
    parser.add_argument("--tasks", type=Path, help="a folder for results of tasks that runs share")
    parser.add_argument("--kept", action="store_true", help="run no task: tables of what --tasks holds")
    parser.add_argument("--docs", type=Path, help="a folder for the tables as a page in Markdown, with its figures")
    options = parser.parse_args(argv)
    import jax

    from experiments.engine import run_config
    from experiments.page import write_docs

    jax.config.update("jax_enable_x64", True)
    workers = options.workers or os.cpu_count() or 1
    try:
        with progress.shown():
            runs = run_config(
                options.config, options.set, out=options.out, workers=workers, kept=options.tasks,
                fresh=not options.kept,
            )  # fmt: skip
            if options.docs:
                write_docs(options.docs, options.config.stem, [Path(r["folder"]) for r in runs])
    except InputError as e:
        print(f"experiments: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("experiments: interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    print(f"{options.out}/metrics.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
