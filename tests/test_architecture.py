"""The rules of the tree: what may import what, what a module exports, what no file may contain."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import hdev_jax

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "hdev_jax"

# From the bottom up. A module imports from lines above its own, and from its own package.
LAYERS = [
    {"checkpoints", "errors", "segments", "progress"},
    {"compiling", "textfiles", "units", "rundir"},
    {"logs", "physics"},
    {"inference", "learn", "fleet"},
    {"diagnosis"},
    {"report"},
    {"opening"},
    {"prediction"},
    {"posterior"},
    {"api"},
    {"demo", "cli", "experiments"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
PHYSICS_MAY_IMPORT = {"jax", "equinox", "jaxtyping", "numpy", "hdev_jax", *sys.stdlib_module_names}

MODULES = sorted(PACKAGE.rglob("*.py")) + sorted((ROOT / "experiments").rglob("*.py"))


def dotted(path: Path) -> tuple[str, ...]:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def imported(path: Path) -> set[tuple[str, ...]]:
    """Every module that the file imports, wherever in it, as parts of its absolute name."""
    package = dotted(path) if path.name == "__init__.py" else dotted(path)[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {tuple(alias.name.split(".")) for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            base += tuple(node.module.split(".")) if node.module else ()
            # `from hdev_jax import physics` names a module in the list, not in the address.
            found |= {(*base, alias.name) for alias in node.names} if base == ("hdev_jax",) else {base}
    return found


def part(module: tuple[str, ...]) -> str | None:
    """The part of the tree that a module belongs to; None for the package itself and other libraries."""
    if module[0] == "experiments":
        return "experiments"
    names = {p.stem for p in PACKAGE.iterdir()}
    return module[1] if module[0] == "hdev_jax" and len(module) > 1 and module[1] in names else None


def label(path: Path) -> str:
    return ".".join(dotted(path))


@pytest.mark.parametrize("path", MODULES, ids=label)
def test_imports_point_one_way(path):
    own = part(dotted(path))
    if own is None:  # hdev_jax/__init__.py re-exports from everywhere, on first use
        return
    assert own in LEVEL, f"{own} is new: say in LAYERS of {Path(__file__).name} where it belongs"
    for module in imported(path):
        other = part(module)
        assert other in (None, own) or LEVEL[other] < LEVEL[own], (
            f"{own} imports {'.'.join(module)}, which is not below it"
        )


@pytest.mark.parametrize("path", [p for p in MODULES if part(dotted(p)) == "physics"], ids=label)
def test_physics_is_light(path):
    assert {m[0] for m in imported(path)} <= PHYSICS_MAY_IMPORT


@pytest.mark.parametrize("path", MODULES, ids=label)
def test_module_says_what_it_is_and_what_it_exports(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree), "a docstring that says in one line what it is"
    targets = {t.id for n in tree.body if isinstance(n, ast.Assign) for t in n.targets if isinstance(t, ast.Name)}
    assert "__all__" in targets


def test_import_sets_nothing_and_loads_nothing_heavy():
    code = (
        "import hdev_jax, sys, jax\n"
        "assert not jax.config.jax_enable_x64\n"
        "import hdev_jax.physics, hdev_jax.segments\n"
        "assert not jax.config.jax_enable_x64\n"
        "heavy = {'matplotlib', 'lightgbm', 'pandas', 'sklearn', 'pyarrow'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_export_is_there():
    for name in hdev_jax.__all__:
        assert getattr(hdev_jax, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        hdev_jax.nothing


def text_files() -> dict[Path, str]:
    """What a commit of the whole tree would hold, as far as it is text."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    found = {}
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.is_file() and b"\0" not in (content := path.read_bytes())[:8192]:
            found[path] = content.decode("utf-8", errors="replace")
    return found


def test_no_file_names_this_machine_or_a_package_registry():
    hosts = [rf"//[\w.-]*{h}" for h in (r"pypi\.org", r"pythonhosted\.org", r"npmjs\.org", r"anaconda\.org")]
    places = {str(ROOT.parent), str(Path.home())} - {"/", "/tmp"}
    paths = [r"(?<![\w.~/-])" + re.escape(place) + r"/" for place in places]
    pattern = re.compile("|".join([*hosts, *paths]))
    found = {str(p.relative_to(ROOT)): m.group() for p, text in text_files().items() if (m := pattern.search(text))}
    assert not found


def test_pins_cover_every_requirement():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (installed,) = re.findall(r"-e '\.\[([\w,]+)\]'", (ROOT / "Makefile").read_text())
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + [w for extra in installed.split(",") for w in extras[extra]]
    pins = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in pins), "names and versions, nothing else"

    def name(line: str) -> str:
        return re.split(r"[^\w.-]", line, maxsplit=1)[0].replace("_", "-").lower()

    assert {name(w) for w in wanted} <= {name(p) for p in pins}


def test_version_is_the_same_everywhere():
    assert f"\nversion: {hdev_jax.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {hdev_jax.__version__}" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ci", "there", "failed"), [("true", True, 3), ("true", False, 0), ("", True, 0)], ids=["ci", "no data", "by hand"]
)
def test_ci_fails_where_a_test_of_measured_data_is_skipped(pytester, monkeypatch, ci, there, failed):
    pytester.makeconftest((ROOT / "tests" / "conftest.py").read_text())
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.data
        def test_skips_by_itself(): pytest.skip("no time")

        @pytest.mark.data
        @pytest.mark.skip(reason="not today")
        def test_is_marked(): pass

        @pytest.mark.skip(reason="not today")
        def test_uses_the_folder(data_dir): pass

        def test_has_nothing_to_do_with_it(): pytest.skip("another reason")
        """
    )
    folder = pytester.path / "measured"
    if there:
        folder.mkdir()
    monkeypatch.setenv("HDEV_DATA", str(folder))
    monkeypatch.setenv("CI", ci)
    outcomes = pytester.runpytest_subprocess("-p", "no:cacheprovider").parseoutcomes()
    assert outcomes.get("failed", 0) + outcomes.get("errors", 0) == failed
    assert outcomes["skipped"] == 4 - failed
