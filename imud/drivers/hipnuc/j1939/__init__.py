"""HiPNUC devices on SAE J1939."""
