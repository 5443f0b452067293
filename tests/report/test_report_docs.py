"""docs/diagnosis.md has every gate with the sentence that a diagnosis gives."""

import re
from pathlib import Path

import pytest

from hdev_jax.diagnosis.gates.rejection import SENTENCES, Kind

PAGE = (Path(__file__).parents[2] / "docs" / "diagnosis.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", Kind)
def test_every_gate_is_in_the_table_with_its_sentence(kind):
    sentence = re.sub(r"\{[^}]*\}", "…", SENTENCES[kind])
    assert f"| `{kind}` | {sentence} |" in PAGE
