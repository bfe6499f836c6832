"""Sensors whose readings stand beside a measurement: files, commands, Modbus."""
