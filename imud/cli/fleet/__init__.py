"""`imud fleet`: what gateways send over MQTT, collected or shown."""
