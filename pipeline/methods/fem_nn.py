"""A model of the speed, fitted by the paper's residual, the preconditioned residual, or the output error.

By the residuals it is a network whose layers are all trained (FEM-NN). By the output error its hidden layer stays as it
was drawn (FEM-RF, random features).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pipeline.config.comparison import FitConfig
from pipeline.errors import IdentifiabilityError
from pipeline.identification.fit import fit, loss_of
from pipeline.identification.trained_fit import FEWEST_SPEEDS
from pipeline.identification.training import FitSetup
from pipeline.methods.method import (
    Estimate,
    MethodOptions,
    Refusal,
    doubt,
    refuse_undetermined,
    require_residual,
)
from pipeline.problem.measurement import Measurement
from pipeline.write_numbers import write_number


def fit_by(section: Callable[[MethodOptions], FitConfig]) -> Callable[[Measurement, MethodOptions], Estimate]:
    """Make a method that fits as a section of the settings says."""

    def identify(data: Measurement, options: MethodOptions) -> Estimate:
        """Fit the measurement. Raises Refusal as the residual's methods do."""
        chosen = section(options)
        setup = FitSetup(chosen.model, chosen.loss, chosen.optimizer, chosen.training, options.seed)
        loss = loss_of(chosen.loss)
        if not loss.weighs_noise:
            require_residual(data, options)
        diagnosis = loss.diagnose(data, setup)
        refuse_undetermined(diagnosis.reports)
        try:
            fitted = fit(data, setup, diagnosis=diagnosis)
        except IdentifiabilityError as error:
            raise Refusal("not_determined", str(error)) from None
        text = f"{fitted.outcome.label} after {fitted.steps} steps"
        if fitted.uncertainty:
            text += f", {write_number(fitted.quality.summary['fit']['chi_square']['numbers'])} numbers"
        table = fitted.table(data.known)
        stated = fitted.uncertainty.state(table) if fitted.uncertainty else table
        return Estimate(stated, text, doubt(fitted.quality.misfit))

    return identify


def fit_trained(data: Measurement, options: MethodOptions) -> Estimate:
    """Fit networks whose hidden layers are trained by the output error. Raises Refusal for constants, or few speeds."""
    if options.constant:
        raise Refusal("constant", "they are the same at every speed: no hidden layer is needed")
    if len(data.dataset.speeds) < FEWEST_SPEEDS:
        raise Refusal("few_speeds", f"{len(data.dataset.speeds)} can't be halved: give {FEWEST_SPEEDS} or more")
    return fit_by(lambda options: options.settings.trained)(data, options)


def fit_laws(data: Measurement, options: MethodOptions) -> Estimate:
    """Fit the few numbers of bearing laws by the output error. Raises Refusal where the machine has no laws."""
    if not options.laws:
        raise Refusal("no_law", "it has none")
    return fit_by(lambda options: options.settings.law)(replace(data, laws=options.laws), options)


def improve_paper(
    options: MethodOptions, *, scaling: bool = False, logarithm: bool = False, second_order: bool = False
) -> FitConfig:
    """The paper's residual with single pieces of the residual as it is configured: an ablation."""
    paper, ours = options.settings.paper, options.settings.residual
    loss = paper.loss.model_copy(update={"scaling": ours.loss.scaling}) if scaling else paper.loss
    model = paper.model.model_copy(update={"parametrisation": ours.model.parametrisation}) if logarithm else paper.model
    optimizer = ours.optimizer if second_order else paper.optimizer
    return paper.model_copy(update={"loss": loss, "model": model, "optimizer": optimizer})
