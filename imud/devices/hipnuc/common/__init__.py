"""Parts that the HiPNUC protocols share: units of raw values, registers, assembly of samples from frames."""
