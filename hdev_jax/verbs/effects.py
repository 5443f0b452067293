"""The verb `effects`: the library of effects as a table."""

from hdev_jax.physics import LIBRARY, Parameter

__all__ = ["effects"]


def effects() -> list[dict[str, str]]:
    """The library of effects: id, stage, equation, parameters with units, channels needed, source."""
    return [
        {
            "id": c.id,
            "stage": c.stage,
            "equation": c.equation,
            "parameters": ", ".join(f"{p.name} [{p.unit}]{_by(p)}" for p in c.parameters),
            "needs": ", ".join(n.replace("|", " or ") for n in c.needs) or "-",
            "source": c.source,
        }
        for c in LIBRARY.values()
    ]


def _by(p: Parameter) -> str:
    return f" by {p.by.replace('_', ' ')}" if p.by else ""
