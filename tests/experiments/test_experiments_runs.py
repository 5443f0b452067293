"""Runs of the engine: what their folders hold, done once, resumed, shared; sweeps as tables; lists on one page."""

import ast
import json
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from toy_studies import squares

from experiments.__main__ import main
from experiments.runner import store
from experiments.runner.compare import check, comparison
from experiments.runner.engine import run_config
from experiments.runner.tables import read_markdown
from hdev_jax import compiling
from hdev_jax.errors import InputError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def config(tmp_path):
    """A config of the toy study whose tasks leave a file in `diary/` when they run."""
    (tmp_path / "diary").mkdir()
    path = tmp_path / "toy.toml"
    diary = json.dumps(str(tmp_path / "diary"))
    path.write_text(f'experiment = "toy_studies.squares"\ncount = 4\ndiary = {diary}\n[tiny]\ncount = 1\n')
    return path


def ran(folder: Path) -> list[str]:
    """The numbers whose tasks ran since the last call."""
    return sorted((p.name.partition("-")[0], p.unlink())[0] for p in (folder / "diary").iterdir())


def test_a_runs_folder_holds_everything_and_is_not_made_again(tmp_path, config):
    out = tmp_path / "run"
    (first,) = run_config(config, out=out)
    assert ran(tmp_path) == ["0", "1", "2", "3"]
    names = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    tables, figures = {f"tables/squares.{e}" for e in ("md", "tex")}, {f"figures/squares.{e}" for e in ("png", "pdf")}
    files = {"config.toml", "environment.json", "metrics.json", "report.html", "log.txt"}
    assert names == files | tables | figures
    environment = json.loads((out / "environment.json").read_text())
    assert {"workers", "seed", "packages", "python", "command"} <= set(environment)
    assert "commit" in environment or not (ROOT / ".git").exists()  # an archive has none
    assert "4 tasks, 0 done before" in (out / "log.txt").read_text()
    assert read_markdown(out / "tables" / "squares.md")[0] == "Squares of numbers | and what divides them."
    assert "Ours is at least as good as the paper." in (out / "report.html").read_text()
    assert run_config(config, out=out) == [first]
    assert ran(tmp_path) == []
    (again,) = run_config(out / "config.toml", out=tmp_path / "again")
    assert again["rows"] == first["rows"], "what a run resolved is a config"
    with pytest.raises(InputError, match="another configuration"):
        run_config(config, ["by=2.0"], out=out)


def test_a_process_forgets_what_it_compiled_before_its_memory_maps_run_out(tmp_path, monkeypatch):
    few, many = tmp_path / "few", tmp_path / "many"
    few.write_text("map\n" * 10)
    many.write_text("map\n" * 11)
    monkeypatch.setattr(compiling, "MOST_MAPS", 10)
    assert [compiling.crowded(calls, few) for calls in (1, compiling.FORGET_EVERY)] == [False, False]
    assert compiling.crowded(1, many)
    nowhere = tmp_path / "no" / "maps"
    assert [compiling.crowded(calls, nowhere) for calls in (1, compiling.FORGET_EVERY)] == [False, True]


