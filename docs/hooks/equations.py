"""Equations of a page as MathML: `$$ … $$` a line of its own, `$ … $` in a sentence. Browsers draw it by themselves."""

import re
from typing import Any

from latex2mathml.converter import convert

__all__ = ["on_page_markdown"]

CODE = re.compile(r"((?:^[ \t]*```.*?^[ \t]*```)|(?:^[ \t]*~~~.*?^[ \t]*~~~)|`[^`\n]*`)", re.MULTILINE | re.DOTALL)
EQUATION = re.compile(r"\$\$(.+?)\$\$|\$([^$\s](?:[^$\n]*[^$\s])?)\$", re.DOTALL)


def _mathml(found: re.Match) -> str:
    block, inline = found.groups()
    # in an element of a sentence: a line that begins with <math> would be a block of its own
    return convert(block, display="block") if block else f"<span>{convert(inline)}</span>"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with its equations converted; what is code stays as it is."""
    return "".join(part if k % 2 else EQUATION.sub(_mathml, part) for k, part in enumerate(CODE.split(markdown)))
