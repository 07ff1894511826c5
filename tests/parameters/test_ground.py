"""Bearings on soft ground: against ROSS's links, against whole matrices, and what fits make of simulated machines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from running import GROUNDED
from training import assert_slopes, differences

from pipeline.coefficients import COEFFICIENTS
from pipeline.config.compose import compose_config
from pipeline.config.rotor import RotorConfig
from pipeline.config.runs import ProbeConfig
from pipeline.data.dataset import DIRECTIONS, Excitation, VibrationDataset
from pipeline.data.sensors import NoiseModel, Sensors, measure, project
from pipeline.data.simulate import add_noise, simulate
from pipeline.errors import ConfigError, DataError
from pipeline.identification.combinations import combine
from pipeline.identification.fit import default_setup, fit, loss_of
from pipeline.identification.identified import Fit
from pipeline.identification.linear_start import start_at
from pipeline.identification.output_error_start import prepare_output_error
from pipeline.identification.readings import sensor_model
from pipeline.parameters.model import model_parameters
from pipeline.problem.determination import Verdict, judge_determined, relative_deviation
from pipeline.problem.measurement import Guess, Measurement
from pipeline.problem.slopes import ReadingSlopes
from pipeline.reporting.diagnosis import describe_series
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.rotor.ross_export import export_rotor
from pipeline.rotor.stored import load_rotor, place_probe
from pipeline.twin.modes import find_modes
from pipeline.unknowns import tie, unknown_set

NODES, SPEEDS = (1, 6), np.linspace(100.0, 700.0, 30)
FILMS = {
    1: (2e7, 3e6, -4e6, 1.5e7, 2e4, 1e3, 2e3, 1.5e4),
    6: (1e7, 1e6, -2e6, 2.5e7, 1e4, 1e3, 1e3, 0.5e4),
}
SUPPORTS = {
    1: {"kxx": 2e7, "kyy": 3e7, "cxx": 9e3, "cyy": 1.5e4, "mxx": 20.0, "myy": 24.0},
    6: {"kxx": 1e7, "kyy": 4e7, "cxx": 7e3, "cyy": 1.6e4, "mxx": 18.0, "myy": 25.0},
}
CROSSED = {"kxy": 3e6, "kyx": -4e6, "cxy": 1e3, "cyx": -2e3}
OFF = {"kxx": 0.5, "kyy": 1.8, "cxx": 2.0, "cyy": 0.7, "mxx": 1.5, "myy": 0.6}
"""What is stated of a support, over what it has."""
WEIGHTS = (Excitation("a", "unbalance", 3, 5e-4, 0.3), Excitation("b", "unbalance", 8, 5e-4, 1.3))
KINDS = {"support_stiffness": "k", "support_damping": "c", "support_mass": "m"}


def config(
    nodes: tuple[int, ...] = NODES, off: bool = False, crossed: Mapping[str, float] | None = None
) -> RotorConfig:
    """A shaft with a disc between its bearings and an overhung one; ``off``: supports as they are stated. ``crossed``
    are their cross terms.
    """
    given = [{key: number * (OFF[key] if off else 1.0) for key, number in SUPPORTS[node].items()} for node in nodes]
    return RotorConfig.model_validate(
        {
            **GROUNDED,
            "supports": [{"node": node, **at, **(crossed or {})} for node, at in zip(nodes, given, strict=True)],
        }
    )


def films(speeds: np.ndarray = SPEEDS) -> BearingTable:
    """The same at every speed."""
    return BearingTable(NODES, speeds, np.array([np.tile(FILMS[node], (len(speeds), 1)) for node in NODES]))


SHAFT, CASING, FILM = range(3)
"""What probes measure: the shaft, the casing, the shaft relative to the casing."""


def readings(rotor: RotorModel, measures: tuple[int, ...]) -> VibrationDataset:
    """x and y of what is measured at both bearings."""
    every = (NODES, range(rotor.n_nodes, rotor.n_places), range(rotor.n_places, rotor.n_views))
    nodes = [node for what in measures for node in every[what]]
    return project(simulate(rotor, films(), WEIGHTS), tuple((n, angle) for n in nodes for angle in DIRECTIONS.values()))


def measured(
    measures: tuple[int, ...] = (SHAFT, CASING), noise: NoiseModel | None = None, seed: int = 0
) -> Measurement:
    """All eight coefficients and all numbers of the supports unknown; readings are exact without ``noise``."""
    data, stated = readings(load_rotor(config()), measures), load_rotor(config(off=True))
    if noise:
        data = add_noise(data, noise.deviation(data.displacement), np.random.default_rng(seed))
    unknowns = unknown_set(dict.fromkeys(NODES, tie(COEFFICIENTS)))
    known = BearingTable(NODES, SPEEDS, np.zeros((2, len(SPEEDS), 8)))
    parameters = model_parameters(dict.fromkeys(KINDS, 1.0), stated, data, known, unknowns)
    noise = noise or NoiseModel(1e-13, 1e-8)
    return Measurement(stated, data, known, noise, unknowns, Guess(1e7, 1e4, within=30.0), parameters=parameters)


def errors(answer: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shares by which films (B, 8) and supports (T,) are off, and the deviations (T,) of the latter."""
    numbers = {p: p.number for p in answer.parameters}
    true = np.array([SUPPORTS[NODES[p.place - 9]][KINDS[p.kind] + 2 * p.detail] for p in numbers])
    shares = np.array([[n["number"], n["number_deviation"]] for n in numbers.values()]) / true[:, None]
    return answer.table(films()).values[:, 0] / np.array([*FILMS.values()]) - 1, shares[:, 0] - 1, shares[:, 1]


