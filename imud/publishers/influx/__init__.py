"""Output `influx`: samples, ledgers and events as line protocol of InfluxDB."""
