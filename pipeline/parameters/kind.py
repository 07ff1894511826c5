"""What a kind of uncertain number is: its key, where a machine has it, and what it changes.

Each module of this room has rows of :class:`Kind`; :mod:`pipeline.parameters.model` finds them. Everybody else calls
what the rows have, and does not ask which kind it is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from pipeline.data.dataset import Excitation, VibrationDataset, synchronous
from pipeline.errors import ConfigError
from pipeline.rotor.bearing_table import BearingTable
from pipeline.rotor.model import RotorModel
from pipeline.unknowns import UnknownSet

PositiveShare = Annotated[float, Field(gt=0, lt=1)]
PARTS = {"real": 1.0, "imaginary": 1j}
"""A complex number is two parameters: its parts, and the unit of each."""
UNSHOWN = "no run that turns with the rotor and that no baseline was subtracted from"
"""What a machine lacks that does not show what turns with the rotor at all speeds alike."""


@dataclass(frozen=True)
class Place:
    """Where a machine has a parameter, as the fields of :class:`ModelParameter` say it."""

    label: str = ""
    place: int = 0
    detail: str = ""
    stated: float = 0.0


@dataclass(frozen=True, eq=False)
class Machine:
    """What parameters belong to: rotor, runs and probes, and the coefficients that are taken as known."""

    rotor: RotorModel
    dataset: VibrationDataset
    known: BearingTable
    unknowns: UnknownSet
    coupling_node: int | None = None  # None: where a coupling may be
    seal_nodes: Collection[int] = ()

    @cached_property
    def discs(self) -> list[Place]:
        """Each disc."""
        return [Place(f"node {node}", node) for node in dict.fromkeys(self.rotor.disc_nodes)]

    @cached_property
    def weights(self) -> list[tuple[int, Excitation]]:
        """Each unbalance with its position among the excitations of its run."""
        return [(i, weight) for i, weight in number_excitations(self.dataset.excitations) if weight.kind == "unbalance"]

    @cached_property
    def probes(self) -> list[Place]:
        """Each channel."""
        return [Place(name, p) for p, name in enumerate(self.dataset.channel_names)]

    @cached_property
    def probes_on_shaft(self) -> list[Place]:
        """Those that look at no casing."""
        casings = range(self.rotor.n_nodes, self.rotor.n_nodes + len(self.rotor.casings))
        return [probe for probe in self.probes if self.dataset.channels[probe.place][0] not in casings]

    @property
    def shows_bow(self) -> bool:
        """Whether a run shows what turns with the rotor at all speeds alike: none whose baseline was subtracted."""
        return self.dataset.subtracted is None and bool(turns_with_rotor(self.dataset).any())


@dataclass(frozen=True)
class ModelParameter:
    """One uncertain number.

    ``youngs_modulus`` scales the shaft's whole stiffness (a shear modulus of constant Poisson's ratio with it),
    ``density`` its mass, ``disc_inertia`` both inertias of a disc. A coupling acts at a node in x and y alike.
    ``bearing_position`` moves a bearing along the shaft, and ``base_participation`` a casing in a mode; their matrices
    stay, and the bearing's places on them change. By ``base_softening`` the logarithm of a mode's stiffness falls with
    the root of the force that excites a run.
    """

    kind: str
    deviation: float  # prior standard deviation in the unit of the kind
    label: str  # what it belongs to, such as "node 3"; empty for the whole shaft
    place: int = 0  # node, position among the run's excitations, channel, bearing, or participation of a base
    detail: str = ""  # run of an excitation, name of a coefficient, part of a complex number, or direction
    stated: float = 0.0  # SI, of a support, or of what softens
    value: float = 0.0  # theta, where rotor, weights and probes are made
    left: float = 1.0  # of its prior deviation after a fit; 1 where the data tell nothing of it

    @property
    def row(self) -> Kind:
        """Its kind."""
        from pipeline.parameters.model import KINDS

        return KINDS[self.kind]

    @property
    def name(self) -> str:
        """Kind and place, as tables show them."""
        return f"{self.kind} {self.label}".strip()

    @property
    def growth(self) -> float:
        """Its deviation where theta is a logarithm; zero where the number is in proportion to theta."""
        return self.deviation if self.row.logarithmic else 0.0

    @property
    def mirrored(self) -> bool:
        """Whether its sign is the other one in the mirrored machine."""
        return self.row.mirrored or self.detail == "imaginary"

    @property
    def shift(self) -> float:
        """By how much it is off at its :attr:`value`, in the unit of the kind."""
        return self.value * self.deviation

    @property
    def step(self) -> float:
        """By how many deviations the number is off there."""
        return float(np.expm1(self.value * self.growth)) / self.growth if self.growth else self.value

    @property
    def slope(self) -> float:
        """The derivative of :attr:`step` by the value."""
        return float(np.exp(self.value * self.growth))

    @property
    def number(self) -> dict[str, float]:
        """A support's own number and its deviation, SI; empty for what is a change of something stated."""
        if not self.stated or not self.growth:
            return {}
        number = self.stated * self.slope
        return {"number": number, "number_deviation": number * self.deviation * self.left}


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of uncertain number, and its ports: what it changes of rotor, bearings' places, weights and probes; what
    changes of supports, bearings and the vibration as it is shown, the modules of their kinds say.
    """

    name: str
    prior: Any  # what its key takes: a standard deviation
    meaning: str  # of the key
    places: Callable[[Machine], Collection[Place]]
    missing: str = ""  # what a machine without a place has
    require: Callable[[ModelParameter, Machine], None] = lambda _, __: None  # raises ConfigError for what can't be
    unit: str = ""  # of the deviation; "" is a share of what is stated, ln the logarithm of the number over that
    shown: tuple[str, float] | None = None  # an engineer's unit and the factor, other than that of the unit
    stated_unit: str = ""  # of what is stated, where the number itself is shown
    usual: float = 0.0  # deviation where none is stated, of what is never known exactly
    widens: bool = True  # where it is not fitted, its usual deviation widens all others
    scope: Literal["machine", "runs", "run"] = "machine"  # it acts always, in all measured runs, or on a reading or run
    logarithmic: bool = False  # theta is the logarithm of the number over what is stated
    mirrored: bool = False  # in the mirrored machine its sign is the other one
    local: Literal["", "k", "c", "m"] = ""  # stiffness, damping or mass that acts where bearings or casings stand alone
    rotor: Callable[[ModelParameter, RotorModel], Mapping[str, np.ndarray]] = lambda _, __: {}
    """What one deviation changes of the rotor's matrices, by their names."""
    move: Callable[[RotorModel, int, float], RotorModel] | None = None
    """The rotor with other places of what bearings feel of the DOF, by the parameter's place and its shift."""
    derive_places: Callable[[RotorModel, int], np.ndarray] | None = None
    """The derivative of these rows by the shift."""
    weight: Literal["", "angle", "gain", "share", "law"] = ""  # which number of weights it shifts
    belongs: Callable[[ModelParameter, int, Excitation], bool] = lambda _, __, ___: True
    """Of which weights, by their positions in their runs."""
    probe: Literal["", "gain", "angle", "position"] = ""  # which number of a probe it shifts

    @property
    def shown_unit(self) -> tuple[str, float]:
        """An engineer's unit, and what the parameter's is multiplied by."""
        usual = {"": ("%", 100.0), "rad": ("deg", float(np.degrees(1))), "m": ("mm", 1e3)}
        return self.shown or usual.get(self.unit, (self.unit, 1.0))


