"""Metrics against thresholds: the accuracy regression that CI runs."""

from __future__ import annotations

from pathlib import Path

from pipeline.config.schema import Config
from pipeline.data.tables import write_table
from pipeline.errors import ConfigError, nearest
from pipeline.evaluation import thresholds
from pipeline.evaluation.thresholds import COMMITTED, Check
from pipeline.files import write_json
from pipeline.reporting.console import say, table, warn
from pipeline.stages.analysis import Analysis
from pipeline.tracking import StageRecord
from pipeline.write_numbers import write_number

THRESHOLDS = Path(__file__).parents[2] / "conf" / "thresholds"


def run(analysis: Analysis) -> StageRecord:
    """Print what changed since the committed metrics, then every metric beside its threshold; write ``check.json``.

    Exits with 1 if a limit is exceeded or a metric is missing. ``check.commit`` makes these metrics the committed ones.
    """
    config = analysis.config
    known = sorted(path.stem for path in THRESHOLDS.glob("*.yaml"))
    beside = Path(config.output).parent  # the folders of all experiments lie beside each other
    checks: list[Check] = []
    committed = thresholds.read_committed(THRESHOLDS / COMMITTED)
    for name in config.check.experiments or known:
        if name not in known:
            raise ConfigError(
                f"check.experiments must name experiments with thresholds, but got '{name}': {nearest(name, known)}"
            )
        checks += thresholds.check_experiment(
            name, thresholds.read_rules(THRESHOLDS / f"{name}.yaml"), beside / name, committed
        )
    _print_changed(checks, config.check.changed)
    header = ["experiment", "metric", "value", "limit", ""]
    table("metrics against thresholds", header, [[c.experiment, c.metric, *_show(c)] for c in checks])
    failed = [c for c in checks if not c.met]
    if config.check.commit:
        _commit(config, failed, checks)
    for c in failed:
        came = (
            f"is missing (run the stages of {c.experiment} first)"
            if c.value is None
            else f"is {write_number(c.value, digits=3)}"
        )
        warn(f"{c.experiment}: {c.metric} must be {c.rule}, but {came}. The limit: {c.rule.why}")
    if not failed:
        say(f"all {len(checks)} metrics hold")
    nearest_limits = thresholds.find_nearest_limits(checks)
    summary = {"checked": len(checks), "failed": len(failed), "share_of_threshold": nearest_limits}
    return StageRecord(summary, files=[write_json(beside / "check.json", summary)], exit_code=1 if failed else 0)


def _show(check: Check) -> list[str]:
    """Value, limit, and whether it holds."""
    value = "missing" if check.value is None else write_number(check.value, digits=3)
    return [value, str(check.rule), "ok" if check.met else "FAILED"]


def _print_changed(checks: list[Check], share: float) -> None:
    rows = [
        [
            c.experiment,
            f"{c.rule.file.removesuffix('.json')}: {c.metric}",
            write_number(c.committed, digits=3),
            *_show(c),
        ]
        for c in checks
        if c.has_changed(share)
    ]
    title = f"changed by more than {100 * share:g} % since the committed metrics"
    table(title, ["experiment", "metric", "committed", "now", "limit", ""], rows)


def _commit(config: Config, failed: list[Check], checks: list[Check]) -> None:
    """Raises ConfigError where not every metric of every experiment holds."""
    if failed or config.check.experiments:
        named = f"check.experiments names {len(config.check.experiments)}"
        raise ConfigError(
            "metrics must be committed of all experiments, and all must hold, but "
            f"{f'{len(failed)} fail' if failed else named}: leave check.commit out, or run stage=check without "
            "check.experiments when all hold"
        )
    path = write_table(THRESHOLDS / COMMITTED, thresholds.tabulate_committed(checks))
    say(f"committed metrics in '{path}'")
