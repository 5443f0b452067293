"""The rules of the tree: what may import what, what a module exports, what no file may contain."""

import ast
import contextlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

import hdev_jax

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "hdev_jax"

# From the bottom up. A module imports from lines above its own, and from its own package.
LAYERS = [
    {"checkpoints", "errors", "segments", "progress"},
    {"compiling", "textfiles", "units", "rundir", "targets"},
    {"logs", "physics"},
    {"inference", "learn", "fleet"},
    {"problem"},
    {"diagnosis", "energy", "export"},
    {"many", "online"},
    {"report"},
    {"options", "verbs"},
    {"cli", "experiments"},
]
PARTS = {p.stem for p in PACKAGE.iterdir()}
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
PHYSICS_MAY_IMPORT = {"jax", "equinox", "jaxtyping", "numpy", "hdev_jax", *sys.stdlib_module_names}

# A folder is a concept that one can take in, a file one idea. What is larger today may only shrink.
MOST_MODULES = 13
MOST_LINES = 340
MORE_MODULES = {"hdev_jax/fleet": 19, "hdev_jax/physics": 15}
MORE_LINES = {"hdev_jax/rundir.py": 341}
IN_A_CIRCLE: set[str] = set()

MODULES = sorted(PACKAGE.rglob("*.py")) + sorted((ROOT / "experiments").rglob("*.py"))


def dotted(path: Path) -> tuple[str, ...]:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imported(path: Path) -> set[tuple[str, ...]]:
    """Every module that the file imports, wherever in it, as parts of its absolute name."""
    package = dotted(path) if path.name == "__init__.py" else dotted(path)[:-1]
    found = set()
    for node in ast.walk(parsed(path)):
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
    return module[1] if module[0] == "hdev_jax" and len(module) > 1 and module[1] in PARTS else None


def label(path: Path) -> str:
    return ".".join(dotted(path))


def loaded(path: Path) -> set[str]:
    """The tree's modules that importing this file loads, under `if TYPE_CHECKING` too, but not in a function's body.

    With a module come the packages above it, except those that hold the file itself: these are being loaded already.
    """
    found, todo = set(), list(parsed(path).body)
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{label(path)}: an absolute import is expected"
            found |= {name for alias in node.names for name in (node.module, f"{node.module}.{alias.name}")}
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            todo += ast.iter_child_nodes(node)
    own = label(path)
    above = {".".join(name.split(".")[:k]) for name in found for k in range(1, name.count(".") + 2)}
    return {name for name in above & BY_NAME.keys() if not f"{own}.".startswith(f"{name}.")}


BY_NAME = {label(path): path for path in MODULES}


def test_no_module_imports_itself_by_way_of_others():
    imports = {name: loaded(path) for name, path in BY_NAME.items()}
    while leaves := {name for name, others in imports.items() if not others & imports.keys()}:
        imports = {name: others for name, others in imports.items() if name not in leaves}
    # what only leads to a circle is no part of one
    while tops := imports.keys() - {other for others in imports.values() for other in others}:
        imports = {name: others for name, others in imports.items() if name not in tops}
    assert imports.keys() <= IN_A_CIRCLE, "these import each other in a circle: move what they share below them"


def too_large(sizes: dict[str, int], most: int, more: dict[str, int]) -> dict[str, int]:
    """What is above its limit, and exceptions that are no longer needed."""
    large = {name: size for name, size in sizes.items() if size > more.get(name, most)}
    return large | {name: sizes.get(name, 0) for name, size in more.items() if sizes.get(name, 0) < size}


def test_folders_and_modules_stay_small():
    folders: dict[str, int] = {}
    for path in MODULES:
        if path.name != "__init__.py":
            folder = path.parent.relative_to(ROOT).as_posix()
            folders[folder] = folders.get(folder, 0) + 1
    lines = {p.relative_to(ROOT).as_posix(): len(p.read_text(encoding="utf-8").splitlines()) for p in MODULES}
    assert not too_large(folders, MOST_MODULES, MORE_MODULES), "too large, or an exception that is now too generous"
    assert not too_large(lines, MOST_LINES, MORE_LINES), "too large, or an exception that is now too generous"


def test_imports_point_one_way():
    # hdev_jax/__init__.py, which is of no part, re-exports from everywhere, on first use
    homes = {path: own for path in MODULES if (own := part(dotted(path))) is not None}
    new = set(homes.values()) - LEVEL.keys()
    assert not new, f"new: say in LAYERS of {Path(__file__).name} where they belong"
    upwards = [
        f"{label(path)} imports {'.'.join(module)}" for path, own in homes.items() for module in imported(path)
        if (other := part(module)) not in (None, own) and LEVEL[other] >= LEVEL[own]
    ]  # fmt: skip
    assert upwards == [], "what is imported is not below"


