"""HiPNUC modules over Modbus RTU (manual B, chapter on Modbus)."""
