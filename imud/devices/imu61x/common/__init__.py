"""What the IMU61x protocols share: models, registers."""
