"""What all tables of `dcam.toml` have in common, and kinds of values that several of them have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Strict, ValidationInfo


def _beside_the_config(value: Path, info: ValidationInfo) -> Path:
    """Take a relative path as relative to the config file, not to where the daemon was started."""
    base: Path = (info.context or {}).get("directory", Path())
    return base / value.expanduser()


Pair = Annotated[tuple[float, float], Strict(strict=False)]
Triple = Annotated[tuple[float, float, float], Strict(strict=False)]
Directory = Annotated[Path, Strict(strict=False), AfterValidator(_beside_the_config)]
Instant = Annotated[AwareDatetime, Strict(strict=False)]


class Section(BaseModel):
    """A table of the config: no unknown keys, no silent conversions, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
