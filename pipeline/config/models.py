"""The schema of coefficient models: constants, networks, fixed functions, bearing laws."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field

from pipeline.config.quantities import Damping, Stiffness
from pipeline.config.section import Section, rule


class _CoefficientModelConfig(Section):
    parametrisation: Literal["log", "scaled"]
    initialisation: Literal["guess", "per_speed"]
    initial_stiffness: Stiffness
    initial_damping: Damping

    varies: ClassVar[bool] = True
    """Whether coefficients change with the speed, and with what else varies."""
    of_speed_alone: ClassVar[bool] = False
    has_laws: ClassVar[bool] = False
    """Whether it is made of the laws of ``machine.laws``."""
    corrects_laws: ClassVar[bool] = False
    trains_hidden: ClassVar[bool] = False
    """Whether it has hidden layers that can be trained."""

    @property
    def families(self) -> tuple[str, ...]:
        """Kinds of bearings whose population is the prior; none for a model without one."""
        return ()

    @property
    def network(self) -> dict[str, Any]:
        """The hidden layers of a network that is trained from an answer at nodes; nothing for a model without one."""
        return {}

    @property
    def shape(self) -> dict[str, Any]:
        """The fields of a :class:`pipeline.identification.model.CoefficientModel` that the kind decides."""
        return {"hidden": ()}

    def as_chebyshev(self, degree: int) -> FunctionsModelConfig:
        """The Chebyshev series of this degree, linear in its parameters."""
        return FunctionsModelConfig(
            kind="chebyshev",
            count=degree,
            input_scaling=getattr(self, "input_scaling", "rpm"),
            trend=False,
            parametrisation="scaled",
            initialisation="guess",
            initial_stiffness=self.initial_stiffness,
            initial_damping=self.initial_damping,
        )


class ConstantModelConfig(_CoefficientModelConfig):
    """One trainable parameter a coefficient, the same at every speed (paper, section 4.1)."""

    kind: Literal["constant"]

    varies: ClassVar[bool] = False


class _LayersConfig(_CoefficientModelConfig):
    width: Annotated[int, Field(ge=1, le=512)]
    depth: Annotated[int, Field(ge=1, le=8)]
    activation: Literal["tanh", "silu", "sine"]
    input_scaling: Literal["rpm", "log_rpm"]

    @property
    def shape(self) -> dict[str, Any]:
        """The layers."""
        return {
            "hidden": (self.width,) * self.depth,
            "activation": self.activation,
            "input_scaling": self.input_scaling,
        }


class NetworkModelConfig(_LayersConfig):
    """A multilayer perceptron of the rotor speed (paper, section 4.2), and of the operating conditions that vary.

    With ``trend`` the output layer sees the inputs and the logarithm of the speed beside the hidden units.
    """

    kind: Literal["network"]
    trend: bool

    trains_hidden: ClassVar[bool] = True

    @property
    def shape(self) -> dict[str, Any]:
        """The layers, and whether the inputs pass by them."""
        return super().shape | {"trend": self.trend}


class LawModelConfig(_CoefficientModelConfig):
    """The bearing laws of ``machine.laws``, whose few numbers are fitted (loss ``response``)."""

    kind: Literal["law"]

    has_laws: ClassVar[bool] = True


class HybridModelConfig(_LayersConfig):
    """The bearing laws of ``machine.laws`` times a network's correction, which is one where the data say nothing.

    How large it may be the data tell, for each bearing (loss ``response``). Straight lines are always part of it.
    """

    kind: Literal["hybrid"]

    has_laws: ClassVar[bool] = True
    corrects_laws: ClassVar[bool] = True

    @property
    def shape(self) -> dict[str, Any]:
        """The layers of the correction."""
        return super().shape | {"fades": True}


class FunctionsModelConfig(_CoefficientModelConfig):
    """A linear combination of ``count`` fixed functions of the rotor speed: cubic B-splines, or Chebyshev polynomials.

    With ``trend`` the speed and its logarithm are among them.
    """

    kind: Literal["b_spline", "chebyshev"]
    count: Annotated[int, Field(ge=2, le=512)]
    input_scaling: Literal["rpm", "log_rpm"]
    trend: bool

    of_speed_alone: ClassVar[bool] = True

    @property
    def shape(self) -> dict[str, Any]:
        """The functions."""
        return super().shape | {
            "input_scaling": self.input_scaling,
            "trend": self.trend,
            "functions": self.kind,
            "n_functions": self.count,
        }

    @rule
    def _cubic(self) -> Iterator[str]:
        if self.kind == "b_spline" and self.count < 4:
            yield f"must have count of at least 4 for cubic B-splines, but got {self.count}"


class BearingsModelConfig(_CoefficientModelConfig):
    """Values of all eight coefficients at ``count`` nodes, even in the logarithm of the speed, with a cubic spline
    between. Their prior is a population of bearings of the kinds that are ``likely`` (loss ``response``).
    """

    kind: Literal["bearings"]
    count: Annotated[int, Field(ge=4, le=64)]
    likely: Annotated[tuple[Literal["plain", "lobed", "tilting_pad", "rolling", "unknown"], ...], Field(min_length=1)]

    of_speed_alone: ClassVar[bool] = True

    @property
    def families(self) -> tuple[str, ...]:
        """The kinds that are likely, each once."""
        return tuple(dict.fromkeys(self.likely))

    @property
    def shape(self) -> dict[str, Any]:
        """The nodes."""
        return super().shape | {
            "functions": "nodes",
            "n_functions": self.count,
            "input_scaling": "log_rpm",
            "parametrisation": "impedance",  # whatever an experiment has for other models
        }


class BearingsNetworkModelConfig(BearingsModelConfig):
    """A network of the speed for each bearing, all layers of which are trained from the answer at the nodes, with the
    same prior: the coefficients follow what a spline between few nodes can't.
    """

    kind: Literal["bearings_network"]  # type: ignore[assignment]  # the tag of a union is narrower in each kind
    width: Annotated[int, Field(ge=1, le=512)]
    depth: Annotated[int, Field(ge=1, le=8)]
    activation: Literal["tanh", "silu", "sine"]

    @property
    def network(self) -> dict[str, Any]:
        """The layers."""
        return {"hidden": (self.width,) * self.depth, "activation": self.activation}


ModelConfig = Annotated[
    BearingsModelConfig
    | BearingsNetworkModelConfig
    | ConstantModelConfig
    | NetworkModelConfig
    | FunctionsModelConfig
    | LawModelConfig
    | HybridModelConfig,
    Field(discriminator="kind"),
]


def model_fields(kind: str) -> tuple[str, ...]:
    """The keys of a model of this kind; none where there is no such kind."""
    kinds = get_args(get_args(ModelConfig)[0])
    sections = (section.model_fields for section in kinds if kind in get_args(section.model_fields["kind"].annotation))
    return tuple(next(sections, {}))
