"""The experiment engine: configs that extend and sweep, one line for a fault, tasks done once, a tiny study."""

import importlib
import json
import re
import tomllib
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from planted import FEW, library_of

from experiments.online import study as online
from experiments.planted.study import Config, tasks
from experiments.runner import store
from experiments.runner.compute import Asked, Where, compute
from experiments.runner.config import CONFIGS, artefact, changes, every_config, expanded, listed, resolve, typed
from experiments.runner.data import MissingDataError
from experiments.runner.engine import plan, run_config
from experiments.runner.log import Log
from experiments.runner.pages.site import MOST_ROWS, WIDTH, part, wrapped, write_docs
from experiments.runner.tables import readable, wilson
from hdev_jax import diagnose
from hdev_jax.errors import InputError
from hdev_jax.fleet.config import Truth
from hdev_jax.physics import LIBRARY

STUDIES = Path(__file__).parents[2] / "configs" / "studies"


def write(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_a_delta_changes_the_keys_it_names_and_no_other(tmp_path):
    write(tmp_path, "base.toml", "a = 1\n[t]\nb = 2\nc = [1, 2]\n")
    delta = write(tmp_path, "delta.toml", 'extends = "base.toml"\n[t]\nc = [3]\n')
    assert resolve(delta) == {"a": 1, "t": {"b": 2, "c": [3]}}
    assert resolve(delta, ["t.b=5", "name=plain text"]) == {"a": 1, "t": {"b": 5, "c": [3]}, "name": "plain text"}


def test_a_sweep_is_a_grid_whose_points_share_nothing(tmp_path):
    path = write(tmp_path, "s.toml", 'a = 1\n[t]\nb = 2\n[sweep]\n"t.b" = [3, 4]\na = [5, 6]\n')
    points = list(expanded(resolve(path), path))
    assert [d for d, _ in points] == [{"t.b": b, "a": a} for b in (3, 4) for a in (5, 6)]
    assert [(c["t"]["b"], c["a"]) for _, c in points] == [(3, 5), (3, 6), (4, 5), (4, 6)]


@pytest.mark.parametrize(
    ("text", "sets", "words"),
    [
        ('experiment = "planted.study"\nsed = 1\n[cases]\n', [], ["key sed", "known keys", "seed"]),
        ('experiment = "planted.study"\nseed = "one"\n[cases]\n', [], ["key seed", "integer", "'one'"]),
        ('experiment = "planted.study"\n[cases.a]\nname = ""\nnoises = ["pink"]\n', [], ["cases.a.noises.0", "'pink'"]),
        ('experiment = "unheard"\n', [], ["key experiment", "paper1.fig5", "planted.study", "'unheard'"]),
        ('experiment = "planted.none"\n', [], ["key experiment", "planted.none cannot be imported"]),
        ("experiment = planted\n", [], ["not a TOML file"]),
        ('extends = "none.toml"\n', [], ["none.toml", "no such file"]),
        ('experiment = "planted.study"\n[cases]\n', ["seed"], ["--set 'seed'", "key=value"]),
        ('experiment = "planted.study"\nsweep = 3\n[cases]\n', [], ["sweep", "list of values"]),
    ],
)
def test_a_config_at_fault_is_one_line_with_its_place(tmp_path, text, sets, words):
    path = write(tmp_path, "c.toml", text)
    with pytest.raises(InputError) as caught:
        run_config(path, sets, out=tmp_path / "out", kept=tmp_path / "kept")
    line = str(caught.value)
    assert "\n" not in line
    assert all(w in line for w in words), line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("base", "delta", "sets", "words"),
    [
        ("", "[noise]\nscal = 1.0\n", [], ["delta.toml, key noise.scal:", "did you mean scale?", "known keys: scale"]),
        ("count = 1.5\n", "by = 2.0\n", [], ["base.toml, key count:", "integer", "1.5"]),
        ("count = 1\n", "count = 1.5\n", [], ["delta.toml, key count:"]),
        ("count = 1\n", "", ["count=x"], ["--set 'count=x', key count:", "'x'"]),
        ("count = 1\n", "[sweep]\ncount = [1, 1.5]\n", [], ["delta.toml, key count:", "1.5"]),
        ("count = 1\n", "[sweep]\ncount = { first = 0 }\n", [], ["delta.toml, table sweep", "first = 0, count = 16"]),
        ("count = 1\n", "", ["count.x=3"], ["--set 'count.x=3': count is no table"]),
        ("count = 1\n", "", ["by=nan"], ["--set 'by=nan', key by:", "finite"]),
        ("count = 1\n", "by = inf\n", [], ["delta.toml, key by:", "finite"]),
        ("count = 1\n", "", ["count=1\nseed=2"], ["key count:", "integer"]),
        ("count = 1\n", "", ["sweep.seed=[1, 2, 1]"], ["table sweep", "seed = 1 and seed = 1 are one run"]),
        ("count = 1\n", "[sweep]\nby = [1, 1.0]\n", [], ["delta.toml, table sweep", "by = 1 and by = 1.0 are one run"]),
        ("count = 1\n", 'experiment = "os.path"\n', [], ["delta.toml, key experiment", "os.path is no experiment"]),
        ("count = 1\n", 'ablates = ["by"]\ncount = 2\n', [], ["key ablates: names by, but", "changes count"]),
        ("count = 1\n", 'ablates = ["count"]\ncount = 1\n', [], ["key ablates: names count", "changes nothing"]),
        ("count = 1\n", 'ablates = "count"\ncount = 2\n', [], ["key ablates: a list of the keys", "'count'"]),
    ],
)
def test_a_fault_is_told_where_it_was_made(tmp_path, base, delta, sets, words):
    write(tmp_path, "base.toml", f'experiment = "toy_studies.squares"\n{base}')
    path = write(tmp_path, "delta.toml", f'extends = "base.toml"\n{delta}')
    with pytest.raises(InputError) as caught:
        run_config(path, sets, out=tmp_path / "out")
    line = str(caught.value)
    assert all(w in line for w in words), line
    assert not (tmp_path / "out").exists()


