"""NMEA 0183: attitude and heading for plotters, autopilots, OpenCPN, Signal K and gpsd."""