@pytest.mark.parametrize("nodes", [NODES, (6,)])
def test_the_response_is_that_of_links_in_ross(nodes: tuple[int, ...]) -> None:
    """Supports as masses on links at nodes of their own; with shaft and casings, one bearing or both on soft ground."""
    rotor, w = load_rotor(config(nodes, crossed=CROSSED)), SPEEDS[7]
    exported = export_rotor(config(nodes, crossed=CROSSED), (), films())
    places = [6 * n for n in range(9)] + [54 + 3 * i for i in range(len(nodes))]  # a link has x, y and z
    lateral = [p + d for p in places for d in ((0, 1, 3, 4) if p < 54 else (0, 1))]
    at = np.ix_(lateral, lateral)
    mass, damping, stiffness = (each[at] for each in (exported.M(w), exported.C(w) + w * exported.G(), exported.K(w)))
    dynamic = stiffness + 1j * w * damping - w**2 * mass
    force = np.zeros(len(lateral), dtype=complex)
    force[[12, 13]] = w**2 * 5e-4 * np.exp(0.3j) * np.array([1.0, -1.0j])
    motion = np.linalg.solve(dynamic, force)
    moving = motion[[lateral.index(p + d) for p in places for d in (0, 1)]]
    expected = np.concatenate([moving, moving[[2 * node + d for node in nodes for d in (0, 1)]] - moving[18:]])
    read = simulate(rotor, films(), WEIGHTS[:1]).displacement[7, :, 0]
    assert np.abs(read - expected).max() <= 1e-10 * np.abs(expected).max()
    theirs = exported.run_unbalance_response([3], [5e-4], [0.3], frequency=SPEEDS[[7]]).forced_resp[:, 0]
    assert np.abs(theirs[lateral] - motion).max() <= 1e-10 * np.abs(motion).max()
    nothing, inverse = np.zeros_like(mass), np.linalg.inv(mass)
    state = np.block([[nothing, np.eye(len(mass))], [-inverse @ stiffness, -inverse @ damping]])
    modes = find_modes(rotor, films(SPEEDS[[7]])).eigenvalues[0]
    assert (np.abs(np.linalg.eigvals(state) - modes[:, None]).min(axis=1) < 1e-9 * np.abs(modes)).all()


def test_readings_far_from_where_the_rotor_was_solved_are_exact_and_so_are_their_derivatives() -> None:
    """Against the rotor solved anew, and central differences; to first order both ways of deriving agree."""
    measurement = measured((SHAFT, CASING, FILM))
    model, none = sensor_model(measurement), torch.zeros(1, 0, dtype=torch.complex128)
    values = torch.as_tensor(measurement.unknowns.to_active(measurement.unknowns.leading(films().values)))[None]
    theta = torch.as_tensor(0.8 * np.cos(1.7 * np.arange(12)))[None]
    again = measurement.update(theta[0].numpy())
    read = again.response.predict(films())
    np.testing.assert_allclose(
        model.predict(values, none, theta)[0][0], read, rtol=1e-8, atol=1e-10 * np.abs(read).max()
    )
    slopes = model.derive(0, values, none, theta)[3]
    by_model = ReadingSlopes(again, films()).by_model * again.deviation[..., None]
    np.testing.assert_allclose(slopes[0], by_model, rtol=1e-7, atol=1e-9 * np.abs(by_model).max())
    wanted = differences(lambda at: model.predict(values, none, torch.as_tensor(at)[None])[0], theta[0].numpy(), 1e-5)
    assert_slopes(slopes, wanted, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("measures", "noise", "which", "film", "support"),
    [
        ((SHAFT, CASING), None, slice(None), 1e-8, 1e-8),
        ((FILM, CASING), None, slice(None), 1e-8, 1e-8),
        ((SHAFT, CASING), NoiseModel(5e-8, 0.01), [0, 3, 4, 7], 0.01, 0.02),
    ],
    ids=["exact", "relative", "noisy"],
)
def test_casing_probes_tell_bearings_and_supports(
    measures: tuple[int, ...], noise: NoiseModel | None, which: slice | list[int], film: float, support: float
) -> None:
    """From supports that are stated up to twice off: exact readings give all coefficients and supports back to 1e-6 %,
    readings of 1 % and 0.05 um direct coefficients within 1 % and supports within 2 %.
    """
    off, supports, deviation = errors(fit(measured(measures, noise), default_setup(Guess(1e7, 1e4), constant=True)))
    assert np.abs(off[:, which]).max() < film
    assert np.abs(supports).max() < support
    assert (np.abs(supports) < 3.5 * deviation).all()


