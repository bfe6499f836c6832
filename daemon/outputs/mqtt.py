"""Rows to an MQTT broker, each once.

MQTT 5 at QoS 2: a message belongs to the broker when it has said so (PUBCOMP), and a connection
that breaks in between is taken up again with the same session and the same message. Where the
broker has lost its session, what it had not acknowledged is sent again: rather twice than never.
"""

from __future__ import annotations

import json
import ssl
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from daemon.config.outputs import MqttSection
from daemon.outputs.certificates import certificate_refused, missing_file
from daemon.outputs.home_assistant import discovery
from daemon.outputs.output import NotTakenError
from daemon.outputs.row_fields import row_fields, slug
from daemon.outputs.secret import read_secret
from daemon.plain import plain
from daemon.store.queries.arrivals import Arrival
from drivers.libraries import require_library

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessageInfo

IN_FLIGHT = 20
"""Rows on their way at the same time."""
KEEPALIVE_S = 30
CONNECT_S = 15.0
ACKNOWLEDGE_S = 60.0
"""Without any acknowledgement for so long the connection is taken for dead."""
SESSION_S = 7 * 86_400
"""How long the broker is to remember a connection that broke."""
_WAIT_S = 1.0
"""For something to arrive, before it is looked whether that takes too long."""

_TLS_FILES = ("ca_file", "cert_file", "key_file")
ONLINE, OFFLINE = "online", "offline"

_Key = tuple[int, str]


