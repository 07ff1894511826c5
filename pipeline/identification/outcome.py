"""How a training ended. A value of :class:`Outcome` is the sentence shown to the user."""

from __future__ import annotations

from enum import StrEnum


class Outcome(StrEnum):
    """The end of a training, and what to try next where it fell short."""

    CONVERGED = (
        "converged: the loss hardly falls any more (by less than training.tolerance, or than the scatter of the data "
        "tells, in the phase's patience)"
    )
    BUDGET_SPENT = (
        "budget spent: the loss still fell at the last step; give the last phase more steps "
        "(such as optimizer.levenberg_marquardt.steps=1000)"
    )
    DIVERGED = (
        "diverged: the loss is not finite or ended above its start; "
        "try a smaller optimizer.adam.learning_rate, model.parametrisation=log or loss.scaling=per_speed"
    )
    INTERRUPTED = "interrupted: the best state so far was kept"

    @property
    def label(self) -> str:
        """Short form for tables and tags."""
        return self.name.lower()
