"""From outside: a `sync` that is killed, all sites in one list, one site read like a pier."""

from __future__ import annotations

import json
import os
import signal
from datetime import UTC, datetime
from pathlib import Path

import pytest
from sqlalchemy import text

from benchmarks.record import fill
from daemon.alarm.memory import Memory, Raised, keep_memory
from daemon.ctl import cli
from daemon.error_report import run
from daemon.status.item import Level
from daemon.store.central.connecting import connect_central
from daemon.store.central.tables import MEASUREMENT
from tests.daemon.commands.imports import modules_of
from tests.daemon.fleet.conftest import Pier, sync
from tests.daemon.fleet.postgres import Proxy, Server
from tests.daemon.fleet.test_sync import rows_here, rows_there
from tests.laboratory import laboratory
from tests.programs import Program


@pytest.fixture
def config(server: Server, central: str, tmp_path: Path) -> Path:
    """A laboratory site with a central database."""
    path = tmp_path / "dcam.toml"
    path.write_text(with_url(server.url(central)))
    return path


def with_url(url: str) -> str:
    return (
        laboratory(640) + f'\n[alarm]\nurls = ["json://user:secret@host"]\n[fleet]\nurl = "{url}"\n'
    )


def site_name(config: Path) -> str:
    return config.read_text().split('name = "')[1].split('"')[0]


