"""The command line: ``python -m pipeline stage=STAGE experiment=NAME [overrides]``.

Every command is checked before anything runs. Exit codes: 0 done, 1 a limit exceeded (``stage=check``) or a result
that could not be made (``stage=identify``), 2 a mistake in what was given, 70 a bug here, 130 interrupted, 141 a closed
pipe.
"""

from __future__ import annotations

import gc
import hashlib
import os
import re
import sys
import textwrap
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

from pipeline import __version__
from pipeline.config.loader import parse_key
from pipeline.errors import INTERRUPTED, MISTAKE, ConfigError, JobFailed, exit_code, say_and_return

if TYPE_CHECKING:
    from argparse import Namespace

    from omegaconf import DictConfig


# A job's folder says what was swept; these keys already change the folder (output: artifacts/${name}),
# and the stages of one experiment share it.
_NOT_IN_FOLDER = {"experiment", "name", "output", "stage"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    return exit_code(lambda: _run_command(arguments))


def _run_command(arguments: list[str]) -> None:
    if {"-h", "--help"} & set(arguments):
        print(format_usage())
    elif "--version" in arguments:
        print(f"pipeline {__version__}")
    else:
        options = _parse_options(arguments)
        # A folder of machines is read here and not by Hydra.
        given, options.config_dir = options.config_dir, None
        folder = None if given is None else Path(os.path.abspath(Path(given).expanduser()))
        # Overrides of the pipeline's own keys: a command of these alone needs nothing of Hydra's launchers.
        if not _list_commands(options) and all(
            "=" in override and not override.startswith("-") and not parse_key(override).startswith("hydra")
            for override in options.overrides
        ):
            _run_stages(options.overrides, folder)
        else:
            _run_hydra(options, folder)


def _run_stages(overrides: list[str], folder: Path | None) -> None:
    """All stages are checked before the first one runs; the first that fails is the last that runs."""
    from pipeline.config.compose import compose_stages
    from pipeline.stages import run_stages
    from pipeline.tracking import recorder_beside

    configs = compose_stages(overrides, folder)
    with recorder_beside(configs[0].tracking.enabled):
        run_stages(configs)


# --- Hydra ---------------------------------------------------------------------------------------


def _parse_options(arguments: list[str]) -> Namespace:
    """Hydra's options that this pipeline takes, also after overrides. Raises ConfigError for options that are unknown,
    refused or don't go together."""
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    parser.error = _refuse  # type: ignore[method-assign]  # Hydra makes the parser: no class of ours can be its
    options = parser.parse_intermixed_args(arguments)
    for name in ("config_path", "config_name", "experimental_rerun"):
        if getattr(options, name) is not None:
            _refuse(f"--{name.replace('_', '-')} is not for this pipeline, configured in conf/config.yaml")
    if len(_list_commands(options)) > 1:
        _refuse("there is more than one of --multirun, --cfg, --info, --shell-completion and --hydra-help")
    if options.resolve and not options.cfg:
        _refuse("--resolve goes with --cfg job")
    return options


def _list_commands(options: Namespace) -> list[Any]:
    every = (options.multirun, options.cfg, options.info, options.shell_completion, options.hydra_help)
    return [command for command in every if command]


def _refuse(message: str) -> NoReturn:
    raise ConfigError(f"the options must be Hydra's, but {message}; `python -m pipeline --help` lists the usual ones")


def _run_hydra(options: Namespace, folder: Path | None) -> None:
    """Check the overrides, then hand the command to Hydra."""
    from pipeline.config.compose import prepare_for_hydra

    if options.shell_completion or options.hydra_help:
        _call_hydra(Job(), options)
        return
    with prepare_for_hydra(options.overrides, folder) as options.overrides:
        job, started = _check(options), time.time()
        try:
            _call_hydra(job, options)
        finally:  # also of the jobs that ended well beside one that failed
            if len(job.folders) > 1:
                from pipeline.reporting.training import compare_jobs

                compare_jobs(job.folders, started)


def _call_hydra(job: Job, options: Namespace) -> None:
    """What ``hydra.main`` does, on ``conf/``."""
    from hydra import version
    from hydra._internal.utils import _run_hydra, get_args_parser
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from pipeline.config.loader import CONF, ROOT_CONFIG, VERSION_BASE

    version.setbase(VERSION_BASE)
    os.environ["HYDRA_FULL_ERROR"] = "1"  # its errors are raised to us instead of printed
    sys.argv[0] = "pipeline"  # the command that a shell completes
    try:
        _run_hydra(options, get_args_parser(), job, str(CONF), ROOT_CONFIG)
    except SystemExit as stop:
        # Hydra's 1, such as for --cfg job with an unknown --package, is not that of stage=check.
        raise SystemExit(MISTAKE if options.cfg and stop.code == 1 else stop.code) from None
    except (HydraException, OmegaConfBaseException) as error:
        # Only what the check can't see: Hydra's own settings, such as hydra.sweep.dir.
        raise ConfigError(f"Hydra must be able to start this, but says: {error}") from None


def _check(options: Namespace) -> Job:
    """The job that Hydra may start: all its configurations compose and fit the schema."""
    from pipeline.config.compose import compose_mapping, compose_stages, expand_sweeps

    if options.cfg or options.info:
        compose_mapping(options.overrides)
        return Job()
    if not options.multirun and "hydra.mode=MULTIRUN" not in options.overrides:
        compose_stages(options.overrides)
        return Job()
    jobs, fixed = expand_sweeps(options.overrides)
    job = Job(multirun=True, fixed=fixed, count=len(jobs))
    return replace(job, folders=_locate_jobs(job, jobs))


def _locate_jobs(job: Job, jobs: list[list[str]]) -> dict[str, str]:
    """What is a job's own -> its folder. Raises ConfigError where two would write the same files."""
    from pipeline.config.compose import compose_stages

    stages_by_folder: dict[str, set[str]] = {}
    folders: dict[str, str] = {}
    for overrides in jobs:
        configs = compose_stages(overrides)
        folder, stages = job.folder(configs[0].output, overrides), {config.stage for config in configs}
        if stages & stages_by_folder.setdefault(folder, set()):
            raise ConfigError(
                f"the jobs of a multirun must write to folders of their own, but two have '{folder}'; "
                "give each value once, and leave output out or give 'output=FOLDER/${name}'"
            )
        stages_by_folder[folder] |= stages
        folders[" ".join(o for o in overrides if job.is_own(o) and parse_key(o) != "stage")] = folder
    parallel = any(o.startswith("hydra/launcher=") and o != "hydra/launcher=basic" for o in jobs[0])
    if parallel and any(len(stages) > 1 for stages in stages_by_folder.values()):
        raise ConfigError(
            "the stages of one experiment must run one after the other, but a parallel launcher got several; "
            "give the stages in separate commands, or leave hydra/launcher out"
        )
    return folders


@dataclass(frozen=True)
class Job:
    """What Hydra calls with each composed configuration, perhaps in another process.

    ``fixed`` holds the keys that all jobs of a multirun share; the others name a job's folder. ``folders`` has those
    of all jobs.
    """

    multirun: bool = False
    fixed: frozenset[str] = frozenset()
    count: int = 1
    folders: Mapping[str, str] = field(default_factory=dict)

    def __call__(self, composed: DictConfig) -> None:
        code = exit_code(lambda: self._run(composed))
        if not code:
            return
        if not self.multirun or code == INTERRUPTED:
            raise SystemExit(code)
        say_and_return(f"{self._describe()} failed", code)
        folder = _get_job().launcher.get("submitit_folder")
        raise JobFailed(code, folder and str(Path(folder).parent))  # Hydra goes on with the other jobs

    def _run(self, composed: DictConfig) -> None:
        from omegaconf import OmegaConf

        from pipeline.config.compose import list_stages, validate_stages
        from pipeline.stages import run_stages
        from pipeline.stages.configure import write_configuration

        overrides = list(_get_job().overrides.task)
        if self.multirun:
            composed.output = self.folder(composed.output, overrides)
            # Studies of different values are different studies.
            if "tune" in list_stages(cast("dict[str, Any]", OmegaConf.to_container(composed))):
                composed.tuning.folder = self.folder(composed.tuning.folder, overrides)
                composed.tuning.study = self.folder(composed.tuning.study, overrides)
            print(f"{self._describe()} -> {composed.output}", flush=True)
        mapping: Any = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        configs = validate_stages(mapping, overrides)
        if self.multirun:  # its folder says what the job was, with MLflow or without
            write_configuration(configs[0])
        run_stages(configs)

    def _describe(self) -> str:
        return f"[{_get_job().job.num + 1}/{self.count}] {' '.join(_get_job().overrides.task)}"

    def is_own(self, override: str) -> bool:
        """Whether other jobs of the multirun have other values of this key."""
        return parse_key(override) not in self.fixed and not parse_key(override).startswith("hydra")

    def folder(self, output: str, overrides: Sequence[str], longest: int = 120) -> str:
        """The folder of the job with these overrides: no other job of the multirun has it."""
        swept = [o for o in overrides if self.is_own(o) and parse_key(o) not in _NOT_IN_FOLDER]
        if not swept:
            return output
        raw = "__".join(override.lstrip("+~").replace("=", "-", 1) for override in swept)
        name = re.sub(r"[^\w.-]+", "_", raw)[:longest]
        if name != raw:  # what the cleaning made equal stays apart
            name += "-" + hashlib.sha256(raw.encode()).hexdigest()[:8]
        return str(Path(output) / name)


def _get_job() -> Any:
    """Hydra's record of the job that runs."""
    from hydra.core.hydra_config import HydraConfig

    return HydraConfig.get()


# --- help ----------------------------------------------------------------------------------------


def format_usage() -> str:
    """The whole help."""
    from pipeline.config.loader import STAGES, list_options

    experiments = {name: _description(name) for name in list_options("experiment")}
    machines = textwrap.fill(", ".join(list_options("machine")), 100, initial_indent="  ", subsequent_indent="  ")
    return f"""\
usage: python -m pipeline stage=STAGE experiment=NAME|machine.file=FILE [KEY=VALUE ...] [-m]

{textwrap.fill(_SUMMARY, 100)}

stages (default: train; a stage whose input is missing makes it first):
{_table(STAGES)}

experiments:
{_table(experiments)}

machines (of an experiment, or alone: machine=NAME; one of your own: machine.file=FILE):
{machines}

examples:
{_EXAMPLES}

options:
  -m, --multirun   one job for every combination of values such as seed=1,2,3
  --cfg job        print the whole configuration and run nothing
  --info           print how Hydra composed it
  -h, --help       this help
  --config-dir DIR machines and experiments of your own, in DIR/machine and DIR/experiment
  --version        the version

Results of an experiment go to artifacts/NAME/ (output=FOLDER for another place); the jobs of a
multirun to a folder of their own each, named by what was swept, such as
artifacts/NAME/optimizer.adam.steps-500/.
Exit codes: 0 done, 1 a threshold passed (stage=check) or a result skipped (stage=identify), 2 a
mistake in what was given, 70 a bug, 130 interrupted."""


_SUMMARY = (
    "Identifies the bearing coefficients of rotating machines from their measured vibration and a model of "
    "shaft and discs. The bearings' stiffness and damping are trained so that the equation of motion holds "
    "at the bearings (FEM-NN)."
)
_EXAMPLES = """\
  python -m pipeline                                         train the default experiment
  python -m pipeline stage=new machine.file=mine.yaml        write a file for a machine of your own
  python -m pipeline stage=train machine.file=mine.yaml      and use it
  python -m pipeline stage=evaluate experiment=NAME          compare with the modelled coefficients
  python -m pipeline stage=[train,evaluate,predict]          several stages, one after the other
  python -m pipeline optimizer.adam.steps=500 seed=3         change values
  python -m pipeline 'machine.rotor.shaft.0.length=150 mm'           quantities carry their unit
  python -m pipeline -m seed=1,2,3                           one job for each value
  python -m pipeline --cfg job experiment=NAME               see the whole configuration"""


def _table(rows: dict[str, str]) -> str:
    width = max(map(len, rows), default=0) + 2
    indent = " " * (width + 2)
    return "\n".join(
        textwrap.fill(row or "-", 100, initial_indent=f"  {name:<{width}}", subsequent_indent=indent)
        for name, row in rows.items()
    )


def _description(experiment: str) -> str:
    """The experiment's ``description``, read without the cost of a YAML parser."""
    from pipeline.config.loader import CONF

    text = (CONF / "experiment" / f"{experiment}.yaml").read_text(encoding="utf-8")
    match = re.search(r"^description: *[>|]?-?\s*(.+)$", text, re.MULTILINE)
    return match[1].strip().strip("'\"") if match else ""


# --- the end of the process -------------------------------------------------------------------------


def _leave(code: int) -> NoReturn:
    """End with ``code``; at once where nothing else is at work: taking torch down in order takes half a second."""
    import atexit
    import threading

    if threading.active_count() > 1:
        sys.exit(code)
    atexit._run_exitfuncs()
    with suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    # The workers of a parallel multirun import Job by name, and `__main__` is another module there.
    from pipeline.__main__ import main as importable_main

    # The packages make a million objects that stay: looking through them again and again is a fifth of a start.
    gc.set_threshold(100_000, 50, 100)
    _leave(importable_main())