class MqttOutput:
    """Three topics below one name: `row` each row, `latest` the newest, `status` online or not."""

    name = "mqtt"
    batch = IN_FLIGHT

    def __init__(self, settings: MqttSection, site: str, *, period_s: int) -> None:
        """Raises MissingLibraryError."""
        require_library("paho", "MQTT", "paho-mqtt")
        self.history = settings.history
        self._settings, self._site, self._period_s = settings, site, period_s
        self._topic = settings.topic or f"dcam/{slug(site)}"
        self._client: Client | None = None
        self._flying: dict[_Key, MQTTMessageInfo] = {}
        self._answer: Any = None
        self._is_up = False
        self._knows_us = False
        self._done: dict[int, Any] = {}
        self._told: str | None = None

    def send(self, rows: Sequence[Arrival], latest: Arrival | None) -> None:
        """Publish rows and wait for their acknowledgement. Raises NotTakenError."""
        if self._client is not None and self._is_up:
            self._client.loop(0.0)  # what keeps the connection alive
        client = self._connected()
        if latest is not None and self._told != latest.slot:
            self._set(client, f"{self._topic}/latest", self._payload(latest))
            self._told = latest.slot
        for row in rows:
            key = (row.row_id, row.slot)
            if key not in self._flying:
                topic = f"{self._topic}/row"
                self._flying[key] = client.publish(
                    topic, self._payload(row), qos=self._settings.qos
                )
        self._await(client, rows)

    def close(self) -> None:
        """Say that nothing more comes, and disconnect; what is not acknowledged is sent again."""
        if self._client is not None and self._is_up:
            with suppress(NotTakenError):
                self._set(self._client, f"{self._topic}/status", OFFLINE)
        self._drop()

    def _payload(self, row: Arrival) -> bytes:
        return json.dumps(plain(row_fields(row, self._site)), ensure_ascii=False).encode()

    # Acknowledgements

    def _await(self, client: Client, rows: Sequence[Arrival]) -> None:
        """Wait until all rows are acknowledged. Raises NotTakenError with how many are."""
        for taken, row in enumerate(rows):
            sent = self._flying[row.row_id, row.slot]
            self._acknowledged(client, sent, f"{self._topic}/row", taken)
            del self._flying[row.row_id, row.slot]

    def _set(self, client: Client, topic: str, payload: bytes | str) -> None:
        """Set a topic that is kept; also shows whether we may write below our name at all."""
        sent = client.publish(topic, payload, qos=1, retain=True)
        self._acknowledged(client, sent, topic)

    def _acknowledged(
        self, client: Client, sent: MQTTMessageInfo, topic: str, taken: int = 0
    ) -> None:
        self._pump(client, lambda: sent.mid in self._done, ACKNOWLEDGE_S, taken)
        reason = self._done.pop(sent.mid)
        if reason.is_failure:
            self._fail(f"the broker refuses {topic}: {reason}", taken)

    def _pump(
        self, client: Client, has_come: Callable[[], bool], within_s: float, taken: int = 0
    ) -> None:
        """Let the client work until something has come. Raises NotTakenError where it does not."""
        give_up_s = time.monotonic() + within_s
        while not has_come():
            if client.loop(_WAIT_S) != 0:
                self._is_up = False
                if not has_come():
                    self._fail("the connection broke", taken)
            elif time.monotonic() > give_up_s:
                self._hang_up(client)
                self._fail(f"no answer for {within_s:.0f} s", taken)

    def _fail(self, why: str, taken: int = 0) -> None:
        msg = f"mqtt.host: {self._settings.host}: {why}"
        raise NotTakenError(msg, taken)

    # Connections

    def _connected(self) -> Client:
        """The client, connected; its session taken up again where there is one."""
        if self._client is not None and self._is_up:
            return self._client
        if self._client is None:
            self._client = self._new_client()
            self._flying.clear()
            self._done.clear()
        client, is_first = self._client, not self._knows_us
        self._connect(client, is_first=is_first)
        if not is_first and not self._answer.session_present:
            self._drop()
            self._fail("the broker has forgotten what it had not acknowledged; it is sent again")
        self._knows_us = True
        self._set(client, f"{self._topic}/status", ONLINE)
        if self._settings.home_assistant:
            for topic, payload in discovery(
                self._site, self._topic, self._settings.home_assistant_prefix, self._period_s
            ):
                self._set(client, topic, json.dumps(payload))
        self._told = None
        return client

    def _connect(self, client: Client, *, is_first: bool) -> None:
        from paho.mqtt.client import WebsocketConnectionError
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        settings = self._settings
        if settings.username is not None:
            secret = settings.password_file
            client.username_pw_set(
                settings.username,
                None if secret is None else read_secret(secret, "mqtt.password_file"),
            )
        self._answer = None
        try:
            if is_first:
                properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
                properties.SessionExpiryInterval = SESSION_S
                port = settings.port or (8883 if settings.tls else 1883)
                client.connect(str(settings.host), port, KEEPALIVE_S, properties=properties)
            else:
                client.reconnect()
        except (OSError, ValueError, WebsocketConnectionError) as error:
            refused = certificate_refused(error, "mqtt.ca_file")
            self._fail(refused or str(error) or type(error).__name__)
        self._pump(client, lambda: self._answer is not None, CONNECT_S)
        if not self._is_up:
            self._fail(f"refused: {self._answer.reason}")

    def _new_client(self) -> Client:
        import paho.mqtt.client as mqtt
        from paho.mqtt.enums import CallbackAPIVersion

        settings = self._settings
        client = mqtt.Client(
            CallbackAPIVersion.VERSION2,
            client_id=f"dcam-{slug(self._site)}",
            protocol=mqtt.MQTTv5,
            reconnect_on_failure=False,
        )
        client.connect_timeout = CONNECT_S
        client.max_inflight_messages_set(IN_FLIGHT)
        client.will_set(f"{self._topic}/status", OFFLINE, qos=1, retain=True)
        if settings.tls:
            keys = {f"mqtt.{key}": getattr(settings, key) for key in _TLS_FILES}
            if missing := missing_file(keys):
                raise NotTakenError(missing)
            try:
                files = (settings.ca_file, settings.cert_file, settings.key_file)
                authority, certificate, key = (None if one is None else str(one) for one in files)
                client.tls_set(authority, certificate, key)
            except (OSError, ValueError, ssl.SSLError) as error:
                self._fail(f"mqtt.ca_file, mqtt.cert_file: {error}")
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_publish = self._on_publish
        self._knows_us = False
        return client

    def _hang_up(self, client: Client) -> None:
        """End a connection that does not answer; the session stays."""
        if (wire := client.socket()) is not None:
            wire.close()
        self._is_up = False

    def _drop(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            client.disconnect()
            client.loop_misc()
        self._is_up, self._knows_us = False, False

    # What the client tells while it works

    def _on_connect(
        self, _client: Client, _data: object, flags: Any, reason: Any, _properties: object
    ) -> None:
        self._is_up = not reason.is_failure
        self._answer = _Answer(bool(flags.session_present), str(reason))

    def _on_disconnect(
        self, _client: Client, _data: object, _flags: object, reason: Any, _properties: object
    ) -> None:
        self._is_up = False
        if self._answer is None:
            self._answer = _Answer(session_present=False, reason=str(reason))

    def _on_publish(
        self, _client: Client, _data: object, mid: int, reason: Any, _properties: object
    ) -> None:
        self._done[mid] = reason


class _Answer:
    """What the broker said to a connection."""

    __slots__ = ("reason", "session_present")

    def __init__(self, session_present: bool, reason: str) -> None:
        self.session_present, self.reason = session_present, reason
