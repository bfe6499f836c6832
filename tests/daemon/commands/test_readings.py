"""Sensors as `check`, `status`, `metrics`, `export`, `plot` and `report` tell of them."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from xml.etree import ElementTree as ET

from prometheus_client.parser import text_string_to_metric_families

from daemon.store.records import READING_FAILED, CameraState, Reading
from tests.daemon.commands.conftest import MINUTE, SIMULATED, START, Ctl, Site

AIR = Reading("air", "degC", 21.5)
DECK = Reading("deck", "degC", None, "no answer within 5 s")
MOIST = Reading("moist", "percent", 63.0)
NAMED = '[[reading]]\nname = "{}"\nunit = "degC"\n{}\n'


def item(site: Site, late=MINUTE / 2) -> dict[str, str] | None:
    items = json.loads(site.status(late).out)["items"]
    return next((one for one in items if one["name"] == "readings"), None)


def test_check_reads_each_sensor_once(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "temp1_input").write_text("21562\n")
    (tmp_path / "dcam.toml").write_text(
        SIMULATED
        + NAMED.format("air", 'file = "temp1_input"\nscale = 0.001')
        + NAMED.format("deck", 'command = ["/bin/false"]')
        + NAMED.format("hot", 'command = ["/bin/echo", "85"]\nmax = 60.0')
        + NAMED.format("none", 'modbus = "tcp://127.0.0.1:1?register=30001&type=int16"')
    )
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "s", "check", "--json")
    found = {
        one["name"]: (one["state"], one["text"])
        for one in json.loads(ran.out)["findings"]
        if one["name"].startswith("reading ")
    }
    advice = f"look at the sensor and at [[reading]] in {tmp_path}/dcam.toml"
    assert found == {
        "reading air": ("ok", "21.562 degC"),
        "reading deck": ("warning", f"false: ended with code 1: {advice}"),
        "reading hot": ("warning", f"outside limits (85 degC): {advice}"),
        "reading none": ("warning", f"127.0.0.1:1: nothing answers there: {advice}"),
    }
    assert ran.err == ""


def test_status_warns_of_a_reading_without_a_value(site: Site) -> None:
    """With its cause and since when; without sensors there is no line."""
    assert item(site) is None
    site.measure(1, readings=(AIR, MOIST), main_camera=CameraState(temperature_c=41.5))
    assert item(site)["level"] == "ok"
    assert item(site)["text"] == "air 21.5 degC; moist 63 percent"
    site.measure(1, readings=(AIR, DECK), main_camera=CameraState(temperature_c=41.5))
    site.write(lambda store: store.add_event(START, READING_FAILED, "deck: another cause"))
    site.write(lambda store: store.add_event(START + MINUTE, READING_FAILED, "deckhouse: x"))
    assert item(site)["level"] == "warning"
    assert item(site)["text"] == (
        "deck without a value since 2026-03-01T00:00:00Z: no answer within 5 s; air 21.5 degC"
    )
    document = json.loads(site.status().out)
    assert document["level"] == "warning"
    assert document["temperatures_c"] == {"main": 41.5, "sub": None}
    assert document["readings"] == [
        {"name": "air", "unit": "degC", "value": 21.5, "cause": "", "failed_since_utc": None},
        {
            "name": "deck",
            "unit": "degC",
            "value": None,
            "cause": "no answer within 5 s",
            "failed_since_utc": "2026-03-01T00:00:00Z",
        },
    ]


def test_status_tells_of_a_sensor_that_dcamd_does_not_know_yet(site: Site) -> None:
    site.config.write_text(SIMULATED + NAMED.format("air", 'file = "/x"'))
    assert item(site)["level"] == "warning"
    assert item(site)["text"] == "air not read yet: dcam-ctl reload"


def test_metrics_have_a_gauge_for_each_reading_with_a_value(site: Site) -> None:
    site.measure(1, readings=(AIR, DECK, MOIST))
    text = site.ctl("metrics", "--at", site.end.isoformat()).out
    samples = {
        (sample.labels["name"], sample.labels["unit"]): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
        if sample.name == "dcam_reading"
    }
    assert samples == {("air", "degC"): 21.5, ("moist", "percent"): 63.0}


def test_export_has_a_column_for_each_reading(site: Site) -> None:
    """Rows from before have none; a record without any has no such columns."""
    plain = site.ctl("export").out
    assert "reading" not in plain
    site.measure(1, readings=(AIR, DECK))
    *_, before, last = csv.DictReader(io.StringIO(site.ctl("export").out))
    names = ("reading_air", "reading_deck", "readings_missing")
    assert [last[name] for name in names] == ["21.5", "", "deck: no answer within 5 s"]
    assert [before[name] for name in names] == ["", "", ""]
    until = (site.end - MINUTE).isoformat()
    assert site.ctl("export", "--until", until).out == plain


def panels(site: Site, output: Path) -> int:
    assert site.ctl("plot", "--output", output).code == 0
    groups = ET.parse(output).getroot().iter("{http://www.w3.org/2000/svg}g")
    return len([group for group in groups if group.get("id", "").startswith("axes_")])


def test_plot_has_a_panel_for_each_unit(site: Site, tmp_path: Path) -> None:
    assert panels(site, tmp_path / "a.svg") == 4
    site.measure(2, main_camera=CameraState(temperature_c=41.5))
    assert panels(site, tmp_path / "b.svg") == 5
    site.measure(2, readings=(AIR, DECK))
    assert panels(site, tmp_path / "c.svg") == 5
    site.measure(2, readings=(MOIST,))
    assert panels(site, tmp_path / "d.svg") == 6


def test_report_sums_the_readings_up(site: Site, tmp_path: Path) -> None:
    site.measure(1, readings=(AIR, DECK), sub_camera=CameraState(temperature_c=39.0))
    site.measure(1, readings=(Reading("air", "degC", -8.5),))
    assert site.ctl("report", "--output", tmp_path / "a.html").code == 0
    page = (tmp_path / "a.html").read_text()
    table = page[page.index("Temperatures and other readings") :].partition("</table>")[0]
    cells = [row.split("</td>") for row in table.split("<tr>")[2:]]
    read = [[cell.rpartition(">")[2].strip() for cell in row[:-1]] for row in cells]
    assert read == [
        ["sub-camera", "degC", "1", "39", "39", "39"],
        ["air", "degC", "2", "6.5", "-8.5", "21.5"],
    ]
