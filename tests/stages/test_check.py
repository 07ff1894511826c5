"""The stage check: thresholds against metrics, and what is no threshold or no metric."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Run, assert_says
from running import few

from pipeline.errors import ConfigError
from pipeline.stages import check

Checking = Callable[..., int]


@pytest.fixture
def checking(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Checking:
    """``checking(rules, metrics, overrides)``: the exit code of stage=check on one experiment, and what it wrote."""
    thresholds = tmp_path / "thresholds"
    thresholds.mkdir()
    monkeypatch.setattr(check, "THRESHOLDS", thresholds)

    def act(rules: str | bytes, metrics: str | None, *overrides: str, name: str = "rig") -> int:
        (thresholds / f"{name}.yaml").write_bytes(rules if isinstance(rules, bytes) else rules.encode())
        folder = tmp_path / "artifacts" / name
        folder.mkdir(parents=True, exist_ok=True)
        if metrics is not None:
            (folder / "metrics.json").write_text(metrics)
        try:
            run("check", few("ball_bearing", *overrides), tmp_path / "artifacts" / "ball_bearing")
        except SystemExit as stop:
            if not isinstance(stop.code, int):
                raise
            return stop.code
        return 0

    return act


RULE = "- {metric: coefficients.*.kxx.mean_error_percent, max: 1.0, why: because the bar says so}\n"
GOOD = '{"coefficients": {"0": {"kxx": {"mean_error_percent": 0.5}}, "2": {"kxx": {"mean_error_percent": 1.0}}}}'


BROKEN = {
    "too large": GOOD.replace("0.5", "1.0000001"),
    "NaN": GOOD.replace("0.5", "NaN"),
    "infinite": GOOD.replace("0.5", "Infinity"),
    "a text": GOOD.replace("0.5", '"0.5"').replace("1.0", '"1.0"'),
    "true": GOOD.replace("0.5", "true").replace("1.0", "false"),
    "no such metric": '{"coefficients": {"0": {"kyy": {"mean_error_percent": 0.5}}}}',
    "no coefficients": '{"coefficients": {}}',
    "no object": "[1, 2]",
    "no JSON": "{",
    "no file": None,
}


@pytest.mark.parametrize("case", BROKEN)
def test_check_fails_what_is_passed_or_missing(
    case: str, checking: Checking, capsys: pytest.CaptureFixture[str]
) -> None:
    """A passed threshold, and a metric that is missing or no number, are exit code 1 with the reason."""
    assert checking(RULE, BROKEN[case]) == 1
    said = capsys.readouterr()
    assert "FAILED" in said.out
    assert_says(said.err, "must be at most 1", "because the bar says so")


RULES = {
    "empty": "",
    "no list": "metric: x\nmax: 1\n",
    "no reason": "- {metric: x, max: 1}\n",
    "a short reason": "- {metric: x, max: 1, why: so}\n",
    "unknown key": RULE.replace("max", "least"),
    "no number": RULE.replace("1.0", "much"),
    "infinite": RULE.replace("1.0", ".inf"),
    "no YAML": "- {metric: [",
    "no UTF-8": b"\xff\xfe- x",
    "an object": "!!python/object/apply:os.system ['echo ran']",
    "no rule": "[]",
}


@pytest.mark.parametrize("case", RULES)
def test_thresholds_that_are_no_thresholds(case: str, checking: Checking) -> None:
    with pytest.raises(ConfigError, match=r"rig\.yaml"):
        checking(RULES[case], GOOD)


def test_check_of_an_unknown_experiment(checking: Checking) -> None:
    with pytest.raises(ConfigError, match="did you mean 'rig'"):
        checking(RULE, GOOD, "check.experiments=[rigg]")


def test_check_of_some_experiments(checking: Checking) -> None:
    assert checking(RULE, None, name="other") == 1
    codes = {(): 1, ("check.experiments=[rig]",): 0, ("check.experiments=[rig,other]",): 1}
    assert {chosen: checking(RULE, GOOD, *chosen) for chosen in codes} == codes


def test_what_changed_since_the_commit_is_shown_first(
    checking: Checking, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Committed are all metrics that hold; then those that moved by more than a tenth stand above the whole table."""
    assert checking(RULE, GOOD, "check.commit=true") == 0
    assert len((tmp_path / "thresholds" / "committed.csv").read_text().splitlines()) == 3
    assert checking(RULE, GOOD) == 0
    said = capsys.readouterr().out
    assert "changed by more than" not in said
    assert_says(said, *(f"coefficients.{node}.kxx.mean_error_percent" for node in (0, 2)), "all 2 metrics hold")
    assert checking(RULE, GOOD.replace("0.5", "0.56")) == 0
    first, whole = capsys.readouterr().out.split("metrics against thresholds")
    assert "changed by more than 10 %" in first
    assert [word in first for word in ("coefficients.0.kxx", "0.5", "0.56", "at most 1", "coefficients.2.kxx")] == [
        *[True] * 4,
        False,
    ]
    assert "coefficients.2.kxx" in whole


def test_metrics_that_fail_are_not_committed(checking: Checking, tmp_path: Path) -> None:
    """Nor those of some experiments; and a table that is none is refused."""
    for metrics, more in ((GOOD.replace("0.5", "5"), []), (GOOD, ["check.experiments=[rig]"])):
        with pytest.raises(ConfigError, match="must be committed of all experiments"):
            checking(RULE, metrics, "check.commit=true", *more)
    (tmp_path / "thresholds" / "committed.csv").write_text("experiment,value\nrig,1\n")
    with pytest.raises(ConfigError, match=r"committed\.csv' must be a table"):
        checking(RULE, GOOD)
