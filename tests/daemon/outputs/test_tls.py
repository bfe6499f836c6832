"""Rows over TLS, to servers with real certificates: one that is not trusted costs no row."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from daemon.config.outputs import InfluxSection, MqttSection
from daemon.outputs.influx import InfluxOutput
from daemon.outputs.mqtt import MqttOutput
from daemon.outputs.output import NotTakenError, Output
from daemon.outputs.sender import Sender
from daemon.store.queries.arrivals import Arrival
from tests.daemon.outputs.conftest import Follow, Record
from tests.daemon.outputs.servers import Broker, Identity, Points, points_server
from tests.daemon.outputs.test_mqtt import Subscriber
from tests.waiting import wait_for

SITE = "pier-3"

# After a refused certificate paho leaves the socket to be closed by the interpreter.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")


@pytest.fixture
def ours(tmp_path: Path) -> Identity:
    """The server's."""
    return Identity.make(tmp_path, "server")


@pytest.fixture
def other(tmp_path: Path) -> Identity:
    """Somebody else's, of the same address."""
    return Identity.make(tmp_path, "other")


@pytest.fixture
def broker(tmp_path: Path, ours: Identity) -> Iterator[Broker]:
    directory = tmp_path / "broker"
    directory.mkdir()
    made = Broker(directory, f"certfile {ours.certificate}\nkeyfile {ours.key}\n")
    yield made
    made.stop()


@pytest.fixture
def archive(broker: Broker, ours: Identity) -> Iterator[Subscriber]:
    made = Subscriber(broker.port, "#", ours.certificate)
    yield made
    made.close()


@pytest.fixture
def points(ours: Identity) -> Iterator[Points]:
    with points_server(ours) as made:
        yield made


def to_broker(port: int, ca_file: Path | None, host: str = "127.0.0.1") -> MqttOutput:
    settings = MqttSection(host=host, port=port, tls=True, ca_file=ca_file, history=True)
    return MqttOutput(settings, SITE, period_s=60)


def to_points(port: int, ca_file: Path | None, host: str = "127.0.0.1") -> InfluxOutput:
    url = f"https://{host}:{port}"
    settings = InfluxSection(url=url, bucket="bridge", org="city", ca_file=ca_file)
    return InfluxOutput(settings, SITE)


def not_trusted_then_trusted(
    kept: Record, follow: Follow, wrong: Output, right: Output, stored: Callable[[], list[str]]
) -> None:
    """A wrong authority is said once however often it is tried; put right, each row comes once."""
    attempts = []

    def send(rows: Sequence[Arrival], latest: Arrival | None) -> None:
        attempts.append(len(rows))
        wrong_send(rows, latest)

    wrong_send, wrong.send = wrong.send, send
    kept.add(5)
    with capture_logs() as logs:
        sender = follow(kept, wrong)
        wait_for(lambda: len(attempts) >= 4, "four attempts")
        sender.stop.set()
    (said,) = [entry for entry in logs if entry["event"] == "not_sent"]
    assert "the server's certificate is refused: self" in said["why"]
    assert said["why"].endswith(f"{right.name}.ca_file names who must sign it")
    assert "\n" not in said["why"]
    assert stored() == []
    assert Sender(kept.state, right).send_all() == 5
    wait_for(lambda: len(stored()) >= 5, "the rows")
    assert stored() == kept.slots


def test_a_broker_whose_certificate_is_not_trusted_gets_its_rows_once_it_is(
    broker: Broker, archive: Subscriber, ours: Identity, other: Identity, kept: Record, follow
) -> None:
    wrong = to_broker(broker.port, other.certificate)
    right = to_broker(broker.port, ours.certificate)
    not_trusted_then_trusted(kept, follow, wrong, right, lambda: list(map(str, archive.slots)))


def test_a_database_whose_certificate_is_not_trusted_gets_its_points_once_it_is(
    points: Points, ours: Identity, other: Identity, kept: Record, follow: Follow
) -> None:
    def stored() -> list[str]:
        seconds = [int(line.rpartition(" ")[2]) for line in points.lines if "point=main" in line]
        moments = [datetime.fromtimestamp(one, UTC) for one in seconds]
        return [f"{moment:%Y-%m-%dT%H:%M:%SZ}" for moment in moments]

    wrong = to_points(points.port, other.certificate)
    right = to_points(points.port, ours.certificate)
    not_trusted_then_trusted(kept, follow, wrong, right, stored)


@pytest.mark.parametrize("name", ["mqtt", "influx"])
def test_a_certificate_of_another_name_or_of_nobody_that_debian_trusts_is_refused(
    name: str, broker: Broker, points: Points, ours: Identity, kept: Record
) -> None:
    make, port = {"mqtt": (to_broker, broker.port), "influx": (to_points, points.port)}[name]
    kept.add()
    with pytest.raises(NotTakenError, match=r"certificate is refused: Hostname mismatch"):
        Sender(kept.state, make(port, ours.certificate, "localhost")).send_all()
    with pytest.raises(NotTakenError, match=r"certificate is refused: self"):
        Sender(kept.state, make(port, None)).send_all()
    assert points.bodies == []


def test_a_connection_that_breaks_is_taken_up_again_over_tls(
    broker: Broker, archive: Subscriber, ours: Identity, kept: Record, follow: Follow
) -> None:
    """No row is lost; a broker that is restarted may repeat some of its own accord."""
    sender = follow(kept, to_broker(broker.port, ours.certificate))
    for number in range(3):
        kept.add(10)
        wait_for(lambda number=number: sender.sent > 10 * number, f"a row to be sent, {number}")
        broker.restart()
    wait_for(lambda: set(archive.slots) == set(kept.slots), "all rows to arrive")


def test_a_certificate_that_is_no_file_is_one_line(kept: Record, tmp_path: Path) -> None:
    kept.add()
    for output in (to_broker(1, tmp_path / "ca.pem"), to_points(1, tmp_path / "ca.pem")):
        with pytest.raises(NotTakenError) as failed:
            Sender(kept.state, output).send_all()
        assert str(failed.value) == f"{output.name}.ca_file: {tmp_path / 'ca.pem'}: no such file"
