"""Sums, differences, products and quotients of columns, with their units: parsed to a tree, never run as code."""

import ast
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hdev_jax.errors import InputError

__all__ = ["Quantity", "check_expression", "evaluate", "names_in"]

_OPERATIONS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_LONGEST = 400  # characters: an expression is a line


@dataclass(frozen=True)
class Quantity:
    """Numbers and their unit as pint knows it; None where the column says no unit."""

    values: Any
    unit: Any | None


def check_expression(where: str, text: str) -> str:
    """The text, where it is an expression of columns. Raises `InputError` saying what is accepted."""
    names_in(text, where)
    return text


def names_in(text: str, where: str) -> tuple[str, ...]:
    """The columns of an expression, in their order."""
    found: dict[str, None] = {}
    _walk(_tree(text, where), lambda name: found.setdefault(name), text, where)
    if not found:
        raise InputError(f"{where} = {text!r}: it names no column")
    return tuple(found)


def _tree(text: str, where: str) -> ast.expr:
    try:
        if len(text) > _LONGEST:
            raise ValueError
        return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise InputError(f"{where} = {text[:80]!r}: not an expression; {_accepted()}") from None


def _accepted() -> str:
    return (
        "columns, numbers, + - * / and brackets are accepted, a name with blanks or brackets in quotes: 'HV volts [V]'"
    )


def _walk(node: ast.expr, leaf: Callable[[str], Any], text: str, where: str) -> Any:
    """Visit the tree; nothing but columns, numbers and the four operations is let through."""
    match node:
        case ast.Name(id=name) | ast.Constant(value=str() as name):
            return leaf(name)
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=inside):
            return (type(sign), _walk(inside, leaf, text, where))
        case ast.BinOp(left=left, op=operation, right=right) if type(operation) in _OPERATIONS:
            return (type(operation), _walk(left, leaf, text, where), _walk(right, leaf, text, where))
    raise InputError(f"{where} = {text!r}: '{ast.unparse(node)[:40]}' cannot stand there; {_accepted()}")


def evaluate(text: str, where: str, column: Callable[[str], Quantity], to: str | None) -> np.ndarray:
    """The expression's values `[row]`: in the unit `to` as pint writes it, checked; with `to` None the bare numbers.

    **Arguments:** `column(name)`, a column's numbers and unit. **Raises:** `InputError` where units do not fit, or a
    column has none while `to` asks for one.
    """

    def leaf(name: str) -> Any:
        q = column(name)
        if to is None:
            return q.values
        if q.unit is None:
            raise InputError(
                f"{where} = {text!r}: column '{name}' says no unit; make it by a rule of its own, or give this rule "
                "a unit and the numbers are taken as they are"
            )
        return q.values * q.unit

    from pint.errors import PintError  # pint takes long to import, and most logs have no expression

    value = _value(_walk(_tree(text, where), leaf, text, where), text, where)
    if to is None:
        return np.asarray(value, dtype=np.float64)
    try:
        return np.asarray(value.to(to).magnitude, dtype=np.float64)
    except (PintError, AttributeError):  # another dimension, or a bare number
        found = f"{value.units:~P}" if hasattr(value, "units") else "a bare number"
        raise InputError(f"{where} = {text!r}: its unit is {found}, {to} is expected") from None


def _value(tree: Any, text: str, where: str) -> Any:
    if not isinstance(tree, tuple):
        return tree
    operation, *parts = tree
    from pint.errors import PintError

    a = _value(parts[0], text, where)
    if operation in (ast.USub, ast.UAdd):
        return -a if operation is ast.USub else a
    b = _value(parts[1], text, where)
    try:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return {ast.Add: lambda: a + b, ast.Sub: lambda: a - b, ast.Mult: lambda: a * b, ast.Div: lambda: a / b}[
                operation
            ]()
    except (PintError, ArithmeticError, TypeError):  # they measure different things, or a number is divided by 0
        raise InputError(
            f"{where} = {text!r}: the two sides of '{_OPERATIONS[operation]}' do not go together"
        ) from None