def test_what_a_delta_changes(tmp_path):
    write(tmp_path, "base.toml", "a = 1\n[t]\nb = 2\nc = [1, 2]\n[tiny]\na = 0\n")
    write(tmp_path, "delta.toml", 'extends = "base.toml"\nablates = ["t.c", "t.d"]\na = 1\n[t]\nc = [3]\nd = "x"\n')
    last = write(tmp_path, "last.toml", 'extends = "delta.toml"\n[tiny]\na = 3\n')
    assert changes(tmp_path / "base.toml") == {}
    assert changes(tmp_path / "delta.toml") == {"t.c": ([1, 2], [3]), "t.d": (None, "x")}
    assert changes(last) == {}, "an ablation's own word is not handed down, and what is tiny is of tests"
    assert resolve(last, tiny=True) == {"a": 3, "t": {"b": 2, "c": [3], "d": "x"}}
    with pytest.raises(InputError, match="extends"):
        resolve(write(tmp_path, "alone.toml", 'ablates = ["a"]\na = 1\n'))


def test_every_ablation_changes_exactly_the_keys_it_names():
    for path in CONFIGS.rglob("*.toml"):
        named = tomllib.loads(path.read_text(encoding="utf-8")).get("ablates")
        if named is not None:
            assert set(changes(path)) == set(named), path


def test_a_list_of_configs_is_in_the_order_of_numbers(tmp_path):
    for name in ("table10", "table2", "fig4", "_base", "table2_wide"):
        write(tmp_path, f"{name}.toml", "a = 1\n")
    every = listed(write(tmp_path, "list.toml", 'configs = ["fig4.toml", "[!l]*.toml"]\n'))
    assert [p.stem for p in every or []] == ["fig4", "table2", "table2_wide", "table10"]
    assert listed(tmp_path / "fig4.toml") is None
    with pytest.raises(InputError, match="no such config fig5"):
        listed(write(tmp_path, "list.toml", 'configs = ["fig5.toml"]\n'))
    with pytest.raises(InputError, match="key configs: '' is no name and no pattern"):
        listed(write(tmp_path, "list.toml", 'configs = [""]\n'))
    with pytest.raises(InputError, match="is no name and no pattern beside this file"):
        listed(write(tmp_path, "list.toml", f'configs = ["{tmp_path}/*.toml"]\n'))
    (tmp_path / "other").mkdir()
    write(tmp_path / "other", "fig4.toml", "a = 2\n")
    again = listed(write(tmp_path, "list.toml", 'configs = ["fig4.toml", "other/../fig4.toml", "list.toml"]\n'))
    assert [p.stem for p in again or []] == ["fig4"], "a file comes once, and the list is no config"
    with pytest.raises(InputError, match="are both called fig4"):
        listed(write(tmp_path, "list.toml", 'configs = ["fig4.toml", "other/*.toml"]\n'))
    assert artefact(STUDIES / "planted.toml") == "studies/planted"


