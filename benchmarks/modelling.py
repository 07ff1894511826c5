"""The response of a modelled machine: against ROSS, and against the size of the mesh."""

from __future__ import annotations

from benchmarks.machines import Machine, refined
from benchmarks.measure import BENCHMARKS, Aim, Times, in_turns, seconds

_EXPERIMENT = "hydrostatic_stiffness"


@BENCHMARKS.add(
    "response_at_7_nodes",
    "the response of 3 runs at 591 speeds, 7 nodes",
    "three ROSS run_unbalance_response calls, assembly left out",
    Aim(50, "at least"),
)
def response_at_7_nodes() -> Times:
    """Times faster than ROSS."""
    return _against_ross(refined(_EXPERIMENT, 1))


@BENCHMARKS.add(
    "response_at_25_nodes",
    "the same on a mesh of 25 nodes",
    "three ROSS run_unbalance_response calls, assembly left out",
    Aim(50, "at least"),
)
def response_at_25_nodes() -> Times:
    """Times faster than ROSS."""
    return _against_ross(refined(_EXPERIMENT, 4))


@BENCHMARKS.add(
    "response_on_pedestals",
    "the response of 3 runs at 591 speeds, 199 nodes on two pedestals",
    "three ROSS run_unbalance_response calls, assembly left out, measured at 6 of these speeds and scaled to 591",
    Aim(50, "at least"),
)
def response_on_pedestals() -> Times:
    """Times faster than ROSS, whose calls at all speeds would take ten minutes."""
    return _against_ross(on_pedestals(33), turns=3, every=118)


def on_pedestals(factor: int) -> Machine:
    """The machine with ``factor`` times the elements, each bearing on a mass, springs and dampers."""
    stand = "mxx: 20 kg, myy: 20 kg, kxx: 2e7 N/m, kyy: 3e7 N/m, cxx: 2e3 N s/m, cyy: 2e3 N s/m"
    supports = ", ".join(f"{{node: {factor * node}, {stand}}}" for node in (1, 5))
    return refined(_EXPERIMENT, factor, f"+machine.rotor.supports=[{supports}]")


@BENCHMARKS.add(
    "response_growth_to_25_nodes",
    "the response of 3 runs at 591 speeds a node, on 25 nodes",
    "the same a node, on 7 nodes",
    Aim(1.5),
)
def response_growth_to_25_nodes() -> Times:
    """The band solve costs as much a node on a fine mesh as on a coarse one."""
    return _growth(25)


@BENCHMARKS.add(
    "response_growth_to_97_nodes",
    "the response of 3 runs at 591 speeds a node, on 97 nodes",
    "the same a node, on 7 nodes",
    Aim(1.5),
)
def response_growth_to_97_nodes() -> Times:
    """The band solve costs as much a node on a fine mesh as on a coarse one."""
    return _growth(97)


def _against_ross(made: Machine, turns: int = 5, every: int = 1) -> Times:
    """ROSS's calls at every so many of the speeds alone count as often as there are speeds."""
    made.respond()
    ours, peer = [], []
    for _ in range(turns):
        peer.append(ross_seconds(made, every) * len(made.speeds) / len(made.speeds[::every]))
        ours.append(min(seconds(made.respond) for _ in range(5)))
    return Times(ours, peer)


def ross_seconds(made: Machine, every: int = 1) -> float:
    """Of ROSS's response of every run at every so many of the speeds. The rotor is fresh: it keeps transfer matrices,
    which the calls share."""
    from benchmarks.ross_oracle import ross_rotor

    rotor = ross_rotor(made.config.machine.rotor, made.config.machine.bearings, made.speeds)

    def calls() -> None:
        for run in made.runs:
            own = [e for e in made.excitations if e.run == run and e.kind == "unbalance"]
            if own:
                nodes, sizes, phases = [e.node for e in own], [e.magnitude for e in own], [e.phase for e in own]
                rotor.run_unbalance_response(nodes, sizes, phases, frequency=made.speeds[::every])

    return seconds(calls)


def _growth(nodes: int) -> Times:
    coarse, fine = refined(_EXPERIMENT, 1), refined(_EXPERIMENT, (nodes - 1) // 6)
    times = in_turns(fine.respond, coarse.respond, 7, inner=3)
    return Times(times.ours, times.peer, scale=7 / nodes)
