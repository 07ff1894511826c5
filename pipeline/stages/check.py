"""Metrics against thresholds: the accuracy regression that CI runs."""

from __future__ import annotations

import math
from pathlib import Path

from pipeline.config.schema import Config
from pipeline.errors import ConfigError, nearest
from pipeline.evaluation.thresholds import Check, check_experiment, read_rules
from pipeline.files import write_json
from pipeline.reporting.console import say, table, warn
from pipeline.stages.execution import StageOutput

THRESHOLDS = Path(__file__).parents[2] / "conf" / "thresholds"


def run(config: Config) -> StageOutput:
    """Print every metric beside its threshold and write ``check.json``.

    Exits with 1 if a limit is exceeded or a metric is missing.
    """
    known = sorted(path.stem for path in THRESHOLDS.glob("*.yaml"))
    chosen = config.check.experiments or known
    for name in chosen:
        if name not in known:
            raise ConfigError(
                f"check.experiments must name experiments with thresholds, but got '{name}': {nearest(name, known)}"
            )
    checks: list[Check] = []
    for name in chosen:
        # The folders of all experiments lie beside each other.
        folder = Path(config.output).parent / name
        checks += check_experiment(name, read_rules(THRESHOLDS / f"{name}.yaml"), folder)
    rows = [
        [
            c.experiment,
            c.metric,
            "missing" if c.value is None else f"{c.value:.3g}",
            str(c.rule),
            "ok" if c.met else "FAILED",
        ]
        for c in checks
    ]
    table("metrics against thresholds", ["experiment", "metric", "value", "limit", ""], rows)
    failed = [c for c in checks if not c.met]
    for c in failed:
        came = f"is missing (run the stages of {c.experiment} first)" if c.value is None else f"is {c.value:.3g}"
        warn(f"{c.experiment}: {c.metric} must be {c.rule}, but {came}. The limit: {c.rule.why}")
    if not failed:
        say(f"all {len(checks)} metrics hold")
    summary = {"checked": len(checks), "failed": len(failed), "share_of_threshold": _compute_shares(checks)}
    path = write_json(Path(config.output).parent / "check.json", summary)
    return StageOutput(summary, files=[path], exit_code=1 if failed else 0)


def _compute_shares(checks: list[Check]) -> dict[str, float]:
    """The metric nearest to its threshold in each experiment, as a share of it; 1 and more fails."""
    shares: dict[str, float] = {}
    for c in checks:
        if c.value is None or not math.isfinite(c.value):
            continue
        if c.rule.max is not None and c.rule.max > 0:
            shares[c.experiment] = max(shares.get(c.experiment, 0.0), c.value / c.rule.max)
        if c.rule.min is not None and c.value > 0:
            shares[c.experiment] = max(shares.get(c.experiment, 0.0), c.rule.min / c.value)
    return shares
