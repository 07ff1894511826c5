"""The sections of what is unknown: coefficients, and uncertain numbers of the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

from pydantic import Field, create_model

from pipeline.coefficients import CoefficientName
from pipeline.config.quantities import Damping, Stiffness, UnbalanceMagnitude
from pipeline.config.section import NonNegativeInt, Once, Section, rule
from pipeline.parameters.model import KINDS
from pipeline.unknowns import Structure, Tied, UnknownSet, tie, unknown_set

Unknowns = Annotated[tuple[CoefficientName, ...], Once]


class OneBearingConfig(Section):
    """One bearing differs from the rest in these values; null stands for the value of the rest."""

    unknowns: Unknowns | None = None
    structure: Structure | None = None


class ModelParametersConfig(
    create_model(  # type: ignore[misc]  # a key for each kind that there is
        "_Deviations",
        __base__=Section,
        **{name: (kind.prior | None, Field(default=None, description=kind.meaning)) for name, kind in KINDS.items()},
    )
):
    """Prior standard deviations of uncertain numbers of the model, which are then fitted with the coefficients.

    See :mod:`pipeline.parameters.model` for what each moves; null stands for exactly known.
    """

    @property
    def deviations(self) -> dict[str, float]:
        """Those that are given, by kind."""
        return {kind: value for kind, value in self if value}


class IdentifyConfig(Section):
    """Which coefficients are unknown, and what ties them together; the others are taken as known.

    ``bearings`` has exceptions by node; ``shared`` makes all bearings alike. With ``unbalance_planes`` a residual
    unbalance at these nodes is identified too, with ``model_parameters`` uncertain numbers of rotor, weights and
    probes (loss ``response``); a coupling that they name acts at ``coupling_node`` (null: at the ends of the shaft
    without disc and bearing), and an added mass at the bearings of ``seal_nodes``. ``known_within`` is a factor: so
    near to ``known_stiffness`` and ``known_damping`` (null: to their initial guess, from which the fit only starts
    otherwise) coefficients are expected, one standard deviation of the logarithm (loss ``response``). Each part of a
    residual unbalance is nothing, plus or minus ``known_unbalance`` (null: nothing is known of it). With
    ``usual_tolerances`` what is never known exactly of shaft, weights and probes, and is not among the model
    parameters, widens all deviations.
    """

    unknowns: Unknowns = Field(min_length=1)
    structure: Structure
    shared: bool
    unbalance_planes: tuple[NonNegativeInt, ...] = ()
    model_parameters: ModelParametersConfig = ModelParametersConfig()
    coupling_node: NonNegativeInt | None = None
    seal_nodes: Annotated[tuple[NonNegativeInt, ...], Once] = ()
    usual_tolerances: bool = True
    known_within: Annotated[float, Field(gt=1)] | None = None
    known_stiffness: Stiffness | None = None
    known_damping: Damping | None = None
    known_unbalance: UnbalanceMagnitude | None = None
    bearings: dict[NonNegativeInt, OneBearingConfig] = Field(default_factory=dict)

    @rule
    def _lawful(self) -> Iterator[str]:
        if self.shared and self.bearings:
            yield "shared makes all bearings alike, but bearings has exceptions: leave one of them out"
        support = next((kind for kind in self.model_parameters.deviations if KINDS[kind].logarithmic), "")
        if support and not self.known_within:
            yield (
                f"model_parameters.{support} must have known_within, a factor such as 30, beside it, since film and "
                "support in series are told apart in part only: give it"
            )
        if (self.known_stiffness or self.known_damping) and not self.known_within:
            yield "known_stiffness and known_damping must have known_within, a factor such as 30: give it, or neither"
        if self.known_unbalance and not self.unbalance_planes:
            yield "known_unbalance must have unbalance_planes, the nodes where it acts, but there are none: give them"
        self.at(-1)
        for node in self.bearings:
            self.at(node)

    def at(self, node: int) -> Tied:
        """Return what is unknown at the bearing of ``node``. Raises ValueError where half of a structure is known."""
        bearing = self.bearings.get(node, OneBearingConfig())
        return tie(self.unknowns if bearing.unknowns is None else bearing.unknowns, bearing.structure or self.structure)

    def unknowns_of(self, nodes: Sequence[int]) -> UnknownSet:
        """Return what is unknown at the bearings of these nodes."""
        return unknown_set({node: self.at(node) for node in nodes}, self.shared, self.unbalance_planes)

    def named(self) -> tuple[str, ...]:
        """Every coefficient that is unknown at some bearing, in the order of the configuration."""
        return tuple(
            dict.fromkeys([*self.unknowns, *(n for bearing in self.bearings.values() for n in bearing.unknowns or ())])
        )