def test_processes_that_start_inside_have_the_environment_and_ours_is_as_it_was(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=1")
    monkeypatch.setenv("NPROC", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    one = compiling.of_threads(1)
    assert one["XLA_FLAGS"].split() == ["--xla_a=1", "--xla_cpu_multi_thread_eigen=false"]
    with compiling.environment(one):
        assert (os.environ["NPROC"], os.environ["OPENBLAS_NUM_THREADS"]) == ("1", "1")
        assert "XLA_FLAGS" not in compiling.of_threads(1), "the flag once"
    assert (os.environ["NPROC"], os.environ["XLA_FLAGS"]) == ("7", "--xla_a=1")
    assert "OPENBLAS_NUM_THREADS" not in os.environ
    assert "XLA_FLAGS" not in compiling.of_threads(2)


def test_what_was_killed_resumes(tmp_path, config, monkeypatch):
    real = squares.run

    def stopped(task):
        if task["n"] == 2:
            raise KeyboardInterrupt
        return real(task)

    monkeypatch.setattr(squares, "run", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_config(config, out=tmp_path / "run")
    assert ran(tmp_path) == ["0", "1"]
    monkeypatch.setattr(squares, "run", real)
    (metrics,) = run_config(config, out=tmp_path / "run")
    assert ran(tmp_path) == ["2", "3"]
    assert metrics["rows"][0]["ours"]["total"] == 14.0
    log = (tmp_path / "run" / "log.txt").read_text()
    assert "4 tasks, 0 done before" in log
    assert "4 tasks, 2 done before" in log


def test_a_number_that_is_none_stops_its_config_alone(tmp_path, config, monkeypatch, capsys):
    """In a list; what is right is made, and the page says why the other is not there."""
    real = squares.run
    monkeypatch.setattr(squares, "run", lambda t: real(t) | ({"square": float("nan")} if t["by"] == 3.0 else {}))
    (tmp_path / "bad.toml").write_text('extends = "toy.toml"\nby = 3.0\n')
    (tmp_path / "list.toml").write_text('configs = ["bad.toml", "toy.toml"]\n')
    assert main([str(tmp_path / "list.toml"), "--out", str(tmp_path / "out")]) == 1
    assert "bad" in capsys.readouterr().err
    assert (tmp_path / "out" / "index.html").exists()
    with pytest.raises(ValueError, match="JSON compliant") as e:
        run_config(tmp_path / "bad.toml", out=tmp_path / "run")
    assert "in the task {" in e.value.__notes__[-1]


def test_what_measures_time_is_not_compiled_quickly(tmp_path, config):
    with pytest.raises(InputError, match="measures time"):
        run_config(config, ["alone=[2]"], out=tmp_path / "run", quickly=True)
    assert ran(tmp_path) == []
    assert len(run_config(config, out=tmp_path / "run", quickly=True)) == 1
    (tmp_path / "timed.toml").write_text('extends = "toy.toml"\nalone = [0]\n')
    (tmp_path / "list.toml").write_text('configs = ["timed.toml", "toy.toml"]\n')
    assert main([str(tmp_path / "list.toml"), "--out", str(tmp_path / "out"), "--compile-quickly"]) == 2
    assert (tmp_path / "out" / "toy" / "metrics.json").exists()
    assert not (tmp_path / "out" / "timed").exists()


def test_two_sweeps_share_what_they_share_and_each_is_a_table(tmp_path, config):
    out, kept = tmp_path / "sweep", tmp_path / "kept"
    found = run_config(config, ["sweep.by=[1.0, 2.0]", "sweep.seed={ first = 0, count = 2 }"], out=out, kept=kept)
    assert len(ran(tmp_path)) == 4, "one process leaves one file for each number"
    assert len(list(kept.rglob("*.json"))) == 4 * 4
    assert [r["sweep"] for r in found] == [{"by": b, "seed": s} for b in (1.0, 2.0) for s in (0, 1)]
    assert json.loads((out / "sweep.json").read_text()) == found
    lines = (out / "sweep.md").read_text().splitlines()
    assert "| by | seed | name | total |" in lines
    assert "| 2 | 0 | sum | 7 |" in lines
    assert "| 2 | sum | 2 | 7 ± 0 |" in lines, "over the seeds"
    assert r"\pm" in (out / "sweep.tex").read_text()
    assert Path(found[0]["folder"]).name in (out / "report.html").read_text()
    (tmp_path / "diary" / "mark").touch()
    run_config(config, ["sweep.by=[2.0, 3.0]"], out=tmp_path / "other", kept=kept)
    assert ran(tmp_path) == ["0", "1", "2", "3", "mark"]
    assert len(list(kept.rglob("*.json"))) == 5 * 4, "by = 2, seed = 0 was there"
    assert run_config(config, ["sweep.by=[2.0]"], out=out)[0]["folder"] not in {r["folder"] for r in found[:2]}
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    with pytest.raises(InputError, match="holds other files"):
        run_config(config, ["sweep.by=[2.0]"], out=tmp_path / "full")


def test_tasks_that_run_together_are_kept_alone(tmp_path, config):
    (metrics,) = run_config(config, ["together=true"], out=tmp_path / "a", kept=tmp_path / "kept")
    assert metrics["beside"] == 4
    assert metrics["tasks_in_one_program"] == 4
    assert "4 tasks in one program" in (tmp_path / "a" / "log.txt").read_text()
    (more,) = run_config(config, ["together=true", "count=6"], out=tmp_path / "b", kept=tmp_path / "kept")
    assert more["rows"][0]["ours"]["total"] == 55.0
    assert len(list((tmp_path / "kept").rglob("*.json"))) == 6


def test_two_workers_share_what_runs_together_and_what_measures_time_runs_last_and_here(tmp_path, config, monkeypatch):
    monkeypatch.setattr(squares, "together", lambda task: None if squares.alone(task) else "all")
    (metrics,) = run_config(config, ["count=6", "alone=[0, 2]"], out=tmp_path / "run", workers=2)
    files = sorted((tmp_path / "diary").iterdir(), key=lambda p: p.stat().st_mtime_ns)
    assert [p.name for p in files[4:]] == [f"0-{os.getpid()}", f"2-{os.getpid()}"]
    assert not any(p.name.endswith(f"-{os.getpid()}") for p in files[:4])
    assert metrics["rows"][0]["ours"]["total"] == 55.0
    assert metrics["beside"] == 3, "of four that could be one program: no more than a worker's share of all"
    assert (tmp_path / "run" / "log.txt").read_text().count("3 tasks in one program") == 1, "work for both"


def test_a_list_of_configs_is_one_page_and_one_at_fault_stops_no_other(tmp_path, config, capsys, monkeypatch):
    monkeypatch.setenv("HDEV_DATA", str(tmp_path / "nowhere"))
    (tmp_path / "toy2.toml").write_text('extends = "toy.toml"\nablates = ["by"]\nby = 2.0\n')
    (tmp_path / "toy10.toml").write_text('extends = "toy.toml"\nby = 0.0\n')
    (tmp_path / "data.toml").write_text('extends = "toy.toml"\nneeds = "kia_niro"\n')
    (tmp_path / "data2.toml").write_text('extends = "data.toml"\nby = 3.0\n')
    (tmp_path / "_base.toml").write_text("count = 3\n")
    (tmp_path / "list.toml").write_text('configs = ["data*.toml", "toy*.toml", "_*.toml", "none*.toml"]\n')
    command = [str(tmp_path / "list.toml"), "--out", str(tmp_path / "out"), "--docs", str(tmp_path / "docs")]
    (tmp_path / "docs").mkdir()
    assert main(command) == 1, "a division by zero is our fault"
    assert ran(tmp_path) == ["0", "1", "2", "3"]
    told = capsys.readouterr()
    assert "2 of 5 configs" in told.out
    lines = [line.split() for line in told.out.splitlines() if " sum " in line]
    assert [x[:5] for x in lines] == [["toy", "sum", "total", "10", "14"], ["toy2", "sum", "total", "10", "7"]]
    why = [line for line in told.err.splitlines() if line.startswith("experiments:")]
    assert len(why) == 2, "one line for each reason"
    assert why[0].startswith("experiments: data, data2: no measured data in")
    assert all(w in why[0] for w in ("github.com/FMLabSouthampton", "set HDEV_DATA", "nowhere"))
    assert why[1] == "experiments: toy10: ZeroDivisionError: float division by zero"
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count("<img") == 2
    assert "not in the public data" in page
    assert "by = 2.0 (not there)" in page
    assert "Not made: data, data2: no measured data" in page
    docs = (tmp_path / "docs" / f"{tmp_path.name}.md").read_text()
    assert re.findall("^## (.*)$", docs, re.MULTILINE) == ["Toy", "Toy2", "Paper against ours"]
    assert "| Toy | sum | total | 10 | 14 | 1.4 |" in docs
    figures = re.findall(r"\]\((figures/[^)]*)\)", docs)
    assert len(set(figures)) == 2, "of each config its own"
    for name in figures:
        assert (tmp_path / "docs" / name).stat().st_size > 200
    assert main([*command, "--kept"]) == 2
    assert "toy10" in capsys.readouterr().err
    assert ran(tmp_path) == [], "with --kept no task is run"
    (tmp_path / "toy10.toml").unlink()
    assert main(command) == 2, "the data is not there"
    assert ran(tmp_path) == []
    config.write_text(config.read_text().replace("count = 4", "count = 5"))
    assert main(command) == 2
    assert ran(tmp_path) == ["4"], "a run of an older config gives way, and its tasks are kept"


def test_a_list_of_no_config_is_an_empty_page(tmp_path, capsys):
    (tmp_path / "list.toml").write_text('configs = ["paper*/*.toml"]\n')
    assert main([str(tmp_path / "list.toml"), "--out", str(tmp_path / "out")]) == 0
    assert "0 of 0 configs" in capsys.readouterr().out
    assert "No config of the list has been run" in (tmp_path / "out" / "index.html").read_text()


def test_no_data_is_one_line_that_says_what_to_do(tmp_path, config, capsys, monkeypatch):
    monkeypatch.setenv("HDEV_DATA", str(tmp_path))
    assert main([str(config), "--set", "needs=kia_niro", "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(w in line for w in ("no measured data", "github.com/FMLabSouthampton", "HDEV_DATA"))


def test_what_is_kept_is_reported_on_and_nothing_else(tmp_path, config, capsys, monkeypatch):
    command = [str(config), "--out", str(tmp_path / "a"), "--tasks", str(tmp_path / "kept")]
    assert main([*command, "--kept"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(w in line for w in ("toy.toml", "none of its tasks has been run yet"))
    assert not (tmp_path / "a").exists()
    assert main([*command, "--set", "count=2"]) == 0
    sweep = [*command[:1], "--out", str(tmp_path / "b"), *command[3:], "--kept", "--set", "sweep.by=[1.0, 2.0]"]
    assert main(sweep) == 0, "the point that has none is left out"
    (found,) = json.loads((tmp_path / "b" / "sweep.json").read_text())
    assert (found["sweep"], found["tasks_left_out"]) == ({"by": 1.0}, 2)
    real = squares.collect
    monkeypatch.setattr(squares, "collect", lambda c, results, run: real(c, [list(results)[3]], run))
    capsys.readouterr()
    assert main([*command[:1], "--out", str(tmp_path / "c"), *command[3:], "--kept"]) == 2
    assert "toy: cannot be shown: 2 of its tasks have not been run" in capsys.readouterr().err
    with pytest.raises(IndexError):
        run_config(config, ["count=2"], out=tmp_path / "d")


def test_a_folder_that_cannot_be_written_is_told_before_anything_runs(tmp_path, config, capsys):
    (tmp_path / "file").touch()
    for option in ("--docs", "--tasks"):
        assert main([str(config), "--out", str(tmp_path / "out"), option, str(tmp_path / "file")]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{option} {tmp_path / 'file'}" in line
    with pytest.raises(SystemExit, match="2"):
        main([str(config), "--out", str(tmp_path / "out"), "--workers", "-1"])
    assert ran(tmp_path) == []


def test_the_docs_of_a_sweep_say_which_run_is_which(tmp_path, config):
    docs = tmp_path / "made" / "docs"
    assert main([str(config), "--out", str(tmp_path / "out"), "--docs", str(docs), "--set", "sweep.by=[1.0, 2.0]"]) == 0
    heads = [line for line in (docs / "toy.md").read_text().splitlines() if line.startswith("## ")]
    assert heads == ["## by = 1.0", "## by = 2.0"]


def test_metrics_are_checked():
    row = {"name": "a", "paper": {"rmse": 2.0, "text": "x", "pe": 1.0}, "ours": {"rmse": 1.0, "free_run": True}}
    good = {"artefact": "a", "data": "d", "synthetic": False, "better_than_paper": 0, "of": 0, "rows": [row],
            "seconds": 1.0, "tasks_left_out": 0}  # fmt: skip
    check(good)
    lines = comparison(good)
    assert [(x["quantity"], x["ratio"], x["why_not"]) for x in lines] == [
        ("RMSE", 0.5, None), ("PE", None, "not computed"),
    ]  # fmt: skip
    with pytest.raises(ValueError, match="lack data"):
        check({k: v for k, v in good.items() if k != "data"})
    with pytest.raises(ValueError, match="null without a reason"):
        check({**good, "rows": [{**row, "ours": None}]})


def test_only_code_counts_towards_what_is_kept(tmp_path):
    text = '"""What it is."""\n\n\nclass A:\n    """An A."""\n\n\ndef f(x):\n    """Twice."""\n    return 2 * x  # so\n'
    edits = {"none": ("", ""), "docstring": ("Twice", "Two times"), "comment": ("# so", "# why"), "code": ("2 ", "3 ")}
    task, whole = {}, {}
    for edit, (old, new) in edits.items():
        file = tmp_path / edit / "made" / "module.py"
        file.parent.mkdir(parents=True)
        file.write_text(text.replace(old, new))
        task[edit], whole[edit] = (store._digest((file,), collect) for collect in (False, True))
    assert task["none"] == task["docstring"] == task["comment"] != task["code"]
    assert len(set(whole.values())) == len(edits), "a whole run tells every file as it is"


LOADS = """
import gc, json, os, sys
import jax, matplotlib, numpy, optax, optimistix, pandas, pydantic.main, tomli_w  # what they share
import scipy.optimize, scipy.signal, scipy.stats
gc.disable()
for name, shared in json.load(sys.stdin):
    for module in shared:
        __import__(module)
    print(flush=True)
    if not os.fork():
        __import__(name)
        print(json.dumps([name, [m for m in sys.modules if m.startswith(("hdev_jax.", "experiments."))]]), flush=True)
        os._exit(0)
    os.wait()
"""


@cache
def reached(name: str) -> frozenset[str]:
    """The modules whose files are in an experiment's fingerprint."""
    files = {Path(store._name(p)).with_suffix("") for p in store.reached(starts_of(name), experiments=True)}
    return frozenset(".".join(f.parts).removesuffix(".__init__") for f in files)


@cache
def starts_of(name: str) -> tuple[Path, ...]:
    """The experiment's file and its SOURCES, which are read: to import every experiment takes seconds."""
    itself = store.HERE / f"{name.replace('.', '/')}.py"
    sources = re.findall(r"^SOURCES = (\(.*?\))", itself.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return itself, *((itself.parent / source).resolve() for source in ast.literal_eval(*sources))


@pytest.fixture(scope="module")
def modules_loaded() -> dict[str, set[str]]:
    """What importing an experiment loads of the tree, by the experiment's name, each in a process of its own. What that
    one and all that are still to come reach is loaded before: it has to be in the fingerprint of each of them."""
    names = sorted(store.experiments_here(), key=lambda name: len(reached(name)))
    each = [(f"experiments.{name}", sorted(frozenset.intersection(*map(reached, names[k:]))))
            for k, name in enumerate(names)]  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LOADS], cwd=ROOT, capture_output=True, text=True, check=True,
        input=json.dumps(each), env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    return {name: set(loaded) for name, loaded in (json.loads(x) for x in done.stdout.splitlines() if x)}


# Beside its SOURCES, a task's files may import what makes pages, what reads configs and data, and what has a
# fingerprint of its own.
PAGES = {"tables", "figures", "drawings", "choice", "pages", "sweeps", "gear_tables", "switching_tables", "config"}
OWN_FINGERPRINT = {"experiments/paper2/diagnosed.py"}


@pytest.mark.parametrize("name", store.experiments_here())
def test_what_a_task_depends_on_is_what_its_modules_load(name, modules_loaded):
    """Every file of the package that importing the sources loads is in the fingerprint; none that they do not name."""
    starts, own_package = starts_of(name), f"experiments.{name.rpartition('.')[0]}"
    assert modules_loaded[f"experiments.{name}"] - {own_package} <= reached(name)
    beside = {p for start in starts for p in store._imports(start) if p.is_relative_to(store.HERE)} - {*starts}
    rest = {p for p in beside if p.parent.name != "runner" and p.stem not in {"__init__", *PAGES}}
    assert {store._name(p) for p in rest} <= OWN_FINGERPRINT
    tasks_need = {store._name(p) for p in store.reached(starts, experiments=False)}
    assert not tasks_need & {"hdev_jax/cli.py", "hdev_jax/verbs/demo.py", "experiments/runner/pages/site.py"}


def test_a_module_of_your_own_is_named_by_its_dotted_name_and_ours_goes_first(tmp_path, monkeypatch):
    for folder, file in (("mine", "fig5"), ("paper1", "fig5")):
        (tmp_path / folder).mkdir()
        text = "SOURCES, Config, tasks, run, collect = (), None, None, None, None\n"
        (tmp_path / folder / f"{file}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert store.experiment("mine.fig5", "a config").__file__ == str(tmp_path / "mine" / "fig5.py")
    assert store.experiment("paper1.fig5", "a config").__name__ == "experiments.paper1.fig5"
    assert store.place(squares, {}, tmp_path).parent == tmp_path / "toy_studies.squares"
