"""A network trained beforehand on modelled critical speeds (Pavlenko, Simonovskiy, Ivanov, Zajac and Pitel 2018).

For many stiffnesses within the bounds that are known beforehand, the model gives the critical speeds; a network learns
the way back, from critical speeds to stiffness. The measured critical speeds then give the stiffness at once.

A critical speed is read off a response, measured or modelled, as the speed at which its phase passes 90 degrees: there
the real part of the apparent dynamic stiffness ``force / displacement`` is zero. That part is smooth through a
resonance, however sharp, so the speed is found between those of the data.

All bearings are assumed to be the same: each direction has one critical speed for one stiffness.

Legend: S speeds, P channels, R runs, D directions of the unknowns, N modelled machines.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from pipeline.coefficients import column, is_direct, is_stiffness
from pipeline.config.comparison import PriorConfig
from pipeline.data.dataset import DIRECTIONS, assemble_forces
from pipeline.methods.method import Estimate, MethodOptions, Refusal, make_estimate
from pipeline.parameters.kind import turns_with_rotor
from pipeline.problem.measurement import Measurement
from pipeline.rotor.model import translation_dof
from pipeline.units import RAD_S_PER_RPM


def identify_by_critical_speeds(
    data: Measurement, options: MethodOptions, modelled: int = 400, spreads: int = 64
) -> Estimate:
    """Constant stiffnesses of bearings that are all the same; raises Refusal for all else.

    The network learns from so many ``modelled`` machines; the deviation is the spread of ``spreads`` data sets with
    more of the stated noise.
    """
    names = data.unknowns.names
    if not all(is_direct(name) and is_stiffness(name) for name in names):
        raise Refusal("stiffness_alone", f"{', '.join(names)} are asked for")
    if not options.constant:
        raise Refusal("not_constant", "functions of the speed are asked for")
    places = [_choose_place(data, name) for name in names]
    measured = _find_crossings(data, data.dataset.displacement, places)
    if np.isnan(measured).any():
        raise Refusal("no_critical_speed", f"there is none for {names[int(np.isnan(measured).argmax())]}")
    generator = np.random.default_rng(options.seed)
    machines = _model_machines(data, options.settings.prior, places, generator, modelled)
    estimate, error = _train(*machines, options.seed)
    values = estimate(measured[None])[0]
    noise = data.deviation * generator.standard_normal((2, spreads, *data.deviation.shape)) / np.sqrt(2)
    readings = data.dataset.displacement + noise[0] + 1j * noise[1]
    again = np.array([_find_crossings(data, reading, places) for reading in readings])
    spread = np.log(estimate(again[~np.isnan(again).any(axis=1)])).std(axis=0)
    deviation = values * np.hypot(spread, error)
    shape = (data.unknowns.n_members, len(data.dataset.speeds), len(names))
    listed = ", ".join(f"{speed / RAD_S_PER_RPM:.1f}" for speed in measured)
    text = f"{modelled} modelled machines; critical speeds {listed} rpm"
    return make_estimate(data, np.broadcast_to(values, shape), np.broadcast_to(deviation, shape), text)


def _choose_place(data: Measurement, name: str) -> tuple[int, int, np.ndarray]:
    """Channel and run that show the resonance of an unknown best, and the force (S,) there: at an exciting node."""
    dataset, angle = data.dataset, list(DIRECTIONS.values())[column(name)]
    run = int(turns_with_rotor(dataset).argmax())  # the first if none turns
    forces = assemble_forces(data.rotor, dataset.excitations, dataset.runs, dataset.frequencies)
    excited = [excitation.node for excitation in dataset.excitations if excitation.run == dataset.runs[run]]
    channels = [p for p, channel in enumerate(dataset.channels) if channel[1] == angle]
    if not channels or not excited:
        raise Refusal("no_critical_speed", f"no sensor looks along {name[1]}")
    nearest = min(channels, key=lambda p: abs(dataset.channels[p][0] - excited[0]))
    return nearest, run, forces[:, translation_dof(excited[0], column(name)), run]


def _find_crossings(
    data: Measurement, readings: np.ndarray, places: list[tuple[int, int, np.ndarray]], most: int = 5
) -> np.ndarray:
    """(D,) critical speeds, rad/s, of readings (S, P, R): where the real part of the apparent stiffness, over the speed
    squared, first falls through zero; NaN where it does not.

    A straight line is fitted through at most so many speeds on either side.
    """
    speeds, crossings = data.dataset.speeds, np.full(len(places), np.nan)
    for d, (p, r, force) in enumerate(places):
        flexibility = (force / readings[:, p, r]).real / speeds**2
        falls = np.flatnonzero((flexibility[:-1] > 0) & (flexibility[1:] <= 0))
        if len(falls):
            s, reach = int(falls[0]), min(most, max(1, len(speeds) // 60))
            near = slice(max(s + 1 - reach, 0), s + 1 + reach)
            slope, offset = np.polyfit(speeds[near] - speeds[s], flexibility[near], 1)
            crossings[d] = speeds[s] - offset / slope
    return crossings


def _model_machines(
    data: Measurement,
    prior: PriorConfig,
    places: list[tuple[int, int, np.ndarray]],
    generator: np.random.Generator,
    modelled: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Critical speeds (N, D), rad/s, of machines with stiffnesses (N, D), N/m, within the bounds."""
    equations = data.response
    bounds = np.log([prior.lowest_stiffness, prior.highest_stiffness])
    stiffness = np.exp(generator.uniform(bounds[0], bounds[1], (modelled, len(data.unknowns.names))))
    speeds = np.array(
        [
            _find_crossings(data, equations.predict(data.table(values[None, None])), places)  # at every speed
            for values in stiffness
        ]
    )
    seen = ~np.isnan(speeds).any(axis=1)
    return speeds[seen], stiffness[seen]


def _train(
    speeds: np.ndarray, stiffness: np.ndarray, seed: int, held_out_every: int = 5, hidden: tuple[int, ...] = (16, 16)
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]:
    """From critical speeds (N, D), rad/s, to stiffnesses (N, D), N/m, by a network of the logarithm.

    With it comes (D,) the root mean square error of the logarithm, on machines that are held out.
    """
    from sklearn.neural_network import MLPRegressor

    middle, size, held_out = speeds.mean(axis=0), speeds.std(axis=0), np.arange(len(speeds)) % held_out_every == 0
    network = MLPRegressor(
        hidden_layer_sizes=hidden,
        activation="tanh",
        solver="lbfgs",
        alpha=1e-8,
        max_iter=3000,
        tol=1e-10,
        random_state=seed,
    )

    def estimate(speeds: np.ndarray) -> np.ndarray:
        return np.asarray(np.exp(network.predict((speeds - middle) / size)))

    with warnings.catch_warnings(action="ignore"):  # that it could be trained on: its held-out error tells
        network.fit((speeds[~held_out] - middle) / size, np.log(stiffness[~held_out]))
    off = np.log(estimate(speeds[held_out])) - np.log(stiffness[held_out])
    return estimate, np.sqrt((off**2).mean(axis=0))
