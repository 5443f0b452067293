"""Adapters that come with the project, for what common tools write: one TOML file each, recognised by its header."""

from hdev_jax.logs.presets.library import PRESETS, is_preset, preset, recognised

__all__ = ["PRESETS", "is_preset", "preset", "recognised"]
