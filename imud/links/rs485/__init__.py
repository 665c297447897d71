"""Serial lines that several devices share, half-duplex."""
