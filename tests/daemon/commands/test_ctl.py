"""`dcam-ctl` as a whole: help, options anywhere, exit codes, errors of one line, `check`."""

from __future__ import annotations

from pathlib import Path

import click
import pytest

from daemon.ctl import COMMANDS
from daemon.ctl import cli as ctl_cli
from daemon.error_report import run
from daemon.main import cli as dcamd_cli
from daemon.store.database import open_store
from tests.daemon.commands.conftest import CONFIG, SIMULATED, Ctl
from tests.daemon.commands.imports import modules_of
from tests.daemon.commands.terminals import on_terminal, program


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_has_an_example_that_names_it(ctl: Ctl, name: str) -> None:
    ran = ctl(name, "--help")
    assert ran.code == 0
    example = ran.out[ran.out.index("Example:") :]
    assert name in example
    assert "dcam-ctl" in example


def test_help_lists_all_commands_and_the_exit_codes(ctl: Ctl) -> None:
    ran = ctl("--help")
    assert ran.code == 0
    assert all(f"\n  {name} " in ran.out for name in COMMANDS)
    assert "5 database" in ran.out
    assert "\\b" not in ran.out


def test_help_loads_neither_numerics_nor_what_reads_a_config() -> None:
    """Who asks what a program can do waits a tenth of a second, not half of one."""
    loaded = modules_of("--help")
    assert loaded.isdisjoint({"numpy", "pydantic", "sqlalchemy", "structlog", "rich"})


@pytest.mark.parametrize("arguments", [[], ["calibrat"], ["gaps", "--sinse", "24h"]])
def test_a_mistyped_command_line_is_exit_code_2_and_one_line(
    ctl: Ctl, arguments: list[str]
) -> None:
    ran = ctl(*arguments)
    assert ran.code == 2
    assert ran.out == ""
    assert len(ran.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (["stauts"], "status"),
        (["gaps", "--sinse", "24h"], "--since"),
        (["simulate", "haed"], "head"),
    ],
)
def test_a_mistyped_name_is_answered_with_the_nearest(
    ctl: Ctl, typed: list[str], meant: str
) -> None:
    ran = ctl(*typed)
    assert ran.code == 2
    assert "Did you mean" in ran.err
    assert f"'{meant}'" in ran.err


def test_a_time_that_is_none_says_how_to_write_one(ctl: Ctl) -> None:
    ran = ctl("gaps", "--since", "yesterday")
    assert ran.code == 2
    assert "2026-03-01T06:00:00Z" in ran.err


