"""The files that a design writes: what it predicts, and the runs that are chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.config.messages import quote_override
from pipeline.config.runs import SpeedsConfig
from pipeline.config.schema import Config
from pipeline.data.dataset import Excitation
from pipeline.files import write_json, write_text
from pipeline.reporting.console import say
from pipeline.stages.analysis import Analysis


def write_design(
    analysis: Analysis,
    chosen: Sequence[Sequence[Excitation]],
    speeds: SpeedsConfig,
    summary: Mapping[str, object],
    overrides: str = "",
) -> list[Path]:
    """``design.json`` and ``designed_excitation.yaml``, which can be used at once: the command, with ``overrides``, is
    said."""
    config, folder = analysis.config, analysis.files.folder
    about = {"runs": [acting[0].run for acting in chosen], "stated_noise": config.stated_noise.model_dump()}
    written = [
        write_text(folder / "designed_excitation.yaml", format_runs(config, chosen, speeds)),
        write_json(folder / "design.json", {**summary, **about}),
    ]
    say(
        f"use them with: python -m pipeline stage=train {config.chosen} "
        f"{quote_override('machine.runs_file', str(written[0]))} {quote_override('output', f'{folder}_designed')}"
        + overrides
    )
    return written


def format_runs(config: Config, chosen: Sequence[Sequence[Excitation]], speeds: SpeedsConfig) -> str:
    """The YAML that ``machine.runs_file`` takes."""
    import yaml

    runs = []
    for acting in chosen:
        run: dict[str, object] = {"name": acting[0].run}
        for key, kind in (("unbalances", "unbalance"), ("forces", "force")):
            alike = [excitation for excitation in acting if excitation.kind == kind]
            if alike:
                run[key] = [_format_source(excitation) for excitation in alike]
        runs.append(run)
    content = {"speeds": speeds.model_dump(), "runs": runs}
    head = f"# Chosen by: python -m pipeline stage=design {config.chosen}\n"
    return head + yaml.safe_dump(content, sort_keys=False)


def _format_source(excitation: Excitation) -> dict[str, object]:
    unit = "kg m" if excitation.kind == "unbalance" else "N"
    source: dict[str, object] = {"node": excitation.node, "magnitude": f"{excitation.magnitude:.12g} {unit}"}
    source["phase"] = f"{np.degrees(excitation.phase):.12g} deg"
    return source | ({"whirl": excitation.whirl} if excitation.kind == "force" else {})
