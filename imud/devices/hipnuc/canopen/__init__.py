"""HiPNUC modules over CANopen."""
