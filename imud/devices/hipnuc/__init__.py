"""HiPNUC CH0x0, CH10x, HI14: IMU configuration manual V1.5.9."""
