"""The base of every part of a configuration."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

NonNegativeInt = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, lt=1)]
"""A share: 0.01 is a percent."""


class Section(BaseModel):
    """A part of a configuration: a key that it does not know is refused, and nothing changes it once it is made."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)
