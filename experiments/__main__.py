"""`python -m experiments CONFIG.toml [--set key=value …] --out DIR [--workers N | --scheduler ADDRESS]`."""

import argparse
import os
import signal
import sys
from concurrent.futures import BrokenExecutor
from pathlib import Path

from hdev_jax import progress
from hdev_jax.errors import InputError

__all__ = ["main"]


def main(argv: list[str] | None = None) -> int:
    """Exit status 0: done; 2: the config, the data or the cluster is at fault, one line; 1: we are; 130: interrupted.

    Of a list of configs, all that can run do.
    """
    options = _parser().parse_args(argv)
    import jax

    from experiments.runner.config import listed
    from experiments.runner.workers import ClusterError
    from hdev_jax.compiling import compile_quickly, keep_compiled

    if options.compile_quickly:
        compile_quickly()
    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    try:
        with progress.shown():
            configs = listed(options.config)
            _check_folders(options)
            return _run_one(options) if configs is None else _run_list(options, configs)
    except (InputError, ClusterError) as e:
        print(f"experiments: {e}", file=sys.stderr)
        return 2
    except BrokenExecutor:
        print("experiments: a worker was killed (out of memory?); the same command goes on from here", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("experiments: interrupted; the same command goes on from here", file=sys.stderr)
        return 130


def _count(text: str) -> int:
    if (count := int(text)) < 0:
        raise argparse.ArgumentTypeError(f"{text}: a number of processes, 0 for one for each core")
    return count


def _check_folders(options: argparse.Namespace) -> None:
    """What is written when everything has run can be written. Raises `InputError`."""
    if options.tasks and options.tasks.exists() and not options.tasks.is_dir():
        raise InputError(f"--tasks {options.tasks}: is a file; name a folder")
    if options.docs:
        try:
            options.docs.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise InputError(f"--docs {options.docs}: cannot be written ({e.strerror or e}); name a folder") from e


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m experiments", description="Run one experiment from its config.")
    parser.add_argument("config", type=Path, help="a TOML file under configs/, or a list of such: configs/paper.toml")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a key (repeatable)")
    parser.add_argument("--out", type=Path, required=True, help="the run's folder")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_count, default=1, metavar="N", help="processes (0: one for each core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="run on a Dask cluster: tcp://host:port, or its file")
    parser.add_argument("--tasks", type=Path, help="a folder for results of tasks that runs share")
    parser.add_argument(
        "--kept", action="store_true", help="run no task: tables of what --tasks holds, or of a list what --out does"
    )
    parser.add_argument("--tiny", action="store_true", help="as small as the config's table [tiny] says, to try it")
    parser.add_argument("--docs", type=Path, help="a folder for the tables as a page in Markdown, with its figures")
    parser.add_argument(
        "--compile-quickly", action="store_true",
        help="programs that are not optimised: sooner done where each runs a few times, as in the study of planted "
        "effects; last bits may differ (a cluster's workers compile as they were started)",
    )  # fmt: skip
    return parser


def _run_one(options: argparse.Namespace) -> int:
    from experiments.runner.config import shown_point
    from experiments.runner.engine import run_config
    from experiments.runner.pages.site import write_docs

    runs = run_config(
        options.config, options.set, out=options.out, workers=_workers(options), scheduler=options.scheduler,
        quickly=options.compile_quickly,
        kept=options.tasks, fresh=not options.kept, tiny=options.tiny,
    )  # fmt: skip
    if options.docs:
        points = [shown_point(r["sweep"]) for r in runs]
        write_docs(
            options.docs, options.config, [Path(r["folder"]) for r in runs], options.set, points, _flags(options)
        )
    print(options.out / ("sweep.json" if runs[0]["sweep"] else "metrics.json"))
    return 0


def _run_list(options: argparse.Namespace, configs: list[Path]) -> int:
    from experiments.runner.compute import Where
    from experiments.runner.pages.site import write_list_docs
    from experiments.runner.paper import against, run_list
    from experiments.runner.tables import cells

    for name in ("set", "tasks"):
        if getattr(options, name):
            raise InputError(f"--{name}: is for one config; {options.config} is a list of {len(configs)}")
    where = Where(_workers(options), options.scheduler, options.compile_quickly)
    came = run_list(configs, out=options.out, where=where, tiny=options.tiny, fresh=not options.kept)
    if lines := against(came):
        table = cells(lines, 4)
        widths = [max(len(c) for c in column) for column in zip(*table, strict=True)]
        for line in table:
            print("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip())
    if options.docs:
        made = {path: [Path(r["folder"]) for r in runs] for path, runs in came.made.items()}
        write_list_docs(options.docs, options.config, made, came.reasons(), _flags(options))
    print(f"{len(came.made)} of {len(configs)} configs: {options.out / 'index.html'}")
    for why in came.reasons():
        print(f"experiments: {why}", file=sys.stderr)
    return 1 if came.broken else 2 if came.refused else 0


def _flags(options: argparse.Namespace) -> list[str]:
    """What a page names of the command beside the config: what decides how much was run, and how it was compiled."""
    return [f"--{n.replace('_', '-')}" for n in ("tiny", "kept", "compile_quickly") if getattr(options, n)]


def _workers(options: argparse.Namespace) -> int:
    return options.workers or os.cpu_count() or 1


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as an interrupt: the workers end with us
    sys.exit(main())