def everywhere(_: Machine) -> list[Place]:
    """A number of the whole machine."""
    return [Place()]


def number_excitations(excitations: Sequence[Excitation]) -> Iterator[tuple[int, Excitation]]:
    """Each excitation with its position among those of its run, which selecting runs does not change."""
    seen: dict[str, int] = {}
    for excitation in excitations:
        seen[excitation.run] = seen.get(excitation.run, -1) + 1
        yield seen[excitation.run], excitation


def turns_with_rotor(dataset: VibrationDataset) -> np.ndarray:
    """(R,) mask of the runs that turn with the rotor."""
    return np.asarray(synchronous(dataset.frequencies, dataset.speeds[:, None]).all(axis=0))


def require_on_shaft(parameter: ModelParameter, machine: Machine, node: int, choose: Callable[..., float]) -> None:
    """Raise ConfigError where one deviation leaves the shaft, by the end that ``choose`` (min, max) takes."""
    positions = machine.rotor.positions
    place = float(machine.rotor.view_positions[node])
    room = choose(place - float(positions[0]), float(positions[-1]) - place)
    if parameter.deviation > room:
        raise ConfigError(
            f"identify.model_parameters.{parameter.kind} must leave node {node} on the shaft, whose end is "
            f"{1e3 * room:g} mm from it, but got {1e3 * parameter.deviation:g} mm: state less, or "
            "model the shaft's end"
        )
