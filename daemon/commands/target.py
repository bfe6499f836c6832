"""`dcam-ctl target`: both targets of the config as PDF, to print at true scale."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

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
    help="Where to write target-main.pdf and target-sub.pdf; made if not there.",
)
@json_option
@common_options
@pass_options
def command(options: Options, directory: Path, as_json: bool) -> int:
    """Write both targets as PDF at true scale, with rulers to check the print.

    Vectors, with the marks and notes that mounting needs. Print at 100 %, then lay a steel rule on
    both rulers. Files of the same names are overwritten.
    """
    site, name = options.config.site(), options.config.name
    sheets = {
        "target-main.pdf": discs_sheet(site.main_target, name, VERSION),
        "target-sub.pdf": board_sheet(site.sub_target, name, VERSION),
    }
    directory.mkdir(parents=True, exist_ok=True)
    for file, sheet in sheets.items():
        (directory / file).write_bytes(sheet.pdf)
    if as_json:
        files = [_fields(directory / file, sheet) for file, sheet in sheets.items()]
        print_json({"command": "target", "files": files})
        return ExitCode.DONE
    rows = [(str(directory / file), sheet.page) for file, sheet in sheets.items()]
    print_table(("file", "page"), rows)
    say("Print at 100 %, no scaling; then lay a steel rule on both rulers.")
    return ExitCode.DONE


def _fields(path: Path, sheet: Sheet) -> dict[str, object]:
    return {
        "file": path,
        "page": sheet.page,
        "page_mm": sheet.page_mm,
        "origin_mm": sheet.origin_mm,
        "rulers": [asdict(ruler) for ruler in sheet.rulers],
    }