def test_physics_is_light():
    physics = [path for path in MODULES if part(dotted(path)) == "physics"]
    heavy = {label(path): {m[0] for m in imported(path)} - PHYSICS_MAY_IMPORT for path in physics}
    assert heavy
    assert {name: found for name, found in heavy.items() if found} == {}


def test_module_says_what_it_is_and_what_it_exports():
    assert [label(path) for path in MODULES if not ast.get_docstring(parsed(path))] == [], "say in one line what it is"
    bare = [
        label(path) for path in MODULES
        if "__all__" not in {t.id for n in parsed(path).body if isinstance(n, ast.Assign) for t in n.targets
                             if isinstance(t, ast.Name)}
    ]  # fmt: skip
    assert bare == [], "no __all__"


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


def test_no_module_hides_an_export_of_its_folder():
    """A name taken from one module that is another module's too: it would be that module once it is loaded."""
    hidden = [
        name for path in MODULES if path.name == "__init__.py" for node in parsed(path).body
        for alias in (node.names if isinstance(node, ast.ImportFrom) else ())
        if (name := f"{label(path)}.{alias.asname or alias.name}") in BY_NAME and node.module != name
    ]  # fmt: skip
    assert hidden == [], "these are modules"


def section(title: str) -> str:
    """A section of docs/architecture.md, without its heading."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    (text,) = re.findall(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", page, flags=re.S | re.M)
    return text


def drawn_tree() -> list[str]:
    """The folders of the page's tree: two spaces to a level, a line each."""
    (block,) = re.findall(r"```\n(.*?)```", section("The tree"), flags=re.S)
    found: list[str] = []
    for line in block.splitlines():
        indent, name = re.fullmatch(r"( *)(\w+)/ +\S.*", line).groups()
        above = next((f for f in reversed(found) if f.count("/") < len(indent) // 2), "") if indent else ""
        assert indent == "  " * (above.count("/") + bool(above)), f"{line}: two spaces to a level"
        found.append(f"{above}/{name}".removeprefix("/"))
    return found


def test_the_page_of_the_architecture_draws_the_tree_as_it_is():
    drawn = drawn_tree()
    assert len(set(drawn)) == len(drawn)
    assert [f for f in drawn if not (ROOT / f).is_dir()] == [], "folders that are not there"
    folders = [p for home in (PACKAGE, ROOT / "experiments") for p in home.rglob("*") if p.is_dir()]
    there = {p.relative_to(ROOT).as_posix() for p in folders if any(f.is_file() for f in p.iterdir())}
    assert {f for f in there if "__pycache__" not in f} <= set(drawn), "every folder with a line"


def test_the_page_of_the_architecture_has_the_layers_in_their_order():
    lines = re.findall(r"^\d+\. (`.*`)$", section("Layers"), flags=re.M)
    assert [set(re.findall(r"`(\w+)`", line)) for line in lines] == LAYERS
    assert set.union(*LAYERS) <= PARTS | {"experiments"}, "layers that are not there"


def test_the_page_of_the_architecture_names_files_that_are_there():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:hdev_jax|experiments|configs|tests|docs|benchmarks)/[\w/.]*)`", page))
    assert named
    assert [f for f in sorted(named) if not (ROOT / f).exists()] == []


def text_files() -> dict[Path, str]:
    """What a commit of the whole tree would hold, as far as it is text."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
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
    pattern, ends = re.compile("|".join([*hosts, *paths])), [".org", *(f"{place}/" for place in places)]  # few have one
    found = {
        str(p.relative_to(ROOT)): m.group() for p, text in text_files().items()
        if any(end in text for end in ends) and (m := pattern.search(text))
    }  # fmt: skip
    assert not found


def test_pins_cover_every_requirement():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    installed = ",".join(re.findall(r"-e '\.\[([\w,]+)\]'", (ROOT / "Makefile").read_text()))
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


def test_ci_fails_where_a_test_of_measured_data_is_skipped(pytester, monkeypatch):
    """With the data there, then without it."""
    pytester.makeconftest((ROOT / "tests" / "measured_data.py").read_text(encoding="utf-8"))
    pytester.makeini("[pytest]\nmarkers = data: reads measured data")
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
    monkeypatch.setenv("HDEV_DATA", str(folder))
    monkeypatch.setenv("CI", "true")
    folder.mkdir()
    for failed in (3, 0):
        outcomes = pytester.runpytest_inprocess("-p", "no:cacheprovider").parseoutcomes()
        assert outcomes.get("failed", 0) + outcomes.get("errors", 0) == failed
        assert outcomes["skipped"] == 4 - failed
        shutil.rmtree(folder, ignore_errors=True)


def test_shapes_in_annotations_are_checked():
    """The hook of tests/conftest.py works, so that a wrong shape fails wherever a test meets it."""
    from hdev_jax.diagnosis.scores.significance import effective_number

    with pytest.raises(jaxtyping.TypeCheckError):
        for _ in range(10):  # one call of ten, where a search has called it often before
            with contextlib.suppress(ValueError):
                effective_number(np.ones(3))
