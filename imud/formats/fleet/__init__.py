"""Messages of gateways over MQTT: topics, the ledger in every message, payloads. No I/O."""
