"""The config of whoever reads the central database: a pier's, or one of `[fleet]` and `[web]`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from daemon.config.file import read_toml
from daemon.config.log import LogSection
from daemon.config.outputs import FleetSection
from daemon.config.problems import describe_problems
from daemon.config.section import Section
from daemon.config.web import WebSection, web_problems
from daemon.errors import ConfigError


class CentreSection(Section):
    """A file without cameras: a computer that only reads."""

    fleet: FleetSection = FleetSection()
    web: WebSection = WebSection()
    log: LogSection = LogSection()


@dataclass(frozen=True, slots=True)
class Centre:
    """What reading the central database needs."""

    path: Path
    fleet: FleetSection
    web: WebSection
    only_reads: bool
    """There is no site in the file."""


def load_centre(path: Path) -> Centre:
    """Read and check a config of a pier, or of a computer that only reads. Raises ConfigError."""
    data = read_toml(path)
    if "site" in data or "camera" in data:
        from daemon.config.reading import config_of

        config = config_of(data, path)
        return Centre(path, config.fleet, config.web, only_reads=False)
    try:
        said = CentreSection.model_validate(data, context={"directory": path.absolute().parent})
    except ValidationError as error:
        raise ConfigError(*describe_problems(error, CentreSection, path)) from None
    if problems := said.fleet.problems() + web_problems(said.web):
        raise ConfigError(*(f"{path}: {problem}" for problem in problems))
    return Centre(path, said.fleet, said.web, only_reads=True)
