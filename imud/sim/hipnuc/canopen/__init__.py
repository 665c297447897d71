"""A simulated HiPNUC module on CAN, CANopen."""