def ctl(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = run(cli, "dcam-ctl", list(map(str, words)))
    said = capsys.readouterr()
    return code, said.out, said.err


def test_a_sync_that_was_killed_in_the_middle_costs_nothing(
    server: Server,
    central: str,
    config: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    state = tmp_path / "one"
    fill(state, 2500)  # more than one transaction
    rows = len(rows_here(state, MEASUREMENT))
    program: list[Program] = []

    def none(_cuts: int) -> None:
        return None

    def kill() -> None:
        program[0].kill()

    line = Proxy(server.port, none, at_bytes=1_500_000, then=kill)
    config.write_text(with_url(server.url(central, line.port)))
    program.append(Program("daemon.ctl", "--config", config, "--state", state, "sync"))
    with program[0]:
        assert program[0].wait() == -signal.SIGKILL
    line.close()
    name = site_name(config)
    copied = len(rows_there(server.url(central), MEASUREMENT, name))
    assert copied < rows
    config.write_text(with_url(server.url(central)))
    code, _, err = ctl(capsys, "--config", config, "--state", state, "sync")
    assert (code, f"{rows - copied} rows" in err) == (0, True), err
    there = rows_there(server.url(central), MEASUREMENT, name)
    assert there == rows_here(state, MEASUREMENT)


def test_sites_are_listed_worst_first(
    server: Server, central: str, pier: Pier, config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, level in (("good", 0), ("ill", 1), ("silent", 0)):
        sync(server.url(central), pier(name, 1), name)
        database = connect_central(server.url(central), None)
        with database.transaction() as connection:
            said = {"level": level, "name": name}
            connection.execute(text("UPDATE site SET level = :level WHERE name = :name"), said)
            if name == "good":
                new = "UPDATE site SET last_slot_utc = now(), alarms = 2 WHERE name = :name"
                connection.execute(text(new), said)
            if name == "silent":
                late = "UPDATE site SET heard_utc = now() - interval '2 hours' WHERE name = :name"
                connection.execute(text(late), said)
        database.close()
    code, out, _ = ctl(capsys, "--config", config, "status", "--fleet", "--json")
    found = json.loads(out)
    assert [(one["site"], one["level"]) for one in found["sites"]] == [
        ("silent", "critical"),
        ("ill", "warning"),
        ("good", "ok"),
    ]
    assert code == found["code"] == 2
    assert found["sums"] == {
        "sites": 3,
        "measuring": 1,
        "stale": 1,
        "silent": 1,
        "alarms": 2,
        "sites_with_alarms": 1,
    }
    _, out, _ = ctl(capsys, "--config", config, "status", "--fleet")
    sums = "measuring: 1; no new rows: 1; not heard from: 1; with alarms: 1 (2 raised)"
    assert out.splitlines()[1] == sums
    assert out.startswith("DCAM CRITICAL - 3 sites: 1 ok, 1 warning, 1 critical\n")
    assert "not heard from for 2 h" in out


def test_the_list_loads_no_models_no_numerics_and_no_config_of_a_site(
    server: Server, central: str, tmp_path: Path
) -> None:
    """To load them took longer than to read 10,000 sites."""
    config = tmp_path / "centre.toml"
    config.write_text(f'[fleet]\nurl = "{server.url(central)}"\n')
    loaded = modules_of("--config", config, "status", "--fleet", code=Level.UNKNOWN)
    slow = {"sqlalchemy.orm", "daemon.store.schema", "numpy", "alembic", "daemon.config.model"}
    assert slow.isdisjoint(loaded)


def test_a_site_is_exported_from_the_centre_as_at_its_pier(
    pier: Pier,
    config: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    state, name = pier("one", 20), site_name(config)
    raised = Raised(id="1", level=Level.WARNING, text="full", at_utc=datetime.now(UTC))
    keep_memory(state, Memory(raised={"disk": raised}))
    assert ctl(capsys, "--config", config, "--state", state, "sync")[0] == 0
    (there,) = json.loads(ctl(capsys, "--config", config, "status", "--fleet", "--json")[1])[
        "sites"
    ]
    assert there["alarms"] == 1
    monkeypatch.setitem(os.environ, "DCAM_STATE", str(tmp_path / "elsewhere"))
    code, there, err = ctl(capsys, "--config", config, "export", "--site", name)
    assert code == 0, err
    _, here, _ = ctl(capsys, "--config", config, "--state", state, "export")
    assert there == here
    assert here.count("\n") == 21
    code, _, err = ctl(capsys, "--config", config, "export", "--site", "nobody")
    assert (code, name in err) == (2, True)
    shared = next((tmp_path / "cache").rglob("dcam.toml")).read_text()
    assert "secret" not in shared


def test_what_reads_a_record_reads_it_from_the_centre_alike(
    config: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    state, name = tmp_path / "one", site_name(config)
    fill(state, 300)
    levelled = tmp_path / "levelled.csv"
    levelled.write_text("time,y_mm,sigma_mm\n2026-03-01T02:00:00Z,-1.2,0.1\n")
    here, span = ["--config", config, "--state", state], ["--since", "2026-03-01"]
    said = ["ledger", "annotate", *span, "--until", "2026-03-02", "--by", "me", "slab cast"]
    assert ctl(capsys, *here, *said)[0] == 0
    assert ctl(capsys, *here, "sync")[0] == 0
    # Whoever reads needs the address alone.
    centre = tmp_path / "centre.toml"
    centre.write_text(f'[fleet]\nurl = "{config.read_text().split("url = ")[-1].strip()[1:-1]}"\n')
    commands = [
        *(["ledger"], ["ledger", "history"], ["gaps"], ["datum"], ["analyse"]),
        ["compare", "--reference", levelled],
    ]
    for words in commands:
        code, at_pier, err = ctl(capsys, *here, *words, "--json")
        assert code == 0, err
        found = ctl(capsys, "--config", centre, *words, "--site", name, "--json")
        assert (found[0], found[1]) == (0, at_pier), found[2]
    code, _, err = ctl(capsys, "--config", centre, "ledger", "--site", name, "undo", "1", "no")
    assert (code, "--site only reads" in err) == (2, True)
    code, out, _ = ctl(capsys, "--config", centre, "status", "--site", name, "--json")
    status = json.loads(out)
    assert (status["site"], status["last"]["slot_utc"]) == (name, "2026-03-01T04:59:00Z")
    assert code == status["code"] == 2  # no daemon runs there


def test_a_wrong_key_of_who_only_reads_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "centre.toml"
    path.write_text('[fleet]\nurll = "postgresql://dcam@central.example/dcam"\n')
    code, _, err = ctl(capsys, "--config", path, "gaps", "--site", "pier-1")
    assert (code, "fleet.urll" in err, "did you mean" in err.lower()) == (3, True, True), err
