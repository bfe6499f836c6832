"""`dcam-ctl target`: the targets of the config as PDF, to print at true scale."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click
import numpy as np

from core.site import CirclesTarget, Site
from daemon.commands.options import Options, common_options, json_option, pass_options
from daemon.commands.output import print_json, print_table, say
from daemon.errors import ExitCode
from daemon.reports.target_sheet import Sheet, board_sheet, discs_sheet
from daemon.version import VERSION


@click.command(
    "target", epilog="\b\nExample:\n  dcam-ctl --config dcam.toml target --output prints"
)
@click.option(
    "--output",
    "directory",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    required=True,
    help="Where to write target-main.pdf, target-sub.pdf and so on; made if not there.",
)
@json_option
@common_options
@pass_options
def command(options: Options, directory: Path, as_json: bool) -> int:
    """Write the targets as PDF at true scale, with rulers to check the print.

    Vectors, with the marks and notes that mounting needs. Print at 100 %, then lay a steel rule on
    both rulers. Further targets of one layout share a file with the name of the first; each is
    to be printed once. Files of the same names are overwritten.
    """
    site, name = options.config.site(), options.config.name
    sheets = {
        **{
            f"target-{next(iter(alike))}.pdf": discs_sheet(alike, name, VERSION)
            for alike in _layouts(site)
        },
        "target-sub.pdf": board_sheet(site.sub_target, name, VERSION),
    }
    directory.mkdir(parents=True, exist_ok=True)
    for file, sheet in sheets.items():
        (directory / file).write_bytes(sheet.pdf)
    if as_json:
        files = [_fields(directory / file, sheet) for file, sheet in sheets.items()]
        print_json({"command": "target", "files": files})
        return ExitCode.DONE
    rows = [
        (str(directory / file), sheet.page, ", ".join(sheet.targets))
        for file, sheet in sheets.items()
    ]
    print_table(("file", "page", "target"), rows)
    say("Print at 100 %, no scaling; then lay a steel rule on both rulers.")
    return ExitCode.DONE


def _layouts(site: Site) -> list[dict[str, CirclesTarget]]:
    """The targets of the main camera by name, those of one layout and size together."""
    found: list[dict[str, CirclesTarget]] = []
    named = {"main": site.main_target} | {extra.name: extra.target for extra in site.extra_targets}
    for name, target in named.items():
        for alike in found:
            if _same_print(target, next(iter(alike.values()))):
                alike[name] = target
                break
        else:
            found.append({name: target})
    return found


def _same_print(one: CirclesTarget, other: CirclesTarget) -> bool:
    return np.array_equal(one.centres_mm, other.centres_mm) and np.array_equal(
        one.diameters_mm, other.diameters_mm
    )


def _fields(path: Path, sheet: Sheet) -> dict[str, object]:
    return {
        "file": path,
        "targets": sheet.targets,
        "page": sheet.page,
        "page_mm": sheet.page_mm,
        "origin_mm": sheet.origin_mm,
        "rulers": [asdict(ruler) for ruler in sheet.rulers],
    }
