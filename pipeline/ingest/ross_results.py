"""Responses that ROSS saved: complex displacements of every DOF over the speed, of q(t) = Re(Q e^{jwt}) as here.

ROSS is not needed to read them: a TOML file of :meth:`ross.ForcedResponseResults.save` has them as texts.

Legend: S speeds, n DOF of ROSS (six a node).
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from pipeline.config.measured import MeasuredConfig, MeasuredProbeConfig, MeasuredRunConfig, TachoAngleConfig
from pipeline.config.section import rule
from pipeline.data.dataset import Excitation, project_direction
from pipeline.data.excitation_files import run_excitations
from pipeline.data.mat_files import open_measured
from pipeline.errors import DataError
from pipeline.ingest.tracks import RunTracks, sort_track

_KIND = "ForcedResponseResults"
_NEXT = 'save what run_unbalance_response or run_forced_response gave, as response.save("run.toml")'


class RossRecordingsConfig(MeasuredConfig):
    """Responses that ROSS saved: displacements of every node in m over the rotor speed."""

    format: Literal["ross"]
    tacho: TachoAngleConfig = TachoAngleConfig()
    probes: dict[str, MeasuredProbeConfig] = Field(min_length=1)
    runs: tuple[MeasuredRunConfig, ...] = Field(min_length=1)

    @rule
    def _lawful(self) -> Iterator[str]:
        yield from self.check_units("m")

    def describe(self) -> str:
        """What the numbers in the files are taken for."""
        return "complex, m, zero-to-peak, of ROSS"

    def read_run(self, run: MeasuredRunConfig, path: Path, dof: int = 6) -> RunTracks:
        """The 1X vectors of a run of ROSS, which has so many ``dof`` a node.

        Raises DataError: no such file, another result of ROSS, JSON (ROSS writes no complex numbers there), a node that
        the rotor of the file has not, other unbalances than the configuration's.
        """
        with open_measured(path, "response that ROSS saved", _NEXT):
            content = _load(path)
            speeds = np.asarray(content["speed_range"], dtype=float)
            response = _to_complex(path, content["forced_resp"])
            if response.ndim != 2 or response.shape[1] != len(speeds):
                raise DataError(
                    f"'{path}' must have a value a speed and DOF, but its shape is {response.shape} of {len(speeds)} "
                    "speeds"
                )
            _check_unbalances(path, content.get("unbalance"), run_excitations(run, self.angle_from_x))
        tracks = {}
        for name, probe in self.probes.items():
            if dof * probe.node + 1 >= len(response):
                raise DataError(
                    f"'{path}' must have the node {probe.node} of probe '{name}', but it has {len(response) // dof} "
                    "nodes: is it of another rotor?"
                )
            x, y = response[dof * probe.node], response[dof * probe.node + 1]
            direction = project_direction(float(np.round(np.degrees(probe.angle), 9)))
            tracks[name] = sort_track(speeds, x * direction[0] + y * direction[1], f"'{path}', probe '{name}',")
        return RunTracks(run.name, f"'{path}'", tracks, tracks)


def _load(path: Path) -> dict[str, Any]:
    if path.suffix.lower() == ".json":
        raise DataError(f"'{path}' must be TOML, but it is JSON, where ROSS leaves complex numbers out: {_NEXT}")
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    if not {"forced_resp", "speed_range"} <= content.get(_KIND, {}).keys():
        listed = ", ".join(content) or "nothing"
        raise DataError(f"'{path}' must have {_KIND} of ROSS, but it has {listed[:100]}: {_NEXT}")
    return dict(content[_KIND])


def _to_complex(path: Path, rows: Any) -> np.ndarray:
    """Complex values of texts such as ``np.complex128(1+2j)``. Raises DataError."""
    try:
        values = np.array([[complex(str(text).removeprefix("np.complex128")) for text in row] for row in rows])
    except (TypeError, ValueError) as error:
        raise DataError(f"'{path}' must have complex numbers in forced_resp, but it has others ({error})") from None
    if not np.isfinite(values).all():
        raise DataError(f"'{path}' must have finite numbers in forced_resp, but it has others: is the rotor held?")
    return values


def _check_unbalances(path: Path, stated: Any, acting: Sequence[Excitation]) -> None:
    """Raise DataError where the file says other unbalances than the configuration."""
    if stated is None:
        return
    theirs = sorted(tuple(float(entry) for entry in row) for row in zip(*stated, strict=True))
    ours = sorted(
        (float(weight.node), weight.magnitude, weight.phase) for weight in acting if weight.kind == "unbalance"
    )
    same = len(theirs) == len(ours) and all(
        a[0] == b[0] and abs(a[1] * np.exp(1j * a[2]) - b[1] * np.exp(1j * b[2])) <= 1e-6 * abs(a[1])
        for a, b in zip(theirs, ours, strict=True)
    )
    if not same:
        text = " and ".join(f"{size:g} kg m at node {node:g}, {phase:g} rad" for node, size, phase in theirs)
        raise DataError(
            f"'{path}' must have the unbalances of its run in machine.recordings.runs (phases from x, shaft_angle: "
            f"from_x), but it says {text}: write these"
        )
