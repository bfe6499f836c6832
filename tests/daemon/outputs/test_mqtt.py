"""MQTT through a real broker: each row once, whatever is cut; what Home Assistant is told."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from pathlib import Path

import paho.mqtt.client as mqtt
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from daemon.config.outputs import MqttSection
from daemon.outputs.mqtt import MqttOutput
from tests.daemon.outputs.conftest import Follow, Record
from tests.daemon.outputs.servers import Broker, Wire
from tests.daemon.store.examples import slot
from tests.waiting import wait_for

SITE = "pier-3"
SEED = 20261128


class Subscriber:
    """Keeps whatever arrives, in order; its session outlives cuts."""

    def __init__(self, port: int, topic: str, ca_file: Path | None = None) -> None:
        self.messages: list[tuple[str, bytes, bool]] = []
        self._client = mqtt.Client(
            CallbackAPIVersion.VERSION2, client_id="archive", clean_session=False
        )
        self._client.reconnect_delay_set(1, 1)
        if ca_file is not None:
            self._client.tls_set(str(ca_file))
        self.is_ready = False
        self._client.on_connect = lambda client, *_: client.subscribe(topic, qos=2)
        self._client.on_subscribe = self._ready
        self._client.on_message = self._keep
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        wait_for(lambda: self.is_ready, "the subscription")

    def _ready(self, *_: object) -> None:
        self.is_ready = True

    def _keep(self, _client: object, _data: object, message: mqtt.MQTTMessage) -> None:
        self.messages.append((message.topic, message.payload, message.retain))

    def of(self, topic: str) -> list[dict[str, object]]:
        return [json.loads(payload) for name, payload, _ in self.messages if name == topic]

    @property
    def slots(self) -> list[object]:
        return [row["slot_utc"] for row in self.of(f"dcam/{SITE}/row")]

    def close(self) -> None:
        self._client.disconnect()
        self._client.loop_stop()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    directory = tmp_path / "broker"
    directory.mkdir()
    made = Broker(directory)
    yield made
    made.stop()


@pytest.fixture
def archive(broker: Broker) -> Iterator[Subscriber]:
    made = Subscriber(broker.port, "#")
    yield made
    made.close()


@pytest.fixture
def wire(broker: Broker) -> Iterator[Wire]:
    made = Wire(broker.port)
    yield made
    made.close()


def output(port: int, **more: object) -> MqttOutput:
    settings = MqttSection(host="127.0.0.1", port=port, **{"history": True, **more})
    return MqttOutput(settings, SITE, period_s=60)


def test_each_row_once_although_the_connection_is_cut_twenty_times(
    wire: Wire, archive: Subscriber, kept: Record, follow: Follow
) -> None:
    """A subscriber that sorts nothing out gets every row, once, in the order of writing."""
    cuts, moments = 20, random.Random(SEED)
    kept.add(60)
    sender = follow(kept, output(wire.port))
    for number in range(cuts):
        kept.add(10)
        until = wire.passed + moments.randrange(1, 4000)
        wait_for(
            lambda until=until: wire.passed >= until or sender.sent == len(kept.slots),
            f"something to cut, {number}",
        )
        wire.cut()
    wait_for(lambda: sender.sent >= len(kept.slots), "all rows to be sent")
    wait_for(lambda: len(archive.slots) >= len(kept.slots), "all rows to arrive")
    kept.add()
    wait_for(lambda: archive.slots[-1:] == kept.slots[-1:], "the last row")
    assert archive.slots == kept.slots


def test_no_row_is_lost_although_the_broker_is_restarted(
    broker: Broker, archive: Subscriber, kept: Record, follow: Follow
) -> None:
    """What a broker remembers of its subscribers is its own: mosquitto 2.0.11 repeats some rows."""
    sender = follow(kept, output(broker.port))
    for number in range(5):
        kept.add(10)
        wait_for(lambda number=number: sender.sent > 10 * number, f"a row to be sent, {number}")
        broker.restart()
    wait_for(lambda: sender.sent >= len(kept.slots), "all rows to be sent")
    wait_for(lambda: set(archive.slots) == set(kept.slots), "all rows to arrive")


def test_late_rows_are_sent_and_the_newest_stays_the_newest(
    broker: Broker, archive: Subscriber, kept: Record, follow: Follow
) -> None:
    follow(kept, output(broker.port))
    kept.add(3)
    wait_for(lambda: archive.slots == kept.slots, "the first rows")
    kept.add(at=slot(-100))
    wait_for(lambda: archive.slots == kept.slots, "the late row")
    latest = {row["slot_utc"] for row in archive.of(f"dcam/{SITE}/latest")}
    assert kept.slots[2] in latest
    assert kept.slots[3] not in latest


def test_a_row_has_everything_in_the_units_of_an_export(
    broker: Broker, archive: Subscriber, kept: Record, follow: Follow
) -> None:
    kept.add(full=True)
    follow(kept, output(broker.port))
    wait_for(lambda: bool(archive.slots), "a row")
    (row,) = archive.of(f"dcam/{SITE}/row")
    assert row["x_mm"] == 0.1
    assert row["flag"] == 3
    assert row["quality"] == "suspect"
    assert row["reasons"] == ["too_dark", "main_target_partly_hidden"]
    assert {target["name"] for target in row["targets"]} == {"quarter-span", "abutment"}


def test_without_history_a_new_broker_gets_only_what_comes(
    broker: Broker, archive: Subscriber, kept: Record, follow: Follow
) -> None:
    kept.add(5)
    follow(kept, output(broker.port, history=False))
    wait_for(lambda: bool(archive.of(f"dcam/{SITE}/latest")), "the newest row")
    kept.add(2)
    wait_for(lambda: len(archive.slots) >= 2, "new rows")
    assert archive.slots == kept.slots[5:]


def test_who_listens_is_told_whether_the_sender_is_there(
    broker: Broker, wire: Wire, archive: Subscriber, kept: Record, follow: Follow
) -> None:
    """Its end, and a connection that breaks: the broker says it for it."""

    def said() -> list[str]:
        topic = f"dcam/{SITE}/status"
        return [payload.decode() for name, payload, _ in archive.messages if name == topic]

    kept.add()
    sender = follow(kept, output(wire.port))
    wait_for(lambda: said() == ["online"], "online")
    wire.cut()
    wait_for(lambda: said() == ["online", "offline", "online"], "offline and online")
    sender.stop.set()
    wait_for(lambda: said()[3:] == ["offline"], "the end")


def test_a_password_in_a_file_and_rights_that_are_missing(tmp_path: Path, kept: Record) -> None:
    """What the broker refuses is said, and no row is taken for sent."""
    from daemon.outputs.output import NotTakenError
    from daemon.outputs.sender import Sender

    directory = tmp_path / "strict"
    directory.mkdir()
    (directory / "acl").write_text("user dcam\ntopic write elsewhere/#\n")
    hashed = (
        "$7$101$TZMHpTDGBRKKwUcX$"
        "T3+8FbrEMbVJ8Bs9zdEbnCrCVJSNZr8nDF8ZWoWUWKmXE5vsYcqTvRK9TKBuS6MHyTBY/xVf9tM8qDaXGXMVkQ=="
    )
    (directory / "users").write_text(f"dcam:{hashed}\n")
    broker = Broker(directory, f"password_file {directory}/users\nacl_file {directory}/acl\n")
    secret = tmp_path / "secret"
    secret.write_text("wrong\n")
    kept.add()
    try:
        made = output(broker.port, username="dcam", password_file=secret)
        with pytest.raises(NotTakenError, match="refused: Not authorized"):
            Sender(kept.state, made).send_all()
        secret.unlink()
        made = output(broker.port, username="dcam", password_file=secret)
        with pytest.raises(NotTakenError, match=r"mqtt.password_file: .*No such file"):
            Sender(kept.state, made).send_all()
    finally:
        broker.stop()


def test_home_assistant_finds_the_site_by_itself(
    broker: Broker, archive: Subscriber, kept: Record, follow: Follow
) -> None:
    """Against https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload."""
    kept.add()
    follow(kept, output(broker.port, home_assistant=True))
    topic = f"homeassistant/device/dcam_{SITE}/config"
    wait_for(lambda: bool(archive.of(topic)), "the description")
    (found,) = archive.of(topic)
    assert set(found) <= {"device", "origin", "components", "availability", "qos"}
    assert found["device"]["identifiers"]
    assert found["origin"]["name"] == "dcam"
    wait_for(lambda: bool(archive.of(f"dcam/{SITE}/latest")), "the newest row")
    latest = archive.of(f"dcam/{SITE}/latest")[-1]
    identifiers = [component["unique_id"] for component in found["components"].values()]
    assert len(set(identifiers)) == len(identifiers)
    for component in found["components"].values():
        assert set(component) <= HOME_ASSISTANT_SENSOR, component
        assert component["platform"] == "sensor"
        assert component["state_topic"] == f"dcam/{SITE}/latest"
        field = component["value_template"].removeprefix("{{ value_json.").removesuffix(" }}")
        assert field in latest, component["value_template"]
    units = {
        key: (one["device_class"], one["unit_of_measurement"])
        for key, one in found["components"].items()
        if "unit_of_measurement" in one
    }
    assert units["x"] == ("distance", "mm")
    assert units["temperature_main"] == ("temperature", "°C")
    enumerated = found["components"]["quality"]
    assert latest["quality"] in enumerated["options"]
    assert "state_class" not in enumerated  # not allowed beside options


HOME_ASSISTANT_SENSOR = {
    *("platform", "name", "unique_id", "state_topic", "value_template", "expire_after"),
    *("device_class", "state_class", "unit_of_measurement", "suggested_display_precision"),
    "options",
}
"""Of the keys of https://www.home-assistant.io/integrations/sensor.mqtt/#configuration-variables."""
