"""Rows sent on, each once: MQTT, InfluxDB, Prometheus over HTTP."""