def test_the_list_of_the_papers_has_every_artefact_under_its_own_name():
    papers = [artefact(p) for p in listed(CONFIGS / "paper.toml") or []]
    figures = [4, 5, 6, 7, 8, 12, 13]
    named = [*(f"paper2/table{k}" for k in range(2, 11)), *(f"paper2/fig{k}" for k in figures)]
    assert [p for p in papers if p.startswith(("paper2/table", "paper2/fig"))] == named
    told = {artefact(p): resolve(p).get("artefact", artefact(p)) for p in every_config()}
    assert told == {name: name for name in told}, "metrics.json names the artefact that the config is named after"


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    return tmp_path_factory.mktemp("kept")


def needs_data(path: Path) -> bool:
    return path.parent.name == "paper2" or resolve(path).get("data") == "ztbus"


def parameters(paths):
    return [pytest.param(p, id=artefact(p), marks=[pytest.mark.data] if needs_data(p) else []) for p in paths]


@pytest.mark.parametrize("path", parameters(every_config()))
def test_every_config_has_tasks_or_says_which_data_it_needs(path):
    """At a tiny size: all of its keys are known, and what it is to compute is listed before anything runs."""
    try:
        plans = plan(path, tiny=True)
    except MissingDataError as e:
        assert needs_data(path)
        pytest.skip(str(e))
    assert all(p.tasks for p in plans)


# One config of each experiment, and of each kind of page that it makes; the planted study has tests of its own.
RUN = (
    "paper1/table1", "paper1/fig5", "paper1/table2", "studies/pinn_buses", "studies/pinn_data",
    "studies/pinn_weights", "paper2/table2", "paper2/fig12", "paper2/selection", "paper2/table8",
    "paper2/input_accelerator_pedal", "paper2/online", "studies/coverage", "studies/linearity", "studies/many",
    "studies/maps", "studies/mass", "studies/ranks", "studies/switching", "studies/simulators",
    "studies/while_driving", "studies/instruments", "studies/watch_months", "studies/energy_study",
)  # fmt: skip


def test_each_experiment_has_a_config_that_tests_run():
    run = {resolve(CONFIGS / f"{name}.toml")["experiment"] for name in RUN}
    assert run | {"planted.study"} == set(store.experiments_here())


