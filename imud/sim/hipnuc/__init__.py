"""Simulated HiPNUC modules, one module or folder per protocol, as in `imud.devices.hipnuc`."""