@pytest.mark.slow
def test_cross_terms_of_supports_come_back_from_exact_readings() -> None:
    """With all coefficients and all numbers of the supports, of which no cross term was stated, to 1e-6 %."""
    data, made = readings(load_rotor(config(crossed=CROSSED)), (SHAFT, CASING)), measured()
    kinds = dict.fromkeys(KINDS, 1.0) | {"support_cross_stiffness": 1e7, "support_cross_damping": 1e4}
    parameters = model_parameters(kinds, made.rotor, data, made.known, made.unknowns)
    answer = fit(replace(made, dataset=data, parameters=parameters), default_setup(Guess(1e7, 1e4), constant=True))
    shifts = {p.name: p.deviation * v for p, v in zip(parameters, answer.uncertainty.parameters, strict=True)}
    for letter, kind in (("k", "support_cross_stiffness"), ("c", "support_cross_damping")):
        for node, axes in ((1, "xy"), (1, "yx"), (6, "xy"), (6, "yx")):
            assert shifts[f"{kind} node {node} {axes}"] == pytest.approx(CROSSED[letter + axes], rel=1e-8)
    films_off = answer.table(films()).values[:, 0] / np.array([*FILMS.values()]) - 1
    assert np.abs(films_off).max() < 1e-8


@pytest.mark.slow
def test_the_diagnosis_names_what_shaft_probes_leave_open_and_casing_probes_tell() -> None:
    """With casing probes all numbers are told to a tenth of what is stated."""
    setup, noise = default_setup(Guess(1e7, 1e4), constant=True), NoiseModel(5e-8, 0.01)
    every = [combine(measured(measures, noise), setup) for measures in ((SHAFT,), (SHAFT, CASING))]
    shaft, both = (found.parameters for found in every if found)
    assert set(both) == {parameter.name for parameter in measured().parameters}
    assert max(both.values()) < (0.1, 0.1)
    assert max(shaft.values()) > tuple(2 * left for left in max(both.values()))


@pytest.mark.slow
def test_the_diagnosis_says_where_only_bearing_and_support_in_series_are_told() -> None:
    """With much noise: the probes that it asks for tell all numbers."""
    every = [measured(measures, NoiseModel(3e-6, 0.15)) for measures in ((SHAFT,), (SHAFT, CASING))]
    shaft, both = filter(None, (combine(made, default_setup(Guess(1e7, 1e4), constant=True)) for made in every))
    assert describe_series(shaft, {1: 9, 6: 10}).startswith("of bearing and support at node 1 these probes tell only")
    assert [made.rotor.unseen_casings(made.dataset.channels) for made in every] == [{1: 9, 6: 10}, {}]
    assert max(both.parameters.values()) < (0.4, 0.4) < tuple(0.5 * left for left in max(shaft.parameters.values()))


@pytest.mark.slow
def test_a_floor_of_probes_is_found_beside_the_share_and_bands_hold() -> None:
    """Floors of accelerometers that are stated a tenth as large as they are come back with the share, and errors of the
    supports' numbers have the stated deviations (root mean square over three data sets).
    """
    noise, off = NoiseModel(0.0, 0.005, floors=((0.0, 0.0, 0.02),) * 8), list[float]()
    for seed in range(3):
        made, everywhere = measured(), simulate(load_rotor(config()), films(), WEIGHTS)
        read = measure(everywhere, Sensors(made.dataset.channels, noise), np.random.default_rng(seed))
        stated = replace(made, dataset=read, noise=noise.with_floor(0.1))
        answer = fit(stated, default_setup(Guess(1e7, 1e4), constant=True, noise="estimated"))
        told = answer.quality.summary["fit"]["noise"]
        assert told == pytest.approx({"floor_m_s2": 0.02, "multiplicative": 0.005}, rel=0.15)
        _, wrong, deviation = errors(answer)
        off += (wrong / deviation).tolist()
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.3


