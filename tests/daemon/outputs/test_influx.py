"""Line protocol over HTTP: each row is one point, whatever the server does; text stays whole."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.config.outputs import InfluxSection
from daemon.outputs.influx import InfluxOutput
from daemon.outputs.line_protocol import line
from daemon.outputs.output import NotTakenError
from daemon.outputs.sender import Sender
from tests.daemon.outputs.conftest import Follow, Record
from tests.daemon.outputs.servers import Points, points_server
from tests.daemon.store.examples import START
from tests.waiting import wait_for


@pytest.fixture
def points() -> Iterator[Points]:
    with points_server() as made:
        yield made


def output(points: Points, **more: object) -> InfluxOutput:
    url = f"http://127.0.0.1:{points.port}"
    settings = {"url": url, "bucket": "bridge", "org": "city", "batch": 7, **more}
    return InfluxOutput(InfluxSection(**settings), "pier 3")


def main_points(points: Points) -> list[tuple[str, int]]:
    """Measurement with tags, and time, of what was stored of the main target, repeats too."""
    found = [stored.rpartition(" ")[0::2] for stored in points.lines]
    keys = [(head.split(" flag")[0], int(when)) for head, when in found]
    return [key for key in keys if "point=main" in key[0]]


def test_each_row_is_one_point_whatever_the_server_does(
    points: Points, kept: Record, follow: Follow
) -> None:
    """It fails, stores without answering, is away, and comes back."""
    kept.add(40)
    points.refuse = [503, 429, 500, 401]  # each is tried again: the last may be put right
    points.forget_to_answer = 3
    follow(kept, output(points))
    wait_for(lambda: len(set(main_points(points))) >= 40, "the first rows")
    points.stop()
    kept.add(20)
    points.start()
    wait_for(lambda: len(set(main_points(points))) >= 60, "the others")
    found = main_points(points)
    minutes = [1772323200 + 60 * minute for minute in range(60)]
    assert [when for _, when in dict.fromkeys(found)] == minutes
    repeats = len(found) - 60
    assert 1 <= repeats <= 3 * 7  # what was stored without an answer, and nothing else


def test_a_further_target_is_a_point_of_its_own(points: Points, kept: Record) -> None:
    kept.add(full=True)
    Sender(kept.state, output(points)).send_all()
    main, *further = points.lines
    assert main.startswith(r"dcam,point=main,site=pier\ 3 flag=3i,")
    assert 'reasons="too_dark+main_target_partly_hidden"' in main
    assert ",x_mm=0.1," in main
    assert {stored.split(" flag")[0] for stored in further} == {
        r"dcam,point=quarter-span,role=measured,site=pier\ 3",
        r"dcam,point=abutment,role=fixed,site=pier\ 3",
    }


def test_where_it_is_written_and_with_which_right(
    points: Points, kept: Record, tmp_path: Path
) -> None:
    """Version 2 with a token, version 1 and VictoriaMetrics with a password; both from a file."""
    kept.add()
    secret = tmp_path / "secret"
    secret.write_text("s3cret\n")
    Sender(kept.state, output(points, token_file=secret)).send_all()
    more = {"bucket": None, "org": None, "database": "bridges"}
    named = output(points, **more, username="dcam", password_file=secret)
    Sender(kept.state, named, again_since=START).send_all()
    (path, headers), (old_path, old_headers) = points.requests
    assert path == "/api/v2/write?org=city&bucket=bridge&precision=s"
    assert headers["Authorization"] == "Token s3cret"
    assert old_path == "/write?db=bridges&precision=s"
    assert old_headers["authorization"].startswith("Basic ")


def test_what_the_server_refuses_is_said_and_kept(points: Points, kept: Record) -> None:
    kept.add()
    points.refuse = [400]
    with pytest.raises(NotTakenError, match="HTTP 400: try later"):
        Sender(kept.state, output(points)).send_all()
    assert Sender(kept.state, output(points)).send_all() == 1


def test_a_server_that_is_away_is_said_in_one_line(points: Points, kept: Record) -> None:
    kept.add()
    points.stop()
    with pytest.raises(NotTakenError, match=r"influx.url: http://.*[Rr]efused") as caught:
        Sender(kept.state, output(points)).send_all()
    assert "object at" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "as_tag", "as_field"),
    [
        ("plain", "plain", '"plain"'),
        ("a b,c=d", r"a\ b\,c\=d", '"a b,c=d"'),
        ('say "no"', r'say\ "no"', r'"say \"no\""'),
        ("ends in \\", "ends\\ in\\ \\\\ ", '"ends in \\\\"'),
        ("two\nlines", r"two\ lines", '"two lines"'),
        ("Brücke 桥", r"Brücke\ 桥", '"Brücke 桥"'),
    ],
)
def test_any_text_stays_one_tag_and_one_field(text: str, as_tag: str, as_field: str) -> None:
    written = line("dcam", {"site": text}, {"reasons": text}, 0)
    assert written == f"dcam,site={as_tag} reasons={as_field} 0"
    assert "\n" not in written


def test_numbers_are_as_exact_as_in_the_database() -> None:
    fields = {"x": 0.1 + 0.2, "y": 1e-9, "flag": 3, "late": True}
    written = line("m", {}, fields, 1772323200)
    assert written == "m x=0.30000000000000004,y=1e-09,flag=3i,late=true 1772323200"
