"""Keys and groups of old, and what took their place: each is refused with its new name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.errors import ConfigError

KEYS = {
    "rotor": "machine.rotor",
    "bearing": "machine.bearings",
    "excitation.speeds": "machine.speeds",
    "excitation.runs": "machine.runs",
    "excitation.residual": "machine.residual_unbalance",
    "excitation.file": "machine.runs_file",
    "excitation": "machine",
    "sensors.probes": "machine.probes.at",
    "sensors": "machine.probes",
    "ingest": "machine.recordings",
    "prediction": "machine.prediction",
    "design.candidates": "machine.candidates",
    "identify.tie_bearings": "identify.shared",
}
"""Old key -> new key, the longer ones of a section first; what lies below a key keeps its name."""

OPTIONS = {
    "rotor": {"two_discs": "two_discs", "one_disc": "one_disc", "compressor": "compressor_two_journals"},
    "bearing": {
        "short_fluid_film": "two_discs",
        "ball_8x30": "one_disc",
        "compressor_two_journals": "compressor_two_journals",
        "compressor_journal_and_isotropic": "compressor_journal_and_isotropic",
        "rotor_file": "machine.bearings.kind=rotor_file",
    },
    "excitation": {
        "three_unbalances": "two_discs",
        "three_unbalances_backward": "two_discs_backward",
        "impulses": "two_discs_impulses",
        "one_unbalance": "one_disc",
        "compressor_unbalances": "compressor_two_journals",
        "compressor_backward": "compressor_journal_and_isotropic_backward",
    },
    "sensors": {
        "all_nodes": "machine.probes.at=all",
        "bearings_1_percent": "machine.probes.at=bearings machine.probes.multiplicative=0.01",
        "proximity_probes": "two_discs_proximity_probes",
    },
    "ingest": {
        "none": "machine.recordings.format=none",
        "measured_demo": "measured_demo",
        "measured_demo_table": "measured_demo_table",
        "table": "two_discs_table",
        "uff58": "two_discs_uff58",
        "waveform": "two_discs_waveform",
    },
    "prediction": {
        "disc_1500_rpm": "two_discs",
        "compressor_disc": "compressor_two_journals",
        "measured_demo": "measured_demo",
    },
    "design": {"three_runs": "two_discs", "compressor_three_runs": "compressor_two_journals"},
}
"""Old group -> option -> the machine that has it, or the overrides that stand for it."""


def rename(key: str) -> str | None:
    """The new name of an old key; None for a key that is none."""
    for old, new in KEYS.items():
        if key == old or key.startswith(f"{old}."):
            return new + key[len(old) :]
    return None


def refuse_renamed(key: str, value: object, text: str) -> None:
    """Raise ConfigError where ``text``, the override ``key=value``, has a key or a group of old."""
    group = key.partition("@")[0].replace("/", ".")
    if group in OPTIONS and isinstance(value, str):
        raise ConfigError(_explain_option(group, value))
    new = rename(group)
    if new is not None:
        given = f": write {text.replace(key, new, 1)}" if "=" in text and group != "excitation" else ""
        raise ConfigError(f"{key} is now {new}{given}")


def _explain_option(group: str, name: str) -> str:
    new = OPTIONS[group].get(name)
    if new is None:
        part = KEYS.get(group, "machine.candidates").partition(".")[2]
        return (
            f"{group}={name} is now a part of a machine{f' ({part})' if part else ''}: choose one with machine=NAME, "
            "or one of your own with machine.file=FILE (stage=new writes it)"
        )
    return f"{group}={name} is now {new if '=' in new else f'machine={new}'}"


def refuse_renamed_in(mapping: Mapping[str, Any], file: object, in_machine: bool) -> None:
    """The same for the keys of a YAML file: a machine's, or an experiment's with its defaults list."""
    for old, new in KEYS.items():
        section, _, name = old.partition(".")
        inside = mapping.get(section)
        if section not in mapping or (name and not (isinstance(inside, Mapping) and name in inside)):
            continue
        if in_machine:
            new = new.removeprefix("machine").removeprefix(".") or "speeds and runs, without a section"
        if new != old:
            raise ConfigError(f"in '{file}', {old} is now {new}: write it so")
    for item in mapping.get("defaults") or ():
        for name, option in item.items() if isinstance(item, Mapping) else ():
            group = str(name).removeprefix("override ").strip().lstrip("/").partition("@")[0]
            if group in OPTIONS:
                raise ConfigError(
                    f"in '{file}', {_explain_option(group, str(option))}: write `override /machine: NAME`"
                )