def test_config_and_state_may_stand_before_or_after_the_command(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(CONFIG)
    open_store(tmp_path / "state").close()
    options = ["--config", tmp_path / "dcam.toml", "--state", tmp_path / "state"]
    assert ctl(*options, "gaps").out == ctl("gaps", *options).out == "no gaps\n"


def test_flag_goes_before_environment_before_file(
    ctl: Ctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dcam.toml").write_text(f'{CONFIG}\n[storage]\ndirectory = "of-file"\n')
    monkeypatch.setenv("DCAM_CONFIG", str(tmp_path / "dcam.toml"))
    assert "of-file/dcam.db: no database" in ctl("gaps").err
    monkeypatch.setenv("DCAM_STATE", str(tmp_path / "of-environment"))
    assert "of-environment/dcam.db: no database" in ctl("gaps").err
    assert "of-flag/dcam.db: no database" in ctl("--state", tmp_path / "of-flag", "gaps").err


def test_a_missing_config_is_exit_code_3(ctl: Ctl, tmp_path: Path) -> None:
    ran = ctl("--config", tmp_path / "nowhere.toml", "check")
    assert ran.code == 3
    assert "no such file" in ran.err


@pytest.mark.parametrize("program", [ctl_cli, dcamd_cli])
def test_a_config_that_is_a_directory_is_exit_code_3(
    program: click.Command, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["check"] if program is ctl_cli else []
    assert run(program, "dcam", ["--config", str(tmp_path), *words]) == 3
    assert "Is a directory" in capfd.readouterr().err


@pytest.mark.parametrize("program", [ctl_cli, dcamd_cli])
@pytest.mark.parametrize("fault", ["a file", "below a file", "closed"])
def test_a_state_that_cannot_be_read_is_exit_code_4(
    program: click.Command,
    fault: str,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    state = {"a file": "dcam.toml", "below a file": "dcam.toml/state", "closed": "."}[fault]
    if fault == "closed":  # root, who may run the tests, can read whatever the mode says
        monkeypatch.setattr("daemon.commands.options.os.access", lambda _path, _mode: False)
    options = ["--config", str(tmp_path / "dcam.toml"), "--state", str(tmp_path / state)]
    words = ["gaps"] if program is ctl_cli else ["--max-slots", "1"]
    assert run(program, "dcam", [*options, *words]) == 4
    (line,) = capfd.readouterr().err.splitlines()
    cures = {
        "a file": "not a directory; name another --state",
        "below a file": "dcam.toml is not a directory: name another path",
        "closed": "may not: check its permissions",
    }
    assert cures[fault] in line


def test_debug_shows_where_an_error_came_from(ctl: Ctl, tmp_path: Path) -> None:
    assert "Traceback" not in ctl("--config", tmp_path / "x", "check").err
    assert "Traceback" in ctl("--debug", "--config", tmp_path / "x", "check").err


def test_on_a_terminal_headings_are_bold_and_no_color_is_honoured(tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(CONFIG)
    command = program("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "check")
    coloured, plain = (
        on_terminal(80, command, TERM="xterm-256color", **more) for more in ({}, {"NO_COLOR": "1"})
    )
    assert "\x1b[1mwhat" in coloured
    assert "\x1b[3" not in plain


def test_check_tells_what_is_and_what_to_do(ctl: Ctl, tmp_path: Path) -> None:
    """A new site without cameras in its config: usable for frame sets, with warnings."""
    (tmp_path / "dcam.toml").write_text(CONFIG)
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "check")
    assert ran.code == 0
    lines = {line.split("  ")[0]: line for line in ran.out.splitlines()}
    assert "ok" in lines["config"]
    assert "4.14 px/mm" in lines["main image"]
    assert "warning" in lines["database"]
    assert "enough for calibrate --from" in lines["cameras"]
    assert not (tmp_path / "state").exists()


@pytest.mark.parametrize(
    ("alarm", "code", "said"),
    [
        ("", 0, "warning  nobody is notified when data stop: name urls or a command in [alarm]"),
        ('urls = ["ntfy://ntfy.sh/secret"]', 0, "ok       tells urls[0] (ntfy) of what"),
        (
            'urls = ["ntfy://ntfy.sh/secret", "mailto:/oops-secret"]',
            *(3, "error    alarm.urls[1] (mailto): Apprise cannot use it"),
        ),
        ('urls = ["secret"]', 3, "error    alarm.urls[0] (no scheme): Apprise cannot use it"),
        ('command = ["no-such-secret"]', 3, "error    alarm.command[0]: no such program in PATH"),
        ('command = ["/secret/sms"]', 3, "error    alarm.command[0]: there is no such program"),
        ('command = ["/etc/passwd", "secret"]', 3, "alarm.command[0]: the program is not exec"),
        ('command = ["/bin/true", "secret"]', 0, "ok       tells command of what is critical"),
    ],
)
def test_check_says_who_is_notified_and_never_repeats_a_secret(
    ctl: Ctl, tmp_path: Path, alarm: str, code: int, said: str
) -> None:
    (tmp_path / "dcam.toml").write_text(f"{CONFIG}\n[alarm]\n{alarm}\n")
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "check")
    assert ran.code == code
    assert any(said in line for line in ran.out.splitlines() if line.startswith("alarm "))
    assert "secret" not in ran.out + ran.err
    assert "/etc/passwd" not in ran.out + ran.err


def test_check_warns_of_secrets_that_all_may_read(ctl: Ctl, tmp_path: Path) -> None:
    config = tmp_path / "dcam.toml"
    config.write_text(f'{CONFIG}\n[alarm]\nurls = ["ntfy://ntfy.sh/secret"]\n')
    warning = f"alarm           warning  {config} may hold a password, and all may read it"
    cure = f"chown root:dcam {config} && chmod 640 {config}"
    for mode, warned in ((0o644, True), (0o640, False)):
        config.chmod(mode)
        ran = ctl("--config", config, "--state", tmp_path / "state", "check")
        assert ran.code == 0
        assert (
            any(line.split() == f"{warning}: {cure}".split() for line in ran.out.splitlines())
        ) == warned


def test_check_warns_when_the_drift_takes_the_target_out_of_the_image(
    ctl: Ctl, tmp_path: Path
) -> None:
    (tmp_path / "dcam.toml").write_text(f"{CONFIG}\n[quality]\nexpected_drift_mrad = 9.0\n")
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "check")
    (line,) = (line for line in ran.out.splitlines() if line.startswith("main image"))
    assert "warning" in line


@pytest.mark.parametrize(
    ("drawn", "state"), [("[0, 0, 0]", "warning"), ("[50, 0, 90]", "warning"), ("[0, 90, 0]", "ok")]
)
def test_check_warns_of_cameras_drawn_looking_the_same_way(
    ctl: Ctl, tmp_path: Path, drawn: str, state: str
) -> None:
    (tmp_path / "dcam.toml").write_text(CONFIG.replace("[0.0, 180.0, 0.0]", drawn))
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "check")
    (line,) = (line for line in ran.out.splitlines() if line.startswith("rig "))
    assert line.split()[1] == state
    assert ("the same way" in line) == (state == "warning")


def test_check_of_a_damaged_database_is_exit_code_5(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(CONFIG)
    (tmp_path / "dcam.db").write_bytes(b"no database" * 1000)
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path, "check", "--json")
    assert ran.code == 5
    assert '"state": "error"' in ran.out


def test_check_of_the_hardware_takes_a_pair(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(SIMULATED)
    arguments = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    ran = ctl(*arguments, "check", "--hardware")
    assert ran.code == 0
    assert "640x400 px, 8 bits" in ran.out
    assert "0.00 ms apart" in ran.out


def test_check_of_hardware_that_is_not_there_is_exit_code_4(ctl: Ctl, tmp_path: Path) -> None:
    lost = '[[simulation.scenarios]]\nkind = "camera_loss"\nrole = "sub"\n'
    (tmp_path / "dcam.toml").write_text(SIMULATED + lost)
    arguments = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    ran = ctl(*arguments, "check", "--hardware")
    assert ran.code == 4
    assert "not there; check its cable and power" in ran.out
    assert ctl(*arguments, "capture").code == 4


@pytest.mark.parametrize(
    ("drawn", "what"),
    [
        (("[0.0, 180.0, 0.0]", "[0.0, 0.0, 0.0]"), "back to back is rig.rotation_main_sub_deg"),
        (("-80.0]", "-8000.0]"), "8 m between the cameras"),
        (("-80.0]", "80.0]"), "the board is in front of the main camera"),
    ],
)
def test_check_warns_of_an_unusual_rig_and_says_what_to_write(
    ctl: Ctl, tmp_path: Path, drawn: tuple[str, str], what: str
) -> None:
    """A warning: a rig may be built like that."""
    (tmp_path / "dcam.toml").write_text(CONFIG.replace(*drawn))
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "check")
    assert ran.code == 0
    (line,) = (line for line in ran.out.splitlines() if line.startswith("rig "))
    assert line.split()[1] == "warning"
    assert what in line
