"""What is wrong in a section that may be left out is said in one line with its key."""

import re

import pytest

from tests.daemon.config.conftest import problems_of


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        ("[schedule]\nperiod_s = 0", "schedule.period_s: must be at least 1"),
        ("[schedule]\nperiod_s = 0.5", "schedule.period_s: must be a whole number"),
        ("[schedule]\noffset_s = 60", "schedule.offset_s: must be less than period_s = 60"),
        ("[schedule]\nmax_late_s = 0", "schedule.max_late_s: must be greater than 0"),
        (
            "[schedule]\nburst = 3\nburst_spacing_s = 0.004",
            "schedule.burst_spacing_s: must be longer than the exposure of 0.005 s, is 0.004",
        ),
        (
            "[schedule]\nburst = 32\nburst_spacing_s = 1.0",
            "schedule.burst: 32 pairs 1 s apart may take 33 s .* have half of period_s = 60",
        ),
        (
            "[schedule]\nburst = 29\n[exposure]\nmode = 'auto'\nmain_limits_us = [50.0, 1.9e6]",
            "schedule.burst_spacing_s: must be longer than the exposure of 1.9 s, is 0.5",
        ),
        (
            '[pan_tilt]\nport = "tcp://10.0.0.3:4000"',
            r'pan_tilt.port: "tcp://10.0.0.3:4000" has no way .* socket://HOST:PORT or rfc2217://',
        ),
        (
            '[pan_tilt]\nport = "socket://10.0.0.3"',
            "pan_tilt.port: .* needs host and port number, as socket://192.168.1.20:4000",
        ),
        (
            '[pan_tilt]\nport = "rfc2217://10.0.0.3:99999"',
            "pan_tilt.port: .* needs host and port number, as rfc2217://",
        ),
        (
            '[pan_tilt]\nport = "rfc2217://10.0.0.3:4000?logging=debug"',
            "pan_tilt.port: .* says more than host and port number",
        ),
        (
            "[pan_tilt]\npan_limits_deg = [5.0, -5.0]",
            r"pan_tilt.pan_limits_deg: the lower limit first, is \[5, -5\]",
        ),
        (
            "[pan_tilt]\nhome_deg = [1.0, 7.0]",
            r"pan_tilt.home_deg: tilt 7 is not within tilt_limits_deg = \[-5, 5\]",
        ),
        ("[exposure]\nmain_us = 0.005", "exposure.main_us: .* is this in milliseconds"),
        ("[exposure]\nsub_us = 3e6", r"exposure: 3e\+06 us are not over within trigger.timeout_s"),
        ("[exposure]\nwhite_level = 0.9", r"exposure.white_level: must be at most 0\.75"),
        (
            "[exposure]\nmode = 'auto'\nmain_us = 20.0",
            r"exposure.main_us: 20 is not within main_limits_us = \[50, 100000\]",
        ),
        (
            "[exposure]\nmode = 'auto'\nmain_gain_db = 20.0",
            r"exposure.main_gain_db: 20 is not within main_gain_limits_db = \[0, 12\]",
        ),
        (
            "[exposure]\nmode = 'auto'\nsub_limits_us = [9e4, 50.0]",
            "exposure.sub_limits_us: the lower limit first",
        ),
        (
            "[exposure]\nmode = 'auto'\nsub_gain_limits_db = [3.0, 1.0]",
            "exposure.sub_gain_limits_db: the lower limit first",
        ),
        (
            "[exposure]\nmode = 'auto'\nsub_limits_us = [50.0, 3e6]",
            r"exposure: 3e\+06 us are not over within trigger.timeout_s = 2",
        ),
        ("[log]\nlevel = 'loud'", "log.level: must be one of"),
        ("[storage]\ndir = '/tmp'", "storage.dir: unknown key; did you mean storage.directory"),
        (
            "[simulation]\nstart_utc = 2026-03-01T00:00:00",
            "simulation.start_utc: must be a time in",
        ),
        ("[simulation]\nstart_utc = 'noon'", "simulation.start_utc: must be a time in UTC such as"),
        (
            "[[simulation.scenarios]]\nkind = 'fog'",
            r"simulation.scenarios\[0\].kind: must be one of .*'snow'",
        ),
        (
            "[[simulation.scenarios]]\nkind = 'snow'\nstart_m = 3",
            r"simulation.scenarios\[0\].start_m: unknown key; did you mean .*\.start_min",
        ),
        (
            "[[simulation.scenarios]]\nkind = 'snow'\nstart_min = 3\nend_min = 3",
            r"simulation.scenarios\[0\].end_min: must be greater than start_min = 3, is 3",
        ),
        (
            "[simulation]\nbridge_course = [[5.0, 0.0], [5.0, -6.5]]",
            "simulation.bridge_course: each point must be later than the one before",
        ),
        ("[wifi]\nport = 80", "wifi: unknown key; known here"),
        ("[web]\nhost = 'pier'", 'web.host: "pier" is no address; write "127.0.0.1"'),
        ("[web]\ntoken = 'short'", "web.token: must have at least 16 characters"),
        (
            "[web]\nhost = '0.0.0.0'\nhosts = ['pier-3']",
            "web.token: missing; whoever reaches 0.0.0.0 could look",
        ),
        (
            "[web]\nhost = '::'\ntoken_file = 'token'",
            "web.hosts: missing; list the names or addresses",
        ),
        ("[web]\nhosts = ['a b']", "web.hosts.*not shown"),
    ],
)
def test_optional_sections_are_checked_as_well(write, extra: str, expected: str) -> None:
    (problem,) = problems_of(write(extra=extra))
    assert re.match(expected, problem), problem
