"""HiPNUC modules over NMEA 2000."""