# Of these the diagnosis is most of the time, and has tests of its own: here it knows few effects; the fleet needs more.
EFFECTS = {
    "instruments": ("grade_noise", "mass_scale"), "many": ("air_density", "auxiliary_power"), "watch_months": FEW,
    "switching": ("auxiliary_power", "switching_load"), "table8": ("copper_loss", "time_skew"),
    "while_driving": ("time_skew", *vars(Truth())),
}  # fmt: skip
# Smaller still than `[tiny]`: a task of each kind. The networks have the same data, and what one has trained is kept.
NETWORKS = ('variants=["A", "B"]', 'held_variants=["B"]', "shares=[0.5]")
SMALLER = {
    "paper1/fig5": ('variants=["D", "truck_8x4_37t", "bus_12m_3speed"]', "routes=12"),
    "paper2/input_accelerator_pedal": ('model="linear_arx"',),
    "studies/instruments": ("rows_per_trip={ segments = 60 }",), "studies/mass": ('buses=["B183"]', "rows=1000"),
    "studies/ranks": ('worlds={ "closed form" = 1, "fleet on statistics" = 1, NUTS = 1 }', "warm_up=50", "vehicles=2"),
    "paper2/selection": ('groups.orders.tried={ "1; 1, 1" = { outputs = 1, lags = [0], units = 2 }, '
                         '"1 kW" = { outputs = 1, lags = [0], units = 2, huber_kw = 1.0 } }',),
    "paper1/table1": ("repetitions=1",), "studies/pinn_weights": NETWORKS,
    "paper1/table2": (*NETWORKS, "effects={ regen_cutoff = { speed_mps = 2.5 } }"),
    "paper2/table8": ('order=["NARXS", "NARXP", "physics", "diagnosed", "persistence"]',),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.drawn
@pytest.mark.parametrize("path", parameters(CONFIGS / f"{name}.toml" for name in RUN))
def test_a_config_runs_at_a_tiny_size(path, tmp_path, kept, monkeypatch):
    if path.stem == "simulators":
        pytest.importorskip("fastsim", reason="fastsim is in the extra truth")
    monkeypatch.setattr(online, "diagnose", partial(diagnose, only=("headwind",)))  # its fleet needs the others
    try:
        with library_of(EFFECTS.get(path.stem, LIBRARY)):
            runs = run_config(path, SMALLER.get(artefact(path), ()), out=tmp_path / "out", kept=kept, tiny=True)
    except MissingDataError as e:
        pytest.skip(str(e))
    assert all(r["rows"] for r in runs)
    for folder in (Path(r["folder"]) for r in runs):
        for kinds in (("tables", "md", "tex"), ("figures", "png", "pdf")):
            one, other = ({p.stem for p in (folder / kinds[0]).glob(f"*.{end}")} for end in kinds[1:])
            assert one == other, "each in both formats"
        assert [*folder.glob("tables/*.tex"), *folder.glob("figures/*.pdf")]
        assert (folder / "report.html").stat().st_size > 1000


@pytest.mark.parametrize("path", sorted(STUDIES.glob("planted*.toml")), ids=lambda p: p.stem)
def test_every_study_is_a_config(path):
    config = typed(Config, resolve(path), path)
    every = list(tasks(config))
    assert every
    assert len({t["seed"] for t in every}) == len(every), "each log has its own noise"


def test_intervals_of_shares():
    low, high = wilson(5, 100)
    assert low == pytest.approx(0.0215, abs=1e-3)  # R: prop.test(5, 100, correct = FALSE)
    assert high == pytest.approx(0.1118, abs=1e-3)
    assert wilson(0, 0) == (0.0, 1.0)


def test_many_tasks_on_two_workers_are_all_kept(tmp_path, monkeypatch):
    """More tasks than a worker keeps its compiled programs for; an error of a task is the run's, and says of which."""
    toy = "SOURCES = ()\n\n\ndef run(task):\n    return {'square': task['n'] ** 2, 'by': 1 / task['by']}\n"
    write(tmp_path, "toy_experiment.py", toy)
    monkeypatch.syspath_prepend(tmp_path)
    toy = importlib.import_module("toy_experiment")
    todo, kept, log = [{"n": n, "by": 1} for n in range(90)], tmp_path / "kept", Log(None)
    asked = [Asked("toy", toy, todo), Asked("bad", toy, [{"n": 1, "by": 0}])]
    failed = compute(asked, Where(workers=2), kept, log, keep_going=True)
    assert [store.read(store.place(toy, t, kept))["result"]["square"] for t in todo] == [n * n for n in range(90)]
    assert {name: type(e) for name, e in failed.items()} == {"bad": ZeroDivisionError}
    assert "in the task {" in failed["bad"].__notes__[-1]


def test_a_tiny_study_runs_is_kept_and_is_not_run_again(tmp_path, monkeypatch):
    def once(out: str, sets=(), **options) -> dict:
        with library_of(("air_density", "auxiliary_power", "headwind", "mass_scale")):
            return run_config(STUDIES / "planted_quick.toml", sets, out=tmp_path / out, kept=kept, **options)[0]

    kept = tmp_path / "kept"
    first = once("a")
    assert first["logs"] == 2
    assert first["synthetic"] is True
    assert first["skipped"] == []
    rows = {r["name"]: r["ours"] for r in first["rows"]}
    assert rows["one effect, effect/noise 1, 12 trips, ar1"]["named_exactly"] == 1.0
    assert rows["nothing planted, 12 trips, ar1"]["false_name"] == 0.0
    made = ("tables/planted.md", "tables/planted.tex", "figures/confusion.png", "figures/confusion.pdf", "report.html")
    assert all((tmp_path / "a" / name).stat().st_size > 200 for name in made)
    assert not (tmp_path / "a/figures/power.png").exists(), "one size is no curve"
    monkeypatch.setattr("experiments.planted.study.run", lambda task: pytest.fail(f"run again: {task}"))
    again = once("b")
    assert again["rows"] == first["rows"]
    assert json.loads((tmp_path / "b" / "metrics.json").read_text())["rows"] == first["rows"]
    sets = ["cases.single.logs=3", "cases.null.logs=2"]
    part = once("c", sets, fresh=False)
    assert part["logs"] == 1, "the first log is the same one, whatever comes after it"
    assert part["tasks_left_out"] == 4
    write_docs(tmp_path / "docs", STUDIES / "planted.toml", [tmp_path / "c"], sets)
    page = " ".join((tmp_path / "docs" / "planted.md").read_text().split())
    assert "1 synthetic log." in page
    assert "Not run: 4 more tasks of the config" in page
    assert "planted.toml --set cases.single.logs=3 --set" in page
    for name in re.findall(r"\]\((figures/[^)]*)\)", page):
        assert (tmp_path / "docs" / name).stat().st_size > 200


def test_a_long_table_of_a_page_of_many_runs_is_folded():
    table = "\n".join(["| a | b |", "|---|---|", *(f"| {k} | 1 |" for k in range(MOST_ROWS + 1))])
    whole, some = (part(["Said."], [], [table], [], most_rows=most) for most in (None, MOST_ROWS))
    assert "<details" not in "\n".join(whole)
    assert f"<summary>Table of {MOST_ROWS + 1} rows</summary>" in "\n".join(some)
    assert all(f"| {k} | 1 |" in "\n".join(some) for k in range(MOST_ROWS + 1))


WORDS = ("white", "noise,", "held-out", "+", "-", "=", "2.", "3)", ">5", ">=", "##", "<b>", "`a b`", "[x](y.md)")
BEGINNINGS = ("A sentence ", "- an item ", "12. ")


@given(st.lists(st.sampled_from(WORDS), min_size=30, max_size=90), st.sampled_from(BEGINNINGS))
def test_a_wrapped_page_says_the_same_and_begins_nothing_inside_a_sentence(words, begin):
    line = f"{begin}a {' a '.join(words)} end."  # so that a short word stands somewhere in each line
    first, *more = wrapped(line).split("\n")
    assert all(len(x) <= WIDTH for x in (first, *more))
    assert " ".join([first, *(x.strip() for x in more)]) == line
    assert not [x for x in more if re.match(r" *([-+*=]+( |$)|[#<>]|\d+[.)]( |$))", x)]
    for other in (f"| a | {line} |", f"# {line}", f"![{line}](x.png)", f"<summary>{line}</summary>", f"{line}  "):
        assert wrapped(other) == other
    for fence in ("```", "  ~~~"):
        assert wrapped(f"{fence}sh\n{line}\n{fence}") == f"{fence}sh\n{line}\n{fence}"


@pytest.mark.parametrize(
    ("key", "words"),
    [("median_error_percent", "median error [%]"), ("energy_error_trip1", "energy error trip 1"),
     ("trip4", "trip 4"), ("c_rr", "c_rr"), ("step_ms", "step [ms]"), ("physics, tables", "physics, tables")],
)  # fmt: skip
def test_a_key_is_read_as_words(key, words):
    assert readable(key) == words


def test_the_page_of_paper_2_says_which_of_its_models_are_means_of_starts():
    models = resolve(CONFIGS / "paper2" / "_base.toml")["models"]
    means = [name for name, m in models.items() if m.get("rule") == "ensemble"]
    assert f"for {' and '.join(sorted(means, reverse=True))} the mean prediction of all starts" in (
        CONFIGS / "paper2.toml"
    ).read_text(encoding="utf-8")
