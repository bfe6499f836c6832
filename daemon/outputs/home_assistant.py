"""What Home Assistant needs to show a site: one device, found by itself over MQTT.

https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from daemon.outputs.row_fields import slug
from daemon.version import VERSION

STALE_PERIODS = 10
"""Without a new row for so many periods a value is unavailable, as `status` calls it critical."""

_DISTANCE = {"device_class": "distance", "unit_of_measurement": "mm"}
_NUMBERS: tuple[tuple[str, str, str, dict[str, Any]], ...] = (
    ("x", "Displacement x", "x_mm", {**_DISTANCE, "suggested_display_precision": 3}),
    ("y", "Displacement y", "y_mm", {**_DISTANCE, "suggested_display_precision": 3}),
    (
        "sigma_x",
        "Displacement x, 1 sigma",
        "sigma_x_mm",
        {**_DISTANCE, "suggested_display_precision": 3},
    ),
    (
        "sigma_y",
        "Displacement y, 1 sigma",
        "sigma_y_mm",
        {**_DISTANCE, "suggested_display_precision": 3},
    ),
    (
        "temperature_main",
        "Main camera temperature",
        "main_temperature_c",
        {"device_class": "temperature", "unit_of_measurement": "°C"},
    ),
)


def discovery(
    site: str, topic: str, prefix: str, period_s: int
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Give topic and payload of what is to be kept at the broker."""
    name = f"dcam_{slug(site)}"
    components: dict[str, dict[str, Any]] = {
        key: {
            "platform": "sensor",
            "name": title,
            "unique_id": f"{name}_{key}",
            "state_class": "measurement",
            # A value that is withheld is null: Home Assistant shows it as unknown.
            "value_template": f"{{{{ value_json.{field} }}}}",
            **more,
        }
        for key, title, field, more in _NUMBERS
    }
    components["quality"] = {
        "platform": "sensor",
        "name": "Quality",
        "unique_id": f"{name}_quality",
        "device_class": "enum",
        "options": ["good", "suspect", "bad", "missing"],
        "value_template": "{{ value_json.quality }}",
    }
    components["slot"] = {
        "platform": "sensor",
        "name": "Last slot",
        "unique_id": f"{name}_slot",
        "device_class": "timestamp",
        "value_template": "{{ value_json.slot_utc }}",
    }
    for component in components.values():
        component |= {"state_topic": f"{topic}/latest", "expire_after": STALE_PERIODS * period_s}
    payload = {
        "device": {"identifiers": [name], "name": site, "model": "dcam", "sw_version": VERSION},
        "origin": {"name": "dcam", "sw_version": VERSION},
        "availability": [{"topic": f"{topic}/status"}],
        "components": components,
        "qos": 1,
    }
    yield f"{prefix}/device/{name}/config", payload
