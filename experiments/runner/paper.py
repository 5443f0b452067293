"""Every table and figure there is: a list of configs, each run in its place, paper against ours, one page of all."""

import base64
import contextlib
import dataclasses
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.runner.compare import as_good, comparison, decides, headlines, merged
from experiments.runner.compute import Where, compute
from experiments.runner.config import artefact, changes, shown, shown_point
from experiments.runner.engine import Plan, claim_folder, plan, refuse_hurry, run_config, unfinished
from experiments.runner.figures import against_paper
from experiments.runner.log import Log
from experiments.runner.pages.html import Folded, Section, Table, of_run, write_html
from experiments.runner.pages.site import about, heading, kind_of, title_of
from experiments.runner.tables import cells
from experiments.runner.workers import ClusterError
from hdev_jax.errors import InputError

__all__ = ["Outcomes", "against", "run_list"]


@dataclasses.dataclass
class Outcomes:
    """What came of a list: each config's runs (their metrics), and why there are none, our faults apart."""

    made: dict[Path, list[dict[str, Any]]] = dataclasses.field(default_factory=dict)
    refused: dict[Path, str] = dataclasses.field(default_factory=dict)
    broken: dict[Path, str] = dataclasses.field(default_factory=dict)

    def reasons(self) -> list[str]:
        """One line for each reason, with all the configs that it stopped."""
        by: dict[str, list[str]] = {}
        for path, why in {**self.refused, **self.broken}.items():
            by.setdefault(why, []).append(artefact(path))
        return [f"{', '.join(names)}: {why}" for why, names in by.items()]


def run_list(
    configs: Sequence[Path], *, out: str | Path, where: Where, tiny: bool = False, fresh: bool = True
) -> Outcomes:
    """Run each config in `out/NAME`, those whose tasks run on all workers at once first; then write `out/index.html`.

    A config that cannot run leaves the others alone. A run of an older configuration in its place is replaced.
    `fresh=False` runs no task and reports on those that `out` keeps; a config with none of them is not made.

    **Raises:** `InputError` where `out` holds something else.
    """
    claim_folder(out)
    home, came = Path(out), Outcomes()
    log = Log(home / "log.txt")
    store = home / "tasks"
    planned: list[Plan] = []
    of: dict[str, Path] = {}
    for path in configs:
        with _caught(came, path, log):
            plans = plan(path, tiny=tiny, kept=None if fresh else store)
            if not plans:
                raise InputError("none of its tasks has been run yet")
            refuse_hurry(plans, where)
            planned += unfinished(plans, home / artefact(path))
            of[artefact(path)] = path
    log.say(f"{len(configs)} configs, {len({p.name for p in planned})} of them to run")
    for name, why in compute([p.asked for p in planned], where, store, log, keep_going=True).items():
        _blame(came, of[name], why, log)
    for name, path in of.items():
        if path not in came.refused and path not in came.broken:
            with _caught(came, path, log):
                came.made[path] = run_config(
                    path, out=home / name, workers=where.workers, scheduler=where.scheduler, kept=store, tiny=tiny,
                    fresh=fresh, replace=True,
                )  # fmt: skip
    _write_index(home, came)
    log.say("index.html")
    return came


@contextlib.contextmanager
def _caught(came: Outcomes, path: Path, log: Log) -> Iterator[None]:
    """What a config raises is the config's: an interrupt is not, nor is a cluster that is gone."""
    try:
        yield
    except ClusterError:
        raise
    except Exception as e:
        _blame(came, path, e, log)


def _blame(came: Outcomes, path: Path, error: Exception, log: Log) -> None:
    if isinstance(error, InputError):
        came.refused[path] = str(error)
        return
    came.broken[path] = " ".join(f"{type(error).__name__}: {error}".split())
    for line in "".join(traceback.format_exception(error)).splitlines():
        log.say(f"{artefact(path)}: {line}", shown=False)


def against(came: Outcomes) -> list[dict[str, Any]]:
    """A line for each number of the papers: config, name, quantity, paper, ours, ratio, why there is none."""
    pairs = [(path, run) for path, every in came.made.items() for run in every]
    return [{"part": _at(artefact(path), run), **line} for path, run in pairs for line in comparison(run)]


def _title(path: Path, run: Mapping[str, Any]) -> str:
    """What a page calls the config, and of a sweep the point of the grid."""
    return _at(title_of(path), run)


def _at(name: str, run: Mapping[str, Any]) -> str:
    point = shown_point(run["sweep"])
    return f"{name} ({point})" if point else name


def _write_index(home: Path, came: Outcomes) -> None:
    parts: list[Section] = []
    links: dict[str, list[tuple[str, str]]] = {}
    for path, runs in came.made.items():
        if runs[0]["sweep"]:
            to = [("the sweep as a table over its runs", f"{artefact(path)}/report.html")]
            parts.append(Section(title_of(path), contents=[("", to)]))
        for run in runs:
            made, changed = _made(path, run["sweep"]), _changed(path)
            part = of_run(Path(run["folder"]), run, made=made, changed=changed, home=home)
            part = dataclasses.replace(part, title=_title(path, run), said=[*about(path), *part.said])
            parts.append(part)
            kind = kind_of(path)
            name = heading(path.stem) if kind.startswith("Paper") else part.title
            links.setdefault(kind if kind != "Study" else "Studies", []).append((name, f"#{part.anchor}"))
    write_html(home / "index.html", "Every table and figure", [_summary(came, links), *parts])


def _summary(came: Outcomes, links: Mapping[str, Sequence[tuple[str, str]]]) -> Section:
    """How we compare, the deciding errors, what there is; times and every number of the papers folded."""
    every = [(path, run) for path, runs in came.made.items() for run in runs]
    rows = [
        {
            "config": _title(path, run), "data": run["data"],
            "at least as good": f"{run['better_than_paper']} of {run['of']}" if run["of"] else None,
            "seconds": run["seconds"],
        }
        for path, run in every
    ]  # fmt: skip
    lines = [{"part": _title(path, run), **line} for path, run in every for line in comparison(run)]
    first = [
        (run["synthetic"] or line["paper"] is None, {"part": _title(path, run), **line})
        for path, run in every for line in headlines(run)
    ]  # fmt: skip
    theirs, alone = (merged([line for apart, line in first if apart is of_ours]) for of_ours in (False, True))
    said = [] if came.made else ["No config of the list has been run."]
    said += as_good(run for _, run in every)
    said += [f"Not made: {why}." for why in came.reasons()]
    folded = [
        Folded("On synthetic data, and models that the papers do not have", tables=_table(decides(alone), alone)),
        Folded("Every number of the papers, and ours", tables=_table("Paper against ours", lines)),
        Folded("Data and time of each", tables=_table("Runs", rows)),
    ]
    image = against_paper(theirs)
    return Section(
        "", said=said, tables=_table(decides(theirs), theirs), folded=[f for f in folded if f.tables],
        figures=[("Our error over the paper's", base64.b64encode(image).decode("ascii"))] if image else [],
        contents=list(links.items()),
    )  # fmt: skip


def _table(caption: str, rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    return [(caption, cells(rows, 4))] if rows else []


def _made(path: Path, delta: Mapping[str, Any]) -> list[str]:
    """The command of a run."""
    point = shown_point(delta)
    return [f"python -m experiments {shown(path)} --out DIR{f': the run at {point}' if point else ''}"]


def _changed(path: Path) -> list[str]:
    """What a config changes in the one that it extends."""
    return [
        f"{k} = {new!r:.60} ({'not there' if old is None else f'there {old!r:.60}'})"
        for k, (old, new) in changes(path).items()
    ]
