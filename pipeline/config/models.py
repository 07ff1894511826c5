"""The schema of coefficient models: constants, networks, fixed functions, bearing laws."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator

from pipeline.config.quantities import Damping, Stiffness
from pipeline.config.section import Section


class _CoefficientModelConfig(Section):
    parametrisation: Literal["log", "scaled"]
    initialisation: Literal["guess", "per_speed"]
    initial_stiffness: Stiffness
    initial_damping: Damping

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


class _LayersConfig(_CoefficientModelConfig):
    width: Annotated[int, Field(ge=1, le=512)]
    depth: Annotated[int, Field(ge=1, le=8)]
    activation: Literal["tanh", "silu", "sine"]
    input_scaling: Literal["rpm", "log_rpm"]


class NetworkModelConfig(_LayersConfig):
    """A multilayer perceptron of the rotor speed (paper, section 4.2), and of the operating conditions that vary.

    With ``trend`` the output layer sees the inputs and the logarithm of the speed beside the hidden units.
    """

    kind: Literal["network"]
    trend: bool


class LawModelConfig(_CoefficientModelConfig):
    """The bearing laws of ``machine.laws``, whose few numbers are fitted (loss ``response``)."""

    kind: Literal["law"]


class HybridModelConfig(_LayersConfig):
    """The bearing laws of ``machine.laws`` times a network's correction, which is one where the data say nothing.

    How large it may be the data tell, for each bearing (loss ``response``). Straight lines are always part of it.
    """

    kind: Literal["hybrid"]


class FunctionsModelConfig(_CoefficientModelConfig):
    """A linear combination of ``count`` fixed functions of the rotor speed: cubic B-splines, or Chebyshev polynomials.

    With ``trend`` the speed and its logarithm are among them.
    """

    kind: Literal["b_spline", "chebyshev"]
    count: Annotated[int, Field(ge=2, le=512)]
    input_scaling: Literal["rpm", "log_rpm"]
    trend: bool

    @model_validator(mode="after")
    def _cubic(self) -> FunctionsModelConfig:
        if self.kind == "b_spline" and self.count < 4:
            raise ValueError(f"must have count of at least 4 for cubic B-splines, but got {self.count}")
        return self


ModelConfig = Annotated[
    ConstantModelConfig | NetworkModelConfig | FunctionsModelConfig | LawModelConfig | HybridModelConfig,
    Field(discriminator="kind"),
]


def model_fields(kind: str) -> tuple[str, ...]:
    """The keys of a model of this kind; none where there is no such kind."""
    kinds = get_args(get_args(ModelConfig)[0])
    sections = (section.model_fields for section in kinds if kind in get_args(section.model_fields["kind"].annotation))
    return tuple(next(sections, {}))
