"""docs/settings.md: the numbers that decide what is named, with what half and double of it do to planted logs.

`python -m experiments.planted.settings_page --docs docs` writes the table. With `--run OUT`, the folder of
`python -m experiments configs/studies/settings.toml --out OUT`, its columns half and double show the study's results.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.runner.pages.site import wrapped
from experiments.runner.tables import markdown
from hdev_jax.diagnosis.settings import described
from hdev_jax.errors import InputError

__all__ = ["changed", "main", "page", "points"]

Number = int | float
Counts = tuple[int, int, int]  # logs named as they should be, logs with a false effect, logs

_INTRO = """\
# Settings

Nearly every number that decides what a diagnosis names is a field of `hdev_jax.diagnosis.settings.Settings`; what a
cluster is, and a few numbers inside a test, are constants beside the code with their reason. `hdev diagnose --fdr` and
`hdev_jax.diagnose(…, fdr=…)` set the first. The function behind them takes them all:
`hdev_jax.diagnosis.diagnose.diagnose(problem, split, library, settings=Settings(close=0.9))`.

Made by `{command}`.

Columns *half* and *double*: the values with which the study of planted effects (synthetic logs) is run again, one
setting changed at a time. {result} Whole numbers are rounded up; a share or probability whose
double would reach 1 is not doubled.

The study runs all of them, or one:

```sh
python -m experiments configs/studies/settings.toml --compile-quickly --out OUT
python -m experiments configs/studies/settings.toml --compile-quickly --out OUT \\
    --set 'sweep.settings=[{{}}, {{close=0.425}}]'
python -m experiments.planted.settings_page --docs docs --run OUT
```
"""


def changed(default: Number, unit: str) -> dict[str, Number]:
    """Half and double of a setting; no double of a share or a probability that would reach 1."""
    if isinstance(default, int):
        return {"half": (default + 1) // 2, "double": 2 * default}
    share = unit == "1" and default < 1.0
    return {"half": default / 2.0} | ({} if share and 2.0 * default >= 1.0 else {"double": 2.0 * default})


def points() -> list[dict[str, Number]]:
    """The points of the study's sweep: the defaults, then one setting changed at a time."""
    return [{}, *({s["name"]: x} for s in described() for x in changed(s["default"], s["unit"]).values())]


def page(found: Sequence[Mapping[str, Any]] = (), *, command: str) -> str:
    """The page in Markdown; `found` holds the metrics of the study's runs, each with its point of the sweep."""
    counts = {_key(m["sweep"]["settings"]): _counts(m["rows"]) for m in found}
    by_default = counts.get(_key({}))
    result = "No results are on this page yet."
    if by_default:
        result = (
            "Beside each value: logs with the right answer of all logs, and logs in which an effect is named that was "
            f"not planted; with the defaults, {_shown(by_default)}."
        )
    rows = [["setting", "default", "half", "double", "unit", "meaning", "source"]]
    for s in described():
        ways = changed(s["default"], s["unit"])
        cells = [_cell(s["name"], ways.get(way), counts) for way in ("half", "double")]
        rows.append(
            [
                f"`{s['name']}`",
                f"{s['default']:g}",
                *cells,
                "–" if s["unit"] == "1" else s["unit"],
                s["meaning"],
                s["source"],
            ]
        )
    return f"{_INTRO.format(command=command, result=result)}\n{markdown(rows, 'All settings')}"


def _cell(name: str, value: Number | None, counts: Mapping[str, Counts]) -> str:
    if value is None:
        return "–"
    there = counts.get(_key({name: value}))
    return f"{value:g}: {_shown(there)}" if there else f"{value:g}"


def _shown(counts: Counts) -> str:
    right, false, logs = counts
    return f"{right}/{logs}, {false} false"


def _key(settings: Mapping[str, Number]) -> str:
    return json.dumps({k: float(v) for k, v in settings.items()}, sort_keys=True)


def _counts(rows: Sequence[Mapping[str, Any]]) -> Counts:
    """Over the settings of the study's first table, without its rows over several of them."""
    own = [r["ours"] for r in rows if "false_name" in (r["ours"] or {}) and "all together" not in r["name"]]
    right = sum(round(x["right"] * x["n"]) for x in own)
    return right, sum(round(x["false_name"] * x["n"]) for x in own), sum(x["n"] for x in own)


def _read(out: Path) -> list[dict[str, Any]]:
    """The runs of a sweep. Raises `InputError` where the folder holds none."""
    try:
        found = json.loads((out / "sweep.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise InputError(f"--run {out}: no complete sweep.json is there ({e}); run the study into it first") from e
    if not all("settings" in m.get("sweep", {}) for m in found):
        raise InputError(f"--run {out}: is no sweep over settings; run configs/studies/settings.toml into it")
    return found


def main(argv: list[str] | None = None) -> int:
    """Write the page. Exit status 0: done; 2: the input is at fault, one line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.planted.settings_page", description=__doc__)
    parser.add_argument("--docs", type=Path, required=True, help="the folder that settings.md is written into")
    parser.add_argument("--run", type=Path, metavar="OUT", help="a run of configs/studies/settings.toml")
    options = parser.parse_args(argv)
    command = f"{parser.prog} --docs docs{' --run OUT' if options.run else ''}"
    try:
        found = _read(options.run) if options.run else []
        options.docs.mkdir(parents=True, exist_ok=True)
        (options.docs / "settings.md").write_text(wrapped(page(found, command=command)), encoding="utf-8")
    except (InputError, OSError) as e:
        print(f"settings_page: {e}", file=sys.stderr)
        return 2
    print(options.docs / "settings.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
