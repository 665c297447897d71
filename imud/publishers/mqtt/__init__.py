"""Samples, statistics, events and status to an MQTT broker, through a spool on disk that loses nothing."""
