"""HiPNUC devices on CANopen."""
