"""Averaged responses to a measured force: against the closed form of one mass, and ROSS's own response in time."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from machine_files import given_by
from scipy.signal import butter, cont2discrete, lfilter, sosfilt

from pipeline.__main__ import main
from pipeline.errors import DataError
from pipeline.ingest.dataset import join_responses
from pipeline.ingest.exciter import ExciterRecordingsConfig, FrequencyResponse
from pipeline.rotor.ross_adapter import ross

RS = ross()
MASS, DAMPING, STIFFNESS, RATE = 2.0, 12.0, 2e5, 4000.0
# A force that is linear between samples; scipy.signal.lsim gives the same, and steps in Python.
FILTER = [np.ravel(part) for part in cont2discrete(([1.0], [MASS, DAMPING, STIFFNESS]), 1 / RATE, method="foh")[:2]]
PROBES = {name: {"node": 0, "angle": angle, "channel": name} for name, angle in (("a", "45 deg"), ("b", "135 deg"))}


def read(folder: Path, forces: list[np.ndarray], noise: float = 0.0, **changes: Any) -> tuple[Any, FrequencyResponse]:
    """A mass on a spring, pushed along x in each file, with noise as shares of motion and force; and its averages."""
    generator = np.random.default_rng(3)
    for i, force in enumerate(forces):
        motion = lfilter(*FILTER, force)
        drawn = generator.standard_normal((3, len(force)))
        channels = {"a": motion / np.sqrt(2), "b": -motion / np.sqrt(2)}  # x at 45 and at 135 degrees
        shown = {
            name: 1e6 * (m + noise * np.std(m) * d) for (name, m), d in zip(channels.items(), drawn[:2], strict=True)
        }
        felt = force + changes.get("noisy_force", 0.0) * np.std(force) * drawn[2]
        keep = changes.get("keep", slice(None))
        np.savez(
            folder / f"{i}.npz", force=0.0225 * felt[keep], **{name: values[keep] for name, values in shown.items()}
        )
    config = ExciterRecordingsConfig.model_validate(
        {
            "format": "exciter",
            "signal_unit": "um",
            "sample_rate": RATE,
            "reference": {"channel": "force", "size": "1 V / (22.5 mV/N)"},
            "averaging": {"segment": 2.0, "start_hz": 10, "stop_hz": 90, "step_hz": 2} | changes.get("averaging", {}),
            "probes": PROBES,
            "runs": [
                {
                    "name": "push",
                    "files": [str(folder / f"{i}.npz") for i in range(len(forces))],
                    "node": 0,
                    "angle": "0 deg",
                }
            ],
        }
    )
    (test,) = config.read_responses()
    return join_responses(config, [test]), test


def off(data: Any) -> np.ndarray:
    """Errors of x over their stated root mean square, of all lines."""
    w = data.own_frequencies[0]
    real = np.sinc(w / (2 * np.pi * RATE)) ** 2 / (STIFFNESS - w**2 * MASS + 1j * w * DAMPING)  # the force is linear
    return np.abs(data.displacement[0, 0] - real) / data.noise[0, 0]


def push(seconds: float) -> np.ndarray:
    """A random force in N below 300 Hz."""
    return sosfilt(butter(4, 300, fs=RATE, output="sos"), np.random.default_rng(0).standard_normal(int(seconds * RATE)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["random", "impacts", "stepped sine", "sweeps"])
def test_bands_hold_the_response_of_one_mass(kind: str, folder: Path) -> None:
    """Circular complex errors are within sqrt(3) of their root mean square 95 times of 100."""
    time, boxcar = np.arange(int(4 * RATE)) / RATE, {"averaging": {"window": "boxcar", "segment": 4.0}}
    blows = [np.exp(-(((time - 0.05) / 0.002) ** 2)) * size for size in (20, 30, 25, 28, 22, 26)]
    steps = [np.sin(2 * np.pi * hz * np.arange(int(16 * RATE)) / RATE) for hz in range(30, 72, 2)]
    settled = {"keep": slice(int(4 * RATE), None), "averaging": boxcar["averaging"] | {"start_hz": 30, "stop_hz": 70}}
    kinds: dict[str, Any] = {
        "random": ([push(240)], {}, 225),
        "impacts": (blows, boxcar, 6),
        "stepped sine": (steps, settled, 63),
        "sweeps": (
            [np.pad(np.sin(np.pi * 25 * time**2), (0, 8000))] * 4,
            {"averaging": {"window": "boxcar", "segment": 6.0}},
            4,
        ),
    }
    forces, changes, averages = kinds[kind]
    data, test = read(folder, forces, 0.05, **changes)
    ratio = off(data)
    assert np.mean(ratio <= np.sqrt(3)) >= 0.9
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.3
    assert test.averages == pytest.approx(averages, rel=0.06)


@pytest.mark.slow
def test_a_noisy_force_makes_h1_too_small(folder: Path) -> None:
    """By the share r of its power, and Hv, which takes the motion for as noisy, by r / 2."""
    every = [read(folder, [push(120)], noisy_force=0.5, averaging={"estimator": e})[0] for e in ("H1", "Hv")]
    w = every[0].own_frequencies[0]
    stiff = STIFFNESS - w**2 * MASS + 1j * w * DAMPING
    first, second = (np.median(np.abs(data.displacement[0, 0] * stiff)[:12]) for data in every)
    assert first < 0.97
    assert 1 - second == pytest.approx((1 - first) / 2, rel=0.1)


def test_a_single_sweep_under_hanns_window_is_told(folder: Path) -> None:
    """And no random force that lasts."""
    time = np.arange(int(40 * RATE)) / RATE
    (note,) = read(folder, [np.sin(np.pi * 2.5 * time**2)])[1].notes
    assert "as of a single sweep" in note
    assert read(folder, [push(40)])[1].notes == ()


def test_an_impact_that_does_not_ring_down_in_a_segment_is_told(folder: Path) -> None:
    """One mass decays by exp(-c t / 2 m), which is 22 % half a second after the blow and 0.3 % after two."""
    boxcar, time = {"window": "boxcar"}, np.arange(int(2 * RATE)) / RATE
    blow = 20 * np.exp(-(((time - 0.05) / 0.002) ** 2))
    assert read(folder, [blow] * 3, averaging=boxcar)[1].notes == ()
    assert read(folder, [push(20)], averaging=boxcar)[1].notes == ()  # it lasts
    notes = read(folder, [blow[: int(0.57 * RATE)]] * 3, averaging=boxcar | {"segment": 0.57})[1].notes
    shares = [float(note.split(": ")[1].split(" %")[0]) for note in notes if "left at the end of a segment" in note]
    assert shares == pytest.approx([100 * np.exp(-DAMPING / (2 * MASS) * 0.5)] * 3 * len(PROBES), rel=0.1)


@pytest.mark.parametrize(
    ("seconds", "changes", "said"),
    [
        (2, {}, "must have at least 3 segments of 2 s, but it has 1"),
        (1, {}, "must be as long as a segment (2 s)"),
        (20, {"stop_hz": 3000}, "more than twice averaging.stop_hz"),
        (20, {"step_hz": 0.5}, "averaging.step_hz must be 1 or more"),
        (0, {}, "must have a force at every line"),
    ],
)
def test_what_can_not_be_averaged_is_told(seconds: int, changes: dict[str, float], said: str, folder: Path) -> None:
    with pytest.raises(ValueError if "step_hz" in changes else DataError, match=re.escape(said)):
        read(folder, [push(seconds) if seconds else np.zeros(80000)], averaging=changes)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("rpm", [0, 3000])
def test_identify_takes_a_rotor_at_rest(rpm: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Random forces on ROSS's rotor, by ROSS's own response in time: bearings within their bands, and its modes."""
    steel = RS.Material("steel", rho=7810, E=211e9, G_s=81.2e9)
    shaft = [RS.ShaftElement(0.3, 0.0, 0.05, material=steel) for _ in range(4)]
    real = {1: (2e7, 3e7, 8e3, 9e3), 4: (2.5e7, 3.5e7, 7e3, 6e3)}
    bearings = [
        RS.BearingElement(n, **dict(zip(("kxx", "kyy", "cxx", "cyy"), c, strict=True))) for n, c in real.items()
    ]
    rotor = RS.Rotor(shaft, [RS.DiskElement.from_geometry(2, steel, 0.05, 0.05, 0.26)], bearings)
    rotor.save(str(folder / "rotor.toml"))
    speed, time, generator = rpm * np.pi / 30, np.arange(int(30 * RATE)) / RATE, np.random.default_rng(5)
    for name, axis in (("x", 0), ("y", 1)):
        force = np.zeros((len(time), rotor.ndof))
        force[:, 6 * 2 + axis] = 100 * sosfilt(
            butter(4, 300, fs=RATE, output="sos"), generator.standard_normal(len(time))
        )
        motion = rotor.time_response(speed, force, time)[1]
        shown = {f"{n}{d}": motion[:, 6 * n + i] for n in real for i, d in enumerate("xy")}
        noisy = {key: m + 1e-7 * generator.standard_normal(len(time)) for key, m in shown.items()}
        np.savez(folder / f"{name}.npz", force=force[:, 6 * 2 + axis], **noisy)
    recordings = {
        "format": "exciter",
        "signal_unit": "m",
        "sample_rate": RATE,
        "reference": {"channel": "force", "size": "1 N"},
        "averaging": {"segment": 1.0, "start_hz": 20, "stop_hz": 220, "step_hz": 5},
        "known": {key: 0 for key in ("kxy", "kyx", "cxy", "cyx")},
        "probes": {
            f"{n}{d}": {"node": n, "angle": f"{90 * i} deg", "channel": f"{n}{d}"}
            for n in real
            for i, d in enumerate("xy")
        },
        "runs": [
            {"name": name, "file": f"{name}.npz", "node": 2, "angle": f"{90 * i} deg", "speed_rpm": rpm}
            for i, name in enumerate("xy")
        ],
    }
    (folder / "rig.yaml").write_text(yaml.safe_dump({"rotor": {"file": "rotor.toml"}, "recordings": recordings}))
    command = ["stage=identify", given_by(folder / "rig.yaml"), "tracking=none", "identify.unknowns=[kxx,kyy,cxx,cyy]"]
    assert main([*command, f"output='{folder / 'out'}'"]) == 0, capsys.readouterr().err
    names, answer = ["kxx", "kyy", "cxx", "cyy"], pd.read_csv(folder / "out" / "identified_coefficients.csv")
    off = answer[names].to_numpy() - list(real.values())
    assert (np.abs(off) < 0.05 * np.array(list(real.values()))).all()
    assert (np.abs(off) < 3.5 * answer[[f"{name}_std" for name in names]].to_numpy()).all()
    mismatch = json.loads((folder / "out" / "training.json").read_text())["fit"]["mismatch"]
    assert mismatch["chi_square"] is None  # no line repeats another, so the size of what is left over tells nothing
    modes = json.loads((folder / "out" / "prediction.json").read_text())["identified"]["modes"]
    modal = rotor.run_modal(speed, num_modes=24)
    order = np.argsort(modal.wd)[: len(modes)]
    off = np.array([mode["hz"] for mode in modes.values()]) - modal.wd[order] / (2 * np.pi)
    assert (np.abs(off) < 3.5 * np.array([mode["hz_std"] for mode in modes.values()])).all()
    shown = modes["4"]["measured_logarithmic_decrement"] - modal.log_dec[order[3]]
    assert abs(shown) < 3.5 * modes["4"]["measured_logarithmic_decrement_std"]
    assert "under " + ("a force at 120 Hz" if rpm == 0 else "an unbalance") + " never seen" in capsys.readouterr().out