def seen_in_x(turning: float, guess: Guess) -> tuple[Measurement, BearingTable]:
    """Probes in x alone of a shaft with so many times its gyroscopic moments, on bearings without cross coefficients
    and rigid supports; direct ones are unknown. And these bearings.
    """
    rotor, names = load_rotor(RotorConfig.model_validate(GROUNDED)), ("kxx", "kyy", "cxx", "cyy")
    rotor = replace(rotor, gyroscopic=turning * rotor.gyroscopic)
    real, nothing = (replace(films(), values=films().values * kept) for kept in (np.isin(COEFFICIENTS, names), 0.0))
    data, noise = project(simulate(rotor, real, WEIGHTS), ((1, 0.0), (6, 0.0))), NoiseModel(5e-8, 0.01)
    return Measurement(rotor, data, nothing, noise, unknown_set(dict.fromkeys(NODES, tie(names))), guess), real


def test_a_probe_in_x_alone_tells_x_alone_where_nothing_couples_the_directions() -> None:
    """Without gyroscopic moments and cross coefficients y is another machine: the diagnosis says that it is open."""
    made, _ = seen_in_x(0.0, Guess(1e7, 1e4))
    setup = default_setup(made.guess, constant=True)
    diagnosis = loss_of(setup.loss).diagnose(made, setup)
    for expected in (diagnosis.expected, loss_of(setup.loss).expect(made, setup, diagnosis)):
        found = {(each.node, each.name): each.verdict is Verdict.NO for each in judge_determined(expected)}
        assert found == {(node, name): "y" in name for node in NODES for name in ("kxx", "kyy", "cxx", "cyy")}


@pytest.mark.slow
def test_a_probe_in_x_tells_of_y_what_the_true_bearings_would_let_it_tell() -> None:
    """From a guess that is ten times too soft, whose response is not the one that was read."""
    made, real = seen_in_x(0.3, Guess(1e6, 1e3))
    setup = default_setup(made.guess, constant=True)
    loss = loss_of(setup.loss)
    foretold = relative_deviation(loss.expect(made, setup, loss.diagnose(made, setup)))
    problem = prepare_output_error(made, setup).problem
    leading = made.unknowns.leading(real.values)
    true = problem.unknown_deviation(start_at(problem, leading))[0] / made.unknowns.to_active(leading)
    expected = made.unknowns.expand_deviation(made.unknowns.from_active(true))
    assert np.nanmax(expected) > 0.3 > 0.05 > np.nanmin(expected)
    assert np.nanmax(np.abs(np.log(foretold / expected))) < 0.6


@pytest.mark.slow
def test_cross_coefficients_that_start_at_zero_have_shares() -> None:
    """Sizes that are stated make a fit start at guesses, where cross coefficients are zero; supports are off."""
    made = replace(measured((SHAFT, CASING), NoiseModel(5e-8, 0.01)), parameters=())
    found = combine(made, default_setup(made.guess, constant=True))
    assert 0 < found.strongest.deviation < found.weakest.deviation < np.inf


def test_what_supports_cannot_do_is_refused() -> None:
    """A support without a bearing, the residual, and a place of a bearing that is off."""
    with pytest.raises(
        ConfigError, match=r"must have bearing nodes without a support \(1, 6\), each once, but has 6, 6"
    ):
        load_rotor(config((6, 6)))
    probe = ProbeConfig(node=1, angle=0.0, measures="shaft relative to casing")
    assert [place_probe(load_rotor(config(nodes)), "at", probe) for nodes in (NODES, (1,))] == [11, 10]
    with pytest.raises(
        ConfigError, match=r"at must measure the casing where .* has one \(6\), but got node 1 with measu"
    ):
        place_probe(load_rotor(config((6,))), "at", probe)
    with pytest.raises(DataError, match=r"that of node 1 has a support"):
        _ = measured().equations
    soft = measured()
    for kind, nodes in {"bearing_position": NODES, "support_mass": ()}.items():
        with pytest.raises(ConfigError, match=f"{kind} must belong to something that the machine has"):
            model_parameters({kind: 1e-3}, load_rotor(config(nodes)), soft.dataset, soft.known, soft.unknowns)
    support = "{node: 1, mxx: 1 kg, myy: 1 kg, kxx: 1e7, kyy: 1e7, cxx: 1e3, cyy: 1e3}"
    on_casing = "machine.prediction={node: 7, speed_rpm: 1000, unbalances: [{node: 7, magnitude: 1 g mm}]}"
    with pytest.raises(ConfigError, match=r"must use nodes 0 to 6 of the rotor, but prediction\.unbalances got node 7"):
        compose_config(["experiment=noisy_all", f"+machine.rotor.supports=[{support}]", on_casing])
