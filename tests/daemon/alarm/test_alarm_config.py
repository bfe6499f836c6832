"""What can be wrong in the alarms of a config is one line that says what to write."""

from __future__ import annotations

import pytest

from tests.daemon.alarm.conftest import LOW, Program, configure, listed, look, row
from tests.daemon.commands.conftest import MINUTE, Site

RATE = '[[alarm.rate]]\nname = "sinks"\nlimit_mm_per_day = 1.0\n'
HOT = '[[alarm.reading]]\nname = "hot"\nreading = "temperature-main"\nabove = 60.0\n'


@pytest.mark.parametrize(
    ("alarm", "said"),
    [
        (f"{LOW}abov_mm = 3.0", "alarm.value[0].abov_mm: unknown key; did you mean"),
        (f"{LOW}above_mm = -11.0", "alarm.value[0].below_mm: must be less than above_mm = -11"),
        (LOW.replace("below_mm = -10.0", ""), "alarm.value[0].above_mm: missing; give above_mm"),
        (f'{LOW}target = "span-9"', "alarm.value[0].target: 'span-9' is no target; measured are"),
        (f"{LOW}{LOW}", "alarm.value[1].name: 'midspan-low' is the name of another alarm"),
        (LOW.replace("midspan-low", "disk"), "alarm.value[0].name: 'disk' is the name of"),
        (LOW.replace("-10.0", '"low"'), "alarm.value[0].below_mm: must be a number, is 'low'"),
        (f"{LOW}dwell_min = 0", "alarm.value[0].dwell_min: must be greater than 0"),
        (RATE.replace("1.0", "-1.0"), "alarm.rate[0].limit_mm_per_day: must be greater than 0"),
        (HOT.replace("temperature-main", "deck"), "alarm.reading[0].reading: there is no reading"),
        ('warnings = ["disc"]', "alarm.warnings: 'disc' is no alarm of every site; they are"),
    ],
)
def test_one_line_says_what_is_wrong(site: Site, alarm: str, said: str) -> None:
    configure(site, alarm)
    ran = site.ctl("check")
    assert ran.code == 3, ran.out
    (line,) = ran.err.splitlines()
    assert said in line


def test_a_wrong_alarm_on_the_value_is_told_to_those_who_must_know(
    site: Site, program: Program
) -> None:
    configure(site, f"command = {program.command}\nafter_min = 0\n{LOW}target = 'span-9'")
    look(site)
    assert "'span-9' is no target" in program.messages()[0]


def test_check_says_what_each_alarm_watches_and_what_will_surprise(site: Site) -> None:
    configure(site, f'command = ["true"]\n{LOW}dwell_min = 2\n{RATE}window_h = 24\n{HOT}')
    lines = [line for line in site.ctl("check").out.splitlines() if line.startswith("alarm ")]
    told = " ".join(" ".join(lines).split())
    assert "warning midspan-low: main y below -10 mm over 2 min, critical: 3 rows" in told
    assert "warning sinks: main y beyond 1 mm/d over 24 h, critical: the way up or down" in told
    assert "ok hot: temperature-main above 60 over 15 min, warning" in told


def test_alarms_are_judged_where_nobody_is_to_tell(site: Site) -> None:
    """The page and `alarm list` show them all the same."""
    configure(site, LOW)
    site.measure(5, row(-11.0))
    look(site, late=MINUTE)
    assert listed(site)["midspan-low"]["state"] == "raised"
