"""What a configuration asks about: the coefficients that it takes as known, the machine modelled, the measurement.

Legend: S speeds, R runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.measured import AS_MODELLED, KnownConfig
from pipeline.config.motion import find_floor
from pipeline.config.runs import find_frequencies
from pipeline.config.schema import Config
from pipeline.data.coefficient_files import read_coefficients
from pipeline.data.conditions import gather_conditions
from pipeline.data.dataset import Excitation, VibrationDataset, require_synchronous
from pipeline.data.excitation_files import run_excitations
from pipeline.data.operating import Operating, group_rows, spread_states
from pipeline.data.sensors import (
    NO_FLOOR,
    Channels,
    Floors,
    NoiseModel,
    Sensors,
    list_directions,
    measure,
    name_channel,
)
from pipeline.data.simulate import simulate
from pipeline.errors import ConfigError
from pipeline.ingest.dataset import resolve
from pipeline.laws.law_set import NO_LAWS, make_laws
from pipeline.parameters.as_built import build_rotor, misplace_probes, simulate_as_built
from pipeline.parameters.model import ALWAYS_FITTED, model_parameters, usual_tolerances
from pipeline.problem.condition_noise import NO_LEVELS, condition_noise, suffices, to_dataset
from pipeline.problem.measurement import Guess, Measurement
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.stored import load_modelled_bearings, load_rotor, place_probe, require_nodes


def load_known(
    config: Config,
    given: str | KnownConfig | None,
    key: str,
    nodes: Sequence[int],
    speeds: np.ndarray,
    operating: Operating | None = None,
) -> BearingTable | None:
    """The known coefficients of the bearings at ``nodes``, ``speeds`` (S,) rad/s and ``operating`` conditions (S,)
    each; the others are zero.

    ``given`` is what the configuration has at ``key``. None where some are needed and nothing gives them. Raises
    ConfigError for values that lack one, DataError as :func:`pipeline.data.coefficient_files.read_coefficients`.
    """
    needed = list_known(config, nodes)
    operating = operating or {}
    blank = BearingTable(tuple(nodes), speeds, np.zeros((len(nodes), len(speeds), len(COEFFICIENTS))), operating)
    if not any(needed.values()):
        return blank
    if given is None:
        return None
    if given == AS_MODELLED:
        bearings = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, operating)
        stays = np.array([[name in needed[node] for name in COEFFICIENTS] for node in bearings.nodes])
        return replace(bearings, values=np.where(stays[:, None], bearings.values, 0.0))
    if isinstance(given, KnownConfig):
        for b, c in ((b, COEFFICIENTS.index(name)) for b, names in enumerate(needed.values()) for name in names):
            if (value := getattr(given, COEFFICIENTS[c])) is None:
                raise ConfigError(
                    f"{key} must have a value of every coefficient that is not identified, but {COEFFICIENTS[c]} is "
                    "missing"
                )
            blank.values[b, :, c] = value
        return blank
    return read_coefficients(Path(given), nodes, speeds, needed, operating, between=True)


def require_known(known: BearingTable | None, config: Config, nodes: Sequence[int]) -> BearingTable:
    """``known``. Raises ConfigError where there is none: it says what is missing, and how to give it."""
    if known is not None:
        return known
    every = [name for name in COEFFICIENTS if any(name in names for names in list_known(config, nodes).values())]
    values = ", ".join(f"{name}: 0 {'N/m' if name.startswith('k') else 'N s/m'}" for name in every)
    raise ConfigError(
        f"coefficients that are not identified must be known, but nothing gives {', '.join(every)}: give values or a "
        f"file as machine.recordings.known (of vibration of your own: data.known), such as {{{values}}}, or "
        f"'{AS_MODELLED}' for those of the machine's bearings; or identify them too (identify.unknowns)"
    )


def list_known(config: Config, nodes: Sequence[int]) -> dict[int, tuple[str, ...]]:
    """The coefficients of each bearing that are not identified. Raises ConfigError for an exception without bearing."""
    for node in config.identify.bearings:
        if node not in nodes:
            raise ConfigError(
                f"identify.bearings must name bearing nodes of the rotor ({', '.join(map(str, nodes))}), but got {node}"
            )
    unknown = {node: config.identify.at(node) for node in nodes}
    return {node: tuple(name for name in COEFFICIENTS if name not in unknown[node]) for node in nodes}


def model_machine(config: Config, seed: int | None = None) -> tuple[RotorModel, BearingTable, VibrationDataset]:
    """The configured machine, and its vibration without noise at every node; as it was built, if it says so.

    ``seed`` draws what weights are off by; None for that of the probes.
    """
    speeds, operating = spread_states(config.machine.speeds.rad_s(), config.machine.operating)
    rotor, built = load_rotor(config.machine.rotor), config.machine.as_built
    list_known(config, rotor.bearing_nodes)  # refuses exceptions without a bearing
    bearings = load_modelled_bearings(config.machine.rotor, config.machine.bearings, speeds, operating)
    runs, frequencies = configure_excitations(config), configure_frequencies(config, speeds)
    residual = tuple(
        Excitation(run.name, "unbalance", weight.node, weight.magnitude, weight.phase)
        for run in config.machine.runs
        if not run.frequency_hz and not run.frequency_ratio  # it turns with the rotor
        for weight in config.machine.residual_unbalance
    )
    acting = (*runs, *residual)
    require_nodes(rotor, "machine.runs", [excitation.node for excitation in acting])
    if built is None:
        complete = simulate(rotor, bearings, acting, frequencies)
        require_synchronous(rotor, complete)
    else:
        require_nodes(rotor, "machine.as_built.coupling_node", [built.coupling_node])
        generator = np.random.default_rng([config.machine.probes.seed if seed is None else seed, 1])
        fine = build_rotor(config.machine.rotor, built)
        complete = simulate_as_built(fine, built, bearings, acting, frequencies, generator)
    # The residual unbalance is in the vibration and nobody knows of it.
    return rotor, bearings, replace(complete, excitations=runs)


def read_probes(
    config: Config, rotor: RotorModel, complete: VibrationDataset, seed: int | None = None
) -> VibrationDataset:
    """What the probes make of a vibration with x and y at every node; ``seed`` as :func:`model_machine`."""
    probes, built = configure_sensors(config, rotor), config.machine.as_built
    seed = config.machine.probes.seed if seed is None else seed
    if built is not None and probes.channels is not None:
        complete = misplace_probes(complete, built, probes.channels, np.random.default_rng([seed, 2]))
        probes = replace(probes, channels=None)
    return measure(complete, probes, np.random.default_rng(seed))


def find_idle(bearings: BearingTable) -> list[str]:
    """The operating conditions that take several values and change no coefficient."""
    idle = []
    for name, values in bearings.operating.items():
        others = [bearings.speeds, *(levels for other, levels in bearings.operating.items() if other != name)]
        changes = any(np.ptp(bearings.values[:, rows], axis=1).any() for rows in group_rows(np.stack(others, axis=1)))
        if np.ptp(values) > 0 and not changes:
            idle.append(name)
    return idle


def configure_excitations(config: Config) -> tuple[Excitation, ...]:
    """The configured runs."""
    return tuple(excitation for run in config.machine.runs for excitation in run_excitations(run))


def configure_sensors(config: Config, rotor: RotorModel) -> Sensors:
    """The configured sensors."""
    spec = config.machine.probes
    channels: Channels | None = None
    if spec.at == "bearings":
        channels = list_directions(rotor.bearing_nodes)
    elif spec.at != "all":
        channels = tuple(name_channel(place_probe(rotor, "machine.probes.at", probe), probe.angle) for probe in spec.at)
    return Sensors(
        channels,
        NoiseModel(spec.additive, spec.multiplicative, floors=_state_floors(config, rotor, channels or ())),
        spec.runout,
        spec.quantisation,
        spec.slow_roll_readings,
    )


def _state_floors(config: Config, rotor: RotorModel, channels: Channels) -> Floors:
    """The floor of each channel: that of its probe, or of x and y what the probes give them that tell them together."""
    if not config.machine.floors:
        return ()
    placed = [
        probe.model_copy(update={"node": place_probe(rotor, "a probe with a floor", probe)})
        for probe in config.machine.listed_probes
    ]
    squares = np.array([find_floor(probe.floor) for probe in placed]) ** 2
    told, shares, _ = resolve(placed, np.eye(len(placed))[..., None])  # (P, Q, 1)
    named = [*told, *(name_channel(probe.node, probe.angle) for probe in placed)]
    sizes = np.sqrt(np.concatenate([shares[..., 0].T ** 2 @ squares, squares]))
    floors = dict(zip(named, map(tuple, sizes.tolist()), strict=True))
    return tuple(floors.get((node, round(angle, 9)), NO_FLOOR) for node, angle in channels)


def configure_frequencies(config: Config, speeds: np.ndarray) -> np.ndarray | None:
    """(S, R) rad/s of the configured runs at ``speeds`` (S,) rad/s; None where all are synchronous."""
    runs = config.machine.runs
    if not any(run.frequency_hz or run.frequency_ratio for run in runs):
        return None
    return np.stack([find_frequencies(run, speeds) for run in runs], axis=1)


def build_measurement(config: Config, rotor: RotorModel, dataset: VibrationDataset, known: BearingTable) -> Measurement:
    """From a data set that is at hand, and the ``known`` coefficients at its speeds."""
    require_synchronous(rotor, dataset)
    noise, model, identify = config.stated_noise, config.model, config.identify
    if noise.record and np.any(dataset.subtracted):
        raise ConfigError(
            "stated_noise.record must be 0 where a baseline is subtracted, since a reading and its baseline are of two "
            f"records, but got {noise.record:g}: leave out data.baseline (identify.unbalance_planes), or record"
        )
    laws, floors = config.machine.laws, _state_floors(config, rotor, dataset.channels)
    stated, drift = NoiseModel(noise.additive, noise.multiplicative, noise.drift, noise.record, floors), NO_LEVELS
    if dataset.conditions is not None:
        conditions = gather_conditions(dataset)
        if suffices(conditions):
            drift = condition_noise(conditions, stated)
        else:
            stated = stated.with_drift()
        dataset = to_dataset(conditions)
    unknowns, stated_numbers = identify.unknowns_of(rotor.bearing_nodes), identify.model_parameters.deviations
    usual = identify.usual_tolerances
    if model.families and usual:
        always = usual_tolerances((), rotor, dataset, known, unknowns, ALWAYS_FITTED)
        usual, stated_numbers = False, {p.kind: p.deviation for p in always} | dict(stated_numbers)
    return Measurement(
        rotor,
        dataset,
        known,
        stated,
        unknowns,
        Guess(
            identify.known_stiffness or model.initial_stiffness,
            identify.known_damping or model.initial_damping,
            identify.known_within,
            identify.known_unbalance or np.inf,
        ),
        drift=drift,
        laws=NO_LAWS if laws is None else make_laws(laws, rotor.bearing_nodes),
        parameters=model_parameters(
            stated_numbers, rotor, dataset, known, unknowns, identify.coupling_node, identify.seal_nodes
        ),
        tolerances=usual_tolerances(stated_numbers, rotor, dataset, known, unknowns) if usual else (),
    )
