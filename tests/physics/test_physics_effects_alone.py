"""An effect is one class: nothing of it is kept elsewhere in the package."""

import ast
import re
from pathlib import Path

import pytest

from hdev_jax.physics import DECLARED, LIBRARY
from hdev_jax.report import names

PACKAGE = Path(__file__).parents[2] / "hdev_jax"
IDS = {*LIBRARY, *(c.id for c in DECLARED)}
ID = re.compile(rf"\b(?:{'|'.join(IDS)})\b")

# Words that are also something else: channels of a log, features of a network, the kind of a quantity by its name.
CHANNELS = {"wet_road", "road_surface"}
ELSEWHERE: dict[str, set[str]] = {
    # the truth that logs are made with shares no code with the kernel
    "fleet": IDS,
    # the two coefficients of paper 1 that a network takes over, and the declared load as a feature
    "learn/pinn/rows.py": {"rolling", "aero", "auxiliary", "cornering"},
    # fields of other programs' vehicles that hold these terms
    "export/simulators.py": {
        "inertia",
        "rolling",
        "rolling_linear",
        "aero",
        "auxiliary",
        "auxiliary_power",
        "rotating_mass",
    },
    # columns of a linear fit that is given as one
    "learn/sources.py": {"copper_loss", "inverter_loss"},
    # parts of a name that say what a column holds; bins and words of a figure
    "units.py": {"grade", "air_density", "hvac_power"},
    "logs/guesses.py": {"grade", "auxiliary"},
    # the kernel taken apart: each declared part as a hypothesis
    "problem/plausible.py": {"grade", "auxiliary", "inertia", "rolling", "aero"},
    "report/fleet/figures.py": {"grade", "rolling"},
}


def texts(path: Path) -> set[str]:
    """Every text in the code of a file that has the word of an effect, without its docstrings."""
    text = path.read_text(encoding="utf-8")
    if not ID.search(text):
        return set()
    tree = ast.parse(text)
    said = {
        id(n.body[0].value)
        for n in ast.walk(tree)
        if isinstance(n, ast.Module | ast.ClassDef | ast.FunctionDef) and n.body and isinstance(n.body[0], ast.Expr)
    }
    return {
        n.value
        for n in ast.walk(tree)
        if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in said
    }


def named(path: Path) -> set[str]:
    """Ids of effects that a file speaks of, by themselves or as part of a path in a sheet."""
    words = {part for text in texts(path) for part in (text, *text.split(".")[1:2] * text.startswith("effects."))}
    return words & IDS - CHANNELS


@pytest.mark.parametrize("c", [*LIBRARY.values(), *DECLARED], ids=lambda c: c.id)
def test_an_effect_says_all_of_itself(c) -> None:
    assert c.label
    assert c.equation
    assert c.source
    assert names.effect(c.id) == c.label
    for p in c.parameters:
        assert names.parameter(p.name, c.id)
        if p.by:
            assert p.by.replace("_", " ") + " 2)" in names.parameter(f"{p.name}[2]", c.id)


def test_labels_tell_effects_apart() -> None:
    labels = [c.label for c in (*LIBRARY.values(), *DECLARED)]
    assert len(set(labels)) == len(labels)


def test_an_effect_is_named_in_its_class_alone() -> None:
    found: dict[str, set[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if name.startswith("physics/"):
            continue
        excused = next(
            (ids for place, ids in ELSEWHERE.items() if name == place or name.startswith(f"{place}/")), set()
        )
        if here := named(path) - excused:
            found[name] = here
    assert not found, "what is a property of an effect belongs into its class"
