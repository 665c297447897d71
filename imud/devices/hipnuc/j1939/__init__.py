"""HiPNUC modules over SAE J1939."""
